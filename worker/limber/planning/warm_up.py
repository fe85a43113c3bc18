"""Compiles the planner's loops once, so that no user waits for a compiler."""

import numpy as np

from limber.core.progress import SILENT, Progress
from limber.planning.baseline_and_plan import plan_pair
from limber.planning.field.energy_field import fit_field
from limber.planning.field.stored_states import GraspSamples
from limber.planning.goals.goal_kinds import GraspGoal
from limber.planning.settings import PlanSpec


def warm_up(progress: Progress = SILENT) -> None:
    """Plan once on an invented branch; the compiled code stays in the user's cache folder."""
    generator = np.random.default_rng(0)
    points = generator.uniform(-1.0, 1.0, (40, 3))
    points[0] = 0.0
    energies = 0.5 * (points**2).sum(axis=1)
    samples = GraspSamples(np.hstack([points, 0 * points]), energies, points, points,
                           np.ones(40), np.full((1, 6), 0.9), np.ones(40))
    field = fit_field(samples, np.array([0.0, 0.0, -3.0]), progress=progress.part(0.0, 0.5))
    settings = PlanSpec(iterations=100, engine="own", max_energy=1e3, max_force=1e3)
    plan_pair(field, np.zeros(3), GraspGoal((0.2, 0.0, 0.0), 0.05), settings,
              progress=progress.part(0.5, 1.0))
