"""The cell: robot base beside the branch, gripper and obstacles.

``cell.toml`` is written by ``limber robot calibrate`` and by hand. All lengths are in metres,
angles in radians, masses in kilograms. The branch's frame is that of its folder (z up).
"""

import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomlkit
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from limber.cell.arm import MOST_SPEED, MOST_TURN_SPEED, Arm, greatest_force, greatest_torque
from limber.cell.known_arms import arm_named
from limber.cell.ur_arms import NAMES
from limber.cell.urdf_arm import is_file
from limber.core.errors import Command, InputError, Option, Text
from limber.core.files.atomic import write_atomically
from limber.core.files.reading import read_toml
from limber.core.json_values import plain, refusal_of, validated
from limber.core.numerics.rigid import inverted, matrices

RIGID_N_PER_M = 2e5
"""Stiffness with which a gripper meets a rigid thing: that of the arm and its joints [N/m]."""

FAR = 20.0
"""Greatest distance from the branch [m] of any object that an arm works with."""
Vector = tuple[float, float, float]
Pose = tuple[float, float, float, float, float, float]


def _in_metres(value: tuple[float, ...]) -> tuple[float, ...]:
    if max(abs(part) for part in value[:3]) > FAR:
        raise ValueError(f"is {max(abs(part) for part in value[:3]):g} m away; it may have been "
                         "given in millimetres")
    return value


def _known_model(value: str) -> str:
    try:
        return arm_named(value).name
    except InputError as error:
        raise ValueError(error.seen.removeprefix(f"Robot {value!r} ")) from error


class _Entry(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class RobotEntry(_Entry):
    """Robot model and address."""

    model: str = Field(description=f"One of {NAMES}; or the URDF file of another arm, beside the "
                       "cell file.")
    address: str = Field("127.0.0.1", min_length=1, description="Of the controller; ws:// of ROS.")
    ros: dict[str, str] = Field({}, description="Namespace, prefix of joints, topics and actions.")
    version: str | None = Field(None, pattern=r"^\d+\.\d+(\.\d+)*$",
                                description="Controller version at the calibration.")
    pose_sigma_m: float = Field(
        5e-5, ge=0, le=0.01, description="Repeatability of the arm over a few centimetres [m].")
    pose_sigma_rad: float = Field(3e-4, ge=0, le=0.1, description="Repeatability of the arm's "
                                                                  "rotation [rad].")
    joint_limits_rad: tuple[tuple[float, float], ...] | None = Field(
        None, description="Narrower joint limits, as in the controller's safety settings.")

    _known = field_validator("model")(_known_model)


class BaseEntry(_Entry):
    """The robot's base frame, as its pendant shows it, in the branch's frame."""

    pose: Pose = Field(description="Position [m] and rotation vector [rad]. ROS' base_link is "
                       "turned by 180 degrees about z from the pendant's base.")
    position_sigma_m: float = Field(0.005, ge=0, le=0.5)
    rotation_sigma_rad: float = Field(0.01, ge=0, le=0.5)
    residual_m: float | None = Field(None, ge=0, le=0.5,
                                     description="Residual of the calibration [m].")

    _near = field_validator("pose")(_in_metres)


class CapsuleEntry(_Entry):
    """A capsule in the frame of the flange: one part of the gripper's shape."""

    start_m: Vector
    end_m: Vector
    radius_m: float = Field(gt=0, le=1)


class ToolEntry(_Entry):
    """The gripper: its grasp pose, weight and shape."""

    grasp_pose: Pose = Field((0.0,) * 6, description="Frame of the grasp in the flange's frame: "
                             "its origin is between the fingers, its z the direction of approach, "
                             "its y lies along the branch.")
    mass_kg: float | None = Field(
        None, ge=0, le=20, description="Payload [kg]: all that the flange carries, with the "
                                       "sensor; 0 for a bare flange. The robot does not move "
                                       "without it.")
    centre_of_mass_m: Vector = Field((0.0, 0.0, 0.0), description="Position in the flange's frame "
                                                                  "[m].")
    parts: tuple[CapsuleEntry, ...] = ()
    compliance_m_per_n: float = Field(
        5e-5, ge=0, le=1e-2, description="Compliance of arm, fingers and bark [m/N].")
    gripper: Literal["none", "digital_output", "robotiq", "ros", "by_hand"] = Field(
        "by_hand", description="How it is driven. digital_output: by close_output. robotiq: by the "
        "socket of Robotiq's URCap. ros: by its action.")
    grip_force: float = Field(0.2, ge=0, le=1, description="Share of a Robotiq gripper's greatest "
                                                           "force.")
    grip_seconds: float = Field(
        1.0, gt=0, le=30, description="Time for the gripper to close or open [s].")
    close_output: int = Field(0, ge=0, le=7, description="Digital output that closes it.")

    _near = field_validator("grasp_pose", "centre_of_mass_m")(_in_metres)


class ApproachEntry(_Entry):
    """Approach and departure of the gripper."""

    direction: Vector = Field((0.0, 0.0, 1.0), description="Direction in which the gripper moves "
                              "to the branch, in the grasp's frame.")
    distance_m: float = Field(0.08, gt=0, le=1, description="Length of that straight motion [m].")

    @field_validator("direction")
    @classmethod
    def _unit(cls, value: Vector) -> Vector:
        length = float(np.linalg.norm(value))
        if length < 1e-9:
            raise ValueError("is zero and has no direction")
        x, y, z = (float(part) / length for part in value)
        return x, y, z


class SensorEntry(_Entry):
    """The force-torque sensor that the guard and recordings use."""

    kind: Literal["controller", "ft300", "ft300_usb", "none"] = Field(
        "controller", description="ft300: by its URCap's stream (port 63351 of the robot's "
        "address). ft300_usb: by Modbus on device.")
    device: str | None = Field(None, description="Serial line of kind = \"ft300_usb\".")
    topic: str | None = Field(None, min_length=1, description="Topic of its wrench in ROS "
                              "(geometry_msgs/msg/WrenchStamped). By default it is that of the "
                              "UR driver only for the own sensor of an e-Series arm.")
    pose: Pose = Field((0.0,) * 6, description="The sensor's frame in the flange's frame.")
    force_range_n: float = Field(100.0, gt=0)
    torque_range_nm: float = Field(10.0, gt=0)
    force_sigma_n: float = Field(0.15, gt=0)
    torque_sigma_nm: float = Field(0.02, gt=0)
    drift_n_per_minute: float = Field(0.8, ge=0)

    @model_validator(mode="after")
    def _has_its_line(self) -> "SensorEntry":
        if self.kind == "ft300_usb" and self.device is None:
            raise ValueError("device, the serial line of kind = \"ft300_usb\", is missing")
        return self


class LimitsEntry(_Entry):
    """Limits of every motion, clamped far below what the robot itself allows."""

    speed_m_s: float = Field(0.05, gt=0, le=MOST_SPEED)
    acceleration_m_s2: float = Field(0.3, gt=0, le=2.0)
    turn_speed_rad_s: float = Field(0.5, gt=0, le=MOST_TURN_SPEED)
    soft_force_n: float = Field(10.0, gt=0, description="Motion pauses.")
    hard_force_n: float = Field(20.0, gt=0, description="Motion stops.")
    hard_torque_nm: float = Field(3.0, gt=0)
    unexpected_force_n: float = Field(
        3.0, gt=0, description="Most that a force differs from the predicted one [N], beside that "
        "one's error; the likelihood stops earlier. And by how much it may rise in a return.")
    singularity: float = Field(0.05, gt=0, le=0.5)
    joint_margin_rad: float = Field(0.05, ge=0, le=1)
    contact_n_per_m: float = Field(
        RIGID_N_PER_M, gt=0, le=1e7, description="Stiffness of the stiffest thing that the gripper "
        "may run into [N/m]; by default a rigid one, 20000 for a thin panel, 1000 where there is "
        "only the branch. Motions are so slow that such a contact stays below hard_force_n plus a "
        "tenth.")

    @model_validator(mode="after")
    def _order(self) -> "LimitsEntry":
        if self.soft_force_n >= self.hard_force_n:
            raise ValueError("soft_force_n must be less than hard_force_n, because it pauses the "
                             "motion before hard_force_n stops it")
        return self


class CameraEntry(_Entry):
    """A depth camera: a pinhole that looks along its z axis, y down."""

    pose: Pose
    mount: Literal["branch", "flange"] = Field("branch", description="Frame of the pose.")
    width: int = Field(640, gt=0, le=20_000)
    height: int = Field(480, gt=0, le=20_000)
    focal_px: tuple[float, float] = (600.0, 600.0)
    centre_px: tuple[float, float] = (320.0, 240.0)
    range_m: tuple[float, float] = (0.2, 2.0)

    _near = field_validator("pose")(_in_metres)


class SecondArmEntry(_Entry):
    """Another arm that works on the branch while this one holds it."""

    model: str
    base_pose: Pose = Field(description="Its base frame in the branch's frame.")
    grasp_pose: Pose = Field((0.0,) * 6, description="Its tool in its flange's frame: the point "
                             "that must reach the target.")

    _known = field_validator("model")(_known_model)
    _near = field_validator("base_pose")(_in_metres)


class WorkspaceEntry(_Entry):
    """The box that contains the grasp, branch frame."""

    low_m: Vector
    high_m: Vector

    _near = field_validator("low_m", "high_m")(_in_metres)

    @model_validator(mode="after")
    def _order(self) -> "WorkspaceEntry":
        if not all(low < high for low, high in zip(self.low_m, self.high_m, strict=True)):
            raise ValueError("low_m must be below high_m in x, y and z")
        return self


_Edge = Annotated[float, Field(gt=0, le=FAR)]


class BoxEntry(_Entry):
    """A box as an obstacle."""

    kind: Literal["box"] = "box"
    name: str = ""
    size_m: tuple[_Edge, _Edge, _Edge] = Field(description="Edge lengths [m].")
    pose: Pose = Field(description="Pose of its centre in the branch's frame.")


class MeshEntry(_Entry):
    """A closed surface as an obstacle, branch frame."""

    kind: Literal["mesh"] = "mesh"
    name: str = ""
    file: str = Field(description="STL, PLY or OBJ, beside the cell file.")
    unit: Literal["m", "cm", "mm"] = "m"

    @property
    def scale(self) -> float:
        """Length of the file's unit [m]."""
        return {"m": 1.0, "cm": 0.01, "mm": 0.001}[self.unit]


ObstacleEntry = Annotated[BoxEntry | MeshEntry, Field(discriminator="kind")]


class Cell(_Entry):
    """Content of ``cell.toml``."""

    format_version: Literal[1] = 1
    branch: str | None = Field(None, description="Identity of the branch (branch.json) that "
                               "base.pose was calibrated for.")
    calibrated: str | None = Field(None, description="Date of the calibration, ISO 8601.")
    robot: RobotEntry
    base: BaseEntry
    tool: ToolEntry = ToolEntry()
    approach: ApproachEntry = ApproachEntry()
    sensor: SensorEntry = SensorEntry()
    limits: LimitsEntry = LimitsEntry()
    camera: CameraEntry | None = None
    second_arm: SecondArmEntry | None = None
    workspace: WorkspaceEntry | None = None
    obstacles: tuple[ObstacleEntry, ...] = ()

    @field_validator("obstacles", mode="before")
    @classmethod
    def _of_its_kind(cls, value: Any) -> Any:
        """Without a kind, an entry with a file is a mesh and any other a box."""
        return value if not isinstance(value, list | tuple) else [
            {"kind": "mesh" if "file" in one else "box", **one} if isinstance(one, dict) else one
            for one in value]

    @model_validator(mode="after")
    def _carries_its_tool(self) -> "Cell":
        if (self.tool.mass_kg or 0.0) > self.arm.payload:
            raise ValueError(f"tool.mass_kg is {self.tool.mass_kg:g}, but a {self.arm.name} "
                             f"carries at most {self.arm.payload:g} kg")
        return self

    @model_validator(mode="after")
    def _limits_each_joint(self) -> "Cell":
        limits, count = self.robot.joint_limits_rad, len(self.arm.joint_names)
        if limits is not None and len(limits) != count:
            raise ValueError(f"robot.joint_limits_rad has {len(limits)} rows, but a "
                             f"{self.arm.name} has {count} joints")
        return self

    @model_validator(mode="after")
    def _makes_sense(self) -> "Cell":
        if found_slips := list(slips(self)):
            raise ValueError("; ".join(found_slips))
        return self

    @property
    def arm(self) -> Arm:
        return arm_named(self.robot.model)

    @property
    def joint_limits(self) -> np.ndarray:
        """The cell's limits of the joints [rad] within the arm's, shape [joints, 2]."""
        limits = self.arm.joint_limits
        if self.robot.joint_limits_rad is None:
            return limits
        own = np.asarray(self.robot.joint_limits_rad, float)
        return np.column_stack([np.maximum(limits[:, 0], own[:, 0]),
                                np.minimum(limits[:, 1], own[:, 1])])

    def flange_frames(self, grasp_poses: np.ndarray) -> np.ndarray:
        """Return the flange's frames in the robot's base, [..., 4, 4], for grasp poses in the
        branch's frame [m, rad], shape [..., 6]."""
        return (inverted(matrices(np.array(self.base.pose))) @ matrices(grasp_poses)
                @ inverted(matrices(np.array(self.tool.grasp_pose))))

    def grasp_frames(self, flange_frames: np.ndarray) -> np.ndarray:
        """Return the grasp's frames in the branch's frame for flange frames [..., 4, 4]."""
        return (matrices(np.array(self.base.pose)) @ np.asarray(flange_frames, float)
                @ matrices(np.array(self.tool.grasp_pose)))


def read_cell(path: str | Path) -> Cell:
    """Read a cell file; InputError if it cannot be read, is not TOML (with the line), or an entry
    makes no sense (with the field)."""
    path = Path(path)
    content = read_toml(path, Text("the description of a robot's cell (TOML; ",
                                   Command("robot calibrate"), " makes one)"), finite=False)
    for entry in (content.get("robot"), content.get("second_arm")):
        # An arm's file is relative to the cell file, as those of obstacles are.
        if isinstance(entry, dict) and is_file(str(entry.get("model", ""))):
            entry["model"] = str(path.absolute().parent / entry["model"])
    try:
        return validated(Cell, content)
    except ValidationError as error:
        problems = "; ".join(_problem_text(path, item) for item in error.errors())
        raise InputError(problems, "A wrong entry can move the arm elsewhere, or stop it too late.",
                         "Correct the entries; lengths are in metres, angles in radians.",
                         ) from error


def write_cell(path: str | Path, cell: Cell) -> None:
    """Write a cell file; entries that are None are omitted."""
    content = _without_none(plain(cell))
    for name in ("robot", "second_arm"):
        model = Path(content.get(name, {}).get("model", ""))
        if model.is_relative_to(Path(path).absolute().parent):
            content[name]["model"] = model.relative_to(Path(path).absolute().parent).as_posix()
    write_atomically(Path(path), tomlkit.dumps(content))


def _problem_text(path: Path, item: Mapping[str, Any]) -> str:
    key = ".".join(str(part) for part in item["loc"])
    message = refusal_of(item)
    # An error that several entries cause together begins with the name of one of them.
    first = re.match(r"[\w.]+", message)
    named = tuple(first[0].split(".")) if first and not item["loc"] else item["loc"]
    line = _line_of(path, named)
    where = f"{path}, line {line}" if line else f"{path}"
    return f"{where}: {key}: {message}" if key else f"{where}: {message}"


def _line_of(path: Path, location: tuple) -> int | None:
    """Line of an entry: its key within its table, or the table's own line if the key is missing."""
    names = [part for part in location if isinstance(part, str)]
    table, found = "", None
    for number, line in enumerate(path.read_text(encoding="utf-8").splitlines(), start=1):
        text = line.strip()
        if text.startswith("["):
            table = text.strip("[] ").split("]")[0]
            if names and table == names[0] and found is None:
                found = number
        key = text.split("=")[0].strip()
        if "=" in text and ([table, key] if table else [key]) == names[:2 if table else 1]:
            return number
    return found


def _without_none(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _without_none(item) for key, item in value.items() if item is not None}
    if isinstance(value, list | tuple):
        return [_without_none(item) for item in value]
    return value


_FAR_FROM_ARM = 10.0  # m; distance of the branch's origin beyond the arm's reach
_AT_FLANGE = 1.0  # m; a tool is nearer to the flange
_WHOLE_TURN = 2 * math.pi + 1e-6
_DEGREES = 4 * math.pi  # no joint limit is beyond; in degrees nearly all are
_LARGEST_RANGE = {"force": 1e4, "torque": 1e3}  # [N], [N m]


def slips(cell: "Cell") -> Iterator[str]:
    """Yield contradictions of a cell with individually valid entries: "limits.hard_force_n is ...".
    """
    yield from _joint_slips(cell)
    yield from _pose_slips(cell)
    yield from _tool_slips(cell)
    yield from _limit_slips(cell)
    if cell.sensor.kind != "none":
        yield from _sensor_slips(cell.sensor, cell.limits.hard_force_n, cell.limits.hard_torque_nm)
    yield from _camera_slips(cell)
    yield from _position_slips(cell)


def _joint_slips(cell: "Cell") -> Iterator[str]:
    own = cell.robot.joint_limits_rad
    if own is None:
        return
    for number, (low, high) in enumerate(own):
        where = f"robot.joint_limits_rad, row {number + 1},"
        if max(abs(low), abs(high)) > _DEGREES:
            yield (f"{where} has {low:g} to {high:g} rad, which is over two turns; was it given in "
                   "degrees?")
        elif low >= high:
            yield f"{where} has {low:g} to {high:g} rad; the lower limit comes first"
        elif (np.diff(cell.joint_limits[number]) <= 2 * cell.limits.joint_margin_rad).any():
            yield (f"{where} has {low:g} to {high:g} rad, which leaves the joint no angle within "
                   f"the arm's own limits and the margin of {cell.limits.joint_margin_rad:g} rad")


def _pose_slips(cell: "Cell") -> Iterator[str]:
    reach = cell.arm.reach + _FAR_FROM_ARM
    poses: list[tuple[str, Any, float]] = [
        ("base.pose", cell.base.pose, reach), ("tool.grasp_pose", cell.tool.grasp_pose, _AT_FLANGE),
        ("sensor.pose", cell.sensor.pose, _AT_FLANGE)]
    if cell.camera is not None:
        most = _AT_FLANGE if cell.camera.mount == "flange" else FAR
        poses.append(("camera.pose", cell.camera.pose, most))
    if cell.second_arm is not None:
        poses += [("second_arm.base_pose", cell.second_arm.base_pose, reach),
                  ("second_arm.grasp_pose", cell.second_arm.grasp_pose, _AT_FLANGE)]
    poses += [(f"obstacles.{number}.pose", one.pose, FAR)
              for number, one in enumerate(cell.obstacles) if one.kind == "box"]
    for name, pose, most in poses:
        yield from _far(name, pose[:3], most)
        turn = math.hypot(*pose[3:])
        if turn > _WHOLE_TURN:
            yield (f"{name} is turned by {turn:g} rad, more than a whole turn; was the rotation "
                   "given in degrees?")
    yield from _far("tool.centre_of_mass_m", cell.tool.centre_of_mass_m, _AT_FLANGE)
    for number, part in enumerate(cell.tool.parts):
        for end in ("start_m", "end_m"):
            yield from _far(f"tool.parts.{number}.{end}", getattr(part, end), _AT_FLANGE)


def _tool_slips(cell: "Cell") -> Iterator[str]:
    """Values of the gripper that are those of a bare flange."""
    tool = cell.tool
    is_driven = tool.gripper in ("digital_output", "robotiq")
    if not any(tool.grasp_pose[:3]) and tool.gripper != "none" and (is_driven or tool.mass_kg):
        yield (f"tool.grasp_pose is at the flange, where the gripper (tool.gripper = "
               f'"{tool.gripper}") is screwed on; the flange would go where the fingers should be. '
               "State where the branch lies between the fingers, in the flange's frame, such as "
               "[0, 0, 0.15, 0, 0, 0] for fingers 0.15 m before it")
    if is_driven and tool.mass_kg == 0 and not cell.robot.address.startswith("127."):
        yield ("tool.mass_kg is 0, the mass of a bare flange, but tool.gripper is "
               f'"{tool.gripper}"; its weight would be taken for a force on the '
               "branch. State what the flange carries (`limber robot weigh` compares it)")


def _far(name: str, position: Any, most: float) -> Iterator[str]:
    distance = math.hypot(*position)
    if distance > most:
        yield (f"{name} is {distance:g} m away, farther than the {most:g} m that are possible; "
               f"{distance / 1000:g} m? Was it given in millimetres?")


def _limit_slips(cell: "Cell") -> Iterator[str]:
    limits, arm = cell.limits, cell.arm
    for name, value, most, unit in (
            ("hard_force_n", limits.hard_force_n, greatest_force(arm), "N"),
            ("unexpected_force_n", limits.unexpected_force_n, greatest_force(arm), "N"),
            ("hard_torque_nm", limits.hard_torque_nm, greatest_torque(arm), "N m")):
        if value > most:
            yield (f"limits.{name} is {value:g}, but a {arm.name} may exert at most {most:.3g} "
                   f"{unit}; {value / 1000:g} {unit}?")


def _sensor_slips(sensor: "SensorEntry", hard_force: float, hard_torque: float) -> Iterator[str]:
    for what, unit, hard, spread, span in (
            ("force", "n", hard_force, sensor.force_sigma_n, sensor.force_range_n),
            ("torque", "nm", hard_torque, sensor.torque_sigma_nm, sensor.torque_range_nm)):
        if hard < spread:
            yield (f"sensor.{what}_sigma_{unit} is {spread:g}, so that limits.hard_{what}_{unit} "
                   f"({hard:g}) is within its noise; was one of them given in another unit?")
        if span <= hard:
            yield (f"sensor.{what}_range_{unit} is {span:g}, but limits.hard_{what}_{unit} is "
                   f"{hard:g}: the sensor would be at the end of its range before the motion "
                   "stops")
        if span > _LARGEST_RANGE[what]:
            yield (f"sensor.{what}_range_{unit} is {span:g}, which no sensor at a flange has; "
                   f"{span / 1000:g}?")
    if sensor.drift_n_per_minute > sensor.force_range_n:
        yield (f"sensor.drift_n_per_minute is {sensor.drift_n_per_minute:g}, more than the "
               f"sensor's range ({sensor.force_range_n:g} N) in a minute")


def _camera_slips(cell: "Cell") -> Iterator[str]:
    camera = cell.camera
    if camera is None:
        return
    near, far = camera.range_m
    if not 0 <= near < far <= FAR:
        yield (f"camera.range_m is {near:g} to {far:g} m; it must rise, from 0 to at most {FAR:g} "
               "m. Was it given in millimetres?")
    if not all(0.1 * size < focal < 100 * size for focal, size in
               zip(camera.focal_px, (camera.width, camera.height), strict=True)):
        yield (f"camera.focal_px is {camera.focal_px}, which is no focal length of an image of "
               f"{camera.width} x {camera.height} pixels; was it given in millimetres?")
    if not all(0 <= at <= size for at, size in
               zip(camera.centre_px, (camera.width, camera.height), strict=True)):
        yield (f"camera.centre_px is {camera.centre_px}, outside the image of {camera.width} x "
               f"{camera.height} pixels")


def _position_slips(cell: "Cell") -> Iterator[str]:
    """Distances that the arm is to reach, compared with its reach from the base."""
    if cell.workspace is None:
        return
    low, high = np.array(cell.workspace.low_m), np.array(cell.workspace.high_m)
    shoulder = matrices(np.array(cell.base.pose)) @ np.r_[cell.arm.shoulder, 1.0]
    away = float(np.linalg.norm(shoulder[:3] - np.clip(shoulder[:3], low, high)))
    grasp = math.hypot(*cell.tool.grasp_pose[:3])
    # The distance from wrist to flange is less than the reach of any arm.
    most = 1.5 * cell.arm.reach + grasp
    if away > most:
        yield (f"workspace is {away:.3g} m from the arm's shoulder, but a {cell.arm.name} reaches "
               f"{most:.3g} m at most; are base.pose and workspace both in the branch's frame?")


_BY_CALIBRATION = ("format_version", "branch", "calibrated")  # by `limber robot calibrate`
_TEMPLATE_EXAMPLES: dict[str, Any] = {
    "tool": {"grasp_pose": [0.0, 0.0, 0.15, 0.0, 0.0, 0.0], "mass_kg": 0.9,
             "parts": [{"start_m": [0.0, 0.0, 0.0], "end_m": [0.0, 0.0, 0.12],
                        "radius_m": 0.04}]},
    "robot": {"version": "5.11.6", "joint_limits_rad": [[-3.1, 3.1]] * 6,
              "ros": {"namespace": "left", "prefix": "left_"}},
    "base": {"residual_m": 0.001},
    "sensor": {"device": "/dev/ttyUSB0", "topic": "/ft300/wrench"},
    "camera": {"pose": [0.0, -1.0, 0.5, -1.57, 0.0, 0.0]},
    "second_arm": {"model": "ur5e", "base_pose": [0.6, 0.6, 0.0, 0.0, 0.0, 0.0]},
    "workspace": {"low_m": [-0.4, -0.4, 0.0], "high_m": [0.4, 0.4, 1.2]},
    "obstacles": [{"kind": "box", "name": "table", "size_m": [1.0, 1.0, 0.04],
                   "pose": [0.5, 0.0, -0.02, 0.0, 0.0, 0.0]},
                  {"kind": "mesh", "name": "pot", "file": "pot.stl", "unit": "mm"}]}
"""Values that a user has to replace; they are commented out."""
TO_FILL_IN = ("grasp_pose", "mass_kg")
"""Keys of [tool] for which no value is usual: without them nothing moves."""

_TEMPLATE_HEAD = """\
# The cell: which robot stands where beside the branch, what it holds, what it must not exceed.
# Lengths in metres, angles in radians, masses in kilograms, forces in newtons. Frames: the branch's
# has z up; the flange's and the base's are those of the controller. Poses are position and rotation
# vector. Lines behind # show what else there is; take the sign away to use them.
#
# Next: limber robot check, then limber robot calibrate, which writes [base].
"""


def cell_template(cell: Cell) -> str:
    """Return the text of a cell file with all sections: what ``cell`` states, and examples."""
    parts = [_TEMPLATE_HEAD, "format_version = 1\n"]
    for name, entry in type(cell).model_fields.items():
        if name in _BY_CALIBRATION:
            continue
        value = getattr(cell, name)
        if name == "obstacles":
            parts += [_obstacle(plain(each), False) for each in value]
            parts += [_obstacle(each, True) for each in _TEMPLATE_EXAMPLES[name]]
            continue
        kind = _model_of(entry.annotation)
        stated = plain(value) if value is not None else {}
        if name == "tool":
            stated = {key: stated[key] for key in stated if key not in not_stated(cell)}
        lines = "\n".join(_template_lines(kind, stated, _TEMPLATE_EXAMPLES.get(name, {}),
                                          value is None))
        mark = "# " if value is None else ""
        parts.append(f"# {_first_line(kind)}\n{mark}[{name}]\n{lines}\n")
    return "\n".join(parts)


def not_stated(cell: Cell) -> list[str]:
    """Return the keys of [tool] that a cell with a gripper still has to state."""
    return [] if cell.tool.gripper == "none" else [
        name for name in TO_FILL_IN if getattr(cell.tool, name) == getattr(ToolEntry(), name)]


def _template_lines(kind: type[BaseModel], stated: dict[str, Any], examples: dict[str, Any],
                    is_example: bool) -> Iterator[str]:
    """The keys of a section; those that are not stated are examples, commented out."""
    for name, entry in kind.model_fields.items():
        value, mark = stated.get(name), ""
        if value in (None, [], {}) or is_example:
            value, mark = examples.get(name, entry.default), "# "
        if entry.description:
            yield f"# {entry.description}"
        if mark and kind is ToolEntry and name in TO_FILL_IN:
            yield "# TO FILL IN, measured at your gripper; the next line is only an example."
        yield f"{mark}{name} = {_written(value)}"


def _obstacle(entry: dict[str, Any], is_example: bool) -> str:
    mark = "# " if is_example else ""
    lines = [f"{mark}{name} = {_written(value)}" for name, value in entry.items()]
    comment = "A box in the way." if entry["kind"] == "box" else "A closed surface in the way."
    return "\n".join([f"# {comment}", f"{mark}[[obstacles]]", *lines]) + "\n"


def _written(value: Any) -> str:
    if isinstance(value, list | tuple) and any(isinstance(each, dict) for each in value):
        return "[" + ", ".join(map(_written, value)) + "]"
    return _inline(value) if isinstance(value, dict) else tomlkit.item(plain(value)).as_string()


def _inline(entry: dict[str, Any]) -> str:
    return "{" + ", ".join(f"{key} = {_written(value)}" for key, value in entry.items()) + "}"


def _model_of(annotation: Any) -> type[BaseModel]:
    """The model of a section, also of an optional one."""
    for each in (annotation, *getattr(annotation, "__args__", ())):
        if isinstance(each, type) and issubclass(each, BaseModel):
            return each
    raise TypeError(f"{annotation} is no section")


def _first_line(kind: type[BaseModel]) -> str:
    return (kind.__doc__ or "").strip().split("\n")[0]


_SAME_M, _SAME_RAD = 1e-3, 5e-3


def require_payload(cell: Cell) -> None:
    """Refuse to move an arm whose payload is not stated: InputError if the cell lacks the gripper's
    mass."""
    if cell.tool.mass_kg is None:
        raise InputError("The cell file does not state tool.mass_kg, so the payload is not set.",
                         "The controller and the guard would interpret the gripper's weight as a "
                         "force on it.", "Weigh the gripper and state its mass; 0 for a "
                                                "bare flange.")


def check_plan(made_for: dict[str, Any] | None, cell: Cell) -> str | None:
    """Return a warning if a plan was made without a robot's cell; ``made_for``: what its file
    states. InputError if that is another robot, branch or pose of the base."""
    if not made_for:
        return Text("The plan was made without a cell (", Command("plan", Option("cell")), "), so "
                    "obstacles and the gripper's shape were not checked.")
    if made_for.get("model") != cell.arm.name:
        raise InputError(f"The plan was made for a {made_for.get('model')}, but the cell has a "
                         f"{cell.arm.name}.", "The two arms differ in reach.",
                         "Plan again with this cell.")
    if made_for.get("branch") not in (None, cell.branch):
        raise InputError(f"The plan was made with a cell of branch {made_for['branch']}, but this "
                         "cell belongs to branch "
                         f"{cell.branch}.", "The robot would move to the position of another "
                         "branch.", "Plan again with this cell.")
    base = made_for.get("base_pose")
    if base is not None:
        off = np.abs(np.array(base, float) - np.array(cell.base.pose))
        if off[:3].max() > _SAME_M or off[3:].max() > _SAME_RAD:
            raise InputError(
                f"The plan was made with the robot's base {1e3 * off[:3].max():.1f} mm and "
                f"{np.degrees(off[3:].max()):.2f} degrees away from its pose in the cell file.",
                "The cell was calibrated again after planning, so reach and obstacles have "
                "changed.",
                "Plan again with this cell.")
    return None


def check_branch(cell: Cell, uuid: str, folder: object) -> str | None:
    """Return a warning if the cell names no branch; InputError if it was calibrated for another
    one."""
    if cell.branch is None:
        return Text("The cell file names no branch, so it is assumed that base.pose was calibrated "
                    "for this one. ", Command("robot calibrate"), " writes the name.")
    if cell.branch != uuid:
        raise InputError(f"The cell was calibrated for branch {cell.branch}, but {folder} is "
                         f"branch {uuid}.",
                         "The robot would move to the position of another branch.",
                         "Calibrate it for this branch: limber robot calibrate.")
    return None
