"""Import of a recording of another program into ``pulls/NAME``."""

import re
import shutil
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError, Option, Text
from limber.core.files.safe_names import refuse_links
from limber.core.files.tables import write_table
from limber.recordings.bag_pull import pull_of_bag
from limber.recordings.bag_reader import LIMBER, Bag, read_bag
from limber.recordings.force_slope import (
    WHY_NO_MODULUS,
    ForceTable,
    force_slope,
    read_force_displacement,
)
from limber.recordings.image_folders import copy_clouds, copy_rgbd, moved_into
from limber.recordings.import_request import (
    ImportRequest,
    of_known_robot,
    require_near,
    require_no_slip,
    require_on_branch,
)
from limber.recordings.markers_under_load import (
    import_gauge,
    import_load,
    require_loadable,
)
from limber.recordings.recording import (
    POSE_COLUMNS,
    WRENCH_COLUMNS,
    Observations,
    Pull,
    PullEntry,
    calibration_of,
    entry_of_text,
    no_pose,
    read_pull,
    write_entry,
    write_pull,
)
from limber.recordings.recording_formats import (
    RECORDINGS,
    RecordingFormat,
    recording_format,
)
from limber.recordings.robot_tables import is_robot_table, robot_stream, with_columns
from limber.recordings.sensor_checks import clean
from limber.recordings.synchronisation import DETERMINED_S, estimate_offset
from limber.recordings.tables import (
    LENGTH_UNITS_M,
    Title,
    marker_stream,
    marker_tracks,
    read_table,
    split_title,
)
from limber.recordings.time_series import MAD_TO_SIGMA, Stream

# Detection and reading of recordings other than bags: folders, tables, logs.


def read_folder(path: Path, request: ImportRequest) -> Pull:
    """Copy a folder in the pull format and read it."""
    refuse_links(path)
    shutil.copytree(path, request.folder, dirs_exist_ok=True)
    return read_pull(request.folder)


def read_rgbd(path: Path, request: ImportRequest) -> list[str]:
    """Copy a folder of depth images; return warnings."""
    return copy_rgbd(path, request.folder, request.settings, request.progress)


def read_clouds(path: Path, request: ImportRequest) -> list[str]:
    """Copy a folder of clouds; return warnings."""
    return copy_clouds(path, request.folder, request.settings, request.progress)


def is_force_table(path: Path) -> bool:
    """Whether it is a table of displacement and force."""
    names = [title.name.lower() for title in _titles(path)]
    moved = any(re.search(r"displacement|travel|stroke|deflection", name) for name in names)
    return moved and any(re.search(r"force|load", name) for name in names)


def read_force_table(path: Path, request: ImportRequest) -> ForceTable:
    """Return displacements [m] and forces [N]."""
    return read_force_displacement(path, unit=request.settings.unit,
                                   force_unit=request.settings.force_unit)


def is_robot_log(path: Path) -> bool:
    """Whether it is a table of a gripper's position and force."""
    return is_robot_table(_titles(path))


def read_robot(path: Path, request: ImportRequest) -> Stream:
    """Return the gripper's poses and the wrenches about them, in the branch's frame."""
    settings = request.settings
    robot = robot_stream(path, settings.force_unit, settings.rate_hz)
    stream = with_columns(robot, POSE_COLUMNS + WRENCH_COLUMNS)
    if settings.frame_pose is None:
        return stream
    moved = moved_into(settings.frame_pose, stream.values[:, :6], stream.values[:, 6:])
    return Stream(stream.times, np.hstack(moved), stream.columns, stream.warnings)


def read_markers(path: Path, request: ImportRequest) -> tuple[Stream, list[str]]:
    """Return tracks of markers [m], and their labels."""
    return marker_stream(path, request.settings.unit, request.settings.rate_hz)


def _titles(path: Path) -> list[Title]:
    return _titles_of(path, path.stat().st_mtime_ns)


@lru_cache(maxsize=1)
def _titles_of(path: Path, _changed: int) -> list[Title]:
    """The columns of a table, used by several formats; none if it is no table."""
    try:
        return [split_title(title) for title in read_table(path).titles]
    except InputError:
        return []


def import_recording(kind: str, request: ImportRequest) -> dict[str, Any]:
    """Import a recording into the folder of a pull, in the pull format.

    Args:
        kind: The name of its format among :data:`~.formats.RECORDINGS`.
        request: The import's source, target and settings.

    Returns:
        ``frame_count``, ``point_count``, ``time_offset_s``; for a steady load ``displacement_m``,
        ``settled_s`` and ``registration_rms_m``; for a force table without a mesh or the
        position of the load ``slope_n_per_m``, ``slope_interval_n_per_m`` and ``why_no_modulus``.

    Raises:
        InputError: the recording cannot be read as its stated kind.
    """
    request.progress(0.1, f"reading {kind}")
    chosen, settings = recording_format(kind), request.settings
    if chosen.holds == "force":
        table = _read(chosen, request)
        if table.distance is not None and not request.stated & {"grasp_point", "grasp_distance"}:
            request = replace(request, settings=settings.model_copy(
                update={"grasp_distance": table.distance}))
        is_placed = request.branch.nodes is not None and (
            request.stated & {"grasp_point", "grasp_distance"})
        return (import_gauge if is_placed else _import_force)(table, request)
    if settings.weight is not None or settings.load is not None:
        require_loadable(chosen, request)
        return import_load(_read(chosen, request), request)
    return _import_motion(chosen, replace(request, progress=request.progress.part(0.1, 1.0)))


def _read(chosen: RecordingFormat, request: ImportRequest) -> Any:
    read = RECORDINGS.read_as(chosen, request.source, request=request)
    if chosen.holds == "markers":
        stream, labels = read
        points = stream.values.reshape(len(stream), -1, 3)
        moved = request.markers_in_branch(points).reshape(stream.values.shape)
        return replace(stream, values=moved), labels
    return read


def _import_force(read: ForceTable, request: ImportRequest) -> dict[str, Any]:
    displacement, force = read.displacement, read.force
    found = force_slope(displacement, force, warnings=read.warnings)
    for message in found.warnings:
        request.progress.warn(message)
    request.progress.warn(f"{request.source.name} does not give a modulus. {WHY_NO_MODULUS}")
    write_table(request.folder / "force.csv", ("displacement_m", "force_n"),
                zip(displacement, force, strict=True))
    return {"slope_n_per_m": found.slope, "slope_interval_n_per_m": list(found.interval),
            "contact_m": found.contact, "contact_seen": found.contact_seen,
            "baseline_n": found.baseline, "stiffening": found.stiffening,
            "slips_m": list(found.slips), "slope_before_slip_n_per_m": found.slope_before_slip,
            "return_slope_n_per_m": found.return_slope, "energy_lost": found.energy_lost,
            "frame_count": len(force), "why_no_modulus": WHY_NO_MODULUS}


def _import_motion(chosen: RecordingFormat, request: ImportRequest) -> dict[str, Any]:
    is_whole = chosen.holds == "pull"
    pull = _read(chosen, request) if is_whole else _assembled(chosen, request)
    if request.replaced:
        pull = replace(pull, entry=request.as_stated(pull.entry))
    if not (request.folder / "pull.toml").exists():
        write_pull(request.folder, pull)
    elif request.replaced:
        write_entry(request.folder / "pull.toml", pull.entry)
    cleaned = clean(pull)
    for message in cleaned.warnings:
        request.progress.warn(message)
    entry, seen = pull.entry, cleaned.observations
    if not is_whole and request.settings.time_offset is None and seen is not None:
        entry = _with_offset(cleaned, seen.times, request)
        write_entry(request.folder / "pull.toml", entry)
    return {"frame_count": len(seen.times) if seen is not None else len(pull.times),
            "point_count": seen.point_count if seen is not None else 0,
            "time_offset_s": entry.time_offset_s}


def _with_offset(pull: Pull, seen: np.ndarray, request: ImportRequest) -> PullEntry:
    """The pull's entry with the clocks' offset, if the recording determines it.

    Args:
        seen: Times of the observations [s].
    """
    offset = 0.0
    if np.isin(np.round(seen, 6), np.round(pull.times, 6)).all():
        request.progress.warn(
            f"{pull.name}: gripper and observations have the same time stamps, so one clock is "
            "assumed. If there were two, state ", Option("time_offset"), ".")
        return pull.entry
    if seen[-1] < pull.times[0] or seen[0] > pull.times[-1]:
        offset = float(pull.times[0] - seen[0])
        request.progress.warn(
            f"{pull.name}: the times of the two recordings do not overlap. They are assumed to "
            "start together, and the offset was estimated from there.")
    entry = pull.entry.model_copy(update={"time_offset_s": offset})
    found, sigma = estimate_offset(replace(pull, entry=entry))
    if sigma < DETERMINED_S:
        request.progress.warn(
            f"{pull.name}: the clocks' offset was found from the motion: {found:.4f} s (standard "
            f"deviation {1e3 * sigma:.1f} ms) is added to the observations' times. If the clocks "
            "are one, state ", Option("time_offset", 0), ".")
        known = calibration_of(entry)
        is_wider = sigma > known.clock_sigma_s > 0
        return entry.model_copy(update={"time_offset_s": found} | ({
            "calibration": known.model_copy(update={"clock_sigma_s": sigma})} if is_wider else {}))
    request.progress.warn(
        f"{pull.name}: the offset between the clocks cannot be determined from this pull. "
        f"{offset:g} s is assumed.")
    return entry


def _assembled(chosen: RecordingFormat, request: ImportRequest) -> Pull:
    """The pull of the branch's observations, or of the robot's log, and the robot's table."""
    if chosen.holds == "robot" and request.settings.robot is not None:
        raise InputError(
            Text(f"{request.source.name} holds a gripper's positions and forces, and ",
                 Option("robot"), " was given as well."), "The two tables are likely exchanged.",
            "Give the markers as SOURCE, and ", Option("robot", request.source.name), ".")
    found, settings = _read(chosen, request), request.settings
    observations: Observations | None = None
    rest: np.ndarray | None = None
    messages: list[str] = []
    if chosen.holds == "markers":
        observations, rest, messages = _seen(found, request)
    elif chosen.holds != "robot":
        messages = found
    robot: Stream = found if chosen.holds == "robot" else _gripper(request)
    poses, wrenches = (np.ascontiguousarray(part) for part in np.hsplit(robot.values, 2))
    if not np.isfinite(poses).all(axis=1).any():
        raise no_pose(Path(request.settings.robot or request.source))
    entry = request.entry(
        "none" if chosen.holds == "robot" else chosen.holds, rest, drive=settings.drive,
        mode=settings.grasp_mode, sigma=settings.position_sigma or 1e-3,
        grasp=request.grasp_or(lambda: poses[np.isfinite(poses).all(axis=1)][0]))
    pull = require_no_slip(Pull(request.name, entry, robot.times, poses, wrenches, observations,
                                (*messages, *robot.warnings)))
    require_on_branch(entry.grasp, request.name, request.branch)
    return of_known_robot(pull, request) if chosen.holds == "robot" else pull


def _gripper(request: ImportRequest) -> Stream:
    if request.settings.robot is None:
        raise InputError("No robot table was given.", "A pull needs the gripper's pose, and its "
                         "force where measured.", "Give the table with ", Option("robot"),
                         " ROBOT.csv, or a hung weight with ", Option("weight"), ".")
    return read_robot(Path(request.settings.robot), request)


def _at_rest_first(seen: Observations, labels: list[str], stream: Stream, name: str,
                   ) -> tuple[Observations, np.ndarray, list[str]]:
    """The markers that the first frame shows, when the branch is at rest; those positions [m]."""
    there = seen.visible[0]
    if not there.any():
        raise InputError(f"{name}: no marker is visible in the first frame.",
                         "The markers' positions at rest are not known.",
                         "Start the recording before the pull, or give ", Option("nominal"), ".")
    unseen = [label for label, here in zip(labels, there, strict=True) if not here]
    messages = [f"{name}: {label} is not visible in the first frame, where the branch is at rest, "
                "and was discarded." for label in unseen]
    used = seen.positions[:, there]
    return replace(seen, positions=used), used[0], [*stream.warnings, *messages]


def _seen(read: tuple[Stream, list[str]], request: ImportRequest,
          ) -> tuple[Observations, np.ndarray | None, list[str]]:
    """Markers [m], their nominal rest positions if given, and warnings."""
    stream, labels = read
    seen = Observations(stream.times, stream.values.reshape(len(stream), -1, 3))
    placed = request.registered(seen.positions[0], labels)
    if placed is None:
        if request.branch.nodes is not None:
            require_near(seen.positions[0], request.name, request.branch)
        if not request.own_markers(seen.positions):
            return seen, None, list(stream.warnings)
        return _at_rest_first(seen, labels, stream, request.name)
    moved = placed.apply(seen.positions[:, placed.used])
    return (replace(seen, positions=moved), moved[0],
            [*stream.warnings, *placed.warnings])


# C3D files of motion capture, read in a separate process.


def c3d_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the markers of a C3D file: ``points`` [3, m, n], rate, unit, labels.

    Read by compiled code, which a corrupt file may crash.
    """
    import ezc3d

    data = ezc3d.c3d(str(path))
    parameters = data["parameters"]["POINT"]
    labels = [str(label) for label in parameters["LABELS"]["value"]]
    unit = (parameters.get("UNITS", {}).get("value") or ["mm"])[0].strip()
    return {"points": np.asarray(data["data"]["points"][:3], float),
            "rate": np.array(float(data["header"]["points"]["frame_rate"])),
            "unit": np.array(unit), "labels": np.array(labels, "U64")}


def markers_of_arrays(path: Path, data: dict[str, np.ndarray], **_request: object,
                      ) -> tuple[Stream, list[str]]:
    """Return marker tracks [m] and labels of arrays from :func:`c3d_arrays`.

    Raises:
        InputError: there are no points, no times, or positions that are not finite.
    """
    points, labels = data["points"], [str(label) for label in data["labels"]]
    if not points.size:
        raise InputError(f"{path} has no points.", "Marker tracks were expected.",
                         "Export the trajectories too.")
    scale = LENGTH_UNITS_M.get(str(data["unit"]).lower(), 1e-3)
    rate = float(data["rate"])
    if not (np.isfinite(rate) and rate > 0) or np.isinf(points).any():
        raise InputError(f"{path} has a rate of {rate:g} frames per second, or positions that are "
                         "not finite.",
                         "A motion needs valid times and positions.", "Export it again.")
    positions = np.moveaxis(points, 0, -1).transpose(1, 0, 2) * scale
    times = np.arange(len(positions)) / rate
    return marker_tracks(times, positions), labels[:positions.shape[1]]


# Import of a bag into the pull format, including Limber's own records in it.


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
                         "Start the recording before the pull, or give ", Option("nominal"), ".")
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
