"""Import of a bag into the pull format, including Limber's own records in it."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.recordings.bags.bag_pull import pull_of_bag
from limber.recordings.bags.bag_reader import LIMBER, Bag, read_bag
from limber.recordings.importing.import_request import (
    ImportRequest,
    of_known_robot,
    require_near,
    require_on_branch,
)
from limber.recordings.recording import Observations, Pull, PullEntry, entry_of_text
from limber.recordings.time_series import MAD_TO_SIGMA


def read_bag_pull(path: Path, request: ImportRequest) -> Pull:
    """Return the pull in a bag; images and clouds go into the pull's folder.

    Raises:
        InputError: see :func:`.bag_reader.read_bag` and :func:`.bag_pull.pull_of_bag`; or no
            marker is seen in the first frame.
    """
    bag, robot, asked = read_bag(path), request.robot, request
    found = pull_of_bag(bag, request.folder, request.settings,
                        None if robot is None else robot.joint_poses, request.progress)
    recorded, warnings = _recorded_by_limber(bag)
    poses, wrenches = found.robot.values[:, :6], found.robot.values[:, 6:]
    if request.settings.torque_sigma is None:
        request = replace(request, settings=request.settings.model_copy(update={
            "torque_sigma": _torque_noise(wrenches[:, 3:])}))
    seen, rest = (None, None) if found.seen is None else _markers(found.seen, recorded, request)
    settings = request.settings
    entry = request.entry(found.observation, rest, drive=settings.drive, mode=settings.grasp_mode,
                          grasp=request.grasp_or(lambda: poses[0]),
                          sigma=settings.position_sigma or 1e-3)
    if recorded is not None:
        entry = _with_recorded(entry, recorded, request)
    require_on_branch(entry.grasp, request.name, request.branch)
    return of_known_robot(Pull(request.name, entry, found.robot.times, poses, wrenches, seen,
                               (*found.warnings, *warnings)), asked)


def _markers(seen: Observations, recorded: PullEntry | None, request: ImportRequest,
             ) -> tuple[Observations, np.ndarray]:
    """Markers with a known rest position, and those positions [m], shape [m, 3]."""
    seen = replace(seen, positions=request.markers_in_branch(seen.positions))
    placed = request.registered(seen.positions[0], [f"m{k}" for k in range(seen.point_count)])
    at_rest = None if recorded is None or placed else recorded.rest_points_m
    known = at_rest is not None and len(at_rest) == seen.point_count
    used = placed.used if placed else np.flatnonzero(seen.visible[0] | known)
    if not len(used):
        raise InputError(f"{request.name}: no marker is visible in the first frame.",
                         "The markers' positions at rest are not known.",
                         "Start the recording before the pull, or give --nominal.")
    positions = seen.positions[:, used]
    seen = replace(seen, positions=placed.apply(positions) if placed else positions)
    rest = np.array(at_rest) if known else seen.positions[0]
    if request.branch.nodes is not None:
        require_near(rest, request.name, request.branch)
    return seen, rest


def _recorded_by_limber(bag: Bag) -> tuple[PullEntry | None, tuple[str, ...]]:
    """The description that `limber export-pull` wrote beside the messages, and its faults.
    """
    if not bag.pull_toml:
        return None, ()
    try:
        return entry_of_text(bag.pull_toml, f"{bag.path.name}, metadata {LIMBER}"), ()
    except InputError as error:
        return None, (f"{error} Default values are used for grasp, noise and calibration.",)


def _with_recorded(entry: PullEntry, recorded: PullEntry, request: ImportRequest) -> PullEntry:
    """The entry of a bag that Limber wrote; the import's settings take precedence."""
    requested = request.stated
    kept: dict[str, Any] = {
        "calibration": recorded.calibration, "weightless": recorded.weightless,
        "truth": recorded.truth,
        "source": f"{entry.source} ({recorded.source})" if recorded.source else entry.source}
    if "own_weight" not in requested:
        kept["gravity_m_s2"] = recorded.gravity_m_s2
    kept |= {name: getattr(recorded, name) for name in ("drive", "motion") if name not in requested}
    grasp: dict[str, Any] = {"mode": recorded.grasp.mode} if "grasp_mode" not in requested else {}
    if "grasp_radius" not in requested:
        grasp["radius_m"] = recorded.grasp.radius_m
    if not requested & {"grasp_point", "frame_pose", "cell"}:
        grasp["point_m"] = recorded.grasp.point_m
    sensor: dict[str, float | None] = {} if "position_sigma" in requested else {
        "position_sigma_m": recorded.sensor.position_sigma_m}
    if "force_sigma" not in requested:
        sensor["force_sigma_n"] = recorded.sensor.force_sigma_n
    if "torque_sigma" not in requested:
        sensor["torque_sigma_nm"] = recorded.sensor.torque_sigma_nm
    return entry.model_copy(update=kept | {
        "grasp": entry.grasp.model_copy(update=grasp),
        "sensor": recorded.sensor.model_copy(update={
            "position_sigma_m": entry.sensor.position_sigma_m,
            "force_sigma_n": entry.sensor.force_sigma_n,
            "torque_sigma_nm": entry.sensor.torque_sigma_nm} | sensor)})


def _torque_noise(torques: np.ndarray) -> float | None:
    """Standard deviation of measured torques [n, 3] from their steps [N m]; at least 2 % of the
    peak, a typical sensor error. None if none was measured.
    """
    peak = float(np.abs(np.nan_to_num(torques)).max(initial=0.0))
    steps = np.abs(np.diff(torques, axis=0)).ravel()
    steps = steps[np.isfinite(steps)]
    if peak < 1e-6 or not len(steps):
        return None
    return max(MAD_TO_SIGMA * float(np.median(steps)) / np.sqrt(2.0), 0.02 * peak)
