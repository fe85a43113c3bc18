"""The paper's table: savings of a path at most 8.1 % longer than that of RRT*."""

import time
from dataclasses import dataclass, field

import numpy as np
from scipy.integrate import trapezoid

from benchmarks.table import Asked, Row
from limber.core.errors import LimberError
from limber.planning.baseline_and_plan import plan_pair
from limber.planning.cost import arc_lengths, resample
from limber.planning.field.energy_field import EnergyField
from limber.planning.goals.goal_kinds import GraspGoal
from limber.planning.path_problem import random_start
from limber.planning.settings import PlanSettings

SAVED, ADDED = 35.69, 8.10
"""Percent, means over the paper's three branches."""

_AGAINST = ("RRT*, not smoothed", "RRT*", "straight line")
DETOUR_ROWS = (*(Asked(
    f"paper's arcs, --max-detour {ADDED}: saved against {name}",
    f"paper: {SAVED} %, {ADDED} % longer" if name == _AGAINST[0] else "-") for name in _AGAINST),
    Asked("there: points of saving that the certified optimum may still have, median / worst",
          "2"),
    Asked("there: certified gap of the energy within the length, median / worst", "3 / 6 %"),
    Asked("there: planning after the field, processor time, median / worst", "10 s median"))


@dataclass
class Detour:
    """Savings of one start [%] against other paths, and the most points by which they could grow.

    ``branch``, ``seed`` and ``source`` (digest of the sources) identify it.
    """

    number: int
    branch: str = ""
    seed: int = 0
    source: str = ""
    saved: dict[str, float] = field(default_factory=dict)
    added: dict[str, float] = field(default_factory=dict)
    below_bound: float | None = None
    gap: float | None = None
    seconds: float = 0.0
    trouble: str = ""


def run_detour(known: EnergyField, goal: GraspGoal, number: int, seed: int, **whose: str,
               ) -> Detour:
    """Plan within the paper's detour, from rest (number 0) or from a random start."""
    detour = Detour(number, seed=seed, **whose)
    settings = PlanSettings(seed=seed, max_detour=ADDED)
    try:
        start = known.rest.copy() if number == 0 else random_start(known, goal, settings, seed)
        began = time.process_time()
        pair = plan_pair(known, start, goal, settings, detour_from_tree=True)
        detour.seconds = time.process_time() - began
    except LimberError as error:
        detour.trouble = f"{type(error).__name__}: {error}"
        return detour
    own_length, own = _measured(pair.plan.points, known)
    assert pair.detour is not None
    detour.gap = 100.0 * pair.certificate.gap
    for name in _AGAINST:
        if name in pair.compared:
            length, integral = _measured(pair.compared[name], known)
            detour.saved[name] = 100.0 * (1.0 - own / integral)
            detour.added[name] = 100.0 * (own_length / length - 1.0)
            if name == _AGAINST[0]:
                detour.below_bound = 100.0 * (own - max(pair.detour.energy_bound, 0.0)) / integral
    return detour


def detour_rows(detours: list[Detour]) -> list[Row]:
    """Return the rows of the paper's table."""
    good = [one for one in detours if not one.trouble]
    table = []
    for row, name in zip(DETOUR_ROWS, _AGAINST, strict=False):
        saved = [one.saved[name] for one in good if name in one.saved]
        added = [one.added[name] for one in good if name in one.saved]
        asked = name == _AGAINST[0]
        table.append(Row(
            *row,
            f"{np.mean(saved):.1f} %, {np.mean(added):+.1f} % long, {len(saved)} of "
            f"{len(detours)} starts" if saved else "none",
            bool(saved and np.mean(saved) > SAVED) if asked else None, len(detours)))
    below = [one.below_bound for one in good if one.below_bound is not None]
    table.append(Row(
        *DETOUR_ROWS[3], f"{np.median(below):.2f} / {np.max(below):.2f}" if below else "none",
        bool(below) and float(np.median(below)) <= 2.0, len(below)))
    gaps = [one.gap for one in good if one.gap is not None]
    table.append(Row(
        *DETOUR_ROWS[4], f"{np.median(gaps):.2f} / {np.max(gaps):.2f} %" if gaps else "none",
        bool(gaps) and float(np.median(gaps)) <= 3.0 and max(gaps) <= 6.0, len(gaps)))
    seconds = [one.seconds for one in good]
    table.append(Row(
        *DETOUR_ROWS[5], f"{np.median(seconds):.1f} / {np.max(seconds):.1f} s" if seconds
        else "none", bool(seconds) and float(np.median(seconds)) <= 10.0, len(seconds)))
    return table


def _measured(path: np.ndarray, known: EnergyField) -> tuple[float, float]:
    fine = resample(path, 0.001)
    along = arc_lengths(fine)
    return float(along[-1]), float(trapezoid(known.energy(fine), along))
