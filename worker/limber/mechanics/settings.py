"""Settings of a simulated pull; they load nothing heavy."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field

from limber.core.settings import Groups, OneOf, Settings
from limber.mechanics.materials.registry import material_names

Point = tuple[float, float, float]
PointLoad = tuple[float, float, float, float, float, float]
PlacedMass = tuple[float, float, float, float]


class SimulateSettings(Settings):
    """Options of `limber simulate`; with no motion and no force, one that bends it a little."""

    groups: ClassVar[Groups] = {
        "output": ("name", "frame_rate", "vtu"),
        "motion": ("kind", "move", "turn", "grasp_force", "duration", "hold"),
        "grasp and loads": ("grasp_point", "grasp_radius", "grasp_mode", "hold_at", "load_at",
            "mass_at"),
        "material": ("young", "material", "gravity", "rest_shape", "damping_mass",
            "damping_stiffness"),
        "solver": ("step", "scheme", "newmark_beta", "newmark_gamma", "lumped_mass"),
    }
    common = ("name", "move", "grasp_force", "young")

    name: str = Field("simulate", pattern=r"^[\w-]+$",
                      description="Name of the result: frames/NAME.pc2 and frames/NAME.json.")
    kind: Literal["static", "dynamic"] = Field(
        "dynamic", description="dynamic: motion in time; static: a path of equilibria.")
    move: tuple[float, float, float] | None = Field(
        None, description="Move the grasp by X Y Z [m].")
    turn: tuple[float, float, float] | None = Field(
        None, description="Turn the grasp by a rotation vector X Y Z [rad].")
    grasp_force: tuple[float, float, float] | None = Field(
        None, description="Pull the grasp with a force X Y Z [N] instead of moving it.")
    grasp_point: tuple[float, float, float] | None = Field(
        None, description="Grasp at X Y Z [m] instead of where the mesh marks it.")
    grasp_radius: float = Field(
        0.01, gt=0, description="Radius [m] of that grasp, and of the patches of --hold-at and "
        "--load-at.")
    grasp_mode: Literal["clamped", "pinned"] = Field(
        "clamped", description="clamped: position and rotation held; pinned: position alone.")
    hold_at: tuple[Point, ...] = Field(
        (), description="A second gripper or a tie holds the branch at X Y Z [m], as the grasp "
        "mode says; may be given several times.", json_schema_extra={"metavar": "X Y Z"})
    load_at: tuple[PointLoad, ...] = Field(
        (), description="At X Y Z [m] a force FX FY FZ [N] grows with the pull; may be given "
        "several times.", json_schema_extra={"metavar": "X Y Z FX FY FZ"})
    mass_at: tuple[PlacedMass, ...] = Field(
        (), description="At X Y Z [m] hang KG (a fruit, a flower), from the start; may be given "
        "several times.", json_schema_extra={"metavar": "X Y Z KG"})
    duration: float = Field(1.0, gt=0, description="Time of the pull [s].")
    hold: float = Field(0.5, ge=0, description="Time at the end of the pull [s] (dynamic).")
    frame_rate: float = Field(60.0, gt=0, le=2000, description="Frames a second.")
    step: float = Field(1 / 60, gt=0, description="Longest time step [s] (dynamic).")
    scheme: Literal["energy_momentum", "newmark"] = Field(
        "energy_momentum", description="energy_momentum: gains no energy however far the branch "
        "swings; newmark: the paper's (dynamic).")
    newmark_beta: float = Field(
        0.25, gt=0, le=0.5, description="Newmark's beta (--scheme newmark).")
    newmark_gamma: float = Field(
        0.5, ge=0.5, le=1, description="Newmark's gamma (--scheme newmark); over 0.5 damps fast "
        "vibration.")
    lumped_mass: bool = Field(
        False, description="Mass at the nodes alone instead of the consistent mass matrix.")
    young: float | None = Field(
        None, gt=0, description="Young's modulus everywhere [Pa] instead of the mesh's.")
    gravity: bool = Field(
        True, description="The branch bears its own weight, and was scanned so.")
    rest_shape: bool = Field(
        True, description="Take the scan as already sagging under gravity; else gravity bends it.")
    material: Annotated[str, OneOf(material_names)] = Field(
        "st_venant_kirchhoff", description="Material law.")
    damping_mass: float = Field(0.5, ge=0, description="Damping on velocity [1/s].")
    damping_stiffness: float = Field(0.002, ge=0, description="Damping on strain rate [s].")
    vtu: bool = Field(False, description="Also write a VTU series that ParaView opens.")
