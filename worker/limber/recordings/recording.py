"""A pull: the gripper's action on the branch, and the observations; its folder ``pulls/NAME``.

``pull.toml`` describes how to read the rest; ``robot.csv`` has the gripper's pose in the branch's
frame and the wrench of the gripper on the branch; ``markers.csv`` has observed points. Depth frames
and clouds are files, and become points in :mod:`limber.perception`.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import tomlkit
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator

from limber.core.errors import Command, InputError, Option, Text
from limber.core.files.reading import checked_as, read_toml, toml_content
from limber.core.json_values import first_refusal, plain, validated
from limber.core.numerics.rigid import rotation_matrix
from limber.core.settings import GraspMode, possible_time
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.grasp import Grasp
from limber.recordings.time_series import Stream, read_stream, write_stream

# Calibration errors of a cell: standard deviations of errors constant over a recording.
#
# Noise averages out over frames; an error of a millimetre in the gripper's frame does not. A fit
# treats these errors as unknowns, with the deviations given here as their prior.


class CalibrationEntry(BaseModel):
    """Standard deviations, under ``[calibration]`` of ``pull.toml``; 0: known exactly.

    The defaults are those of a carefully set up cell without later measurement: a hand-eye
    calibration accurate to a millimetre and a degree, a force sensor within 2 % whose zero drifts
    by a newton (makers' sheets allow more; see the note on field errors), a camera accurate to a
    millimetre.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    pose_sigma_m: float = Field(
        1e-3, ge=0,
        description="Position of the gripper's frame in the branch's frame, each axis.")
    pose_sigma_rad: float = Field(
        0.0175, ge=0,
        description="Rotation of the gripper's frame in the branch's frame, each axis.")
    pose_noise_m: float = Field(
        1e-4, gt=0, description="Error of a single pose: the robot's repeatability.")
    force_gain_sigma: float = Field(0.02, ge=0, description="Relative error of the force.")
    force_bias_sigma_n: float = Field(
        1.0, ge=0, description="Zero offset of the force, each axis.")
    force_drift_sigma_n: float = Field(
        1.0, ge=0, description="Drift of the force's zero over the recording, each axis.")
    torque_bias_sigma_nm: float = Field(
        0.05, ge=0, description="Zero offset of the torque, each axis.")
    camera_sigma_m: float = Field(
        1e-3, ge=0,
        description="Position of the observer's frame in the branch's frame, each axis.")
    camera_sigma_rad: float = Field(
        1e-3, ge=0, description="Rotation of the observer's frame about the branch, each axis.")
    point_sigma_m: float = Field(
        5e-3, ge=0, description="Position of each observed point along the branch, relative to "
        "its place on the scanned one, and across it unless rest_points_m states it. Scanned tips "
        "were up to 16 mm short.")
    clock_sigma_s: float = Field(
        2e-3, ge=0,
        description="Offset of the observer's clock from the robot's that remains after alignment.")
    slip_sigma_m: float = Field(
        5e-4, ge=0, description="Slip of the grasp along the branch from beginning to end.")
    held_length_sigma_m: float = Field(
        1e-3, ge=0, description="Half the length of the piece that a clamping gripper holds.")
    repeat_sigma: float = Field(
        0.02, ge=0, description="Relative variation of the stiffness of one branch between "
        "recordings: creep, temperature, how it is held.")


def read_calibration(path: Path) -> CalibrationEntry:
    """Read the table ``[calibration]`` of a TOML file, with defaults for what it does not state;
    InputError if it cannot be read, or states another quantity."""
    what = "the errors of a cell (none, realistic or a TOML file with [calibration])"
    return checked_as(path, CalibrationEntry, read_toml(path, what).get("calibration", {}), what)


EXACT = CalibrationEntry(
    pose_sigma_m=0.0, pose_sigma_rad=0.0, force_gain_sigma=0.0, force_bias_sigma_n=0.0,
    force_drift_sigma_n=0.0, torque_bias_sigma_nm=0.0, camera_sigma_m=0.0, camera_sigma_rad=0.0,
    point_sigma_m=0.0, clock_sigma_s=0.0, slip_sigma_m=0.0, held_length_sigma_m=0.0,
    repeat_sigma=0.0)
"""Calibration of a simulated cell without errors."""
WITHOUT_GRIPPER = CalibrationEntry(
    pose_sigma_m=0.0, pose_sigma_rad=0.0, force_gain_sigma=0.0, force_bias_sigma_n=0.0,
    force_drift_sigma_n=0.0, torque_bias_sigma_nm=0.0, camera_sigma_m=0.0, camera_sigma_rad=1e-3,
    point_sigma_m=0.0, clock_sigma_s=0.0, slip_sigma_m=0.0, held_length_sigma_m=0.0)
"""Calibration for a stated load and markers registered to the branch at rest. The remaining error
is the rotation of that registration."""


def calibration_of(entry: "PullEntry") -> CalibrationEntry:
    """Return the calibration of a pull's cell; the defaults if its recording does not state it."""
    return entry.calibration or CalibrationEntry()


POSE_COLUMNS = ("x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad")
WRENCH_COLUMNS = ("fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm")

Vector = tuple[float, float, float]


class GraspEntry(BaseModel):
    """Grasp of the branch at rest: position and type."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    point_m: Vector = Field(
        description="Centre of the grasp patch at rest, in the branch's frame.")
    radius_m: float = Field(
        gt=0, description="Nodes within this distance are held. A clamped grasp holds the branch "
        "over this length to both sides along its axis.")
    mode: GraspMode = "rigid"


class SensorEntry(BaseModel):
    """Noise and range of the sensors."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    position_sigma_m: float = Field(1e-3, gt=0)
    measured_direction: Vector | None = Field(
        None, description="Positions were measured along this direction alone, as with a ruler.")
    force_sigma_n: float = Field(0.1, gt=0)
    torque_sigma_nm: float | None = Field(None, gt=0)
    force_range_n: float | None = Field(None, gt=0)
    tared: bool = Field(
        True, description="Whether the zero of the force was set before the pull. false: an "
        "estimate fits it freely.")


class SwingEntry(BaseModel):
    """Release of a swinging branch; its load is the force in ``robot.csv``."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    start: Literal["held", "loaded"] = Field(
        "held", description="held: in the rest shape, until weight and load act. loaded: bent by "
        "the load until it is removed.")
    load_mass_kg: float = Field(0.0, ge=0, description="Mass that swings with the branch.")
    noise_m: float = Field(gt=0, description="Noise of one reading of a marker.")
    registration_m: float | None = Field(
        None, gt=0, description="RMS distance of the markers from their positions on the branch.")


class PullEntry(BaseModel):
    """Content of ``pull.toml``."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    format_version: Literal[1] = 1
    observation: Literal["markers", "clouds", "depth", "none"] = "markers"
    drive: Literal["pose", "force"] = "pose"
    motion: Literal["quasi_static", "dynamic", "swing"] = "quasi_static"
    swing: SwingEntry | None = Field(None, description="For motion \"swing\".")
    gravity_m_s2: Vector | None = Field(
        None, description="Gravity that bends the branch out of its rest shape. Absent if the "
        "scanned shape already includes it.")
    weightless: bool = Field(
        False, description="Whether this is a simulated pull of a branch without weight.")
    time_offset_s: float = Field(
        0.0, description="Added to the observations' time stamps to get the robot's.")
    grasp: GraspEntry
    sensor: SensorEntry = SensorEntry()
    calibration: CalibrationEntry | None = Field(
        None, description="Calibration errors of gripper, force and camera. Absent: those of a "
        "cell that was set up with care and not measured since.")
    rest_points_m: tuple[Vector, ...] | None = Field(
        None, description="Positions of the observed points at rest. Absent: the control points.")
    recorded: str | None = Field(
        None, description="When it was recorded, such as 2026-05-01 or 2026-05-01T14:00. With "
        "pulls of several days an estimate states the change of the modulus per day.")
    source: str = ""
    truth: dict[str, Any] | None = None

    _recorded = field_validator("recorded")(possible_time)


@dataclass(frozen=True)
class Observations:
    """Observed points over time.

    Attributes:
        times: [s] on the observer's clock, shape [n].
        positions: [m] in the branch's frame, shape [n, m, 3]; NaN where a point was not seen.
        covariance: [m^2], shape [n, m, 3, 3], or None: isotropic ``position_sigma_m``.
    """

    times: np.ndarray
    positions: np.ndarray
    covariance: np.ndarray | None = None

    @property
    def point_count(self) -> int:
        return self.positions.shape[1]

    @property
    def visible(self) -> np.ndarray:
        """Whether each point was seen, shape [n, m] of bool."""
        return np.isfinite(self.positions).all(axis=2)


@dataclass(frozen=True)
class Pull:
    """One recorded pull.

    Attributes:
        name: Name of its folder.
        entry: Settings as in ``pull.toml``.
        times: The robot's time stamps [s], shape [n].
        poses: Poses of the grasp [m, rad], shape [n, 6].
        wrenches: Force [N] and torque [N m] of the gripper on the branch, shape [n, 6]; NaN
            where not measured.
        observations: Observed points, or None if they have yet to be found in images.
        warnings: Faults of the files.
    """

    name: str
    entry: PullEntry
    times: np.ndarray
    poses: np.ndarray
    wrenches: np.ndarray
    observations: Observations | None = None
    warnings: tuple[str, ...] = field(default=())

    def warned(self, *messages: str) -> "Pull":
        """Return the pull with additional warnings."""
        return replace(self, warnings=self.warnings + messages)


def read_pull(folder: str | Path) -> Pull:
    """Read the folder of a pull.

    Raises:
        InputError: a file or a column is missing, or a value makes no sense.
    """
    folder = Path(folder)
    entry = read_entry(folder / "pull.toml")
    robot = read_stream(folder / "robot.csv")
    poses = _columns(folder / "robot.csv", robot, POSE_COLUMNS)
    wrenches = _columns(folder / "robot.csv", robot, WRENCH_COLUMNS, missing=np.nan)
    if not np.isfinite(poses).all():
        bad = ~np.isfinite(poses).all(axis=1)
        robot = replace(robot, times=robot.times[~bad], warnings=(
            *robot.warnings,
            f"robot.csv: {bad.sum()} rows without a complete pose were discarded."))
        if bad.all():
            raise no_pose(folder / "robot.csv")
        poses, wrenches = poses[~bad], wrenches[~bad]
    warnings = list(robot.warnings)
    observations = None
    if entry.observation == "markers":
        markers = read_stream(folder / "markers.csv")
        observations = _marker_observations(folder / "markers.csv", markers)
        warnings += markers.warnings
    return Pull(folder.name, entry, robot.times, poses, wrenches, observations, tuple(warnings))


def no_pose(path: Path) -> InputError:
    """Return the error for a table in which no row has a complete pose of the gripper."""
    return InputError(f"{path} has no row with a complete pose of the gripper.",
                      "In each row one of x, y, z, rx, ry, rz is missing or no number.",
                      "Export the recording again, with the gripper's position and rotation.")


def write_pull(folder: str | Path, pull: Pull) -> None:
    """Write ``pull.toml``, ``robot.csv`` and, if there are observations, ``markers.csv``."""
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    write_entry(folder / "pull.toml", pull.entry)
    robot = Stream(pull.times, np.hstack([pull.poses, pull.wrenches]),
                   POSE_COLUMNS + WRENCH_COLUMNS)
    write_stream(folder / "robot.csv", robot)
    if pull.observations is not None:
        seen = pull.observations
        names = tuple(f"m{point}_{axis}_m" for point in range(seen.point_count) for axis in "xyz")
        values = seen.positions.reshape(len(seen.times), -1)
        write_stream(folder / "markers.csv", Stream(seen.times, values, names))


def read_entry(path: Path) -> PullEntry:
    """Read ``pull.toml``; InputError if it is missing, not TOML, or an entry, which it names, makes
    no sense."""
    content = read_toml(path, Text("the description of a pull (", Command("import-pull"), " makes "
                                   "one)"))
    return _checked(content, str(path))


def entry_of_text(text: str, where: str) -> PullEntry:
    """Return the entry of a ``pull.toml`` text; ``where`` names its source in messages. InputError
    as of :func:`read_entry`."""
    return _checked(toml_content(text, where, "the description of a pull"), where)


def entry_with(entry: PullEntry, content: dict[str, Any], where: str) -> PullEntry:
    """Return an entry with values of ``content`` in place of its own, table by table; ``where``
    names their source. InputError as of :func:`read_entry`."""
    known = _without_none(plain(entry))
    return _checked(known | {
        key: known.get(key, {}) | value if isinstance(value, dict) else value
        for key, value in content.items()}, where) if content else entry


def _checked(content: dict[str, Any], where: str) -> PullEntry:
    try:
        return validated(PullEntry, content)
    except ValidationError as error:
        raise InputError(f"{where}: {first_refusal(error)}.",
                         "The pull cannot be read without a valid entry.",
                         "Correct the entry.") from error


def write_entry(path: Path, entry: PullEntry) -> None:
    """Write ``pull.toml``."""
    path.write_text(entry_text(entry), encoding="utf-8")


def entry_text(entry: PullEntry) -> str:
    """Return the text of ``pull.toml``; entries that are None are omitted: TOML has no null."""
    return tomlkit.dumps(_without_none(plain(entry)))


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    return value


def _columns(path: Path, stream: Stream, names: tuple[str, ...], missing: float | None = None,
             ) -> np.ndarray:
    absent = [name for name in names if name not in stream.columns]
    if absent and missing is None:
        raise InputError(f"{path} lacks {', '.join(absent)}.",
                         "The gripper's pose is needed in every row.",
                         "Add the columns, in metres and radians, with the names given in the "
                         "documentation.")
    return np.column_stack([
        stream.values[:, stream.columns.index(name)] if name in stream.columns
        else np.full(len(stream), missing) for name in names])


def _marker_observations(path: Path, stream: Stream) -> Observations:
    if len(stream.columns) % 3 or not all(name.endswith("_m") for name in stream.columns):
        raise InputError(f"{path} has the columns {', '.join(stream.columns)}.", "Three columns "
                         "per marker, m0_x_m, m0_y_m, m0_z_m, ..., were expected.", "Import the "
                         "file with ", Command("import-pull", Option("unit"), "..."), ".")
    positions = stream.values.reshape(len(stream), -1, 3)
    partly = np.isfinite(positions).any(axis=2) & ~np.isfinite(positions).all(axis=2)
    positions = np.where(partly[..., None], np.nan, positions)
    return Observations(stream.times, positions)


# The recorded grasp on any mesh that simulates it.

LEAST_NODES = 6
"""Fewest nodes of a patch; a smaller one is widened."""


def grasp_on(mesh: TetMesh, entry: GraspEntry) -> Grasp:
    """Return the recorded grasp as a patch of a mesh about its point; one of under 6 nodes is
    widened, the length held by a clamping gripper is kept. InputError if the point is not on the
    branch, or is in its fixed base."""
    point = np.array(entry.point_m)
    distance = np.sort(np.linalg.norm(mesh.nodes - point, axis=1))
    if entry.mode == "rigid":
        is_off = distance[0] > 3 * entry.radius_m
        return Grasp.gripping(mesh, point, entry.radius_m, 1 if is_off else LEAST_NODES)
    if distance[0] > 3 * entry.radius_m:
        return Grasp.at(mesh, point, entry.radius_m, entry.mode)
    radius = max(entry.radius_m, distance[min(LEAST_NODES, len(distance)) - 1] * (1 + 1e-9))
    return Grasp.at(mesh, point, radius, entry.mode)


def pose_on(grasp: Grasp, entry: GraspEntry, pose: np.ndarray) -> np.ndarray:
    """Return the pose [m, rad] of a mesh's patch for a recorded pose of the grasp point."""
    arm = grasp.centre - np.array(entry.point_m)
    turn = rotation_matrix(pose[3:]) if grasp.mode == "rigid" else np.eye(3)
    return np.concatenate([pose[:3] + turn @ arm, pose[3:]])


def point_of(grasp: Grasp, entry: GraspEntry, pose: np.ndarray) -> np.ndarray:
    """Return the recorded grasp point [m], shape [3], for a pose of a mesh's patch [m, rad]."""
    arm = np.array(entry.point_m) - grasp.centre
    turn = rotation_matrix(pose[3:]) if grasp.mode == "rigid" else np.eye(3)
    return pose[:3] + turn @ arm
