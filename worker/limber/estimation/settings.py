"""Settings of estimates, virtual pulls and predictions, without heavy imports."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, field_validator, model_validator

from limber.core import settings as base
from limber.core.errors import Option, Text
from limber.geometry.settings import DENSITY_SIGMA

if TYPE_CHECKING:
    import numpy as np

    from limber.recordings.recording import CalibrationEntry

_QUICK = {"key_frames": 4, "hold_out": False, "mesh_check": False, "shapes": 0}


class EstimateSettings(base.Settings):
    """Options for estimating Young's modulus from pulls."""

    groups: ClassVar[base.Groups] = {
        "input": ("pull", "drive", "motion", "fractions"),
        "material": ("also", "field", "pith_radius", "bark"),
        "solver": ("method", "delta_m2", "quick"),
    }
    common = ("pull", "fractions", "method", "also", "quick")

    pull: tuple[str, ...] = Field((), description="Names of the pulls to use. Default: all.")
    method: Literal["gauss-newton", "nelder-mead"] = Field(
        "gauss-newton", description="Optimiser; nelder-mead is the paper's.")
    delta_m2: float | None = Field(
        None, gt=0, description="Mean squared distance of the points [m^2] below which "
        "nelder-mead ends: the paper's delta. Default: where it no longer falls.")
    quick: bool = Field(
        False, description="A first look: few simulated frames, no fit without each pull, no "
        "finer mesh and no other shapes of the branch. Its intervals are too narrow.",
        json_schema_extra={"switch": True})
    drive: Literal["pose", "force"] | None = Field(
        None, description="pose: the gripper's pose is prescribed, and its force is compared. "
        "force: the measured force is prescribed, as in the paper. Default: as each pull states.")
    motion: Literal["quasi_static", "dynamic"] | None = Field(
        None, description="dynamic: simulate inertia and damping. Default: as each pull states.")
    fractions: tuple[float, ...] = Field(
        (), description="Positions of the control points as fractions of the main path. Default: "
        "0.2,0.4,0.6,0.8, or fewer or more (1 to 6 at equal distances) where the pulls clearly "
        "support them.")
    field: Literal["open", "inverse_distance"] = Field(
        "open", description="Young's modulus between the control points. open: unknown, which "
        "widens the intervals. inverse_distance: interpolated exactly as in the paper.")
    also: tuple[Literal["poisson", "density", "damping", "orders", "frame"], ...] = Field(
        (), description="What to estimate too. poisson: Poisson's ratio. density. damping: "
        "Rayleigh damping (dynamic only). frame: that of the observed points, to 10 cm and 17 "
        "degrees, instead of within the pull's calibration; the result states what that costs. "
        "orders: the modulus of side branches over that of the main path, one ratio for each "
        "branching order. Pull or observe side branches: otherwise the pulls do not determine "
        "it.")
    pith_radius: float = Field(
        0.0, ge=0, description="Radius of a hollow or of pith that carries nothing [m]. The "
        "modulus is then that of the wood, and the mesh has an equivalent one for bending.")
    bark: Annotated[tuple[float, float] | None, base.within((0, 1), (0, 100))] = Field(
        None, description="Thickness of the bark [m], and the ratio of its Young's modulus to that "
        "of the wood.", json_schema_extra={"metavar": "THICKNESS RATIO"})

    @model_validator(mode="after")
    def _of_the_simplex(self) -> Self:
        if self.delta_m2 is not None and self.method != "nelder-mead":
            raise ValueError(Text(Option("delta_m2"), " ends only ",
                                  Option("method", "nelder-mead"), "; gauss-newton ends at the "
                                  "least loss"))
        return self

    @property
    def initial_fractions(self) -> tuple[float, ...]:
        """Positions of the control points of a first fit, as fractions of the main path."""
        from limber.geometry.skeleton.skeleton import FRACTIONS

        return self.fractions or FRACTIONS

    @property
    def section(self) -> dict[str, float]:
        """Layers of the cross-section, as :class:`limber.mechanics.materials.materials` takes
        them; empty for a solid one.
        """
        thickness, modulus = self.bark or (0.0, 0.0)
        layers = {"pith_radius": self.pith_radius, "bark_thickness": thickness,
                  "bark_modulus": modulus}
        return layers if self.pith_radius or thickness else {}


class FitSpec(EstimateSettings):
    """An estimate, with what only Python sets."""

    key_frames: int = Field(
        9, ge=3, description="Number of simulated frames. A spline interpolates the others. The "
        "number is doubled if that changes the result.")
    hold_out: bool = Field(
        True, description="With several pulls, fit without each one in turn, and compare it with "
            "its prediction.")
    mesh_check: bool = Field(
        True, description="Measure the excess stiffness of this mesh on a finer mesh, and include "
        "it in the intervals.")
    shapes: int = Field(
        16, ge=0, description="Number of posterior samples of the branch's shape given the scan. "
        "The pulls are simulated on each one to include the uncertainty of the shape in the "
        "intervals. 0: only the uncertainty of the radii.")
    young: float | None = Field(
        None, gt=0, description="Initial Young's modulus [Pa] where no measured force gives "
        "one. Default: the mesh's.")
    poisson: float | None = Field(
        None, ge=0, lt=0.5, description="Poisson's ratio, constant unless ``also`` has it. "
        "Default: the mesh's.")
    density: float | None = Field(
        None, gt=0, description="Density [kg/m^3]. Default: the mesh's.")
    gravity: bool = Field(
        True, description="The branch carries its own weight, as when it was scanned.")
    poisson_sigma: float = Field(
        0.05, ge=0, description="Standard deviation of Poisson's ratio if it is not fitted.")
    density_sigma: float = Field(
        DENSITY_SIGMA, ge=0, description="Relative standard deviation of the density, if weight or "
        "inertia acts.")
    hung_sigma: float = Field(
        0.4, ge=0, description="Relative standard deviation of the mass of twigs and leaves "
        "outside the mesh. The default is the difference between two programs' volumes of one "
        "crown.")

    _young = field_validator("young")(base.possible_young)
    _density = field_validator("density")(base.possible_density)

    @classmethod
    def of(cls, settings: base.Settings, **more: Any) -> Self:
        found = super().of(settings, **more)
        return found.model_copy(update=_QUICK) if found.quick else found


class SwingSettings(base.Settings):
    """Options for estimating Young's modulus and damping from a free swing."""

    groups: ClassVar[base.Groups] = {
        "input": ("pull",),
    }
    common = ("pull",)

    pull: str | None = Field(None, description="Name of the swing. Default: the only one.")


class VirtualPullSettings(base.Settings):
    """A simulated pull."""

    groups: ClassVar[base.Groups] = {
        "material": ("young",),
        "motion": ("model", "motion", "drive", "frames"),
        "noise": ("camera", "seed"),
        "errors of the cell": ("cell_errors",),
    }
    common = ("cell_errors", "seed", "young")
    results_version = 2

    young: tuple[float, ...] = Field(
        (), description="True Young's modulus at the control points [Pa]. Default: that of a "
        "generated branch, or a gradient from 160 to 40 MPa, stiffer if the branch could not carry "
        "itself.")
    model: Literal["tetrahedra", "rod"] = Field(
        "tetrahedra", description="tetrahedra: a finer mesh than the fit's. rod: a Cosserat rod of "
        "the true axes and radii, which shares no code with the fit's simulation. Only for slow "
        "pulls without --camera. Side branches are then rigid.")
    motion: Literal["quasi_static", "dynamic"] = Field(
        "quasi_static", description="dynamic: fast, with inertia and damping. The gripper shakes "
        "the branch; with --drive force it pulls and releases it.")
    drive: Literal["pose", "force"] = Field(
        "pose", description="Quantity that drives the branch according to the recording: the "
            "gripper's pose, or its force as in the paper.")
    frames: int | None = Field(
        None, ge=2, description="Number of recorded frames. Default: 24, or 60 for a dynamic "
        "pull.")
    camera: bool = Field(
        False, description="Record depth images of a simulated D455 instead of points.")
    cell_errors: str = Field(
        "none", description="Errors of the cell that stay during the recording, those of frames "
        "and gain the same in all pulls of a branch: none, realistic, or a TOML file whose table "
        "[calibration] has their standard deviations, as pull.toml has. realistic: those of a cell "
        "that was set up with care and not measured since (gripper 1 mm and 1 degree, force gain "
        "2 %, zero and drift 1 N, camera 1 mm, points 5 mm along the branch). The pull states "
        "them.")
    seed: int = Field(0, ge=0, description="Seed of all random numbers.")

    @property
    def calibration(self) -> "CalibrationEntry":
        """Standard deviations of the cell's errors.

        Raises:
            InputError: they are in a file that cannot be read.
        """
        from limber.recordings.recording import EXACT, CalibrationEntry, read_calibration

        if self.cell_errors == "none":
            return EXACT
        return (CalibrationEntry() if self.cell_errors == "realistic"
                else read_calibration(Path(self.cell_errors)))

    _young = field_validator("young")(base.possible_young)


class PullSpec(VirtualPullSettings):
    """A simulated pull, with what only Python sets."""

    poisson: float = Field(0.35, ge=0, lt=0.5, description="True Poisson's ratio.")
    density: float = Field(900.0, gt=0, description="True density [kg/m^3].")
    duration: float | None = Field(
        None, gt=0, description="Duration of the recording [s]. Default: 6, or 1.5 for a dynamic "
        "pull.")
    grasp_fraction: float = Field(
        0.92, gt=0, le=1, description="Position of the grasp as a fraction of the main path. It "
        "must be beyond the last control point: the branch does not bend beyond the grasp, so its "
        "modulus there cannot be estimated.")
    mode: base.GraspMode = Field(
        "point", description="point: a loop holds the branch and lets it turn. rigid: "
        "the gripper turns the branch less than it would turn freely, so that a torque "
        "acts.")
    reach: float = Field(
        0.35, gt=0, le=0.8, description="Sideways travel of the grasp as a fraction of its arc "
            "length.")
    phase: float | None = Field(
        None, description="Initial direction of the pull [rad]. Default: drawn from the seed.")
    position_noise: float = Field(1e-3, ge=0, description="Noise of the observed points [m].")
    force_noise: float = Field(
        0.02, ge=0, description="Noise of the force as a fraction of its largest value.")
    gravity: bool = Field(
        True, description="The branch carries its own weight, as when it was scanned.")
    own_weight: bool = Field(
        False, description="The shape is unloaded, as drawn. Gravity then bends the branch, as "
        "for `limber import-pull --own-weight`.")
    shape: Literal["likely", "fitted"] = Field(
        "likely", description="Branch that is pulled if only a scan is known. likely: a posterior "
        "sample of the shape given the scan, the same in all pulls. fitted: the reconstructed "
        "shape.")
    weight: float | None = Field(
        None, gt=0, description="Instead of pulling sideways, hang a weight on the grasp that "
        "grows to this value [N]. The pull is slow and force-driven.")
    damping: tuple[float, float] = Field(
        (0.5, 0.002), description="True Rayleigh damping of a dynamic pull [1/s, s].")
    torque_noise: float = Field(
        0.02, ge=0, description="Noise of the torque as a fraction of its largest value (rigid).")
    outliers: float = Field(0.0, ge=0, lt=0.5, description="Fraction of points displaced by 5 cm.")
    known: dict[str, float] = Field(
        {}, description="Standard deviations in place of those of cell_errors, by their names in "
        "[calibration] of pull.toml.")

    _density = field_validator("density")(base.possible_density)
    _force = field_validator("weight")(base.possible_force)

    @property
    def times(self) -> "np.ndarray":
        """Time stamps [s], shape [n]."""
        import numpy as np

        duration, count = (1.5, 60) if self.motion == "dynamic" else (6.0, 24)
        return np.linspace(0.0, self.duration or duration, self.frames or count)

    @property
    def calibration(self) -> "CalibrationEntry":
        """Standard deviations of the cell's errors, each as requested."""
        return super().calibration.model_copy(update=self.known)


class PredictSettings(base.Settings):
    """A load on a branch whose Young's modulus has been estimated."""

    groups: ClassVar[base.Groups] = {
        "input": ("pull",),
        "grasp and loads": ("weight", "load"),
    }
    common = ("weight", "load")

    pull: str | None = Field(
        None, description="Name of the pull whose points, grasp and gravity are used. Default: "
        "the first one.")
    weight: float | None = Field(None, ge=0, description="Weight that hangs on the grasp [N].")
    load: tuple[float, float, float] | None = Field(
        None, description="Steady force in any direction, in the branch's frame [N].")

    _force = field_validator("weight", "load")(base.possible_force)
