"""Plans that must keep a limit with a probability, tested on draws of Young's modulus."""

from dataclasses import dataclass

import numpy as np

from benchmarks.planning_branches import Subject
from benchmarks.table import Asked, Row
from limber.core.errors import LimberError, NoPathError
from limber.planning.constraints.chance import YoungUncertainty
from limber.planning.constraints.limits import Limits
from limber.planning.field.energy_field import EnergyField
from limber.planning.goals.goal_kinds import GraspGoal
from limber.planning.make_plan import PlannedMotion, plan_motion
from limber.planning.path_on_full_model import ResolvedPath, SolvedPoses
from limber.planning.settings import PlanSettings

CONFIDENCE = 0.95
_DEVIATION = 0.12  # of log E at each control point: an interval of about -21 to +27 %
_NEIGHBOUR = -0.4  # correlation of neighbours, as fits have it
_EVERY = 4  # pose of the motion is asked under each draw, and the one with most force
_LOW = 0.6  # of the limit: a pose of less force breaks it under no likely draw
_TIGHT = (0.5, 0.75, 0.9, 1.0)
"""Position of the limit between the force that the goal itself needs and the peak of the unlimited
motion, each with the confidence: the first with a plan is used.
"""
SURE_ROW = Asked(f"force limit kept at --confidence {CONFIDENCE}, each draw on the full model",
                 "90 to 100 %")


@dataclass
class Sure:
    """One plan with a force limit kept at a confidence, and its draws.

    Attributes:
        kept: Fraction of draws, each solved on the full model, that keep the limit.
        before: The same by the risk of the plan for the estimate alone.
        tight: Element of ``_TIGHT`` for the limit.
    """

    branch: str
    seed: int = 0
    source: str = ""
    kept: float | None = None
    before: float | None = None
    tight: float | None = None
    trouble: str = ""


def run_sure(subject: Subject, known: EnergyField, goal: GraspGoal, draws: int, seed: int,
             source: str = "") -> Sure:
    """Plan from rest under a force that binds, with confidence; draw moduli, solve the motion."""
    sure = Sure(subject.name, seed, source)
    model, uncertain_part = subject.model, uncertainty_of(subject)
    settings = PlanSettings(seed=seed, iterations=500, goal=goal.position,
                            goal_tolerance=goal.tolerance)
    try:
        motion, cap = _planned(sure, subject, known, uncertain_part, settings)
        sure.before = motion.summary["confidence"]["of_a_plan_for_the_estimate"]
        states = motion.plan.approach.joined(motion.plan.solved)
        high = np.flatnonzero(states.force_sizes > _LOW * cap)
        chosen = np.unique([*high[::_EVERY], *high[-1:], int(states.force_sizes.argmax())])
        generator = np.random.default_rng([seed, 5])
        kept = [
            uncertain_part.solved(
                model, uncertain_part.draw(generator), states.take(chosen)
            ).force_sizes.max()
            <= cap
            for _ in range(draws)
        ]
        sure.kept = float(np.mean(kept))
    except LimberError as error:
        sure.trouble = f"{type(error).__name__}: {error}"
    return sure


def _planned(sure: Sure, subject: Subject, known: EnergyField, uncertain_part: YoungUncertainty,
             settings: PlanSettings) -> tuple[PlannedMotion, float]:
    """Return a plan with confidence under a force limit that binds, and the limit [N].

    Raises:
        NoPathError: there is none under any of the limits tried.
    """
    model = subject.model
    free = plan_motion(known, model, settings, workers=1)
    states = free.plan.approach.joined(free.plan.solved)
    likely = _likely_forces(uncertain_part, subject, states)
    end = tuple(map(float, free.plan.solved.poses[-1, :3]))
    for tight in _TIGHT:
        cap = float(max(likely[-1] + tight * (likely.max() - likely[-1]), 1.02 * likely[-1]))
        sure.tight = tight
        try:
            return plan_motion(
                free.field,
                model,
                settings.model_copy(
                    update={"max_force": cap, "confidence": CONFIDENCE, "goal": end}
                ),
                uncertainty=uncertain_part,
                workers=1,
            ), cap
        except NoPathError:
            if tight == _TIGHT[-1]:
                raise
    raise AssertionError("the last limit either has a plan or raises")


def _likely_forces(
    uncertain_part: YoungUncertainty, subject: Subject, states: SolvedPoses
) -> np.ndarray:
    """Return the largest force [N] that each state takes with the confidence, shape [n]."""
    peak = states.force_sizes.max()
    found = uncertain_part.exposure(subject.model, ResolvedPath(
        states, states.take(np.arange(1)), np.empty((0, 3)), (), True), Limits(force=2.0 * peak))
    return states.force_sizes * found.risk(uncertain_part.covariance, CONFIDENCE).factors["force"]


def uncertainty_of(subject: Subject) -> YoungUncertainty:
    """Return a posterior like an estimate's: the same deviation at each control point."""
    count = subject.shares.shape[1]
    near = np.abs(np.subtract.outer(np.arange(count), np.arange(count))) == 1
    return YoungUncertainty(subject.shares, np.full(count, _DEVIATION),
                      np.eye(count) + _NEIGHBOUR * near)


def sure_rows(found: list[Sure], draws: int) -> list[Row]:
    """Return the row of limits kept with confidence."""
    good = [one for one in found if one.kept is not None]
    troubles = "; ".join(f"{one.branch}: {one.trouble}" for one in found if one.trouble)
    if not good:
        return [Row(*SURE_ROW, troubles, False, len(found))]
    kept = 100.0 * np.array([one.kept for one in good])
    before = 100.0 * np.array([one.before for one in good])
    tight = [one.tight for one in good]
    return [Row(
        *SURE_ROW, f"{kept.min():.0f} to {kept.max():.0f} %, mean {kept.mean():.1f}, of {draws} "
        f"draws each; {len(good)} of {len(found)} branches, limit at {100 * min(tight):.0f} to "
        f"{100 * max(tight):.0f} % of the way from what the goal needs to what the free motion "
        f"takes; planned for the estimate alone {before.min():.0f} to {before.max():.0f}"
        + (f"; {troubles}" if troubles else ""),
        bool(kept.min() >= 90.0 and len(good) == len(found)), len(found))]
