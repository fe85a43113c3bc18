"""Import of a recording of another program into ``pulls/NAME``.

Each format gives a :class:`.Recorded`, or a pull in our format. Its markers are placed on the
branch, and the settings describe the pull: of a robot, of a load that hangs from the branch, of a
force gauge.
"""

import re
import shutil
from collections.abc import Iterable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import Command, InputError, Option, Text
from limber.core.files.safe_names import refuse_links
from limber.core.files.tables import write_table
from limber.core.not_none import present
from limber.recordings.bag_pull import pull_of_bag
from limber.recordings.bag_reader import LIMBER, read_bag
from limber.recordings.force_slope import (
    FORCE,
    MOVED,
    WHY_NO_MODULUS,
    ForceTable,
    force_slope,
    read_force_displacement,
)
from limber.recordings.hung_load import settled, swung
from limber.recordings.image_folders import copy_clouds, copy_rgbd, moved_into
from limber.recordings.import_request import (
    ImportRequest,
    Placed,
    Recorded,
    require_near,
    require_on_branch,
)
from limber.recordings.recording import (
    POSE_COLUMNS,
    WITHOUT_GRIPPER,
    WRENCH_COLUMNS,
    CalibrationEntry,
    Observations,
    Pull,
    PullEntry,
    SwingEntry,
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
from limber.recordings.sensor_checks import clean
from limber.recordings.slips import (
    Cantilever,
    require_bent_as_pulled,
    require_followed,
    require_no_slip,
)
from limber.recordings.synchronisation import DETERMINED_S, estimate_offset
from limber.recordings.tables import (
    LENGTH_UNITS_M,
    Title,
    is_robot_table,
    marker_stream,
    marker_tracks,
    read_table,
    robot_stream,
    split_title,
)
from limber.recordings.time_series import MAD_TO_SIGMA, Stream

_LEAST_BENDING_ANGLE = 20.0
"""Angle [degrees] between a gauge and the branch below which its direction is refused: there an
error of 5 degrees changes the modulus by half."""
UNLOADED = 0.01
"""Fraction of the largest force of a table below which the branch is unloaded."""
_GRASP = {"grasp_point", "grasp_distance"}

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
    names = [title.plain for title in _titles(path)]
    # A robot's log has positions and forces too.
    return all(any(re.search(words, name) for name in names)
               for words in (MOVED.replace("|position", ""), FORCE))


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
    stream = robot_stream(path, settings.force_unit, settings.rate_hz)
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
        ``frame_count``, ``point_count``, ``time_offset_s``, ``young_beam_pa`` (the modulus that
        force and motion imply by beam theory); for a steady load ``displacement_m``,
        ``settled_s`` and ``registration_rms_m``; for a force table without a mesh or the
        position of the load ``slope_n_per_m``, ``slope_interval_n_per_m`` and ``why_no_modulus``.

    Raises:
        InputError: the recording cannot be read as its stated kind.
    """
    request.progress(0.1, f"reading {kind}")
    chosen, settings = recording_format(kind), request.settings
    is_loaded = settings.weight is not None or settings.load is not None
    if is_loaded and chosen.holds != "force":
        _require_loadable(chosen, request)
    else:
        request = replace(request, progress=request.progress.part(0.1, 1.0))
    found = _read(chosen, request)
    if isinstance(found, ForceTable):
        if found.distance is not None and not request.stated & _GRASP:
            request = replace(request, settings=settings.model_copy(
                update={"grasp_distance": found.distance}))
        if request.branch.nodes is None or not request.stated & _GRASP:
            return _slope_alone(found, request)
        pull, numbers = _gauge(found, request)
    elif is_loaded:
        pull, numbers = _under_load(found, request)
    else:
        return _moved_by_robot(found, request)
    write_pull(request.folder, pull)
    seen = present(pull.observations, "markers")
    return {"frame_count": len(seen.times), "point_count": seen.point_count,
            "time_offset_s": 0.0} | numbers


def _read(chosen: RecordingFormat, request: ImportRequest) -> Any:
    """What a source holds: a :class:`Recorded`, a whole :class:`Pull`, or a force table."""
    read = RECORDINGS.read_as(chosen, request.source, request=request)
    if chosen.holds == "markers":
        stream, labels = read
        positions = stream.values.reshape(len(stream), -1, 3)
        return Recorded("markers", seen=request.tracks(stream.times, positions), labels=labels,
                        warnings=stream.warnings)
    if chosen.holds == "robot":
        return Recorded("none", read)
    return read if chosen.holds in ("pull", "force") else Recorded(chosen.holds, warnings=(*read,))


def _tell(request: ImportRequest, messages: Iterable[str]) -> None:
    for message in messages:
        request.progress.warn(message)


def _pull(request: ImportRequest, entry: PullEntry, robot: Stream, seen: Observations | None,
          warnings: tuple[str, ...] = (), *, is_table: bool = False) -> Pull:
    """The pull of a gripper's stream or a load's; InputError if the grasp is off the branch."""
    poses, wrenches = (np.ascontiguousarray(part) for part in np.hsplit(robot.values, 2))
    pull = Pull(request.name, entry, robot.times, poses, wrenches, seen, warnings)
    if is_table:
        pull = require_no_slip(pull)
    require_on_branch(entry.grasp, request.name, request.branch)
    return pull


# A pull of a robot, from tables or a bag.


def _moved_by_robot(found: Recorded | Pull, request: ImportRequest) -> dict[str, Any]:
    """Write the pull, with the faults of its sensors told, and its clocks' offset."""
    pull = found if isinstance(found, Pull) else _of_robot(found, request)
    frame = request.settings.force_frame
    if request.replaced:
        pull = replace(pull, entry=request.as_stated(pull.entry))
    if frame is not None:
        pull = replace(pull, wrenches=request.frames.on_branch(frame, pull.poses, pull.wrenches))
    if frame is not None or not (request.folder / "pull.toml").exists():
        write_pull(request.folder, pull)
    elif request.replaced:
        write_entry(request.folder / "pull.toml", pull.entry)
    skeleton = request.branch.skeleton
    young = None
    if skeleton is not None and frame is None:
        _require_there(pull, request)
        young, suspicion = require_bent_as_pulled(pull, skeleton, request.frames)
        if suspicion:
            request.progress.warn(suspicion)
    cleaned = clean(pull)
    _tell(request, cleaned.warnings)
    entry, seen = pull.entry, cleaned.observations
    if (isinstance(found, Recorded) and found.is_table and seen is not None
            and request.settings.time_offset is None):
        entry = _with_offset(cleaned, seen.times, request)
        write_entry(request.folder / "pull.toml", entry)
    if skeleton is not None:
        require_followed(replace(cleaned, entry=entry), skeleton, request.frames,
                         is_placed=request.settings.marker_frame is not None,
                         is_timed=request.settings.time_offset is not None)
    return {"frame_count": len(seen.times) if seen is not None else len(pull.times),
            "point_count": seen.point_count if seen is not None else 0,
            "time_offset_s": entry.time_offset_s, "young_beam_pa": young}


def _require_there(pull: Pull, request: ImportRequest) -> None:
    """Refuse a gripper that is never near where it holds the branch."""
    away = np.linalg.norm(pull.poses[:, :3] - pull.entry.grasp.point_m, axis=1)
    require_near(pull.poses[[away.argmin()], :3], pull.name, request.branch, "the gripper")


def _of_robot(found: Recorded, asked: ImportRequest) -> Pull:
    """The pull of the branch's observations, and of the recording's gripper or the table of it."""
    request, settings = asked, asked.settings
    if found.is_table and found.robot is not None and settings.robot is not None:
        raise InputError(
            Text(f"{request.source.name} holds a gripper's positions and forces, and ",
                 Option("robot"), " was given as well."), "The two tables are likely exchanged.",
            "Give the markers as SOURCE, and ", Option("robot", request.source.name), ".")
    written, rest = found.written, None
    if not found.is_table and found.robot is not None:
        if settings.torque_sigma is None:
            request = replace(request, settings=settings.model_copy(update={
                "torque_sigma": _torque_noise(found.robot.values[:, 9:])}))
        at_rest = written.rest_points_m if written is not None else None
        if at_rest and settings.nominal is None and len(at_rest) == len(found.labels):
            rest = np.array(at_rest)
    markers = Placed() if found.seen is None else request.placed(found, rest)
    robot = _gripper(request) if found.robot is None else found.robot
    known = np.isfinite(robot.values[:, :6]).all(axis=1)
    if not known.any():
        raise no_pose(Path(settings.robot or request.source))
    entry = request.entry(found.observation, markers.rest,
                          request.grasp_or(lambda: robot.values[known][0]))
    if written is not None:
        entry = _with_written(entry, written, request)
    pull = _pull(request, entry, robot, markers.seen,
                 (*found.warnings, *markers.warnings, *robot.warnings), is_table=found.is_table)
    return _of_known_robot(pull, asked)


def _gripper(request: ImportRequest) -> Stream:
    if request.settings.robot is None:
        raise InputError("No robot table was given.", "A pull needs the gripper's pose, and its "
                         "force where measured.", "Give the table with ", Option("robot"),
                         " ROBOT.csv, or a hung weight with ", Option("weight"), ".")
    return read_robot(Path(request.settings.robot), request)


def _with_offset(pull: Pull, seen: np.ndarray, request: ImportRequest) -> PullEntry:
    """The pull's entry with the clocks' offset, if the recording determines it; ``seen``: times of
    the observations [s]."""
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


def _of_known_robot(pull: Pull, request: ImportRequest) -> Pull:
    """Return the pull completed by values from its robot's cell; one that states its calibration is
    unchanged, and without a cell the assumed values are reported."""
    settings, robot = request.settings, request.robot
    if pull.entry.calibration is not None or "calibration" in request.replaced:
        return pull
    if robot is None:
        taken = CalibrationEntry()
        peak = float(np.nan_to_num(np.linalg.norm(pull.wrenches[:, :3], axis=1)).max())
        errors = pull.entry.sensor.force_sigma_n + taken.force_bias_sigma_n
        small = Text(f" The largest force, {peak:.3g} N, is small against them, so the modulus "
                     "will be uncertain: state them, a gauge's noise with ", Option("force_sigma"),
                     ", its zero as force_bias_sigma_n.") if 0 < peak < 3 * errors else ""
        return pull.warned(Text(
            f"{pull.name}: the calibration errors of gripper and force sensor are not stated. "
            f"Assumed standard deviations: gripper frame {1e3 * taken.pose_sigma_m:g} mm and "
            f"{np.degrees(taken.pose_sigma_rad):.1g} degrees, force "
            f"{100 * taken.force_gain_sigma:g} %, force zero {taken.force_bias_sigma_n:g} N, force "
            f"drift {taken.force_drift_sigma_n:g} N. They widen the interval of an estimate. Give "
            "the robot's cell file with ", Option("cell"), ", or [calibration] in ",
            Option("pull_toml"), ".", small))
    sensor = pull.entry.sensor.model_copy(update={
        "force_range_n": robot.noise.force_range_n,
        **({} if "force_sigma" in request.stated else {
            "force_sigma_n": robot.noise.force_sigma_n}),
        **({} if settings.torque_sigma is not None or pull.entry.sensor.torque_sigma_nm is None
           else {"torque_sigma_nm": robot.noise.torque_sigma_nm})})
    return replace(pull, entry=pull.entry.model_copy(update={
        "sensor": sensor, "calibration": robot.errors(float(pull.times[-1] - pull.times[0]))}))


# Pulls without a robot: markers on a branch that is bent by a steady load, or released from it.


def _require_loadable(chosen: RecordingFormat, request: ImportRequest) -> None:
    """Refuse settings that do not fit a load: InputError without markers, with two loads, a load
    without a position, or a dynamic pull."""
    settings = request.settings
    if chosen.holds != "markers":
        raise InputError(
            f"A steady load was given, but {request.source.name} is {chosen.name}.",
            "The rest position is determined from marker tracks.",
            "Give a CSV or C3D file of markers.")
    if settings.weight is not None and settings.load is not None:
        raise InputError(Text("Both ", Option("weight"), " and ", Option("load"), " were given."),
                         "The branch carries one load.", "Give only one of them.")
    sags = settings.weight == 0 and settings.own_weight
    if settings.grasp_point is None and settings.grasp_distance is None and not sags:
        raise InputError("A load was given without its position.",
                         "The deflection of the branch depends on that position.",
                         "Give ", Option("grasp_point"), " or ", Option("grasp_distance"), ".")
    if settings.motion == "dynamic":
        raise InputError("A steady load was given for a dynamic pull.",
                         "A branch under a steady load either swings after release or is at rest.",
                         "For a swing, give ", Option("motion", "swing"), " and run ",
                         Command("swing"), ". For the rest position, omit ", Option("motion"), ".")


def _under_load(found: Recorded, request: ImportRequest) -> tuple[Pull, dict[str, Any]]:
    """The pull of a few frames at rest under a load, or of a swing with all its frames; numbers."""
    settings, seen = request.settings, present(found.seen, "markers")
    nodes, load = present(request.branch.nodes, "mesh of the branch"), _load(request)
    own: dict[str, Any] = {"calibration": WITHOUT_GRIPPER}
    numbers: dict[str, Any] = {"load_n": load.tolist()}
    _tell(request, found.warnings)
    if settings.motion == "swing":
        rest, noise = swung(seen, settings.swing_start, request.name)
        markers = request.placed(found, rest)
        _tell(request, markers.warnings)
        sigma, mass = settings.position_sigma or noise, 0.0
        if settings.weight is not None and settings.swing_start == "held":
            mass = settings.weight / float(np.linalg.norm(request.branch.gravity))
        own["swing"] = SwingEntry(start=settings.swing_start, load_mass_kg=mass, noise_m=noise,
                                  registration_m=markers.rms)
        numbers["load_mass_kg"] = mass
        first = 0
    else:
        still = settled(seen, request.name)
        markers = request.placed(replace(found, seen=Observations(still.times, still.positions)),
                                 still.rest)
        _tell(request, (*still.warnings, *markers.warnings))
        sigma = settings.position_sigma or still.sigma(1e-3 if markers.rms is None
                                                       else markers.rms)
        first = -1
        numbers |= {"settled_s": still.duration, "position_sigma_m": sigma}
    tracks, rest = present(markers.seen, "markers"), present(markers.rest, "positions at rest")
    moved = tracks.positions[first:] - rest
    # A branch under its own weight has no point of load: use the marker that moves most.
    # An invisible marker does not count as moving.
    farthest = np.nan_to_num(np.linalg.norm(moved, axis=2)).max(axis=0).argmax()
    grasp = request.grasp_or(lambda: nodes[np.linalg.norm(
        nodes - rest[farthest], axis=1).argmin()])
    entry = request.as_stated(request.entry(
        "markers", rest, grasp, drive="force", grasp_mode="point", position_sigma=sigma),
        **own)
    row = np.r_[entry.grasp.point_m, np.zeros(3), load, np.zeros(3)]
    robot = Stream(tracks.times[[0, -1]], np.tile(row, (2, 1)), POSE_COLUMNS + WRENCH_COLUMNS)
    pull = _pull(request, entry, robot, tracks)
    if settings.motion != "swing":
        numbers["displacement_m"] = moved[0].tolist()
        if suspicion := against_load(moved[0], load):
            _tell(request, [f"{request.name}: {suspicion}"])
    return pull, numbers | {"labels": markers.labels, "registration_rms_m": markers.rms}


def against_load(moved: np.ndarray, load: np.ndarray) -> str:
    """Return a warning if markers move against the load (displacements [m], load [N]), else "".
    Motion across it is plausible: an upright branch bends sideways under a weight."""
    size = np.linalg.norm(moved, axis=1)
    mean = moved[size >= 0.5 * np.nanmax(size)].mean(axis=0)
    turn = np.degrees(np.arccos(np.clip(
        mean @ load / max(np.linalg.norm(mean) * np.linalg.norm(load), 1e-12), -1, 1)))
    if turn < 100:
        return ""
    return Text(f"the markers move at {turn:.0f} degrees to the load. Check that the recording is "
                "in the branch's frame (", Option("nominal"), "), and check the direction of the "
                "load.")


def _load(request: ImportRequest) -> np.ndarray:
    """Force on the branch [N] in the branch's frame, shape [3]."""
    settings, branch = request.settings, request.branch
    if settings.load is None:
        down = np.array(branch.gravity)
        return settings.weight * down / np.linalg.norm(down)
    turn = np.array(branch.alignment.rotation)
    return turn @ settings.load if settings.coordinates == "scan" else np.array(settings.load)


def _gauge(table: ForceTable, request: ImportRequest) -> tuple[Pull, dict[str, Any]]:
    """The pull of a test with force gauge and ruler, and its numbers: pulled in one direction,
    displacement read in it where the gauge held. A row without force is the ruler's zero."""
    settings = request.settings
    peak = float(np.abs(table.force).max())
    if peak == 0.0:
        raise InputError(f"{request.source.name} has no force.", "Nothing pulled the branch.",
                         "Check the columns of the table.")
    _tell(request, table.warnings)
    unloaded = np.abs(table.force) <= UNLOADED * peak
    zero = float(table.displacement[unloaded].mean()) if unloaded.any() else 0.0
    direction = np.array(settings.direction) / np.linalg.norm(settings.direction)
    if settings.coordinates == "scan":
        direction = np.array(request.branch.alignment.rotation) @ direction
    point = np.array(request.grasp_or(lambda: np.zeros(3)))
    _require_bending(request, point, direction)
    entry = request.entry("markers", point[None], tuple(point.tolist()), drive="force",
                          grasp_mode="point")
    entry = request.as_stated(
        entry, calibration=WITHOUT_GRIPPER.model_copy(update={
            "point_sigma_m": CalibrationEntry().point_sigma_m, "camera_sigma_rad": 0.0}),
        sensor=entry.sensor.model_copy(update={"measured_direction": tuple(direction.tolist())}))
    times = np.arange(len(table.force), dtype=float)
    seen = point + (table.displacement - zero)[:, None] * direction
    still = np.zeros_like(seen)
    robot = Stream(times, np.hstack([seen, still, table.force[:, None] * direction, still]),
                   POSE_COLUMNS + WRENCH_COLUMNS)
    return _pull(request, entry, robot, Observations(times, seen[:, None])), {
        "load_n": (peak * direction).tolist(),
        "displacement_m": (seen[[np.argmax(np.abs(table.force))]] - point).tolist()}


def _require_bending(request: ImportRequest, point: np.ndarray, direction: np.ndarray) -> None:
    """Refuse the direction of a force at a point [m], [3] each, that runs along the branch."""
    skeleton = request.branch.skeleton
    beam = None if skeleton is None else Cantilever.of(skeleton, point)
    if beam is None:
        return
    angle = float(np.degrees(np.arccos(min(1.0, abs(beam.stiffest_axis() @ direction)))))
    if angle < _LEAST_BENDING_ANGLE:
        raise InputError(
            Text(f"{request.name}: the force acts at {angle:.0f} degrees to the branch, from its "
                 "base to where it is held."), "Such a force stretches or squeezes the branch. A "
            "test of its stiffness bends it.", "State the direction in which it was pulled and "
            "measured: ", Option("direction"), " X Y Z, in the frame set by ",
            Option("coordinates"), ".")


def _slope_alone(read: ForceTable, request: ImportRequest) -> dict[str, Any]:
    """Keep a force table, and return its slope: there is no branch yet, or no place on it."""
    displacement, force = read.displacement, read.force
    found = force_slope(displacement, force, warnings=read.warnings)
    _tell(request, (*found.warnings, f"{request.source.name} does not give a modulus. "
                    f"{WHY_NO_MODULUS}"))
    write_table(request.folder / "force.csv", ("displacement_m", "force_n"),
                zip(displacement, force, strict=True))
    return {"slope_n_per_m": found.slope, "slope_interval_n_per_m": list(found.interval),
            "contact_m": found.contact, "contact_seen": found.contact_seen,
            "baseline_n": found.baseline, "stiffening": found.stiffening,
            "slips_m": list(found.slips), "slope_before_slip_n_per_m": found.slope_before_slip,
            "return_slope_n_per_m": found.return_slope, "energy_lost": found.energy_lost,
            "frame_count": len(force), "why_no_modulus": WHY_NO_MODULUS}


# C3D files of motion capture, read in a separate process.


def c3d_arrays(path: Path) -> dict[str, np.ndarray]:
    """Return the markers of a C3D file: ``points`` [3, m, n], rate, unit, labels; read by compiled
    code, which a corrupt file may crash."""
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
    """Return marker tracks [m] and labels of :func:`c3d_arrays`; InputError without points or
    times, or if positions are not finite."""
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


# A bag, with Limber's own record in it.


def read_bag_pull(path: Path, request: ImportRequest) -> Recorded:
    """Return the series of a bag; images and clouds go into the pull's folder. InputError as of
    :func:`.bag_reader.read_bag` and :func:`.bag_pull.pull_of_bag`."""
    bag = read_bag(path)
    found = pull_of_bag(bag, request)
    if not bag.pull_toml:
        return found
    try:
        return replace(found, written=entry_of_text(bag.pull_toml,
                                                    f"{bag.path.name}, metadata {LIMBER}"))
    except InputError as error:
        return replace(found, warnings=(*found.warnings, f"{error} Default values are used for "
                                        "grasp, noise and calibration."))


def _with_written(entry: PullEntry, written: PullEntry, request: ImportRequest) -> PullEntry:
    """The entry as `limber export-pull` wrote it; the import's settings take precedence."""
    requested = request.stated

    def kept(source: Any, **keys: str) -> dict[str, Any]:
        return {key: getattr(source, key) for name, key in keys.items() if name not in requested}

    grasp = kept(written.grasp, grasp_mode="mode", grasp_radius="radius_m")
    if not requested & {"grasp_point", "frame_pose", "cell"}:
        grasp["point_m"] = written.grasp.point_m
    sensor = kept(written.sensor, position_sigma="position_sigma_m", force_sigma="force_sigma_n",
                  torque_sigma="torque_sigma_nm")
    noise = ("position_sigma_m", "force_sigma_n", "torque_sigma_nm")
    return entry.model_copy(update={
        "calibration": written.calibration, "weightless": written.weightless,
        "truth": written.truth,
        "source": f"{entry.source} ({written.source})" if written.source else entry.source,
        **kept(written, own_weight="gravity_m_s2", drive="drive", motion="motion"),
        "grasp": entry.grasp.model_copy(update=grasp),
        "sensor": written.sensor.model_copy(
            update={key: getattr(entry.sensor, key) for key in noise} | sensor)})


def _torque_noise(torques: np.ndarray) -> float | None:
    """Standard deviation of measured torques [n, 3] from their steps [N m]; at least 2 % of the
    peak, a typical sensor error. None if none was measured."""
    peak = float(np.abs(np.nan_to_num(torques)).max(initial=0.0))
    steps = np.abs(np.diff(torques, axis=0)).ravel()
    steps = steps[np.isfinite(steps)]
    if peak < 1e-6 or not len(steps):
        return None
    return max(MAD_TO_SIGMA * float(np.median(steps)) / np.sqrt(2.0), 0.02 * peak)
