"""Settings of the energy field and of paths; they import nothing heavy."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from pydantic import Field

from limber.core.optional import Choices
from limber.core.settings import BOX, POSITION, Groups, OneOf, Settings, within

PLANNERS = Choices("limber.planners", {
    "auto": "", "ompl": "limber.planning.planners.trees:OmplRrtStar",
    "own": "limber.planning.planners.rrt_star:OwnRrtStar"})
"""Classes of planners (:class:`limber.planning.planners.rrt_star.Planner`) by the names of
``engine``, in the order in which ``auto`` prefers them.
"""


class EnergySettings(Settings):
    """Sampling of the energy field."""

    groups: ClassVar[Groups] = {
        "samples": ("samples", "field_error", "deflection", "seed"),
    }
    common: ClassVar[tuple[str, ...]] = ("samples", "field_error")

    samples: int = Field(225, ge=30, description=(
        "Number of grasp positions to solve. Two thirds are spread evenly; the others are placed "
        "where neighbouring solutions disagree."))
    field_error: float | None = Field(None, gt=0, description=(
        "Largest error of the energy [%] at samples excluded from the fit (root mean square). "
        "The number of poses is doubled, at most to four times --samples."))
    deflection: float = Field(0.4, gt=0, le=1.0, description=(
        "Largest distance from the rest position, as a fraction of the branch's length up to the "
        "grasp."))
    seed: int = Field(0, ge=0, description="Seed of the sampled positions.")


class EnergySpec(EnergySettings):
    """Sampling, with what only Python sets."""

    gravity: bool = Field(True, description=(
        "The branch carries its own weight, as when it was scanned. Otherwise it has no weight."))


@dataclass(frozen=True)
class Effort:
    """How thoroughly a plan is searched and checked.

    Attributes:
        iterations: Number of samples of RRT* and D-RRT*.
        engine: Implementation of both: OMPL's or our own. auto: OMPL if it is installed.
        inertia: Also check the limits in motion, with the branch's inertia, and slow the motion
            down until they hold. Otherwise they are checked at every pose at rest.
    """

    iterations: int = 3000
    engine: str = "auto"
    inertia: bool = True


class PlanSettings(Settings):
    """Start, goal, cost and limits of a plan."""

    groups: ClassVar[Groups] = {
        "start and goal": ("goal", "tip_goal", "target", "target_box", "goal_in",
                           "goal_seed", "goal_tolerance", "start", "start_seed"),
        "weights and limits": ("weights", "max_detour", "max_energy",
                               "max_force", "max_axial_force", "max_torque", "max_strain",
                               "wood", "max_damage", "max_stress", "workspace",
                               "clearance", "turn_slack", "confidence"),
        "timing": ("speed", "hold"),
        "solver": ("planner", "seed"),
    }
    common: ClassVar[tuple[str, ...]] = (
        "goal", "tip_goal", "target", "max_force", "max_strain", "max_detour")

    goal: tuple[float, float, float] | None = Field(None, description=(
        "Goal position of the grasp, in the branch's frame [m]. Without any goal, a distant pose "
        "is chosen and stated."),
                                                    json_schema_extra=POSITION)
    tip_goal: tuple[float, float, float] | None = Field(None, description=(
        "Goal position of the branch's tip, or of --target, in the branch's frame [m]."),
                                                        json_schema_extra=POSITION)
    target: str | None = Field(None, description=(
        "Named target (`limber target`) for --tip-goal, --target-box and --goal-in. Default: the "
        "tip."))
    target_box: tuple[float, float, float, float, float, float] | None = Field(None, description=(
        "Box that the target must reach: lower corner, upper corner, in the branch's frame [m]."),
        json_schema_extra=BOX)
    goal_in: Literal["view", "second_arm"] | None = Field(None, description=(
        "Region of the cell that the target must reach. view: visible to the camera, which is "
        "inside its image, within its range, and not hidden by the branch, nor by what a "
        "connected RealSense camera sees now. second_arm: within reach of the second arm."))
    goal_seed: int | None = Field(None, ge=0, description=(
        "Seed of a random goal in the paper's hemisphere: above the base, within the branch's "
        "length, among sampled poses that are allowed and far from rest."))
    goal_tolerance: float = Field(
        0.01, gt=0, le=1, description="Radius of the goal region [m]. Of a chosen goal at most a "
        "quarter of the largest deflection.")
    start: tuple[float, float, float] | None = Field(None, description=(
        "Start position of the grasp [m]. Default: the rest pose."),
                                                     json_schema_extra=POSITION)
    start_seed: int | None = Field(None, ge=0, description=(
        "Seed of a random deformed start configuration, as in the paper's trials."))
    weights: Annotated[tuple[float, float], within((1e-9, 1e9), (1e-9, 1e9))] = Field(
        (1.0, 1.5), description="Weights of deformation and of distance, the paper's alpha_def and "
        "alpha_dis; the path depends on their ratio.",
        json_schema_extra={"metavar": "DEFORMATION DISTANCE"})
    max_detour: float | None = Field(None, ge=0, le=1000, description=(
        "Largest extra length over the shortest path [%]. The weight of distance is set so that "
        "the gentlest such path is found."))
    max_energy: float | None = Field(None, gt=0, description=(
        "Largest deformation energy of any pose [J]."))
    max_force: float | None = Field(None, gt=0, description=(
        "Largest force of the gripper at any pose [N]."))
    max_axial_force: float | None = Field(None, gt=0, description=(
        "Largest component of that force along the branch, in tension or compression [N]."))
    max_torque: float | None = Field(None, gt=0, description=(
        "Largest torque of the gripper at any pose [Nm]. A gripper that turns with the branch "
        "needs almost none."))
    max_strain: float | None = Field(None, gt=0, lt=1, description=(
        "Largest principal strain anywhere in the branch at any pose (0.01 is 1 %). Default: half "
        "of the breaking strain by --break-tests or --wood, or of green wood where the modulus is "
        "that of wood; else none."))
    wood: Literal["ash", "cherry", "maple", "oak", "walnut"] | None = Field(None, description=(
        "Limit the strain to half of the breaking strain of green wood of this species (0.3 %; "
        "Wood Handbook FPL-GTR-190). Young shoots withstand more; give --max-strain for them."))
    max_damage: float | None = Field(None, gt=0, lt=1, description=(
        "Largest probability that the largest strain along the path breaks the branch (0.01 is "
        "1 %), by --break-tests or --wood. It replaces the limit of --wood."))
    max_stress: float | None = Field(None, gt=0, description=(
        "Largest principal stress anywhere in the branch at any pose [Pa], for the stiff end of "
        "the estimate's intervals."))
    workspace: tuple[float, float, float, float, float, float] | None = Field(None, description=(
        "Box that the grasp must stay in: lower corner, upper corner, in the branch's frame [m]."),
                                                                              json_schema_extra=BOX)
    clearance: float | None = Field(None, ge=0, le=0.5, description=(
        "Least distance of branch, gripper and arm from the cell's obstacles [m]. Default: twice "
        "the uncertainty of the robot's base in the cell file, but no more than the branch has at "
        "rest."))
    turn_slack: float | None = Field(None, gt=0, le=1.5, description=(
        "Largest rotation of the gripper beyond the branch's own along the path [rad]. It is used "
        "where the arm, or an obstacle, does not let the gripper turn with the branch; its torque "
        "is kept within the limits. Default: the gripper turns with the branch."))
    confidence: float | None = Field(None, ge=0.5, lt=1, description=(
        "Probability that the limits hold, given the uncertainty of the estimated Young's "
        "modulus. Default: the limits are checked for the estimate only."))
    speed: float = Field(0.02, gt=0, le=0.25, description="Largest speed of the gripper [m/s].")
    hold: float = Field(2.0, ge=0, le=3600, description=(
        "Time to hold the branch at the path's end [s]."))
    planner: Literal["eikonal", "d-rrt-star"] = Field("eikonal", description=(
        "eikonal: the least-cost path on a grid, refined; mostly within 1 % of the best possible "
        "path. d-rrt-star: the paper's D-RRT*. Both state a proven lower bound."))
    seed: int = Field(0, ge=0, description="Seed of both planners.")

    @property
    def effort(self) -> Effort:
        return Effort()


class PlanSpec(PlanSettings):
    """A plan, with what only Python sets: the fields of :class:`Effort`."""

    iterations: int = Field(Effort.iterations, ge=100, le=200_000)
    engine: Annotated[str, OneOf(PLANNERS.names)] = Effort.engine
    inertia: bool = Effort.inertia

    @property
    def effort(self) -> Effort:
        return Effort(self.iterations, self.engine, self.inertia)
