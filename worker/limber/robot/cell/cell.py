"""The cell: robot base beside the branch, gripper and obstacles.

``cell.toml`` is written by ``limber robot calibrate`` and by hand. All lengths are in metres,
angles in radians, masses in kilograms. The branch's frame is that of its folder (z up).
"""

import re
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tomlkit
from pydantic import BaseModel, ConfigDict, Field, ValidationError, field_validator, model_validator

from limber.core.errors import InputError
from limber.core.files.atomic import write_atomically
from limber.core.files.reading import read_toml
from limber.core.json_values import plain, validated
from limber.core.numerics.rigid import inverted, matrices
from limber.robot.cell.implausible_values import FAR, slips
from limber.robot.interface import Arm
from limber.robot.known_arms import arm_named
from limber.robot.load_ratings import MOST_SPEED, MOST_TURN_SPEED
from limber.robot.urdf.chain_arm import ENDING

RIGID_N_PER_M = 2e5
"""Stiffness with which a gripper meets a rigid thing: that of the arm and its joints [N/m]."""

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

    model: str = Field(description="ur3, ur5, ur10, ur3e, ur5e, ur10e or "
                       "ur16e; the URDF file of another arm, beside the cell file.")
    address: str = Field("127.0.0.1", min_length=1, description="Address of the controller.")
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
    gripper: Literal["none", "digital_output", "robotiq", "by_hand"] = Field(
        "by_hand", description="How it is driven. digital_output: by close_output. robotiq: by the "
        "socket of Robotiq's URCap.")
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
        return tuple(float(part) / length for part in value)


class SensorEntry(_Entry):
    """The force-torque sensor that the guard and recordings use."""

    kind: Literal["controller", "ft300", "ft300_usb", "replay", "none"] = Field(
        "controller", description="ft300: by its URCap's stream (port 63351 of the robot's "
        "address). ft300_usb: by Modbus on device. replay reads a file and works only with the "
        "virtual robot.")
    device: str | None = Field(None, description="Serial line of kind = \"ft300_usb\".")
    file: str | None = Field(None, description="CSV of a replay: t_s and six columns, in the "
                             "sensor's frame.")
    topic: str | None = Field(None, min_length=1, description="Topic of its wrench in ROS "
                              "(geometry_msgs/msg/WrenchStamped). `limber ros` takes that of the "
                              "UR driver only for the own sensor of an e-Series arm.")
    pose: Pose = Field((0.0,) * 6, description="The sensor's frame in the flange's frame.")
    force_range_n: float = Field(100.0, gt=0)
    torque_range_nm: float = Field(10.0, gt=0)
    force_sigma_n: float = Field(0.15, gt=0)
    torque_sigma_nm: float = Field(0.02, gt=0)
    drift_n_per_minute: float = Field(0.8, ge=0)

    @model_validator(mode="after")
    def _has_its_file(self) -> "SensorEntry":
        if (self.kind == "replay") != (self.file is not None):
            raise ValueError("file is the CSV of kind = \"replay\", and is allowed only with it")
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
        3.0, gt=0, description="Largest difference between measured and predicted force [N]. With "
        "the branch held the guard allows less: two fifths of the predicted force, and the "
        "sensor's noise and drift.")
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


class BoxEntry(_Entry):
    """A box as an obstacle."""

    kind: Literal["box"] = "box"
    name: str = ""
    size_m: Vector = Field(description="Edge lengths.")
    pose: Pose = Field(description="Pose of its centre in the branch's frame.")

    @field_validator("size_m")
    @classmethod
    def _solid(cls, value: Vector) -> Vector:
        if min(value) <= 0 or max(value) > FAR:
            raise ValueError("edge lengths must be positive and in metres")
        return value


class MeshEntry(_Entry):
    """A closed surface as an obstacle, branch frame."""

    kind: Literal["mesh"] = "mesh"
    name: str = ""
    file: str = Field(description="STL, PLY or OBJ, beside the cell file.")
    unit: Literal["m", "cm", "mm"] = "m"


Obstacle = Annotated[BoxEntry | MeshEntry, Field(discriminator="kind")]


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
    obstacles: tuple[Obstacle, ...] = ()

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
        """Return the flange's frames in the robot's base for grasp poses in the branch's frame.

        Args:
            grasp_poses: [m, rad], shape [..., 6].

        Returns:
            Shape [..., 4, 4].
        """
        return (inverted(matrices(self.base.pose)) @ matrices(grasp_poses)
                @ inverted(matrices(self.tool.grasp_pose)))

    def grasp_frames(self, flange_frames: np.ndarray) -> np.ndarray:
        """Return the grasp's frames in the branch's frame for flange frames [..., 4, 4]."""
        return (matrices(self.base.pose) @ np.asarray(flange_frames, float)
                @ matrices(self.tool.grasp_pose))


def read_cell(path: str | Path) -> Cell:
    """Read a cell file.

    Raises:
        InputError: it cannot be read, is not TOML (the line is named), or an entry makes no sense
            (the field is named).
    """
    path = Path(path)
    content = read_toml(path, "the description of a robot's cell (TOML; `limber "
                              "robot calibrate` makes one)", finite=False)
    for entry in (content.get("robot"), content.get("second_arm")):
        # An arm's file is relative to the cell file, as those of obstacles are.
        if isinstance(entry, dict) and str(entry.get("model", "")).lower().endswith(ENDING):
            entry["model"] = str(path.absolute().parent / entry["model"])
    try:
        return validated(Cell, content)
    except ValidationError as error:
        problems = "; ".join(_problem_text(path, item) for item in error.errors())
        raise InputError(problems, "The robot's position or reach would be wrong.",
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


def _problem_text(path: Path, item: dict) -> str:
    key = ".".join(str(part) for part in item["loc"])
    message = item["msg"].removeprefix("Value error, ")
    # An error that several entries cause together begins with the name of one of them.
    named = tuple(re.match(r"[\w.]+", message)[0].split(".")) if not item["loc"] else item["loc"]
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
