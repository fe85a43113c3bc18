"""Settings of an import; they load nothing heavy."""

from typing import ClassVar, Literal

from pydantic import Field

from limber.core.settings import Groups, Settings

Kind = Literal["auto", "pull", "markers", "c3d", "clouds", "rgbd", "force-displacement", "bag",
               "robot"]


class ImportSettings(Settings):
    """How to read a recording."""

    groups: ClassVar[Groups] = {
        "input": ("kind", "robot", "unit", "force_unit", "rate_hz", "nominal", "coordinates",
            "time_offset", "yolo_weights", "yolo_prompt", "yolo_class"),
        "bags and robot logs": ("cell", "frame_pose", "wrench_topic", "pose_topic",
            "points_topic", "bag_clock"),
        "grasp and loads": ("grasp_point", "grasp_radius", "grasp_mode", "weight", "load",
            "own_weight"),
        "simulation": ("drive", "motion", "swing_start"),
        "noise": ("position_sigma", "force_sigma", "torque_sigma"),
    }
    common = ("unit", "grasp_point", "cell")

    kind: Kind = Field("auto", description="What SOURCE is; auto goes by its name and content.")
    robot: str | None = Field(None, description="CSV of the gripper: time, pose and wrench.")
    unit: Literal["m", "cm", "mm"] | None = Field(
        None, description="Unit of positions in SOURCE; without it that of the columns' names, "
        "else metres.")
    force_unit: Literal["N", "gf", "mN", "lbf", "kgf", "kN"] | None = Field(
        None, description="Unit of forces; without it that of the columns' names, else newtons.")
    rate_hz: float | None = Field(
        None, gt=0, description="Frames a second, where SOURCE has no time stamps.")
    nominal: str | None = Field(
        None, description="CSV label,x_m,y_m,z_m: the markers' places on the branch at rest; the "
        "recording's first frames are fitted to it rigidly.")
    coordinates: Literal["branch", "scan"] = Field(
        "branch", description="Frame of --nominal, --grasp-point and --load: the branch folder's, "
        "or that of the file it was made from.")
    grasp_point: tuple[float, float, float] | None = Field(
        None, description="Where the gripper holds or the load hangs, at rest [m]; else the "
        "robot's first pose.")
    grasp_radius: float = Field(
        0.01, gt=0, description="Radius of the grasp patch; half the length of the piece that a "
        "clamping gripper holds [m].")
    grasp_mode: Literal["clamped", "pinned"] = Field(
        "clamped", description="clamped: the gripper also turns the branch.")
    weight: float | None = Field(
        None, ge=0, description="No robot, but a weight of so many newtons that hangs at "
        "--grasp-point: SOURCE shows the branch without it first, at rest under it last. 0 with "
        "--own-weight: held up first, it sags under its own weight.")
    load: tuple[float, float, float] | None = Field(
        None, description="The same for a steady force in any direction [N].")
    own_weight: bool = Field(
        False, description="The branch's own weight is not in its shape at rest (it was held up, "
        "or scanned lying): it acts as well.")
    drive: Literal["pose", "force"] = Field(
        "pose", description="What drives the simulation; the other is compared with it.")
    motion: Literal["quasi_static", "dynamic", "swing"] = Field(
        "quasi_static", description="dynamic where inertia matters; swing: let go without a robot "
        "(with --weight or --load), for `limber swing`.")
    swing_start: Literal["held", "loaded"] = Field(
        "held", description="A swing starts held in the shape at rest, until weight and load act; "
        "or loaded: bent by the load until that is gone.")
    time_offset: float | None = Field(
        None, description="Added to SOURCE's time stamps [s]; without it, it is estimated.")
    position_sigma: float | None = Field(
        None, gt=0, description="Noise of positions [m]; without it 1 mm, under a steady load "
        "what the recording shows.")
    force_sigma: float = Field(0.1, gt=0, description="Noise of forces [N].")
    torque_sigma: float | None = Field(
        None, gt=0, description="Noise of torques about the pose's position [N m]; a clamped "
        "gripper's torque is used only where this is known.")
    cell: str | None = Field(
        None, description="Cell file of the robot: its base in the branch's frame, and where its "
        "joints take the gripper.")
    frame_pose: tuple[float, float, float, float, float, float] | None = Field(
        None, description="Pose of the frame that gripper poses are given in, in the branch's: "
        "[m] and rotation vector [rad]; else the cell's base.")
    wrench_topic: str | None = Field(None, description="Topic of the wrench, where there are two.")
    pose_topic: str | None = Field(
        None, description="Topic of the gripper's pose, or its frame in TF, where there are two.")
    points_topic: str | None = Field(
        None, description="Topic of markers, clouds or depth images; none: nothing was seen.")
    bag_clock: Literal["header", "log"] = Field(
        "header", description="Time stamps of a bag: those of the messages, or when each came.")
    yolo_weights: str | None = Field(
        None, description="Weights file of a YOLO segmentation model of your own, for masks of "
        "an RGB-D folder's colour images (needs ultralytics).")
    yolo_prompt: str | None = Field(
        None, description="What it shall look for, for open-vocabulary models.")
    yolo_class: str | None = Field(None, description="Which of its classes is the branch.")
