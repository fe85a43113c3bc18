"""Recordings of other programs into ``pulls/NAME``: marker tables, C3D, clouds, RGB-D folders."""

import re
import shutil
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.alignment import Alignment
from limber.core.constants import GRAVITY
from limber.core.errors import InputError
from limber.core.files.safe_names import refuse_links
from limber.core.present import present
from limber.core.progress import SILENT, Progress
from limber.geometry.io.isolated_readers import read_apart
from limber.recordings.bags.bag_pull import JointPoses, pull_of_bag
from limber.recordings.bags.bag_reader import LIMBER, Bag, is_bag, read_bag
from limber.recordings.cell_errors import WITHOUT_GRIPPER, CalibrationEntry
from limber.recordings.force_slope import WHY_NO_MODULUS, force_slope, read_force_displacement
from limber.recordings.hung_load import settled, swung
from limber.recordings.image_folders import copy_clouds, copy_rgbd, moved_into
from limber.recordings.recording import (
    POSE_COLUMNS,
    WRENCH_COLUMNS,
    GraspEntry,
    Observations,
    Pull,
    PullEntry,
    SensorEntry,
    SwingEntry,
    entry_of_text,
    read_pull,
    write_entry,
    write_pull,
)
from limber.recordings.registration import Registration, read_nominal, register
from limber.recordings.sensor_checks import clean
from limber.recordings.settings import ImportSettings
from limber.recordings.synchronisation import estimate_offset
from limber.recordings.tables import (
    LENGTH_UNITS_M,
    is_robot_table,
    marker_stream,
    read_table,
    robot_stream,
    split_title,
    with_columns,
)
from limber.recordings.time_series import MAD_TO_SIGMA, Stream


@dataclass(frozen=True)
class BranchFrame:
    """What an import must know of the branch.

    Attributes:
        alignment: From the scan's coordinates to the branch's.
        gravity: [m/s^2] in the branch's frame.
        nodes: Of its mesh [m], shape [n, 3]; a steady load asks for them. None: there is no mesh
            yet, and nothing can be held against it.
    """

    alignment: Alignment = field(default_factory=Alignment)
    gravity: tuple[float, float, float] = GRAVITY
    nodes: np.ndarray | None = None


@dataclass(frozen=True)
class RobotKnown:
    """What is known of the robot that a recording was made with.

    Attributes:
        joint_poses: Where its gripper is by its joint angles.
        noise: Of its force sensor.
        errors: What is left open of a recording of so many seconds.
    """

    joint_poses: JointPoses
    noise: SensorEntry
    errors: Callable[[float], CalibrationEntry]


def import_recording(kind: str, source: Path, folder: Path, name: str, settings: ImportSettings,
                     branch: BranchFrame, progress: Progress = SILENT, *,
                     robot: RobotKnown | None = None) -> dict[str, Any]:
    """Bring a recording into ``folder`` in the pull format.

    Args:
        kind: What SOURCE is, as :func:`kind_of` tells.
        robot: What is known of the robot, where a cell says it.

    Returns:
        ``frame_count``, ``point_count``, ``time_offset_s``; under a steady
        load ``displacement_m``, ``settled_s`` and ``registration_rms_m``; of a force table
        ``slope_n_per_m``, ``slope_interval_n_per_m`` and ``why_no_modulus``.

    Raises:
        InputError: SOURCE cannot be read as what it is said to be.
    """
    progress(0.1, f"reading {kind}")
    if kind == "force-displacement":
        return _import_force_table(source, folder, settings, progress)
    if settings.weight is not None or settings.load is not None:
        return _import_load(kind, source, folder, name, settings, branch, progress)
    return _import_motion(kind, source, folder, name, settings, branch, robot,
                          progress.part(0.1, 1.0))


def markers_from_c3d(path: Path) -> tuple[Stream, list[str]]:
    """Read the points of a C3D file [m], and their labels.

    Raises:
        InputError: not a C3D file, or one without points.
    """
    # Compiled code reads it, which a mangled file may abort.
    data = read_apart("c3d", path)
    points, labels = data["points"], [str(label) for label in data["labels"]]
    if not points.size:
        raise InputError(f"{path} has no points.", "Marker tracks were expected.",
                         "Export the trajectories as well.")
    scale = LENGTH_UNITS_M.get(str(data["unit"]).lower(), 1e-3)
    rate = float(data["rate"])
    if not (np.isfinite(rate) and rate > 0) or np.isinf(points).any():
        raise InputError(f"{path} has {rate:g} frames a second, or places that are not finite.",
                         "Without times and places there is no motion.", "Export it again.")
    positions = np.moveaxis(points, 0, -1).transpose(1, 0, 2) * scale
    # An unseen marker is written as (0, 0, 0) by many programs, as NaN by others.
    positions[np.all(positions == 0.0, axis=2)] = np.nan
    times = np.arange(len(positions)) / rate
    names = tuple(f"m{k}_{axis}_m" for k in range(positions.shape[1]) for axis in "xyz")
    return Stream(times, positions.reshape(len(times), -1), names), labels[:positions.shape[1]]


def kind_of(source: Path) -> str:
    """Return what a recording is, by its name and content."""
    if is_bag(source):
        return "bag"
    if source.is_dir():
        if (source / "pull.toml").exists():
            return "pull"
        if (source / "depth").is_dir():
            return "rgbd"
        return "clouds"
    if source.suffix.lower() == ".c3d":
        return "c3d"
    try:
        titles = read_table(source).titles
        names = [split_title(title).name.lower() for title in titles]
    except InputError:
        return "markers"
    moved = any(re.search(r"displacement|travel|stroke|deflection", name) for name in names)
    forced = any(re.search(r"force|load", name) for name in names)
    if moved and forced:
        return "force-displacement"
    return "robot" if is_robot_table([split_title(title) for title in titles]) else "markers"


def _import_force_table(source: Path, folder: Path, settings: ImportSettings, progress: Progress,
                        ) -> dict[str, Any]:
    displacement, force, warnings = read_force_displacement(
        source, unit=settings.unit, force_unit=settings.force_unit)
    found = force_slope(displacement, force, warnings=warnings)
    for message in found.warnings:
        progress.warn(message)
    progress.warn(f"No modulus from {source.name}. {WHY_NO_MODULUS}")
    table = np.column_stack([displacement, force])
    np.savetxt(folder / "force.csv", table, "%.9g", ",", header="displacement_m,force_n",
               comments="")
    return {"slope_n_per_m": found.slope, "slope_interval_n_per_m": list(found.interval),
            "contact_m": found.contact, "contact_seen": found.contact_seen,
            "baseline_n": found.baseline, "stiffening": found.stiffening,
            "slips_m": list(found.slips), "slope_before_slip_n_per_m": found.slope_before_slip,
            "return_slope_n_per_m": found.return_slope, "energy_lost": found.energy_lost,
            "frame_count": len(force), "why_no_modulus": WHY_NO_MODULUS}


def _import_motion(kind: str, source: Path, folder: Path, name: str, settings: ImportSettings,
                   branch: BranchFrame, robot: RobotKnown | None, progress: Progress,
                   ) -> dict[str, Any]:
    if kind == "pull":
        refuse_links(source)
        shutil.copytree(source, folder, dirs_exist_ok=True)
        pull = read_pull(folder)
    else:
        pull = (_of_bag(source, folder, name, settings, branch, robot, progress)
                if kind == "bag" else
                _assembled(kind, source, folder, name, settings, branch, progress))
        if kind in ("bag", "robot") and pull.entry.calibration is None:
            pull = _of_known_robot(pull, robot, settings)
        write_pull(folder, pull)
    cleaned = clean(pull)
    for message in cleaned.warnings:
        progress.warn(message)
    entry = pull.entry
    told = kind in ("pull", "bag") or settings.time_offset is not None
    seen = cleaned.observations
    if not told and seen is not None:
        entry = _with_offset(cleaned, seen.times, progress)
        write_entry(folder / "pull.toml", entry)
    return {"frame_count": len(seen.times) if seen is not None else len(pull.times),
            "point_count": seen.point_count if seen is not None else 0,
            "time_offset_s": entry.time_offset_s}


def _with_offset(pull: Pull, seen: np.ndarray, progress: Progress) -> PullEntry:
    """The pull's entry with the clocks' offset, as far as the recording tells it.

    Args:
        seen: Times of the observations [s].
    """
    offset = 0.0
    if seen[-1] < pull.times[0] or seen[0] > pull.times[-1]:
        offset = float(pull.times[0] - seen[0])
        progress.warn(
            f"{pull.name}: the two clocks have no moment in common; the recordings were taken to "
            "start together, and the offset was estimated from there.")
    entry = pull.entry.model_copy(update={"time_offset_s": offset})
    found, sigma = estimate_offset(replace(pull, entry=entry))
    if sigma < 0.02:
        return entry.model_copy(update={"time_offset_s": found})
    progress.warn(
        f"{pull.name}: the clocks' offset cannot be told from this pull; {offset:g} s was taken.")
    return entry


def _import_load(kind: str, source: Path, folder: Path, name: str, settings: ImportSettings,
                 branch: BranchFrame, progress: Progress) -> dict[str, Any]:
    """A pull of a few frames from a recording of a branch that a steady load bends."""
    if kind not in ("markers", "c3d"):
        raise InputError(f"A steady load was given, but {source.name} is {kind}.",
                         "Its rest is found in marker tracks.", "Give a CSV or C3D of markers.")
    if settings.weight is not None and settings.load is not None:
        raise InputError("Both --weight and --load were given.", "One load hangs on the branch.",
                         "Give one of them.")
    sags = settings.weight == 0 and settings.own_weight
    if settings.grasp_point is None and not sags:
        raise InputError("A load was given, but not where it hangs.",
                         "How far it bends the branch depends on that.", "Give --grasp-point.")
    if settings.motion == "dynamic":
        raise InputError("A steady load was given for a dynamic pull.",
                         "It shows a branch that is let go and swings, or that rests.",
                         "Give --motion swing and run `limber swing`; or leave --motion out, for "
                         "the place of rest.")
    seen, labels = _markers(kind, source, settings)
    for message in seen.warnings:
        progress.warn(message)
    if settings.motion == "swing":
        return _import_swing(seen, labels, source, folder, name, settings, branch, progress)
    still = settled(Observations(seen.times, seen.values.reshape(len(seen), -1, 3)), name)
    placed = _registered(still.rest, labels, name, settings, branch)
    used = placed.used if placed else np.flatnonzero(np.isfinite(still.rest).all(axis=1))
    rest, positions = still.rest[used], still.positions[:, used]
    if placed:
        rest, positions = placed.apply(rest), placed.apply(positions)
    for message in (*still.warnings, *(placed.warnings if placed else ())):
        progress.warn(message)
    nodes = present(branch.nodes, "mesh of the branch")
    _require_near(rest, name, nodes)
    sigma = settings.position_sigma or still.sigma(placed.rms if placed else 1e-3)
    load = _load(settings, branch)
    moved = positions[-1] - rest
    # Of the branch's own weight alone no load hangs anywhere: where it is seen to sag most.
    grasp = (_nearest(nodes, rest[_farthest(moved[None])])
             if settings.grasp_point is None else _place(settings.grasp_point, settings, branch))
    entry = _entry("markers", source, settings, branch, rest, drive="force", mode="pinned",
                   grasp=grasp, sigma=sigma)
    entry = entry.model_copy(update={"calibration": WITHOUT_GRIPPER})
    _write_loaded(folder, name, entry, load, Observations(still.times, positions), branch)
    if suspicion := _against(moved, load):
        progress.warn(f"{name}: {suspicion}")
    return {"frame_count": len(still.times), "point_count": len(used), "time_offset_s": 0.0,
            "labels": [labels[k] for k in used], "load_n": load.tolist(),
            "displacement_m": moved.tolist(), "settled_s": still.duration,
            "registration_rms_m": placed.rms if placed else None, "position_sigma_m": sigma}


def _write_loaded(folder: Path, name: str, entry: PullEntry, load: np.ndarray,
                  seen: Observations, branch: BranchFrame) -> None:
    """Write a pull without a robot: a steady load [N], shape [3], where the grasp is."""
    _require_on_branch(entry.grasp, name, branch.nodes)
    poses = np.zeros((2, 6))
    poses[:, :3] = entry.grasp.point_m
    wrenches = np.tile(np.r_[load, 0.0, 0.0, 0.0], (2, 1))
    write_pull(folder, Pull(name, entry, seen.times[[0, -1]], poses, wrenches, seen))


def _import_swing(stream: Stream, labels: list[str], source: Path, folder: Path, name: str,
                  settings: ImportSettings, branch: BranchFrame, progress: Progress,
                  ) -> dict[str, Any]:
    """A branch that is let go: all frames, the load, and what swings with it."""
    seen = Observations(stream.times, stream.values.reshape(len(stream), -1, 3))
    rest, noise = swung(seen, settings.swing_start, name)
    placed = _registered(rest, labels, name, settings, branch)
    used = placed.used if placed else np.flatnonzero(np.isfinite(rest).all(axis=1))
    rest, positions = rest[used], seen.positions[:, used]
    if placed:
        rest, positions = placed.apply(rest), placed.apply(positions)
    for message in placed.warnings if placed else ():
        progress.warn(message)
    nodes = present(branch.nodes, "mesh of the branch")
    _require_near(rest, name, nodes)
    load, mass = _load(settings, branch), 0.0
    if settings.weight is not None and settings.swing_start == "held":
        mass = settings.weight / float(np.linalg.norm(branch.gravity))
    # As for a steady load: of its own weight alone, where it is seen to swing farthest.
    grasp = (_nearest(nodes, rest[_farthest(positions - rest)]) if settings.grasp_point is None
             else _place(settings.grasp_point, settings, branch))
    entry = _entry("markers", source, settings, branch, rest, drive="force", mode="pinned",
                   grasp=grasp, sigma=settings.position_sigma or noise)
    entry = entry.model_copy(update={"calibration": WITHOUT_GRIPPER, "swing": SwingEntry(
        start=settings.swing_start, load_mass_kg=mass, noise_m=noise,
        registration_m=placed.rms if placed else None)})
    _write_loaded(folder, name, entry, load, Observations(seen.times, positions), branch)
    return {"frame_count": len(seen.times), "point_count": len(used), "time_offset_s": 0.0,
            "labels": [labels[k] for k in used], "load_n": load.tolist(), "load_mass_kg": mass,
            "registration_rms_m": placed.rms if placed else None}


def _require_on_branch(grasp: GraspEntry, name: str, nodes: np.ndarray | None) -> None:
    """Refuse a grasp in the air beside the branch.

    Raises:
        InputError: no node lies within two grasp radii (and 5 mm) of it.
    """
    if nodes is None:
        return
    off = float(np.linalg.norm(nodes - np.array(grasp.point_m), axis=1).min())
    if off > 2 * grasp.radius_m + 5e-3:
        place = ", ".join(f"{value:.4g}" for value in grasp.point_m)
        raise InputError(
            f"{name}: the grasp point ({place}) m lies {off * 1e3:.0f} mm from the branch.",
            "The gripper would hold nothing: the point, or the whole recording, is in another "
            "frame of reference or unit.",
            "Give --grasp-point on the branch (in the frame that --coordinates says), and check "
            "--unit.")


def _nearest(nodes: np.ndarray, place: np.ndarray) -> tuple[float, float, float]:
    """The node nearest to a place [m]."""
    x, y, z = nodes[np.linalg.norm(nodes - place, axis=1).argmin()]
    return float(x), float(y), float(z)


def _farthest(moved: np.ndarray) -> int:
    """Which marker is seen to move farthest, by displacements [m], shape [frames, m, 3]."""
    # A marker out of sight has not been seen to move.
    return int(np.nan_to_num(np.linalg.norm(moved, axis=2)).max(axis=0).argmax())


def _require_near(rest: np.ndarray, name: str, nodes: np.ndarray) -> None:
    """Refuse markers that lie elsewhere than the branch, as those of a capture's own frame do.

    Raises:
        InputError: one is farther from the mesh than a quarter of its extent.
    """
    off = np.array([np.linalg.norm(nodes - point, axis=1).min() for point in rest])
    extent = float(np.linalg.norm(np.ptp(nodes, axis=0)))
    if off.max() > 0.25 * extent:
        raise InputError(
            f"{name}: at rest a marker lies {off.max() * 1e3:.0f} mm from the branch, which is "
            f"{extent * 1e3:.0f} mm long.",
            "The recording is in another frame of reference, or in another unit.",
            "Say with --nominal where on the branch the markers are, and check --unit.")


def _against(moved: np.ndarray, load: np.ndarray) -> str:
    """Say it where markers go against the load (displacements [m], load [N]); across it is well:
    an upright branch gives way to a weight sideways.
    """
    size = np.linalg.norm(moved, axis=1)
    mean = moved[size >= 0.5 * np.nanmax(size)].mean(axis=0)
    turn = np.degrees(np.arccos(np.clip(
        mean @ load / max(np.linalg.norm(mean) * np.linalg.norm(load), 1e-12), -1, 1)))
    if turn < 100:
        return ""
    return (f"the markers move at {turn:.0f} degrees to the load. Is the recording in the "
            "branch's frame (--nominal), and does the load pull that way?")


def _load(settings: ImportSettings, branch: BranchFrame) -> np.ndarray:
    """Force on the branch [N] in the branch's frame, shape [3]."""
    if settings.load is None:
        down = np.array(branch.gravity)
        return settings.weight * down / np.linalg.norm(down)
    turn = np.array(branch.alignment.rotation)
    return turn @ settings.load if settings.coordinates == "scan" else np.array(settings.load)


def _point(pose: np.ndarray) -> tuple[float, float, float]:
    """The place [m] of a pose."""
    x, y, z = map(float, pose[:3])
    return x, y, z


def _place(point: tuple[float, float, float], settings: ImportSettings, branch: BranchFrame,
           ) -> tuple[float, float, float]:
    """A point [m] of the user's frame in the branch's."""
    x, y, z = _in_branch(np.array([point]), settings, branch)[0]
    return float(x), float(y), float(z)


def _in_branch(points: np.ndarray, settings: ImportSettings, branch: BranchFrame) -> np.ndarray:
    alignment = branch.alignment
    return alignment.apply(points / alignment.scale) if settings.coordinates == "scan" else points


def _markers(kind: str, source: Path, settings: ImportSettings) -> tuple[Stream, list[str]]:
    if kind == "c3d":
        return markers_from_c3d(source)
    return marker_stream(source, settings.unit, settings.rate_hz)


def _registered(rest: np.ndarray, labels: list[str], name: str, settings: ImportSettings,
                branch: BranchFrame) -> Registration | None:
    if settings.nominal is None:
        return None
    known, nominal = read_nominal(Path(settings.nominal))
    return register(rest, labels, known, _in_branch(nominal, settings, branch), name)


def _assembled(kind: str, source: Path, folder: Path, name: str, settings: ImportSettings,
               branch: BranchFrame, progress: Progress) -> Pull:
    observations: Observations | None = None
    rest: np.ndarray | None = None
    messages: list[str] = []
    if kind == "robot":
        settings = settings.model_copy(update={"robot": str(source)})
    elif kind in ("markers", "c3d"):
        stream, labels = _markers(kind, source, settings)
        messages += stream.warnings
        observations = Observations(stream.times, stream.values.reshape(len(stream), -1, 3))
        placed = _registered(observations.positions[0], labels, name, settings, branch)
        if placed:
            moved = placed.apply(observations.positions[:, placed.used])
            observations, rest = replace(observations, positions=moved), moved[0]
            messages += placed.warnings
    else:
        copy = copy_rgbd if kind == "rgbd" else copy_clouds
        messages += copy(source, folder, settings, progress)
    if settings.robot is None:
        raise InputError("No robot table was given.",
                         "A pull needs what the gripper did: pose, and force where measured.",
                         "Give it with --robot ROBOT.csv; a hung weight with --weight.")
    robot = robot_stream(settings.robot, settings.force_unit, settings.rate_hz)
    messages += robot.warnings
    poses = with_columns(robot, POSE_COLUMNS).values
    wrenches = with_columns(robot, WRENCH_COLUMNS).values
    if settings.frame_pose is not None:
        poses, wrenches = moved_into(settings.frame_pose, poses, wrenches)
    grasp = (_place(settings.grasp_point, settings, branch) if settings.grasp_point
             else _point(poses[np.isfinite(poses).all(axis=1)][0]))
    observation = {"rgbd": "depth", "clouds": "clouds", "robot": "none"}.get(kind, "markers")
    entry = _entry(observation, source, settings, branch, rest, drive=settings.drive,
                   mode=settings.grasp_mode, grasp=grasp, sigma=settings.position_sigma or 1e-3)
    _require_on_branch(entry.grasp, name, branch.nodes)
    return Pull(name, entry, robot.times, poses, wrenches, observations, tuple(messages))


def _of_known_robot(pull: Pull, robot: RobotKnown | None, settings: ImportSettings) -> Pull:
    """The pull with what its robot's cell leaves open; without a cell it is said what is taken."""
    if robot is None:
        taken = CalibrationEntry()
        return pull.warned(
            f"{pull.name}: nothing says how well gripper and force sensor are known. Taken: the "
            f"gripper's frame within {1e3 * taken.pose_sigma_m:g} mm and "
            f"{np.degrees(taken.pose_sigma_rad):.1g} degrees, the force within "
            f"{100 * taken.force_gain_sigma:g} %, its zero within {taken.force_bias_sigma_n:g} N "
            f"and its drift within {taken.force_drift_sigma_n:g} N, all standard deviations; the "
            "interval of an estimate is as wide. Give --cell with the robot's cell file.")
    sensor = pull.entry.sensor.model_copy(update={
        "force_range_n": robot.noise.force_range_n,
        **({} if "force_sigma" in _given(settings) else {
            "force_sigma_n": robot.noise.force_sigma_n}),
        **({} if settings.torque_sigma is not None or pull.entry.sensor.torque_sigma_nm is None
           else {"torque_sigma_nm": robot.noise.torque_sigma_nm})})
    return replace(pull, entry=pull.entry.model_copy(update={
        "sensor": sensor, "calibration": robot.errors(float(pull.times[-1] - pull.times[0]))}))


def _given(settings: ImportSettings) -> set[str]:
    """What of the settings is not as it is without being asked for."""
    return {name for name, field in ImportSettings.model_fields.items()
            if getattr(settings, name) != field.default}


def _of_bag(source: Path, folder: Path, name: str, settings: ImportSettings, branch: BranchFrame,
            robot: RobotKnown | None, progress: Progress) -> Pull:
    bag = read_bag(source)
    found = pull_of_bag(bag, folder, settings, None if robot is None else robot.joint_poses,
                        progress)
    told, warnings = _told_by_limber(bag)
    poses, wrenches = found.robot.values[:, :6], found.robot.values[:, 6:]
    if settings.torque_sigma is None:
        settings = settings.model_copy(update={"torque_sigma": _torque_noise(wrenches[:, 3:])})
    seen, rest = found.seen, None
    if seen is not None:
        placed = _registered(seen.positions[0], [f"m{k}" for k in range(seen.point_count)], name,
                             settings, branch)
        at_rest = None if told is None or placed else told.rest_points_m
        known = at_rest is not None and len(at_rest) == seen.point_count
        used = placed.used if placed else np.flatnonzero(seen.visible[0] | known)
        if not len(used):
            raise InputError(f"{name}: no marker is seen in the first frame.",
                             "Where each is at rest is not known.",
                             "Record from before the pull, or give --nominal.")
        positions = seen.positions[:, used]
        seen = replace(seen, positions=placed.apply(positions) if placed else positions)
        rest = np.array(at_rest) if known else seen.positions[0]
        if branch.nodes is not None:
            _require_near(rest, name, branch.nodes)
    grasp = (_place(settings.grasp_point, settings, branch) if settings.grasp_point
             else _point(poses[0]))
    entry = _entry(found.observation, source, settings, branch, rest, drive=settings.drive,
                   mode=settings.grasp_mode, grasp=grasp, sigma=settings.position_sigma or 1e-3)
    if told is not None:
        entry = _as_told(entry, told, settings)
    _require_on_branch(entry.grasp, name, branch.nodes)
    return Pull(name, entry, found.robot.times, poses, wrenches, seen,
                (*found.warnings, *warnings))


def _told_by_limber(bag: Bag) -> tuple[PullEntry | None, tuple[str, ...]]:
    """What `limber export-pull` wrote of the pull beside its messages, and what was wrong with it.
    """
    if not bag.pull_toml:
        return None, ()
    try:
        return entry_of_text(bag.pull_toml, f"{bag.path.name}, metadata {LIMBER}"), ()
    except InputError as error:
        return None, (f"{error} Grasp, noise and calibration are taken as of a bag that does not "
                      "say them.",)


def _as_told(entry: PullEntry, told: PullEntry, settings: ImportSettings) -> PullEntry:
    """The entry of a bag that Limber wrote; what the settings ask for goes before."""
    given = _given(settings)
    kept: dict[str, Any] = {
        "calibration": told.calibration, "weightless": told.weightless, "truth": told.truth,
        "source": f"{entry.source} ({told.source})" if told.source else entry.source}
    if "own_weight" not in given:
        kept["gravity_m_s2"] = told.gravity_m_s2
    kept |= {name: getattr(told, name) for name in ("drive", "motion") if name not in given}
    grasp: dict[str, Any] = {"mode": told.grasp.mode} if "grasp_mode" not in given else {}
    if "grasp_radius" not in given:
        grasp["radius_m"] = told.grasp.radius_m
    if not given & {"grasp_point", "frame_pose", "cell"}:
        grasp["point_m"] = told.grasp.point_m
    sensor: dict[str, float | None] = {} if "position_sigma" in given else {
        "position_sigma_m": told.sensor.position_sigma_m}
    if "force_sigma" not in given:
        sensor["force_sigma_n"] = told.sensor.force_sigma_n
    if "torque_sigma" not in given:
        sensor["torque_sigma_nm"] = told.sensor.torque_sigma_nm
    return entry.model_copy(update=kept | {
        "grasp": entry.grasp.model_copy(update=grasp),
        "sensor": told.sensor.model_copy(update={
            "position_sigma_m": entry.sensor.position_sigma_m,
            "force_sigma_n": entry.sensor.force_sigma_n,
            "torque_sigma_nm": entry.sensor.torque_sigma_nm} | sensor)})


def _torque_noise(torques: np.ndarray) -> float | None:
    """Standard deviation of measured torques [n, 3] by their steps [N m]; at least 2 % of the peak,
    which sensors err by. None where none was measured.
    """
    peak = float(np.abs(np.nan_to_num(torques)).max(initial=0.0))
    steps = np.abs(np.diff(torques, axis=0)).ravel()
    steps = steps[np.isfinite(steps)]
    if peak < 1e-6 or not len(steps):
        return None
    return max(MAD_TO_SIGMA * float(np.median(steps)) / np.sqrt(2.0), 0.02 * peak)


def _entry(observation: Any, source: Path, settings: ImportSettings, branch: BranchFrame,
           rest: np.ndarray | None, *, drive: Any, mode: Any, sigma: float,
           grasp: tuple[float, float, float]) -> PullEntry:
    return PullEntry(
        observation=observation, drive=drive, motion=settings.motion,
        gravity_m_s2=branch.gravity if settings.own_weight else None,
        time_offset_s=settings.time_offset or 0.0, source=source.name,
        grasp=GraspEntry(point_m=grasp, radius_m=settings.grasp_radius, mode=mode),
        sensor=SensorEntry(position_sigma_m=sigma, force_sigma_n=settings.force_sigma,
                           torque_sigma_nm=settings.torque_sigma),
        rest_points_m=None if rest is None else tuple(map(tuple, rest.tolist())))
