"""Settings of reconstruction from scans and surfaces; this module imports nothing heavy."""

from typing import Annotated, ClassVar, Literal

from pydantic import Field, field_validator

from limber.core.optional import Choices
from limber.core.settings import (
    Direction,
    Groups,
    OneOf,
    Settings,
    possible_density,
    possible_young,
)

ESTIMATORS = Choices("limber.radii", {
    "fit": "", "paper": "limber.geometry.skeleton.radii.nearest_points:nearest_point_radii"})
"""Estimators of a skeleton's radii: called with the aligned skeleton as fitted, the aligned points
[m], shape [m, 3], and the settings, they return the skeleton with their radii; ``fit`` leaves it.
"""
OPEN = 0.8
"""Probability below which a decision is an open question."""
GRASP_FRACTION = 2.0 / 3.0
"""Position along the main path at which a branch is held by default."""
DENSITY_SIGMA, POISSON, GIVEN_POISSON_SIGMA = 0.1, 0.35, 0.03
"""Relative standard deviation of the density of wood that nobody weighed; Poisson's ratio where
none was given, and the standard deviation of one that was."""


class PreparationSettings(Settings):
    """Settings of the cloud's cleaning."""

    groups: ClassVar[Groups] = {
        "input": ("crop", "camera_at"),
        "shape": ("keep",),
    }

    crop: tuple[float, float, float, float, float, float] | None = Field(
        None, description="Box to keep: lower corner, upper corner, in the file's coordinates.")
    camera_at: tuple[float, float, float] | None = Field(
        None, description="Position of the depth camera, in the file's coordinates. Default: the "
        "origin, if the cloud is an image seen from there.")
    keep: tuple[Literal["sheets", "flying"], ...] = Field(
        (), description="What is usually removed and is to be kept. sheets: walls and ground, "
        "which are wide and flat. flying: points that look like flying pixels, in a cloud that "
        "one depth camera saw.")


class SkeletonSettings(Settings):
    """Settings of the skeleton."""

    groups: ClassVar[Groups] = {
        "shape": ("plants",),
        "the paper's equations": ("contraction_weight", "gap_factor", "radii",
                                  "radius_neighbours", "radius_range"),
    }

    plants: Literal["refuse", "largest", "joined"] = Field(
        "refuse", description="Two plants in one cloud: refuse the cloud, keep the largest, or "
            "join them.")
    contraction_weight: float = Field(
        1.0, gt=0, le=1e3, description="Weight of smoothness relative to that of position in the "
        "first contraction of the cloud: W_L / W_H of the paper's equation 1.")
    gap_factor: float = Field(
        3.0, gt=1, le=100, description="A step between contracted points of more than this many "
        "median steps is a gap: the paper's gamma.")
    radii: Annotated[str, OneOf(ESTIMATORS.names)] = Field(
        "fit", description="fit: radii fitted together with the axes. paper: the median distance "
        "of the nearest points from each node of the skeleton.")
    radius_neighbours: int = Field(
        24, ge=1, le=10_000, description="Number of nearest points for --radii paper: the paper's "
        "k.")
    radius_range: tuple[float, float] = Field(
        (5e-4, 0.1), description="Smallest and largest radius for --radii paper, as fractions of "
        "the cloud's diagonal D: the paper's alpha and beta.",
        json_schema_extra={"metavar": "LOW HIGH"})

    @field_validator("radius_range")
    @classmethod
    def _ordered(cls, limits: tuple[float, float]) -> tuple[float, float]:
        low, high = limits
        if not 0 < low < high <= 1:
            raise ValueError("the smallest radius must be above 0 and below the largest, which is "
                             "at most 1")
        return limits


class MeshSettings(Settings):
    """Settings of the tetrahedra."""

    groups: ClassVar[Groups] = {
        "mesh": ("mesher", "mesh_spacing"),
    }

    mesher: Literal["auto", "ftetwild", "sweep"] = Field(
        "auto", description="auto: a sweep along the axes, or fTetWild if the sweep cannot join "
        "a twig. ftetwild: fTetWild, with the sweep as its fallback.")
    mesh_spacing: float = Field(
        2.5, gt=0.3, le=8, description="Distance between cross-sections in local radii.")


class BodySettings(Settings):
    """Settings of any branch with tetrahedra: its material, grasp and up direction."""

    groups: ClassVar[Groups] = {
        "material": ("young", "poisson", "density", "density_sigma"),
        "mesh": ("grasp_fraction",),
    }

    up: Direction = Field(
        (0.0, 0.0, 1.0), description="The up direction in the file's axes.")
    young: float | None = Field(
        None, gt=0, description="Young's modulus until it is estimated [Pa]. Default: assumed, so "
        "that the branch carries itself.")
    poisson: float = Field(POISSON, ge=0, lt=0.5, description="Poisson's ratio; if given, to 0.03.")
    density: float = Field(900.0, gt=0, description="Density of the living wood [kg/m^3].")
    density_sigma: float = Field(
        DENSITY_SIGMA, ge=0, le=1, description="Relative standard deviation of the density: 0.02 "
        "where a piece of the branch was weighed.")
    grasp_fraction: float = Field(
        GRASP_FRACTION, gt=0, le=1, description="Position of the grasp as a fraction of the main "
            "path.")

    _young = field_validator("young")(possible_young)
    _density = field_validator("density")(possible_density)


class ReconstructSettings(BodySettings, PreparationSettings, SkeletonSettings, MeshSettings):
    """All settings of a scan's reconstruction."""

    groups: ClassVar[Groups] = {
        "input": ("unit", "up", "root", "upright"),
        "shape": ("twig_radius", "leaves", "unexplained", "leave_out"),
    }
    common = ("unit", "up", "root", "leaves", "plants", "crop")

    unit: Literal["m", "cm", "mm", "in", "um"] = Field(
        "m", description="Unit of the file, if it does not state one.")
    root: tuple[float, float, float] | Literal["auto"] | None = Field(
        None, description="A point near the root, in the file's coordinates. auto: the likeliest "
        "end, however unlikely. Default: the likeliest end, but stop if its probability is below "
        "0.8.")
    upright: bool = Field(
        False, description="Turn the branch, and gravity with it, so that it grows along z, as "
        "in the paper. Default: keep the scan's up direction.")
    leaves: Literal["ask", "cut", "keep"] = Field(
        "ask", description="Leaves. cut: remove them and hang their mass on the stems. ask: the "
        "same, but stop if they are more than 10 % of the points. keep: treat all points as "
        "wood.")
    unexplained: float = Field(
        0.3, ge=0, le=1, description="Refuse a scan if a larger fraction of its points belongs "
        "to no round axis and shows leaves or supports. Points that show neither may be half of "
        "the scan. 1 accepts all.")
    leave_out: bool = Field(
        False, description="Accept a mesh without twigs that hold more than 3 % of the mass. "
        "Their mass is kept.")
    twig_radius: float = Field(
        0.0, ge=0, description="Leave twigs thinner than this [m] out of the mesh, and keep "
            "their mass.")


class MeshSurfaceSettings(BodySettings):
    """Settings of a closed surface."""

    groups: ClassVar[Groups] = {
        "input": ("unit", "up", "root", "upright"),
    }
    common = ("unit", "root")

    unit: Literal["m", "cm", "mm", "in"] = Field("m", description="Unit of the file.")
    root: tuple[float, float, float] | None = Field(
        None, description="A point near the fixed end, in the file's coordinates. Default: the "
        "thicker end.")
    upright: bool = Field(True, description="Turn the long axis to z, and gravity with it.")


class GeneratedSettings(Settings):
    """Settings of a generated branch and its scan."""

    groups: ClassVar[Groups] = {
        "shape": ("length", "radius_root", "fork_count"),
        "scan": ("noise", "point_spacing", "view"),
    }

    length: float = Field(0.9, gt=0.05, description="Length of the main axis [m].")
    radius_root: float = Field(0.009, gt=0, description="Radius at the root [m].")
    fork_count: int = Field(3, ge=0, le=12, description="Number of side twigs.")
    noise: float = Field(0.001, ge=0, description="Standard deviation of the points [m].")
    point_spacing: float = Field(0.002, gt=0, description="Mean distance of the points [m].")
    view: Literal["round", "one-sided"] = Field(
        "round", description="Scanned from all around, or from one side as a depth camera does.")


class BranchSpec(GeneratedSettings):
    """A generated branch, with what only Python sets."""

    occlusion: float = Field(0.1, ge=0, lt=0.6, description="Fraction of the surface that is "
        "missing.")
    gap_count: int = Field(0, ge=0, le=5, description="Number of stretches of 2 cm without points.")
    radius_tip: float = Field(0.004, gt=0, description="Radius at the tip [m].")
    bend: float = Field(0.6, ge=0, description="Turn of the main axis from root to tip [rad].")
    unevenness: float = Field(0.4, ge=0, lt=1, description="Variation of the point density, 0 to "
        "1.")
    young_mean: float = Field(1e8, gt=0, description="Typical Young's modulus [Pa].")
