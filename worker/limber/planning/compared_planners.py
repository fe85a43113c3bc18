"""Comparison of planners over trials with one goal: the paper's experiment.

Each trial starts at a random deformed configuration. The paper's two planners are RRT* on length
and D-RRT* on length and deformation, with their raw tree paths. They are compared with their
smoothed paths, and with the gentlest path and its certificate. A limit on that path's length counts
from the path of RRT* as its tree has it, which the paper's table compares with. All are scored
alike on the energy field.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from limber.core.errors import NoPathError
from limber.core.processes import run_tasks
from limber.core.progress import SILENT, Progress
from limber.planning.baseline_and_plan import plan_pair
from limber.planning.cost import STEP, PathMeasures, measure_path, resample
from limber.planning.field.energy_field import EnergyField
from limber.planning.goals.goal import Goal
from limber.planning.path_problem import random_start
from limber.planning.settings import PlanSettings

BASELINE = "RRT*, not smoothed"
"""Baseline of the comparison, as in the paper."""
COMPARED = {BASELINE: "RRT*", "D-RRT*, not smoothed": "D-RRT*", "RRT*": "RRT*, smoothed",
            "D-RRT*": "D-RRT*, smoothed", "eikonal": "gentle"}
"""Names of paths, and their planners' names in the table."""


@dataclass(frozen=True)
class ComparedTrial:
    """One start: paths [n, 3] [m] and scores by the names of ``COMPARED``; ``gap_percent`` of the
    gentle path, or why there was none."""

    number: int
    start: np.ndarray
    paths: Mapping[str, np.ndarray]
    scores: Mapping[str, PathMeasures]
    gap_percent: float | None = None
    trouble: str = ""


def run_trials(field: EnergyField, goal: Goal, settings: PlanSettings, count: int, *,
               workers: int | None = None, progress: Progress = SILENT) -> list[ComparedTrial]:
    """Return ``count`` trials; the seeds of starts and planners follow from ``settings.seed``."""
    return run_tasks(_trial, [(field, goal, settings, number) for number in range(count)],
                     workers=workers, progress=progress, message="planning from random starts")


def _trial(field: EnergyField, goal: Goal, settings: PlanSettings, number: int,
           progress: Progress = SILENT) -> ComparedTrial:
    own = settings.model_copy(update={"seed": settings.seed + number})
    start = field.rest
    try:
        start = random_start(field, goal, own, own.seed)
        pair = plan_pair(field, start, goal, own, is_compared=True, progress=progress)
    except NoPathError as error:
        return ComparedTrial(number, start, {}, {}, trouble=error.seen)
    paths = {name: resample(pair.compared[name], STEP) for name in COMPARED
             if pair.compared.get(name) is not None}
    gap = pair.certificate.describe()["gap_percent"]
    return ComparedTrial(number, start, paths,
                         {name: _score(field, path) for name, path in paths.items()}, gap)


def _score(field: EnergyField, path: np.ndarray) -> PathMeasures:
    return measure_path(path, field.energy(path), np.linalg.norm(field.force(path), axis=1))


def summarised(trials: Sequence[ComparedTrial]) -> dict[str, dict[str, float | None]]:
    """Return by planner mean and deviation of length and energy, and the change of the means from
    the baseline's [%], over the trials in which both found a path."""
    found: dict[str, dict[str, float | None]] = {}
    for name in COMPARED:
        both = [trial for trial in trials if name in trial.scores and BASELINE in trial.scores]
        if not both:
            continue
        row: dict[str, float | None] = {"trials": len(both)}
        for key, change in (("length_m", "longer_percent"), ("energy_sum_nmm", "saved_percent")):
            own = np.array([getattr(trial.scores[name], key) for trial in both])
            base = np.array([getattr(trial.scores[BASELINE], key) for trial in both])
            row |= {f"{key}_mean": float(own.mean()), f"{key}_deviation": float(
                own.std(ddof=1)) if len(own) > 1 else None}
            off = 100.0 * (own.mean() / base.mean() - 1.0)
            row[change] = float(off if change == "longer_percent" else -off)
        found[name] = row
    return found
