"""Settings of an import; this module imports no heavy package."""

from itertools import permutations
from pathlib import Path
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from limber.core.settings import (
    Direction,
    GraspMode,
    Groups,
    OneOf,
    Settings,
    possible_force,
    possible_time,
)
from limber.recordings.recording_formats import kind_names

_AXES = ["-?" + ",-?".join(axes) for axes in permutations("xyz")]


class ImportSettings(Settings):
    """Settings for reading a recording."""

    groups: ClassVar[Groups] = {
        "input": ("kind", "robot", "unit", "force_unit", "rate_hz", "nominal", "marker_frame",
                  "coordinates", "time_offset", "yolo_weights", "yolo_prompt"),
        "bags and robot logs": ("cell", "frame_pose", "force_frame", "topic", "bag_clock"),
        "grasp and loads": ("grasp_point", "grasp_distance", "grasp_radius", "grasp_mode",
                            "direction", "weight", "load", "own_weight"),
        "simulation": ("motion", "swing_start"),
        "noise": ("force_sigma", "torque_sigma", "pull_toml"),
    }
    common = ("unit", "grasp_point", "grasp_mode", "cell", "robot", "nominal", "weight")

    kind: Annotated[str, OneOf(kind_names)] = Field(
        "auto", description="Kind of SOURCE. auto: determined from its name and content.")
    robot: Path | None = Field(None, description="CSV of the gripper with time, pose and wrench.")
    unit: Literal["m", "cm", "mm"] | None = Field(
        None, description="Unit of positions in SOURCE. Default: the unit in the columns' names, "
        "else metres.")
    force_unit: Literal["N", "gf", "mN", "lbf", "kgf", "kN"] | None = Field(
        None, description="Unit of forces. Default: the unit in the columns' names, else newtons.")
    rate_hz: float | None = Field(
        None, gt=0, description="Frames per second, if SOURCE has no time stamps.")
    nominal: Path | None = Field(
        None, description="CSV with label,x_m,y_m,z_m: positions of the markers on the branch at "
        "rest. A rigid transform fits the recording's first frames to them.")
    pull_toml: Path | None = Field(
        None, description="TOML file whose entries replace those that the import writes to the "
        "pull's pull.toml, such as the table calibration, or tared in the table sensor.")
    marker_frame: tuple[float, float, float, float, float, float] | None = Field(
        None, description="Pose of the frame in which SOURCE gives the markers, such as that of a "
        "motion capture system: [m] and rotation vector [rad]. Without it and without --nominal "
        "they are in the branch's frame.")
    coordinates: Literal["branch", "scan"] = Field(
        "branch", description="Coordinates of the tables of markers and gripper, of --nominal, "
        "--grasp-point, --load, --marker-frame and --frame-pose: the branch folder's, or those of "
        "the scan's file in metres.")
    grasp_point: tuple[float, float, float] | None = Field(
        None, description="Position of the grasp or the load at rest [m]. Default: the robot's "
        "first pose.")
    grasp_distance: float | None = Field(
        None, gt=0, description="Instead of --grasp-point: its distance from the base along the "
        "main path [m]. Default for a force table: its column of that distance.")
    direction: Direction = Field(
        (0.0, 0.0, -1.0), description="Direction of force and displacement in a force table, in "
        "the frame of --coordinates.")
    grasp_radius: float = Field(
        0.01, gt=0, description="Radius of the grasp patch, or half the length of the piece that "
        "a clamping gripper holds [m].")
    grasp_mode: GraspMode = Field(
        "rigid", description="rigid: the gripper holds position and rotation. point: "
            "it holds the position only.")
    weight: float | None = Field(
        None, ge=0, description="Weight [N] that hangs at --grasp-point instead of a robot's "
        "pull. SOURCE begins without it and ends at rest under it. 0 with --own-weight: the "
        "branch is held up first, then sags under its own weight.")
    load: tuple[float, float, float] | None = Field(
        None, description="As --weight, for a steady force in any direction [N].")
    own_weight: bool = Field(
        False, description="The scanned shape does not include the sag under the branch's own "
        "weight (it was held up, or scanned lying), so the weight acts as well.")
    motion: Literal["quasi_static", "dynamic", "swing"] = Field(
        "quasi_static", description="dynamic: inertia matters. swing: released without a robot. "
        "Markers with --weight or --load become a pull for `limber swing`; other records "
        "(accelerometer, strain gauge, video track, markers of a plucked branch) are evaluated "
        "by `limber vibration`.")
    swing_start: Literal["held", "loaded"] = Field(
        "held", description="Start of a swing. held: in the rest shape, until weight and load "
        "act. loaded: bent by the load until it is removed.")
    time_offset: float | None = Field(
        None, description="Added to SOURCE's time stamps [s]. Default: estimated.")
    force_sigma: float = Field(0.1, gt=0, description="Noise of forces [N].")
    torque_sigma: float | None = Field(
        None, gt=0, description="Noise of torques about the pose's position [N m]. A clamped "
        "gripper's torque is used only if this is given.")
    cell: Path | None = Field(
        None, description="The robot's cell file: its base in the branch's frame, and its "
        "kinematics.")
    frame_pose: tuple[float, float, float, float, float, float] | None = Field(
        None, description="Pose of the frame in which the gripper's poses, forces and torques are "
        "given: [m] and rotation vector [rad]. Default: the cell's base, else the branch's frame.")
    force_frame: Annotated[str, Field(
        pattern=f"^({'|'.join(['poses', 'tool', 'scan', *_AXES])})$")] | None = Field(
        None, description="Frame of forces and torques: poses, that of the poses; tool, the "
        "gripper's own; scan, that of the scan's file; or x, y, z by the columns, such as y,-x,z. "
        "Default: poses, and an import is refused if another explains how the branch bends much "
        "better.")
    topic: tuple[Annotated[str, Field(pattern="^(wrench|pose|points)=.+")], ...] = Field(
        (), description="A topic of a bag, if there are several for one of these. wrench=TOPIC: of "
        "the wrench. pose=TOPIC: of the gripper's pose, or its TF frame. points=TOPIC: of markers, "
        "clouds or depth images; points=none: no observations are used. May be given several "
        "times.", json_schema_extra={"metavar": "NAME=TOPIC"})
    bag_clock: Literal["header", "log"] = Field(
        "header", description="Time stamps of a bag: those in the messages' headers, or the "
            "times of logging.")
    yolo_weights: Path | None = Field(
        None, description="Weights file of your own YOLO segmentation model, for masks of an "
        "RGB-D folder's colour images (needs ultralytics).")
    yolo_prompt: str | None = Field(
        None, description="What the branch is: a prompt for an open-vocabulary model, or the name "
        "of a class of another.")

    _force = field_validator("weight", "load")(possible_force)

    def topic_of(self, name: str) -> str | None:
        """The topic that was given for the wrench, the pose or the points."""
        return dict(each.split("=", 1) for each in self.topic).get(name)


class ImportSpec(ImportSettings):
    """An import, with what only Python sets; a user states it in ``pull_toml``."""

    drive: Literal["pose", "force"] = Field(
        "pose", description="Quantity that drives the simulation. The other one is compared with "
        "the recording.")
    recorded: str | None = Field(
        None, description="When it was recorded: 2026-05-01 or 2026-05-01T14:00. With pulls of "
        "several days, the estimate states the change of the modulus per day.")
    position_sigma: float | None = Field(
        None, gt=0, description="Noise of positions [m]. Default: 1 mm; under a steady load, the "
        "noise measured in the recording.")

    _recorded = field_validator("recorded")(possible_time)
