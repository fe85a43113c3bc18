"""Import of a recording of another program into ``pulls/NAME``."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.tables import write_table
from limber.recordings.cell_errors import calibration_of
from limber.recordings.force_slope import WHY_NO_MODULUS, ForceTable, force_slope
from limber.recordings.importing.import_request import (
    ImportRequest,
    of_known_robot,
    require_near,
    require_on_branch,
)
from limber.recordings.importing.markers_under_load import (
    import_gauge,
    import_load,
    require_loadable,
)
from limber.recordings.importing.readers import read_robot
from limber.recordings.importing.recording_formats import (
    RECORDINGS,
    RecordingFormat,
    recording_format,
)
from limber.recordings.importing.slips import require_no_slip
from limber.recordings.recording import (
    Observations,
    Pull,
    PullEntry,
    no_pose,
    write_entry,
    write_pull,
)
from limber.recordings.sensor_checks import clean
from limber.recordings.synchronisation import DETERMINED_S, estimate_offset
from limber.recordings.time_series import Stream


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
            "assumed. If there were two, state --time-offset.")
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
            f"{pull.name}: the clocks' offset was found from the motion: {found:.4f} s "
            f"(standard deviation {1e3 * sigma:.1f} ms) is added to the observations' times. If "
            "the clocks are one, state --time-offset 0.")
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
            f"{request.source.name} holds a gripper's positions and forces, and --robot was given "
            "as well.", "The two tables are likely exchanged.",
            f"Give the markers as SOURCE, and --robot {request.source.name}.")
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
        raise InputError("No robot table was given.",
                         "A pull needs the gripper's pose, and its force where measured.",
                         "Give the table with --robot ROBOT.csv, or a hung weight with --weight.")
    return read_robot(Path(request.settings.robot), request)


def _at_rest_first(seen: Observations, labels: list[str], stream: Stream, name: str,
                   ) -> tuple[Observations, np.ndarray, list[str]]:
    """The markers that the first frame shows, when the branch is at rest; those positions [m]."""
    there = seen.visible[0]
    if not there.any():
        raise InputError(f"{name}: no marker is visible in the first frame.",
                         "The markers' positions at rest are not known.",
                         "Start the recording before the pull, or give --nominal.")
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
