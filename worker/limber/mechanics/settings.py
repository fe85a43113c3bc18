"""Settings of a simulated pull, without heavy imports."""

import math
from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from limber.core.constants import STANDARD_GRAVITY
from limber.core.settings import (
    GraspMode,
    Groups,
    OneOf,
    Settings,
    possible_force,
    possible_young,
    within,
)
from limber.mechanics.materials.laws import material_names

GRASP_RADIUS_M = 0.01
"""Radius of the grasp, and of the patches that hold or carry a load."""
FRAME_RATE = 60.0
"""Frames per second."""
Point = tuple[float, float, float]
PointLoad = tuple[float, float, float, float, float, float]
PlacedMass = tuple[float, float, float, float]


class SimulateSettings(Settings):
    """Options of `limber simulate`; without motion and force, it bends the branch a little."""

    groups: ClassVar[Groups] = {
        "output": ("name", "vtu"),
        "motion": ("kind", "move", "turn", "grasp_force", "duration", "hold"),
        "grasp and loads": ("grasp_point", "grasp_mode", "hold_at", "load_at",
                            "mass_at"),
        "material": ("young", "material", "gravity", "damping"),
        "solver": ("step", "newmark"),
    }
    common = ("name", "move", "turn", "grasp_force", "young", "kind", "duration")

    name: str = Field("simulate", pattern=r"^[\w-]+$",
                      description="Name of the result files: frames/NAME.pc2 and frames/NAME.json.")
    kind: Literal["static", "dynamic"] = Field(
        "dynamic", description="dynamic: motion in time. static: a sequence of equilibria.")
    move: tuple[float, float, float] | None = Field(
        None, description="Move the grasp by X Y Z [m].")
    turn: tuple[float, float, float] | None = Field(
        None, description="Turn the grasp by a rotation vector X Y Z [rad].")
    grasp_force: tuple[float, float, float] | None = Field(
        None, description="Pull the grasp by a force X Y Z [N] instead of moving it.")
    grasp_point: tuple[float, float, float] | None = Field(
        None, description="Position of the grasp X Y Z [m]. Default: the grasp that the mesh "
            "marks.")
    grasp_mode: GraspMode = Field(
        "rigid", description="rigid: hold position and rotation. point: hold "
            "the position only.")
    hold_at: tuple[Point, ...] = Field(
        (), description="Position X Y Z [m] of another gripper or a tie, with the same grasp "
        "mode. May be given several times.", json_schema_extra={"metavar": "X Y Z"})
    load_at: tuple[PointLoad, ...] = Field(
        (), description="A force FX FY FZ [N] at X Y Z [m] that grows with the pull. May be "
        "given several times.", json_schema_extra={"metavar": "X Y Z FX FY FZ"})
    mass_at: tuple[PlacedMass, ...] = Field(
        (), description="A mass KG [kg] (a fruit, a flower) at X Y Z [m], present from the start. "
        "May be given several times.", json_schema_extra={"metavar": "X Y Z KG"})
    duration: float = Field(1.0, gt=0, description="Duration of the pull [s].")
    hold: float = Field(0.5, ge=0, description="Duration of the hold at the end of the pull [s] "
        "(dynamic).")
    step: float = Field(1 / 60, gt=0, description="Longest time step [s] (dynamic).")
    newmark: Annotated[tuple[float, float] | None, within((1e-3, 0.5), (0.5, 1))] = Field(
        None, description="Integrate over time by the paper's implicit Newmark scheme with these "
        "beta (the paper's: 0.25) and gamma (0.5; above it damps high frequencies). Default: an "
        "energy-momentum scheme, which conserves the energy at any amplitude.",
        json_schema_extra={"metavar": "BETA GAMMA"})
    young: float | None = Field(
        None, gt=0, description="Young's modulus of the whole branch [Pa]. Default: the mesh's.")
    gravity: bool = Field(
        True, description="The branch carries its own weight, as when it was scanned.")
    material: Annotated[str, OneOf(material_names)] = Field(
        "st_venant_kirchhoff", description="Material law.")
    damping: Annotated[tuple[float, float], within((0, math.inf), (0, math.inf))] = Field(
        (0.5, 0.002), description="Rayleigh damping: mass-proportional [1/s] and "
        "stiffness-proportional [s].", json_schema_extra={"metavar": "MASS STIFFNESS"})
    vtu: bool = Field(False, description="Also write a VTU series for ParaView.")

    _force = field_validator("grasp_force")(possible_force)
    _young = field_validator("young")(possible_young)

    @field_validator("load_at", "mass_at")
    @classmethod
    def _possible_loads(cls, values: tuple[tuple[float, ...], ...]) -> tuple[tuple[float, ...],
                                                                             ...]:
        for placed in values:
            possible_force(placed[3:] if len(placed) > 4 else (placed[3] * STANDARD_GRAVITY,))
        return values


class SimulateSpec(SimulateSettings):
    """A simulation, with what only Python sets."""

    rest_shape: bool = Field(
        True, description="The scanned shape already sags under gravity. Otherwise gravity bends "
        "it further.")
