"""An import: what is asked, what its source holds, and the slips that its frames and units show."""

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.alignment import Alignment
from limber.core.constants import GRAVITY
from limber.core.errors import InputError, Option, Text
from limber.core.files.reading import read_text, read_toml
from limber.core.not_none import present
from limber.core.numerics.rigid import rigid_fit, rotation_matrix
from limber.core.progress import SILENT, Progress
from limber.geometry.skeleton.skeleton import Skeleton
from limber.recordings.recording import (
    CalibrationEntry,
    GraspEntry,
    Observations,
    PullEntry,
    SensorEntry,
    entry_with,
)
from limber.recordings.settings import ImportSpec
from limber.recordings.slips import Frames, likely_slip, require_named_in_order
from limber.recordings.tables import LENGTH_UNITS_M, same_label, scale_of, split_title
from limber.recordings.time_series import Stream

# Fit of a capture system's markers to their nominal positions on the branch at rest.

POOR_FIT_M = 5e-3
"""Residual of a rigid fit at a marker above which it is reported."""
COLLINEAR = 0.03
"""Ratio of extents across and along a line from which markers span a triangle."""


@dataclass(frozen=True)
class Registration:
    """From the capture frame to the branch's, ``x = rotation p + shift`` [m]; ``used``: indices of
    the recording's markers with a nominal position, ``residual``: distance of each from it at rest
    [m], shape [m] both."""

    rotation: np.ndarray
    shift: np.ndarray
    used: np.ndarray
    residual: np.ndarray
    warnings: tuple[str, ...] = ()

    @property
    def rms(self) -> float:
        """Root mean square of the residuals over the remaining degrees of freedom [m]."""
        freedom = max(3 * len(self.used) - 6, 1)
        return float(np.sqrt(np.sum(self.residual**2) / freedom))

    def apply(self, points: np.ndarray) -> np.ndarray:
        """Transform points [m], shape [..., 3], to the branch's frame."""
        return points @ self.rotation.T + self.shift


def read_nominal(path: Path) -> tuple[list[str], np.ndarray]:
    """Read ``label,x_m,y_m,z_m`` (or another unit of length): labels, positions [m], shape [m, 3];
    InputError if the file is not in this format."""
    path = Path(path)
    lines = [line for line in read_text(path, "a table of the markers' nominal positions")
             .splitlines() if line.strip() and not line.startswith("#")]
    sign = next((sign for sign in ("\t", ";", ",") if lines and sign in lines[0]), ",")
    rows = [[part.strip().strip('"') for part in line.split(sign)] for line in lines]
    try:
        titles = [split_title(part) for part in rows[0][1:4]]
        if len(titles) != 3:
            raise ValueError("its first line does not have three columns of positions")
        scale = [scale_of(title, LENGTH_UNITS_M, "m", path) for title in titles]
        labels = [row[0] for row in rows[1:]]
        points = np.array([[float(part) for part in row[1:4]] for row in rows[1:]])
        if points.shape != (len(labels), 3) or not np.isfinite(points).all():
            raise ValueError("each marker needs three numbers")
        if doubled := [label for label, count in Counter(labels).items() if count > 1]:
            raise ValueError(f"{doubled[0]!r} has several rows")
    except (IndexError, ValueError) as error:
        raise InputError(f"{path} is not a table of markers ({error}).",
                         "The first line must be label,x_m,y_m,z_m. Each further line is one "
                         "marker.",
                         "Correct the file.") from error
    return labels, points * scale


def register(points: np.ndarray, labels: list[str], nominal_labels: list[str],
             nominal: np.ndarray, name: str) -> Registration:
    """Fit markers at rest in the capture frame [m], shape [n, 3], rigidly to their nominal
    positions [k, 3], paired by name; an outlier is excluded if three others agree. InputError if
    fewer than three are shared, one with a nominal position is missing, or they are on a line,
    mirrored, or mistaken for each other."""
    pairs = [(k, j) for k, label in enumerate(labels) for j, known in enumerate(nominal_labels)
             if same_label(label, known) and np.isfinite(points[k]).all()]
    if len(pairs) < 3:
        raise InputError(
            f"{name}: the recording has the markers {', '.join(labels)}. Nominal positions are "
            f"given for {', '.join(nominal_labels)}.",
            "A rigid fit needs three common markers that are in view at the start.",
            "Use the recording's labels in the table of nominal positions.")
    used = np.array([k for k, _ in pairs])
    target = nominal[[j for _, j in pairs]]
    messages = _unpaired(labels, nominal_labels, pairs, name)
    _require_body(target, name)
    _require_same_body(points[used], target, [labels[k] for k in used], name)
    inlier = _consistent(points[used], target)
    rotation, shift = rigid_fit(points[used][inlier], target[inlier])
    residual = np.linalg.norm(points[used] @ rotation.T + shift - target, axis=1)
    for k, off, good in zip(used, residual, inlier, strict=True):
        if not good or off > POOR_FIT_M:
            excluded = "" if good else " and was excluded from the rigid fit"
            messages.append(f"{name}: marker {labels[k]} is {off * 1e3:.1f} mm away from its "
                            f"nominal position{excluded}.")
    return Registration(rotation, shift, used, residual, tuple(messages))


def _unpaired(labels: list[str], nominal_labels: list[str], pairs: list[tuple[int, int]],
              name: str) -> list[str]:
    """State which markers have no nominal position; InputError if one with a nominal position is
    not in the recording, or not visible at its start."""
    missing = [label for j, label in enumerate(nominal_labels) if j not in {j for _, j in pairs}]
    if missing:
        raise InputError(
            f"{name}: {', '.join(missing)} has a nominal position, but is not in the recording's "
            f"first frame. That frame has {', '.join(labels)}.",
            "A marker that is missing or has another name would be ignored without notice.",
            "Correct its name in the table of nominal positions, or remove it from the table.")
    unknown = [label for k, label in enumerate(labels) if k not in {k for k, _ in pairs}]
    if not unknown:
        return []
    return [f"{name}: {', '.join(unknown)} has no nominal position and was discarded."]


def _require_body(target: np.ndarray, name: str) -> None:
    """Raises InputError if markers are on a line: a rotation about it would be undetermined."""
    extent = np.linalg.svd(target - target.mean(axis=0), compute_uv=False)
    if extent[1] < max(COLLINEAR * extent[0], 1e-4):
        raise InputError(f"{name}: the markers' nominal positions lie on a line.",
                         "The rotation of the recording about that line cannot be determined.",
                         "Use at least one marker off the line, so that three span a triangle.")


def _require_same_body(points: np.ndarray, target: np.ndarray, labels: list[str],
                       name: str) -> None:
    """Raises InputError if markers fit once they are mirrored, or two of them are exchanged."""
    rms = float(np.sqrt(np.mean(_residuals(points, target)**2)))
    if rms <= POOR_FIT_M:
        return
    mirrored = float(np.sqrt(np.mean(_residuals(points * [1.0, 1.0, -1.0], target)**2)))
    if mirrored < min(rms / 3, POOR_FIT_M):
        raise InputError(
            f"{name}: the markers fit their nominal positions to {1e3 * mirrored:.1f} mm when "
            f"mirrored, and to {1e3 * rms:.0f} mm as they are.",
            "One axis has the wrong sign in the recording or in the table.",
            "Check the signs and the order of the axes (x, y, z right-handed).")
    for first, second in combinations(range(len(points)), 2):
        order = np.arange(len(points))
        order[[first, second]] = second, first
        swapped = float(np.sqrt(np.mean(_residuals(points, target[order])**2)))
        if swapped < min(rms / 3, POOR_FIT_M):
            raise InputError(
                f"{name}: {labels[first]} and {labels[second]} fit to {1e3 * swapped:.1f} mm when "
                f"they are exchanged, and to {1e3 * rms:.0f} mm as they are named.",
                "Their names are swapped in the recording or in the table.",
                "Exchange their names in the table of nominal positions.")


def _residuals(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    rotation, shift = rigid_fit(points, target)
    return np.linalg.norm(points @ rotation.T + shift - target, axis=1)


def _consistent(points: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Whether each marker agrees with the others; one that triples the residual does not."""
    keep = np.ones(len(points), bool)
    while keep.sum() > 4:
        rms = np.sqrt(np.mean(_residuals(points[keep], target[keep])**2))
        without = []
        for k in np.flatnonzero(keep):
            rest = keep.copy()
            rest[k] = False
            without.append((np.sqrt(np.mean(_residuals(points[rest], target[rest])**2)), k))
        best, worst = min(without)
        if rms < POOR_FIT_M or best > rms / 3:
            break
        keep[worst] = False
    return keep


JointPoses = Callable[[tuple[str, ...], np.ndarray], np.ndarray]
"""From names and angles [rad] of joints, [n, k], to poses of the gripper in the base, [n, 6]."""

@dataclass(frozen=True)
class BranchFrame:
    """Properties of the branch that an import needs: alignment from the scan's coordinates, gravity
    [m/s^2], its skeleton; of the mesh, if there is one, the nodes [m], shape [n, 3], and the
    control points [m], shape [k, 3]."""

    alignment: Alignment = field(default_factory=Alignment)
    gravity: tuple[float, float, float] = GRAVITY
    nodes: np.ndarray | None = None
    skeleton: Skeleton | None = None
    control_points: np.ndarray | None = None

    def at(self, distance: float) -> np.ndarray:
        """Return the point at a distance from the base along the main path [m], shape [3];
        InputError without a skeleton, or if the path is shorter."""
        if self.skeleton is None:
            raise InputError("The branch has no skeleton.",
                             "A distance is measured along the main path.",
                             "Give ", Option("grasp_point"), ", or reconstruct the branch first.")
        path = self.skeleton.nodes[self.skeleton.main_path()]
        along = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))]
        if distance > along[-1]:
            raise InputError(f"The position of the grasp is {distance:g} m from the base, but the "
                             f"main path is {along[-1]:.3g} m long.", "There is no branch to hold "
                             "at that distance.", "Check the distance and its unit, or give ",
                             Option("grasp_point"), ".")
        return np.array([np.interp(distance, along, axis) for axis in path.T])


@dataclass(frozen=True)
class RobotKnown:
    """Known properties of a recording's robot: gripper poses by joint angles, noise of the force
    sensor, calibration errors of a recording of so many seconds."""

    joint_poses: JointPoses
    noise: SensorEntry
    errors: Callable[[float], CalibrationEntry]


@dataclass(frozen=True)
class ImportRequest:
    """An import into the pull format.

    Attributes:
        source: The recording.
        folder: Folder of the pull, for images and clouds.
        name: Name of the pull.
        settings: How to read it.
        branch: Known properties of the branch.
        robot: Known properties of the robot, if a cell states it.
        progress: Called during the work; receives warnings for the user.
    """

    source: Path
    folder: Path = Path()
    name: str = ""
    settings: ImportSpec = field(default_factory=ImportSpec)
    branch: BranchFrame = field(default_factory=BranchFrame)
    robot: RobotKnown | None = None
    progress: Progress = SILENT

    @property
    def stated(self) -> set[str]:
        """Names of the settings that differ from their defaults."""
        return {name for name, field in ImportSpec.model_fields.items()
                if getattr(self.settings, name) != field.default}

    @property
    def frames(self) -> Frames:
        """Rotations of the poses' frame and the scan's to the branch's."""
        pose = self.settings.frame_pose or (0,) * 6
        return Frames(rotation_matrix(np.array(pose[3:])), np.array(self.branch.alignment.rotation))

    def in_branch(self, points: np.ndarray) -> np.ndarray:
        """Transform points [m] from the user's frame to the branch's, shape [n, 3]."""
        if self.settings.coordinates == "branch":
            return points
        return self.branch.alignment.apply_metres(points)

    def tracks(self, times: np.ndarray, positions: np.ndarray) -> Observations:
        """Return markers [m], shape [f, m, 3], transformed from their stated frame, if any;
        InputError if nominal positions are given as well."""
        pose = self.settings.marker_frame
        if pose is None:
            return Observations(times, positions)
        if self.settings.nominal is not None:
            raise InputError(Text("Both ", Option("marker_frame"), " and ", Option("nominal"),
                                  " are given."),
                             "Each determines where the markers are on the branch.",
                             "Give ", Option("marker_frame"), " if the pose of their frame was "
                             "measured; else ", Option("nominal"), ".")
        return Observations(times, positions @ rotation_matrix(np.array(pose[3:])).T + pose[:3])

    def grasp_or(self, otherwise: Callable[[], np.ndarray]) -> tuple[float, float, float]:
        """Return the grasp point in the branch's frame [m]; if none was given, the alternative."""
        point, distance = self.settings.grasp_point, self.settings.grasp_distance
        if point is not None:
            x, y, z = self.in_branch(np.array([point]))[0]
        else:
            x, y, z = otherwise()[:3] if distance is None else self.branch.at(distance)
        return float(x), float(y), float(z)

    def placed(self, found: "Recorded", rest: np.ndarray | None = None) -> "Placed":
        """Return the markers on the branch. ``rest``: where they are known to be at rest [m, 3];
        without it they are at rest in the first frame, and one unseen there is discarded.
        InputError if none is seen, or one is far from the branch; as :func:`register`."""
        seen, labels = present(found.seen, "markers"), found.labels
        start, nominal = seen.positions[0] if rest is None else rest, self.settings.nominal
        if nominal is not None:
            known, positions = read_nominal(nominal)
            fit = register(start, labels, known, self.in_branch(positions), self.name)
            at_rest = fit.apply(start[fit.used])
            require_near(at_rest, self.name, self.branch)
            return Placed(replace(seen, positions=fit.apply(seen.positions[:, fit.used])), at_rest,
                          [labels[k] for k in fit.used], fit.rms, fit.warnings)
        points = self.branch.control_points
        is_control_points = self.settings.marker_frame is None and (
            points is None or len(points) == seen.point_count)
        if rest is None and found.is_table and is_control_points:
            require_near(start, self.name, self.branch)
            if points is not None:
                require_named_in_order(labels, start, points, self.name)
            return Placed(seen, None, labels)
        there = np.isfinite(start).all(axis=1)
        if not there.any():
            raise InputError(f"{self.name}: no marker is visible in the first frame.",
                             "The markers' positions at rest are not known.",
                             "Start the recording before the pull, or give ", Option("nominal"),
                             ".")
        require_near(start, self.name, self.branch)
        unseen = [label for label, here in zip(labels, there, strict=True) if not here]
        return Placed(replace(seen, positions=seen.positions[:, there]), start[there],
                      [labels[k] for k in np.flatnonzero(there)], None, tuple(
            f"{self.name}: {label} is not visible in the first frame, where the branch is at rest, "
            "and was discarded." for label in unseen))

    @cached_property
    def replaced(self) -> dict[str, Any]:
        """The entries of ``pull.toml`` that the user's file replaces; InputError if it is missing
        or not TOML."""
        path = self.settings.pull_toml
        return {} if path is None else read_toml(path, "entries of a pull.toml")

    def as_stated(self, entry: PullEntry, **own: Any) -> PullEntry:
        """Return the entry with ``own`` values, and the user's in place of its own; InputError
        names an entry of the user's file that makes no sense."""
        return entry_with(entry.model_copy(update=own), self.replaced,
                          str(self.settings.pull_toml))

    def entry(self, observation: Any, rest: np.ndarray | None, grasp: tuple[float, float, float],
              **stated: Any) -> PullEntry:
        """Return the description of the pull: markers at rest [m, 3], and the grasp [m], in the
        branch's frame; ``stated``: what takes the place of settings."""
        settings = self.settings.model_copy(update=stated)
        return PullEntry(
            observation=observation, drive=settings.drive, motion=settings.motion,
            gravity_m_s2=self.branch.gravity if settings.own_weight else None,
            time_offset_s=settings.time_offset or 0.0, source=self.source.name,
            grasp=GraspEntry(point_m=grasp, radius_m=settings.grasp_radius,
                             mode=settings.grasp_mode),
            sensor=SensorEntry(position_sigma_m=settings.position_sigma or 1e-3,
                               force_sigma_n=settings.force_sigma,
                               torque_sigma_nm=settings.torque_sigma),
            recorded=settings.recorded,
            rest_points_m=None if rest is None else tuple(map(tuple, rest.tolist())))


@dataclass(frozen=True)
class Recorded:
    """What a source holds, in SI units in the branch's frame, before it is a pull. ``observation``:
    ``markers``, ``clouds``, ``depth`` (files in the pull's folder) or ``none``; ``robot``: poses
    and wrenches, None if in the table of the setting ``robot``; ``is_table``: made by hand, so that
    columns and units may be mistaken; ``written``: what Limber wrote beside a bag's messages."""

    observation: str
    robot: Stream | None = None
    seen: Observations | None = None
    labels: list[str] = field(default_factory=list)
    is_table: bool = True
    written: PullEntry | None = None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class Placed:
    """Markers in the branch's frame over time, and at rest [m, 3] (None: the control points);
    ``rms``: distance from the nominal positions [m], if such were given."""

    seen: Observations | None = None
    rest: np.ndarray | None = None
    labels: list[str] = field(default_factory=list)
    rms: float | None = None
    warnings: tuple[str, ...] = ()


def require_on_branch(grasp: GraspEntry, name: str, branch: BranchFrame) -> None:
    """Refuse a grasp beside the branch: InputError if no node is within two grasp radii and 5
    mm."""
    nodes = branch.nodes
    if nodes is None:
        return
    off = float(np.linalg.norm(nodes - np.array(grasp.point_m), axis=1).min())
    near = 2 * grasp.radius_m + 5e-3
    if off > near:
        slip = likely_slip(np.array([grasp.point_m]), nodes, branch.alignment, near)
        point = ", ".join(f"{value:.4g}" for value in grasp.point_m)
        raise InputError(
            f"{name}: the grasp point ({point}) m is {off * 1e3:.0f} mm away from the branch.",
            "The gripper would not hold the branch. The recording is of another branch, or it or "
            f"the point has another frame of reference or unit. {slip}".rstrip(),
            "Give a ", Option("grasp_point"), " on the branch, in the frame set by ",
            Option("coordinates"), ", and check ", Option("unit"), ".").at(grasp.point_m)


def require_near(rest: np.ndarray, name: str, branch: BranchFrame, what: str = "a marker") -> None:
    """Refuse markers, or a gripper, that are not at the branch, but in another frame:
    InputError if one is farther from the mesh than a quarter of its extent."""
    nodes, seen = branch.nodes, rest[np.isfinite(rest).all(axis=1)]
    if nodes is None or not len(seen):
        return
    off = np.array([np.linalg.norm(nodes - point, axis=1).min() for point in seen])
    extent = float(np.linalg.norm(np.ptp(nodes, axis=0)))
    if off.max() > 0.25 * extent:
        slip = likely_slip(seen, nodes, branch.alignment, 0.25 * extent)
        raise InputError(
            f"{name}: at rest {what} is {off.max() * 1e3:.0f} mm away from the branch, which is "
            f"{extent * 1e3:.0f} mm long.",
            "The recording is of another branch, or has another frame of reference or unit. "
            f"{slip}".rstrip(),
            *(("Give the markers' positions on the branch with ", Option("nominal"),
               ", or the pose of their frame with ", Option("marker_frame"))
              if what == "a marker" else
              ("Give the pose of the frame of the gripper's poses with ", Option("frame_pose"))),
            ", and check ", Option("unit"), ".")
