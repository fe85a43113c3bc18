"""Settings of estimates, of virtual pulls and of predictions; they load nothing heavy."""

from typing import TYPE_CHECKING, ClassVar, Literal

from pydantic import Field

from limber.core.settings import Groups, Settings

if TYPE_CHECKING:
    import numpy as np


class EstimateSettings(Settings):
    """How Young's modulus is found from pulls."""

    groups: ClassVar[Groups] = {
        "input": ("pull", "drive", "motion", "fractions"),
        "material": ("young", "poisson", "density", "gravity", "fit_poisson", "fit_density",
                     "fit_damping"),
        "solver": ("method", "forward", "key_frames", "evaluations", "delta_m2", "robust"),
        "uncertainty": ("field", "poisson_sigma", "density_sigma", "hung_sigma", "hold_out",
                        "mesh_check", "shapes"),
    }
    common = ("pull", "fractions")

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
    gravity: bool = Field(
        True, description="The branch bears its own weight, and was scanned so.")
    field: Literal["open", "inverse_distance"] = Field(
        "open", description="How Young's modulus runs between the control points. open: not "
        "known; the pull and its interval decide. inverse_distance: exactly as the paper's.")
    poisson_sigma: float = Field(
        0.05, ge=0, description="Standard deviation of Poisson's ratio, where it is not fitted.")
    density_sigma: float = Field(
        0.1, ge=0, description="Relative standard deviation of the density, where it acts.")
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
    hung_sigma: float = Field(
        0.4, ge=0, description="Relative standard deviation of the mass of twigs and leaves that "
        "hang on the branch beside its mesh: as far as two programs' volumes of one crown differ.")
    shapes: int = Field(
        16, ge=0, description="At the end, pull so many branches that the scan allows as well; "
        "how they differ enters the interval. 0: the radii's deviation alone, the axis as exact.")


class SwingSettings(Settings):
    """How Young's modulus and damping are found from a free swing."""

    groups: ClassVar[Groups] = {
        "input": ("pull", "periods"),
        "material": ("poisson", "density", "gravity"),
        "uncertainty": ("density_sigma",),
    }
    common = ("pull",)

    pull: str | None = Field(None, description="Name of the swing; without it the only one.")
    periods: float = Field(6.0, ge=2, le=30, description="So many periods after the release.")
    poisson: float | None = Field(None, ge=0, lt=0.495, description="Poisson's ratio.")
    density: float | None = Field(None, gt=0, description="Density [kg/m^3].")
    gravity: bool = Field(
        True, description="The branch bears its own weight, and was scanned so.")
    density_sigma: float = Field(
        0.1, ge=0, description="Relative standard deviation of the density: inertia tells the "
        "modulus, so it enters as it is.")


class VirtualPullSettings(Settings):
    """A simulated pull."""

    groups: ClassVar[Groups] = {
        "material": ("young", "poisson", "density", "damping", "gravity", "own_weight", "shape"),
        "motion": ("motion", "drive", "weight", "frames", "duration", "grasp_fraction", "mode",
            "reach", "turn", "phase"),
        "noise": ("position_noise", "force_noise", "torque_noise", "camera", "outliers", "seed"),
    }
    common = ("seed",)

    young: tuple[float, ...] = Field(
        (), description="True Young's modulus at the control points [Pa]; without it that of a "
        "generated branch, or a gradient from 160 to 40 MPa.")
    poisson: float = Field(0.35, ge=0, lt=0.5, description="True Poisson's ratio.")
    density: float = Field(900.0, gt=0, description="True density [kg/m^3].")
    motion: Literal["quasi_static", "dynamic"] = Field(
        "quasi_static", description="dynamic: fast, with inertia and damping. The gripper shakes "
        "the branch; with --drive force it pulls and lets go.")
    drive: Literal["pose", "force"] = Field(
        "pose", description="What is said to move the branch; force: its force, as in the paper.")
    weight: float | None = Field(
        None, gt=0, description="Hang a growing weight of at last so many newtons on the grasp "
        "instead of pulling sideways (slow, driven by force).")
    damping: tuple[float, float] = Field(
        (0.5, 0.002), description="True Rayleigh damping of a dynamic pull [1/s, s].")
    frames: int | None = Field(
        None, ge=2, description="Number of recorded frames; without it 24, or 60 of a dynamic "
        "pull.")
    duration: float | None = Field(
        None, gt=0, description="Length of the recording [s]; without it 6, or 1.5 of a dynamic "
        "pull.")
    grasp_fraction: float = Field(
        0.92, gt=0, le=1, description="Where the branch is held. Past the last control point: "
        "what lies beyond the grasp is not bent and cannot be estimated.")
    mode: Literal["clamped", "pinned"] = Field(
        "pinned", description="pinned: held in a loop that lets the branch turn; clamped: turned "
        "less than it would turn by itself, so that a torque acts.")
    reach: float = Field(
        0.35, gt=0, le=0.8, description="Sideways travel of the grasp over its arc length.")
    turn: float = Field(2.0, description="How far the pull's direction turns on the way [rad].")
    phase: float | None = Field(
        None, description="Direction in which it starts [rad]; without it drawn from the seed.")
    position_noise: float = Field(1e-3, ge=0, description="Noise of observed points [m].")
    force_noise: float = Field(
        0.02, ge=0, description="Noise of the force over its largest size.")
    torque_noise: float = Field(
        0.02, ge=0, description="Noise of the torque over its largest size (clamped).")
    gravity: bool = Field(
        True, description="The branch bears its own weight, and was scanned so.")
    own_weight: bool = Field(
        False, description="The shape is as drawn, without load: let gravity bend the branch out "
        "of it, as for `limber import-pull --own-weight`.")
    shape: Literal["likely", "fitted"] = Field(
        "likely", description="What is pulled where only a scan is known. likely: a branch that "
        "the scan allows as well as the reconstructed one, drawn from the seed; fitted: that one.")
    camera: bool = Field(
        False, description="Record depth images of a simulated D455 instead of points.")
    outliers: float = Field(0.0, ge=0, lt=0.5, description="Share of points displaced by 5 cm.")
    seed: int = Field(0, ge=0, description="Seed of all that is random.")

    @property
    def frame_count(self) -> int:
        return self.frames or (60 if self.motion == "dynamic" else 24)

    @property
    def times(self) -> "np.ndarray":
        """Time stamps [s], shape [frame_count]."""
        import numpy as np

        duration = self.duration or (1.5 if self.motion == "dynamic" else 6.0)
        return np.linspace(0.0, duration, self.frame_count)


class PredictSettings(Settings):
    """A load on a branch whose Young's modulus has been estimated."""

    groups: ClassVar[Groups] = {
        "input": ("pull",),
        "grasp and loads": ("weight", "load", "gravity"),
    }
    common = ("weight", "load")

    pull: str | None = Field(
        None, description="The pull whose points, grasp and gravity are taken; without it the "
        "first one.")
    weight: float | None = Field(None, ge=0, description="A hung weight [N].")
    load: tuple[float, float, float] | None = Field(
        None, description="A steady force in any direction, branch frame [N].")
    gravity: bool = Field(
        True, description="The branch bears its own weight, and was scanned so.")
