"""A chosen goal: a pose drawn from the paper's hemisphere (``--goal-seed``), a distant one, or the
reach of a second arm.
"""

import numpy as np

from limber.core.errors import NoPathError
from limber.planning.field.energy_field import EnergyField, FieldArrays
from limber.planning.goals.allowed_poses import allowed_points
from limber.planning.goals.goal import GoalKind, GoalRequest
from limber.planning.goals.grasp_goal import GraspGoal, near
from limber.planning.goals.regions import Ball, ball
from limber.planning.goals.target_goal import TargetGoal

_REACH = 0.85  # [m] of a UR5, which stands for the second arm
_HALF = 0.5  # of the grasp's way to the default goal
_TIP_TOLERANCE = 0.02  # [m] about a flower's radius
_BEGINS = 0.6  # fraction of the tip's way to the default goal at which that reach begins


def default_goal(field: EnergyField, tolerance: float) -> GraspGoal:
    """Return a useful goal: far from rest, and reached without force.

    Of the samples deflected by over three quarters of the largest deflection, the one with the
    least energy, moved a little towards the rest pose so that the region is where the field is
    trusted. The trusted region is a shell, often thinner than the tolerance: what counts is how
    much of the goal is in it along the shell.
    """
    chart = field.region.chart.plain
    samples = chart.map(field.samples.positions)
    rest = chart.map(field.rest)[0]
    away = np.linalg.norm(field.samples.positions - field.rest, axis=1)
    far = np.flatnonzero(away >= 0.75 * away.max())
    around = ball(100, np.random.default_rng(0)) * tolerance
    if chart.radius > 0.0:
        around[:, 2] = 0.0
    for index in far[np.argsort(field.samples.energies[far])]:
        for shrink in (1.0, 0.95, 0.9, 0.85):
            centre = rest + shrink * (samples[index] - rest)
            position = chart.curved(centre[None])[0]
            if (field.region.contains(chart.curved(centre + around)).mean() > 0.5
                    and field.region.contains(position)[0]):
                return near(position, tolerance)
    raise NoPathError("No distant pose lies well inside the sampled region.",
                      f"Too few of the {len(away)} accepted samples are far from the rest pose.",
                      "Sample more poses with `limber energy --samples`, or give a --goal.")


def second_arm_goal(field: EnergyField) -> TargetGoal:
    """Return the paper's goal: the branch's tip, with its flower, within reach of a second arm.

    The arm stands on the side to which the branch bends with the least energy. Its reach is a ball.

    Raises:
        NoPathError: there is no far pose.
    """
    far = default_goal(field, 0.01).centre(field)
    rest, there = field.tip(np.stack([field.rest, far]))
    way = there - rest
    x, y, z = map(float, rest + (_BEGINS + _REACH / np.linalg.norm(way)) * way)
    return TargetGoal(Ball((x, y, z), _REACH))


def tip_goal(field: EnergyField) -> TargetGoal:
    """Return a goal as a person states one: a small ball some centimetres from the tip.

    The tip is there while the grasp is half-way to the default goal: the branch reaches it.

    Raises:
        NoPathError: there is no far pose.
    """
    chart = field.region.chart.plain
    rest, far = chart.map(np.stack([field.rest, default_goal(field, 0.01).centre(field)]))
    x, y, z = map(float, field.tip(chart.curved((rest + _HALF * (far - rest))[None]))[0])
    return TargetGoal(Ball((x, y, z), _TIP_TOLERANCE))


def hemisphere_goal(field: EnergyField, base: np.ndarray, length: float, limits: FieldArrays,
                    tolerance: float, seed: int) -> GraspGoal:
    """Return a goal as the paper draws its candidates: evenly from the half ball above the branch's
    ``base`` [m] with its ``length`` [m] as radius; of those, one that is in the trusted field,
    keeps the limits and is at least half the largest deflection away from rest.

    Raises:
        NoPathError: no such pose was found.
    """
    points = field.region.draw(4000, np.random.default_rng([seed, 13]))
    half = 0.5 * float(np.linalg.norm(field.samples.positions - field.rest, axis=1).max())
    fit = (np.linalg.norm(points - base, axis=1) <= length) & (points[:, 2] >= base[2])
    fit &= np.linalg.norm(points - field.rest, axis=1) >= half
    fit &= allowed_points(points, limits)
    if not fit.any():
        raise NoPathError("No pose in the hemisphere is far from rest and keeps the limits.",
                          f"A distant pose is at least {half:.3f} m from rest; the hemisphere's "
                          f"radius is {length:.3f} m.",
                          "Give a --goal, or relax the limits.")
    return near(points[np.flatnonzero(fit)[0]], tolerance)


def _drawn(asked: GoalRequest, seed: int) -> GraspGoal:
    reach = asked.grasp_model.reach
    return hemisphere_goal(asked.field, reach.base, reach.arc_length, asked.limits,
                           asked.settings.goal_tolerance, seed)


DRAWN = GoalKind("goal_seed", _drawn)
