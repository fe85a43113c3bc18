"""Settings of the energy field and of paths; they load nothing heavy."""

from typing import ClassVar, Literal

from pydantic import Field

from limber.core.settings import Groups, Settings


class EnergySettings(Settings):
    """How the energy field is sampled."""

    groups: ClassVar[Groups] = {
        "samples": ("samples", "field_error", "deflection", "seed"),
        "material": ("gravity",),
        "solver": ("forward",),
    }
    samples: int = Field(225, ge=30, description=(
        "Grasp positions to solve: two thirds lie evenly, the others where neighbours do not "
        "agree."))
    field_error: float | None = Field(None, gt=0, description=(
        "Percent that the energy may be off at samples left out of the fit (root mean square over "
        "theirs): more poses are solved where it is off most, up to four times --samples."))
    deflection: float = Field(0.4, gt=0, le=1.0, description=(
        "Largest distance from rest, as a share of the branch's length up to the grasp."))
    gravity: bool = Field(True, description=(
        "The branch bears its own weight, and was scanned so. Otherwise it has no weight."))
    seed: int = Field(0, ge=0, description="Of the sampled positions.")
    forward: Literal["full", "reduced"] = Field("full", description=(
        "reduced: the model that `limber session --mode pinned` learns, kept for both and learnt "
        "first where there is none; each of its states is corrected once by the full model, which "
        "solves those in doubt."))


class PlanSettings(Settings):
    """From where to where, what counts and what is not allowed."""

    groups: ClassVar[Groups] = {
        "start and goal": ("goal", "tip_goal", "target", "target_box", "in_view", "second_arm",
                           "goal_seed", "goal_tolerance", "start", "start_seed"),
        "weights and limits": ("deformation_weight", "distance_weight", "max_detour", "max_energy",
                               "max_force", "max_axial_force", "max_torque", "max_strain",
                               "wood", "max_stress", "workspace_low", "workspace_high",
                               "confidence"),
        "timing": ("speed", "acceleration", "inertia", "slowings"),
        "solver": ("planner", "iterations", "engine", "field_error", "replans", "seed"),
    }
    common = ("goal", "tip_goal", "target", "max_force", "max_strain")

    goal: tuple[float, float, float] | None = Field(None, description=(
        "Where the grasp shall be, in the branch's frame [m]; without any goal a far pose is "
        "chosen and named."))
    tip_goal: tuple[float, float, float] | None = Field(None, description=(
        "Where the branch's tip (its flower), or --target, shall be, in the branch's frame [m]."))
    target: str | None = Field(None, description=(
        "Named target (`limber target`) that --tip-goal, --target-box, --in-view and "
        "--second-arm speak of; without it the tip."))
    target_box: tuple[float, float, float, float, float, float] | None = Field(None, description=(
        "Box that the target shall be in: lower corner, upper corner, in the branch's frame [m]."))
    in_view: bool = Field(False, description=(
        "The target shall be in the view of the cell's camera: in its picture, in its range, and "
        "not hidden by the branch."))
    second_arm: bool = Field(False, description=(
        "The target shall be where the cell's second arm can take it."))
    goal_seed: int | None = Field(None, ge=0, description=(
        "A grasp pose drawn at random from the paper's hemisphere, above the base and as far as "
        "the branch is long, among those known, allowed and far from rest."))
    goal_tolerance: float = Field(0.01, gt=0, le=1, description="Radius of the goal region [m].")
    start: tuple[float, float, float] | None = Field(None, description=(
        "Where the grasp starts [m]; default the rest pose."))
    start_seed: int | None = Field(None, ge=0, description=(
        "Start from a random deformed configuration instead, as in the paper's trials."))
    deformation_weight: float = Field(1.0, ge=0, description=(
        "Weight of deformation, the paper's alpha_def."))
    distance_weight: float = Field(1.5, gt=0, description=(
        "Weight of distance, the paper's alpha_dis."))
    max_detour: float | None = Field(None, ge=0, le=1000, description=(
        "The gentlest path that is at most so many percent longer than the shortest one; sets the "
        "weight of distance."))
    max_energy: float | None = Field(None, gt=0, description=(
        "Deformation energy that no pose may exceed [J]."))
    max_force: float | None = Field(None, gt=0, description=(
        "Force of the gripper that no pose may exceed [N]."))
    max_axial_force: float | None = Field(None, gt=0, description=(
        "Part of that force along the branch, pulling or pushing, that no pose may exceed [N]."))
    max_torque: float | None = Field(None, gt=0, description=(
        "Torque of the gripper that no pose may exceed [Nm]. A gripper that turns as the branch "
        "does needs nearly none."))
    max_strain: float | None = Field(None, gt=0, lt=1, description=(
        "Largest principal strain anywhere in the branch that no pose may exceed (0.01 is 1 %)."))
    wood: Literal["ash", "cherry", "maple", "oak", "walnut"] | None = Field(None, description=(
        "Limit the strain to half of what green wood of this kind breaks at (0.3 %; Wood Handbook "
        "FPL-GTR-190); young shoots bear more: --max-strain."))
    max_stress: float | None = Field(None, gt=0, description=(
        "Largest principal stress anywhere in the branch that no pose may exceed [Pa]; held for "
        "the stiff end of the estimate's intervals."))
    workspace_low: tuple[float, float, float] | None = Field(None, description=(
        "Lower corner of the box that the grasp stays in, in the branch's frame [m]."))
    workspace_high: tuple[float, float, float] | None = Field(None, description=(
        "Upper corner of that box [m]."))
    confidence: float | None = Field(None, ge=0.5, lt=1, description=(
        "Probability with which the limits are kept, Young's modulus being as uncertain as the "
        "estimate says; without it they are kept for the estimate."))
    speed: float = Field(0.02, gt=0, le=0.25, description="Of the gripper, at most [m/s].")
    acceleration: float = Field(0.1, gt=0, le=2.0, description=(
        "Of the gripper, at most [m/s^2]; the motion stands still at both ends of the path."))
    inertia: bool = Field(True, description=(
        "Where there are limits, the motion keeps them also in time, with the branch's inertia; "
        "it is slowed down until it does. Otherwise they are kept at every pose, standing still."))
    slowings: int = Field(4, ge=0, le=10, description=(
        "How often at most to slow the motion down for that."))
    planner: Literal["eikonal", "d-rrt-star"] = Field("eikonal", description=(
        "eikonal: the cheapest way on a grid, refined, mostly within 1 % of the best possible "
        "path; d-rrt-star: the paper's D-RRT*. Either comes with a proven bound."))
    iterations: int = Field(3000, ge=100, le=200_000, description="Samples of RRT* and D-RRT*.")
    engine: Literal["auto", "ompl", "own"] = Field("auto", description=(
        "For RRT* and D-RRT*: OMPL's or our own; auto: OMPL where it is installed."))
    field_error: float = Field(3.0, gt=0, description=(
        "Percent by which the field's energy may be off the full model's along the plan (root mean "
        "square); where it is more, the states found are added to the field and it is planned "
        "anew."))
    replans: int = Field(3, ge=0, le=10, description=(
        "How often at most to plan anew, where the full model breaks a limit, the field is off, or "
        "its error leaves in doubt that no path keeps the limits."))
    seed: int = Field(0, ge=0, description="Of both planners.")
