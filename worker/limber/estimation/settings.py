"""Options of an estimate."""

from typing import Literal

from pydantic import BaseModel, ConfigDict, Field


class EstimateSettings(BaseModel):
    """How Young's modulus is found from pulls."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    pull: tuple[str, ...] = Field((), description="Names of the pulls to use; without it all.")
    method: Literal["gauss-newton", "nelder-mead"] = Field(
        "gauss-newton", description="nelder-mead is the paper's.")
    forward: Literal["full", "reduced"] = Field(
        "full", description="reduced: a reduced model of slow pose-driven pulls, corrected by the "
        "full one; its basis is kept in the branch folder, and another estimate is quick.")
    drive: Literal["pose", "force"] | None = Field(
        None, description="pose: the gripper's pose moves the branch and its force is compared; "
        "force: the force pulls (the paper's). Without it as each pull says.")
    motion: Literal["quasi_static", "dynamic"] | None = Field(
        None, description="dynamic simulates inertia and damping; without it as each pull says.")
    fractions: tuple[float, ...] = Field(
        (0.2, 0.4, 0.6, 0.8), description="Places of the control points on the main path.")
    young: float | None = Field(
        None, gt=0, description="Young's modulus to start from [Pa]; without it, from the force.")
    poisson: float | None = Field(
        None, ge=0, lt=0.495, description="Poisson's ratio, fixed unless --fit-poisson.")
    density: float | None = Field(None, gt=0, description="Density [kg/m^3].")
    fit_poisson: bool = Field(False, description="Estimate Poisson's ratio too.")
    fit_density: bool = Field(False, description="Estimate the density too.")
    fit_damping: bool = Field(False, description="Estimate Rayleigh damping too (dynamic only).")
    key_frames: int = Field(
        12, ge=3, description="Frames that are simulated; a spline gives those between. Doubled "
        "where that shows in the result.")
    evaluations: int = Field(400, ge=1, description="Most forward simulations of all pulls.")
    delta_m2: float | None = Field(
        None, gt=0, description="Nelder-Mead stops at this mean squared distance [m^2].")
    robust: bool = Field(True, description="Outliers count less (Gauss-Newton).")
    hold_out: bool = Field(
        True, description="With several pulls: fit without each in turn, and score it.")
    mesh_check: bool = Field(
        True, description="At the end, see on a finer mesh how much this one is too stiff; it "
        "enters the interval.")
    shapes: int = Field(
        16, ge=0, description="At the end, pull so many branches that the scan allows as well; "
        "how they differ enters the interval. 0: the radii's deviation alone, the axis as exact.")
