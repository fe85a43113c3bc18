"""Pulls without a robot: markers on a branch that is bent by a steady load, or released."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.core.errors import Command, InputError, Option, Text
from limber.core.not_none import present
from limber.recordings.force_slope import ForceTable
from limber.recordings.hung_load import settled, swung
from limber.recordings.import_request import (
    ImportRequest,
    require_near,
    require_on_branch,
)
from limber.recordings.recording import (
    WITHOUT_GRIPPER,
    CalibrationEntry,
    Observations,
    Pull,
    SwingEntry,
    write_pull,
)
from limber.recordings.recording_formats import RecordingFormat
from limber.recordings.time_series import Stream

UNLOADED = 0.01
"""Fraction of the largest force of a table below which the branch is unloaded."""


def require_loadable(chosen: RecordingFormat, request: ImportRequest) -> None:
    """Refuse settings that do not fit a load.

    Raises:
        InputError: no markers, two loads, a load without a position, or a dynamic pull.
    """
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


def import_load(read: tuple[Stream, list[str]], request: ImportRequest) -> dict[str, Any]:
    """Make a pull of marker tracks of a branch under a load, and return its numbers."""
    stream, labels = read
    for message in stream.warnings:
        request.progress.warn(message)
    seen = Observations(stream.times, stream.values.reshape(len(stream), -1, 3))
    if request.settings.motion == "swing":
        return _import_swing(seen, labels, request)
    return _import_rest(seen, labels, request)


@dataclass(frozen=True)
class _Placed:
    """Markers in the branch's frame [m]: at rest [m, 3] and over time [f, m, 3]."""

    rest: np.ndarray
    positions: np.ndarray
    labels: list[str]
    rms: float | None

    def numbers(self, load: np.ndarray) -> dict[str, Any]:
        return {"frame_count": len(self.positions), "point_count": len(self.rest),
                "time_offset_s": 0.0, "labels": self.labels, "load_n": load.tolist(),
                "registration_rms_m": self.rms}


def _placed(rest: np.ndarray, positions: np.ndarray, labels: list[str], request: ImportRequest,
            warnings: Sequence[str] = ()) -> _Placed:
    placed = request.registered(rest, labels)
    used = placed.used if placed else np.flatnonzero(np.isfinite(rest).all(axis=1))
    rest, positions = rest[used], positions[:, used]
    if placed:
        rest, positions = placed.apply(rest), placed.apply(positions)
    for message in (*warnings, *(placed.warnings if placed else ())):
        request.progress.warn(message)
    require_near(rest, request.name, request.branch)
    return _Placed(rest, positions, [labels[k] for k in used], placed.rms if placed else None)


def _nodes(request: ImportRequest) -> np.ndarray:
    return present(request.branch.nodes, "mesh of the branch")


def _import_rest(seen: Observations, labels: list[str], request: ImportRequest) -> dict[str, Any]:
    """A few frames of a branch at rest under a load."""
    still = settled(seen, request.name)
    found = _placed(still.rest, still.positions, labels, request, still.warnings)
    sigma = request.settings.position_sigma or still.sigma(
        1e-3 if found.rms is None else found.rms)
    load = _load(request)
    moved = found.positions[-1] - found.rest
    _write(request, found, still.times, moved[None], load, sigma)
    if suspicion := against_load(moved, load):
        request.progress.warn(f"{request.name}: {suspicion}")
    return found.numbers(load) | {
        "displacement_m": moved.tolist(), "settled_s": still.duration, "position_sigma_m": sigma}


def _import_swing(seen: Observations, labels: list[str], request: ImportRequest,
                  ) -> dict[str, Any]:
    """A released branch: all frames, the load, and the mass that swings with it."""
    settings = request.settings
    rest, noise = swung(seen, settings.swing_start, request.name)
    found = _placed(rest, seen.positions, labels, request)
    load, mass = _load(request), 0.0
    if settings.weight is not None and settings.swing_start == "held":
        mass = settings.weight / float(np.linalg.norm(request.branch.gravity))
    _write(request, found, seen.times, found.positions - found.rest, load,
           settings.position_sigma or noise, swing=SwingEntry(
               start=settings.swing_start, load_mass_kg=mass, noise_m=noise,
               registration_m=found.rms))
    return found.numbers(load) | {"load_mass_kg": mass}


def _write(request: ImportRequest, found: _Placed, times: np.ndarray, moved: np.ndarray,
           load: np.ndarray, sigma: float, **further: SwingEntry) -> None:
    """Write a pull without a robot: a steady load [N], shape [3], at the grasp.

    Args:
        moved: Displacements of the markers [m], shape [frames, m, 3].
        sigma: Standard deviation of their positions [m].
        further: Additional entries beyond those of a pull with a robot.
    """
    nodes = _nodes(request)
    # A branch under its own weight has no point of load: use the marker that moves most.
    grasp = request.grasp_or(lambda: _nearest(nodes, found.rest[_farthest(moved)]))
    entry = request.entry("markers", found.rest, drive="force", mode="point", grasp=grasp,
                          sigma=sigma)
    entry = request.as_stated(entry.model_copy(
        update={"calibration": WITHOUT_GRIPPER, **further}))
    require_on_branch(entry.grasp, request.name, request.branch)
    poses = np.zeros((2, 6))
    poses[:, :3] = entry.grasp.point_m
    wrenches = np.tile(np.r_[load, 0.0, 0.0, 0.0], (2, 1))
    write_pull(request.folder, Pull(request.name, entry, times[[0, -1]], poses, wrenches,
                                    Observations(times, found.positions)))


def import_gauge(table: ForceTable, request: ImportRequest) -> dict[str, Any]:
    """Make a pull of a test with force gauge and ruler, and return its numbers.

    The branch was pulled in one direction, and its displacement was read in that direction at the
    point where the gauge held it. A row without force, if there is one, is the ruler's zero.

    Raises:
        InputError: the grasp is not on the branch, or the force is always zero.
    """
    settings, nodes = request.settings, _nodes(request)
    peak = float(np.abs(table.force).max())
    if peak == 0.0:
        raise InputError(f"{request.source.name} has no force.", "Nothing pulled the branch.",
                         "Check the columns of the table.")
    for message in table.warnings:
        request.progress.warn(message)
    unloaded = np.abs(table.force) <= UNLOADED * peak
    zero = float(table.displacement[unloaded].mean()) if unloaded.any() else 0.0
    direction = np.array(settings.direction) / np.linalg.norm(settings.direction)
    if settings.coordinates == "scan":
        direction = np.array(request.branch.alignment.rotation) @ direction
    point = np.array(request.grasp_or(lambda: nodes[0]))
    entry = request.entry("markers", point[None], drive="force", mode="point",
                          sigma=settings.position_sigma or 1e-3, grasp=tuple(point.tolist()))
    entry = request.as_stated(entry.model_copy(update={
        "calibration": WITHOUT_GRIPPER.model_copy(update={
            "point_sigma_m": CalibrationEntry().point_sigma_m, "camera_sigma_rad": 0.0}),
        "sensor": entry.sensor.model_copy(
            update={"measured_direction": tuple(direction.tolist())})}))
    require_on_branch(entry.grasp, request.name, request.branch)
    times = np.arange(len(table.force), dtype=float)
    seen = point + (table.displacement - zero)[:, None, None] * direction
    poses, wrenches = np.zeros((2, len(times), 6))
    poses[:, :3], wrenches[:, :3] = seen[:, 0], table.force[:, None] * direction
    write_pull(request.folder, Pull(request.name, entry, times, poses, wrenches,
                                    Observations(times, seen)))
    return {"frame_count": len(times), "point_count": 1, "time_offset_s": 0.0,
            "load_n": (peak * direction).tolist(),
            "displacement_m": (seen[np.argmax(np.abs(table.force))] - point).tolist()}


def _nearest(nodes: np.ndarray, point: np.ndarray) -> np.ndarray:
    """The node nearest to a position [m]."""
    return nodes[np.linalg.norm(nodes - point, axis=1).argmin()]


def _farthest(moved: np.ndarray) -> int:
    """Index of the marker with the largest observed displacement [m], shape [frames, m, 3]."""
    # An invisible marker does not count as moving.
    return int(np.nan_to_num(np.linalg.norm(moved, axis=2)).max(axis=0).argmax())


def against_load(moved: np.ndarray, load: np.ndarray) -> str:
    """Return a warning if markers move against the load (displacements [m], load [N]), else "".

    Motion across the load is plausible: an upright branch bends sideways under a weight.
    """
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
