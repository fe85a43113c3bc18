"""Limits near the feasible ones, infeasible ones, and whether the stated errors hold.

A free path, solved on the full model, shows which limits are surely feasible: those that it keeps.
Limits are drawn within 5 % of its peak. An accepted plan is solved again from rest at half the
spacing; a proof that no path exists is false if the free path keeps the limit.
"""

import time
from dataclasses import dataclass

import numpy as np

from benchmarks.table import Asked, Row
from limber.core.errors import LimberError
from limber.core.progress import SILENT
from limber.planning.constraints.limits import Limits, sampled_sizes
from limber.planning.cost import resample
from limber.planning.field.energy_field import EnergyField, limited
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.radial import LocalError
from limber.planning.field.sampling import SolverPool, solve_branch
from limber.planning.field.stored_states import samples_of
from limber.planning.goals.goal_kinds import near
from limber.planning.make_plan import plan_motion
from limber.planning.path_on_full_model import resolve_path
from limber.planning.path_problem import BlockedError, random_start
from limber.planning.settings import PlanSettings

LIMITED = ("force", "strain", "energy", "axial_force")
"""Limited quantities, by their names in settings."""
_SLACK = 1e-3  # of a limit, that the path at other poses may be over it
_HOPELESS = 0.5  # of what the goal itself takes at least
_IN_GOAL = 4000  # poses in it that are looked at

NEAR_ROWS = (
    Asked("limits within 5 % of a known path's: false proofs", "0"),
    Asked("there: limits broken on the full model, solved again", "0"),
    Asked("there: feasible for sure and planned", "95 %"),
    Asked("there: processor time, median / worst", "10 s median"),
    Asked("hopeless limits: said, processor time, worst", "10 s"))
COVERED_ROW = Asked("stated 95 % errors at fresh poses: energy, force, strain, axial force covered",
                    "93-98 %")


@dataclass
class NearLimit:
    """Result for one problem.

    ``branch``, ``seed`` and ``source`` (digest of the sources) identify it. ``share`` is the limit
    over the free path's peak; ``excess`` by how much the plan is over the limit.
    """

    number: int
    branch: str = ""
    seed: int = 0
    source: str = ""
    name: str = ""
    share: float = 0.0
    said: str = ""
    excess: float = -1.0
    seconds: float = 0.0
    hopeless_said: str = ""
    hopeless_seconds: float = 0.0
    trouble: str = ""


_free_paths: dict[tuple[str, int], tuple[PlanSettings, dict[str, float]]] = {}


def _free_path(model: GraspModel, known: EnergyField, branch: str, seed: int,
               ) -> tuple[PlanSettings, dict[str, float]]:
    """Return settings with a random goal, and the peaks of the gentlest path to it, planned once
    for all limits."""
    if (branch, seed) in _free_paths:
        return _free_paths[branch, seed]
    free = PlanSettings(seed=seed, inertia=False, iterations=500, goal_tolerance=0.01)
    goal = random_start(known, near(known.rest, 0.01), free, seed)
    asked = free.model_copy(update={"goal": tuple(map(float, goal))})
    peaks = _peaks(plan_motion(known, model, asked, workers=1).plan.ahead)
    return _free_paths.setdefault((branch, seed), (asked, peaks))


def run_near_limit(model: GraspModel, known: EnergyField, number: int, seed: int, goal_seed: int,
                   **whose: str) -> NearLimit:
    """Plan with a limit near the peak of a free path to a random goal, each quantity in turn."""
    found = NearLimit(number, seed=seed, name=LIMITED[number % len(LIMITED)], **whose)
    generator = np.random.default_rng([seed, number])
    try:
        asked, peaks = _free_path(model, known, found.branch, goal_seed)
        found.share = float(generator.uniform(0.95, 1.05))
        _with_limit(found, model, known, asked, found.share * peaks[found.name])
        if found.name == LIMITED[0]:
            _hopeless(found, model, known, asked)
    except LimberError as error:
        found.trouble = f"{type(error).__name__}: {error}"
    return found


def _with_limit(found: NearLimit, model: GraspModel, known: EnergyField, asked: PlanSettings,
                limit: float) -> None:
    bound = asked.model_copy(update={f"max_{found.name}": limit})
    began = time.process_time()
    try:
        motion = plan_motion(known, model, bound, workers=1)
        found.seconds, found.said = time.process_time() - began, "planned"
    except BlockedError as error:
        found.seconds = time.process_time() - began
        found.said = "proven" if error.is_proven else "not found"
        return
    except LimberError:
        found.seconds, found.said = time.process_time() - began, "not found"
        return
    path = resample(motion.plan.solved.poses[:, :3], 0.0025)
    again = resolve_path(model, path, motion.plan.approach.poses[:, :3])
    found.excess = _peaks(again.ahead)[found.name] / limit - 1.0 if again.is_whole else np.inf


def _hopeless(found: NearLimit, model: GraspModel, known: EnergyField, asked: PlanSettings) -> None:
    # Off the low-energy surface forces differ a hundredfold: in a ball the least of many counts.
    there = near(np.array(asked.goal), asked.goal_tolerance).guess(
        known, _IN_GOAL, np.random.default_rng(0))
    limit = _HOPELESS * float(np.linalg.norm(known.force(there), axis=1).min())
    began = time.process_time()
    try:
        plan_motion(known, model, asked.model_copy(update={"max_force": limit}), workers=1)
        found.hopeless_said = "planned"
    except BlockedError as error:
        found.hopeless_said = "proven" if error.is_proven else "not found"
    except LimberError as error:
        found.hopeless_said = type(error).__name__
    found.hopeless_seconds = time.process_time() - began


def _peaks(states: object) -> dict[str, float]:
    return {"force": float(states.force_sizes.max()), "energy": float(states.energies.max()),
            "strain": float(states.strains.max()),
            "axial_force": float(np.abs(states.axial_forces).max())}


def near_rows(trials: list[NearLimit]) -> list[Row]:
    """Return the rows of problems near the feasible limits."""
    good = [one for one in trials if not one.trouble]
    sure = [one for one in good if one.share > 1.0]
    proven = [one for one in sure if one.said == "proven"]
    planned = [one for one in good if one.said == "planned"]
    broken = [one for one in planned if one.excess > _SLACK]
    solved = [one for one in sure if one.said == "planned"]
    if not good:
        return [Row(*asked, trials[0].trouble if trials else "none", False, 0)
                for asked in NEAR_ROWS]
    seconds = np.array([one.seconds for one in good])
    hopeless = [one for one in good if one.hopeless_said]
    slow = max((one.hopeless_seconds for one in hopeless), default=0.0)
    said = sum(one.hopeless_said != "planned" for one in hopeless)
    return [
        Row(*NEAR_ROWS[0], f"{len(proven)} of {len(sure)}", not proven, len(sure)),
        Row(*NEAR_ROWS[1], f"{len(broken)} of {len(planned)}" + (
            f", worst {100 * max(one.excess for one in broken):+.2f} %" if broken else ""),
            not broken, len(planned)),
        Row(*NEAR_ROWS[2], f"{len(solved)} of {len(sure)}",
            len(solved) >= 0.95 * len(sure), len(sure)),
        Row(*NEAR_ROWS[3], f"{np.median(seconds):.1f} / {seconds.max():.1f} s",
            bool(np.median(seconds) <= 10.0), len(good)),
        Row(*NEAR_ROWS[4], f"{said} of {len(hopeless)}, {slow:.1f} s",
            said == len(hopeless) and slow <= 10.0, len(hopeless))]


def coverage(model: GraspModel, known: EnergyField, count: int, seed: int,
             ) -> dict[str, tuple[int, int]]:
    """Return for each quantity at how many of ``count`` fresh trusted poses the field's
    overestimate is within its stated 95 % error, and the number of poses.
    """
    places = known.region.draw(count, np.random.default_rng(seed))
    with SolverPool(model, 1) as solvers:
        good, _ = solve_branch(solvers, places, progress=SILENT)
    fresh = samples_of(good[1:], np.empty((0, 3)))
    chart, inner = known.region.chart.plain, ~known.region.is_face()
    values, limits = sampled_sizes(fresh), Limits(**dict.fromkeys(LIMITED, 1e9))
    above, found = limits.above(known), {}
    for one in limited(known, limits.on(known)):
        error = LocalError.of(chart.map(known.samples.positions)[inner], above[one.name][inner],
                              0.95)
        off = one.size(fresh.positions) - np.abs(values[one.name])
        kept = off <= error.at(chart.map(fresh.positions)) + 1e-12
        found[one.name] = int(kept.sum()), len(kept)
    return found


def covered_row(found: list[dict[str, tuple[int, int]]]) -> Row:
    """Return the row of the stated errors of several branches."""
    shares = {name: sum(one[name][0] for one in found) / max(sum(one[name][1] for one in found), 1)
              for name in found[0]}
    return Row(*COVERED_ROW, ", ".join(f"{name.replace('_', ' ')} {100 * share:.0f} %"
                                       for name, share in shares.items()),
               all(share >= 0.93 for share in shares.values()),
               sum(one["energy"][1] for one in found))
