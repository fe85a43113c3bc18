"""Settings of what scans and surfaces become; they load nothing heavy."""

from typing import ClassVar, Literal

from pydantic import Field

from limber.core.settings import Direction, Groups, Settings

GRASP_FRACTION = 2.0 / 3.0
"""Where a branch is held, along its main path, if nothing is said."""


class PreparationSettings(Settings):
    """How the cloud is cleaned."""

    groups: ClassVar[Groups] = {
        "input": ("crop_low", "crop_high", "camera_at"),
        "shape": ("flying_angle", "flying_speck", "silhouette_reach", "keep_sheets",
            "outlier_ratio", "outlier_neighbours", "outlier_radius", "voxel"),
    }

    crop_low: tuple[float, float, float] | None = Field(
        None, description="Lower corner of the part to keep, in the file's coordinates.")
    crop_high: tuple[float, float, float] | None = Field(
        None, description="Upper corner of the part to keep.")
    camera_at: tuple[float, float, float] | None = Field(
        None, description="Where the one depth camera stood, in the file's coordinates; else the "
        "origin, if the cloud looks like an image from there.")
    flying_angle: float = Field(
        78.0, ge=0, lt=90, description="Depth camera: a step between neighbouring pixels is no "
        "surface if that would be seen at more than so many degrees; 0 keeps flying pixels.")
    flying_speck: int = Field(
        20, ge=1, description="Depth camera: groups of fewer pixels than that are dropped as "
        "flying.")
    silhouette_reach: float = Field(
        1.5, ge=0, description="Depth camera: a twig stays if, as the camera saw it, it reaches "
        "so many radii of its carrier beyond the carrier's axis; 0 keeps all.")
    keep_sheets: bool = Field(
        False, description="Keep walls and ground: wide flat sheets are else cut out.")
    outlier_ratio: float = Field(
        5.0, ge=0, description="Drop points whose neighbours are so many times as far as is usual "
        "around them; 0 keeps all.")
    outlier_neighbours: int = Field(8, ge=2, le=64, description="Neighbours that are looked at.")
    outlier_radius: float = Field(
        0.0, ge=0, description="Drop points with fewer neighbours than that within this radius "
        "[m]; 0: off.")
    voxel: float = Field(
        0.0, ge=0, description="Keep one point a cell of this size [m]; 0 keeps all.")


class SkeletonSettings(Settings):
    """How the skeleton is made."""

    groups: ClassVar[Groups] = {
        "shape": ("contraction_points", "attraction", "gap_factor", "bridge_limit",
            "prune", "twig_probability", "plants", "radii", "radius_low", "radius_high"),
    }

    contraction_points: int = Field(
        12_000, ge=50, description="Contract at most so many points (thinned evenly).")
    attraction: Literal["constant", "growing"] = Field(
        "constant", description="Attraction of the contraction: constant, or growing each "
        "iteration as neighbourhoods shrink, as the paper's source has it.")
    gap_factor: float = Field(
        3.0, gt=1, description="The paper's gamma: longer than so many median steps is a gap.")
    bridge_limit: float = Field(
        0.15, ge=0, le=1, description="Bridge gaps up to this share of the cloud's diagonal.")
    prune: float = Field(
        2.5, ge=0, description="A twig stays if it reaches so many radii of its carrier beyond "
        "the carrier's axis.")
    twig_probability: float = Field(
        0.5, ge=0, le=1, description="Drop twigs that are less likely there than that; 0 keeps "
        "all.")
    plants: Literal["refuse", "largest", "joined"] = Field(
        "refuse", description="Two plants in one cloud: refuse, take the largest, or join them.")
    radii: Literal["fit", "paper"] = Field(
        "fit", description="Radii fitted together with the axes, or the paper's median distance "
        "of the nearest points.")
    radius_low: float = Field(
        5e-4, ge=0, description="Radii are limited from below at this share of the diagonal.")
    radius_high: float = Field(
        0.1, gt=0, le=1, description="Radii are limited from above at this share.")


class MeshSettings(Settings):
    """How the tetrahedra are made."""

    groups: ClassVar[Groups] = {
        "mesh": ("mesher", "mesh_sides", "mesh_spacing", "mesh_time_limit", "mesh_memory_limit_mb"),
    }

    mesher: Literal["auto", "ftetwild", "sweep"] = Field(
        "auto", description="auto: sweep along the axes, and fTetWild where that cannot join a "
        "twig; ftetwild falls back to the sweep.")
    mesh_sides: int = Field(
        8, ge=4, le=24, description="Sides of the sections that fTetWild fills; the sweep has 6.")
    mesh_spacing: float = Field(
        2.5, gt=0.3, le=8, description="Distance of cross-sections in local radii.")
    mesh_time_limit: float = Field(60.0, gt=0, description="fTetWild's time limit [s].")
    mesh_memory_limit_mb: float = Field(4000.0, gt=0, description="fTetWild's memory limit [MB].")


class ReconstructSettings(PreparationSettings, SkeletonSettings, MeshSettings):
    """Everything that decides what a scan becomes."""

    groups: ClassVar[Groups] = {
        "input": ("unit", "up", "root", "upright"),
        "shape": ("twig_radius", "twig_order", "leaves", "unexplained", "leave_out"),
        "material": ("young", "poisson", "density", "leaf_density"),
        "mesh": ("grasp_fraction",),
    }
    common = ("unit", "up", "root", "leaves")

    unit: Literal["m", "cm", "mm", "in"] = Field("m", description="Unit of the file.")
    up: Direction = Field(
        (0.0, 0.0, 1.0), description="Which way is up in the file's axes.")
    root: tuple[float, float, float] | None = Field(
        None, description="A point near the root, in the file's coordinates; else the thick end.")
    upright: bool = Field(
        False, description="As in the paper, turn the branch so that it grows along z, and gravity "
        "with it; else the scan's own up stays up.")
    leaves: Literal["ask", "cut", "keep"] = Field(
        "ask", description="Where much of a scan is flat or lies on no round axis: cut: cut the "
        "leaves off and hang their mass on the stems; ask: the same, but stop if leaves are over "
        "10 % of the points; keep: all points are wood.")
    unexplained: float = Field(
        0.3, ge=0, le=1, description="Refuse a scan of whose points a larger share lies on no "
        "round axis (leaves); 1 takes all.")
    leave_out: bool = Field(
        False, description="Accept a mesh without twigs that hold over 3 % of the mass; their "
        "mass is kept.")
    twig_radius: float = Field(
        0.0, ge=0, description="Leave out twigs thinner than that [m], keep their mass.")
    twig_order: int = Field(
        9, ge=0, le=9, description="Leave out twigs of a higher branching order, keep their mass.")
    young: float = Field(1e8, gt=0, description="Young's modulus to start from [Pa].")
    poisson: float = Field(0.35, ge=0, lt=0.5, description="Poisson's ratio.")
    density: float = Field(900.0, gt=0, description="Density of the living wood [kg/m^3].")
    leaf_density: float = Field(
        0.2, ge=0, description="Mass of leaves over their area, one side [kg/m^2].")
    grasp_fraction: float = Field(
        GRASP_FRACTION, gt=0, le=1, description="Where the branch is held, along its main path.")


class MeshSurfaceSettings(Settings):
    """What a closed surface becomes."""

    groups: ClassVar[Groups] = {
        "input": ("unit", "up", "root", "upright"),
        "mesh": ("elements_across", "mesh_time_limit", "mesh_memory_limit_mb", "grasp_fraction"),
        "material": ("young", "poisson", "density"),
    }
    common = ("unit",)

    unit: Literal["m", "cm", "mm", "in"] = Field("m", description="Unit of the file.")
    up: Direction = Field(
        (0.0, 0.0, 1.0), description="Which way is up in the file's axes.")
    root: tuple[float, float, float] | None = Field(
        None, description="A point near the end that is held, in the file's coordinates; else "
        "the thicker end.")
    upright: bool = Field(True, description="Turn the long axis to z; gravity is turned with it.")
    elements_across: float = Field(
        3.0, gt=0.2, le=20, description="Elements across the body's thickness.")
    mesh_time_limit: float = Field(120.0, gt=0, description="fTetWild's time limit [s].")
    mesh_memory_limit_mb: float = Field(4000.0, gt=0, description="fTetWild's memory limit [MB].")
    young: float = Field(1e8, gt=0, description="Young's modulus to start from [Pa].")
    poisson: float = Field(0.35, ge=0, lt=0.5, description="Poisson's ratio.")
    density: float = Field(900.0, gt=0, description="Density [kg/m^3].")
    grasp_fraction: float = Field(
        GRASP_FRACTION, gt=0, le=1, description="Where the body is held, along its axis.")


class BranchSpec(Settings):
    """What a generated branch is like and how it is scanned."""

    groups: ClassVar[Groups] = {
        "shape": ("length", "radius_root", "radius_tip", "bend", "fork_count"),
        "scan": ("noise", "point_spacing", "unevenness", "occlusion", "view", "gap_count",
            "gap_length", "outlier_share"),
        "material": ("young_mean",),
    }

    length: float = Field(0.9, gt=0.05, description="Length of the main axis [m].")
    radius_root: float = Field(0.009, gt=0, description="Radius at the root [m].")
    radius_tip: float = Field(0.004, gt=0, description="Radius at the tip [m].")
    bend: float = Field(0.6, ge=0, description="Turn of the main axis from root to tip [rad].")
    fork_count: int = Field(3, ge=0, le=12, description="Number of side twigs.")
    noise: float = Field(0.001, ge=0, description="Standard deviation of the points [m].")
    point_spacing: float = Field(0.002, gt=0, description="Mean distance of the points [m].")
    unevenness: float = Field(0.4, ge=0, lt=1, description="How much the density varies, 0 to 1.")
    occlusion: float = Field(0.1, ge=0, lt=0.6, description="Share of the surface in holes.")
    view: Literal["round", "one-sided"] = Field(
        "round", description="Scanned from all around, or from one side as a depth camera does.")
    gap_count: int = Field(0, ge=0, le=5, description="Stretches without any point.")
    gap_length: float = Field(0.02, gt=0, description="Length of such a stretch [m].")
    outlier_share: float = Field(0.0, ge=0, lt=0.3, description="Share of stray points.")
    young_mean: float = Field(1e8, gt=0, description="Typical Young's modulus [Pa].")
