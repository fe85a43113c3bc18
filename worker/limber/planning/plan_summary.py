"""The summary of a plan: its measures and the shortest path's, its bound, and warnings."""

from dataclasses import asdict
from typing import Any

import numpy as np

from limber.planning.baseline_and_plan import PathPair
from limber.planning.certificate.lower_bound import COST
from limber.planning.constraints.full_model_check import field_error
from limber.planning.cost import STEP, PathMeasures, measure_path, resample
from limber.planning.field.energy_field import EnergyField
from limber.planning.goals.goal import Goal
from limber.planning.goals.goal_kinds import asked_kinds
from limber.planning.path_on_full_model import ResolvedPath
from limber.planning.planners.trees import chosen_engine
from limber.planning.settings import PlanSettings

_CHANGES = ("energy_saved_percent", "peak_energy_saved_percent", "length_added_percent")
_STILL = 1e-9  # [m] a path that is not longer has no length
_WIDE_GAP = 5.0  # percent above which there is a warning


def summary_of(field: EnergyField, goal: Goal, start: np.ndarray, pair: PathPair,
               baseline: ResolvedPath, plan: ResolvedPath, settings: PlanSettings,
               ) -> dict[str, Any]:
    """Return the entries of a plan's file beside its columns that are known without rounds."""
    before, after = baseline.measures, plan.measures
    return {
        "goal": goal.describe() | {"chosen": not asked_kinds(settings)},
        "start_m": start, "seed": settings.seed, "planner": settings.planner,
        "engine": chosen_engine(settings.engine),
        "certificate": pair.certificate.describe() | {"full_model": _on_full_model(
            field, goal, pair, after)},
        "paths_on_field": {name: asdict(_on_field(field, points)) | {
            "peak_strain": float(np.abs(field.load(resample(points, STEP), "strain")).max())}
            for name, points in pair.compared.items()},
        "margins": pair.margins,
        "detour": pair.detour and pair.detour.describe(),
        "weights": {"deformation": pair.cost.deformation,
                    "distance": pair.cost.distance,
                    "energy_scale_j": pair.cost.energy_scale,
                    "length_scale_m": pair.cost.length_scale},
        "zero_of_energy": "the rest state: the branch as scanned, the gripper open; an energy is "
        "the potential of strain and weight, and the gripper's force is its gradient",
        "baseline": asdict(before) | _checked(field, baseline),
        "plan": asdict(after) | _checked(field, plan),
        **(dict.fromkeys(_CHANGES) if pair.stays else dict(zip(_CHANGES, (
            _change(before.energy_integral_jm, after.energy_integral_jm, -1),
            _change(before.peak_energy_j, after.peak_energy_j, -1),
            _change(before.length_m, after.length_m, 1)), strict=True))),
        "convergence": {"baseline": pair.baseline.history, "plan": pair.plan.history},
    }


def _on_full_model(field: EnergyField, goal: Goal, pair: PathPair, found: PathMeasures,
                   ) -> dict[str, Any]:
    """Return the bound for every branch whose energy is nowhere farther below the field's than 95 %
    of the samples were, each left out in turn, and the plan's gap to that bound.

    With c = w E + l and E reduced by an error e, but not below 0, c is nowhere less than l / (l + w
    e) times its former value, and so is the bound. An integral of energy over at most a length is
    reduced by at most e times that length. For a goal of a target no bound is given: the field does
    not know the target's position well enough.
    """
    weights, detour = pair.cost.weights, pair.detour
    cheap = field.samples.energies <= 1.5 * max(found.peak_energy_j, 1e-12)
    missed = np.abs(field.missed[cheap & ~field.region.is_face(), 0])
    error = float(np.quantile(missed, 0.95)) if len(missed) else float(
        np.abs(field.missed[:, 0]).max())
    cost = found.energy_integral_jm if detour else (
        weights.energy * found.energy_integral_jm + weights.length * found.length_m)
    if not np.isfinite(error) or goal.uncertainty(field, pair.plan.points[-1:])[0] > 0.0:
        return {"field_error_j": error if np.isfinite(error) else None, "lower_bound": None,
                "cost": cost, "gap_percent": None}
    lower = pair.certificate.lower - error * detour.longest if detour else (
        pair.certificate.lower * weights.length / (weights.length + weights.energy * error))
    return {"field_error_j": error, "lower_bound": max(lower, 0.0), "cost": cost,
            "gap_percent": 100.0 * (cost / lower - 1.0) if lower > 0.0 else None}


def _checked(field: EnergyField, path: ResolvedPath) -> dict[str, Any]:
    """Return the peak strain, and the field's error against the full model along the path."""
    solved = path.solved
    off = field.energy(solved.poses[:, :3]) - np.maximum(solved.energies, 0.0)
    return {"peak_strain": float(solved.strains.max()),
            "tip_end_m": solved.tips[-1],
            "field_energy_error": field_error(field, solved),
            "field_energy_error_max_j": float(np.abs(off).max()),
            "unsolved_count": path.unsolved_count}


def _on_field(field: EnergyField, points: np.ndarray) -> PathMeasures:
    fine = resample(points, STEP / 5)
    return measure_path(fine, field.energy(fine), np.linalg.norm(field.force(fine), axis=1))


def doubts_of(summary: dict[str, Any], field_error: float, *paths: ResolvedPath) -> list[str]:
    """Return warnings about a plan on a field with an allowed error of ``field_error`` [%]."""
    if summary["plan"]["length_m"] <= _STILL:
        return ["The start already lies in the goal. The path has no length, and there is no "
                "energy to save."]
    doubts = [
        f"Along the {label} path the energy field has an error of {error:.2g} % of the full "
        f"model's energy, which exceeds the limit of {most:g} %. Sample more poses with `limber "
        "energy --samples`."
        for key, label, most in (("baseline", "shortest", 15.0), ("plan", "gentle", field_error))
        if (error := 100.0 * summary[key]["field_energy_error"]) > most]
    gap = summary["certificate"]["gap_percent"]
    if gap is not None and gap > _WIDE_GAP:
        takes = "cost" if summary["certificate"].get("quantity", COST) == COST else "take"
        energy = "" if takes == "cost" else "energy "
        doubts.append(f"The path may {takes} up to {gap:.1f} % more {energy}than the best "
                      "possible one" + ("." if summary["planner"] == "eikonal" else
                                        "; `--planner eikonal` comes closest."))
    unsolved = sum(path.unsolved_count for path in paths)
    if unsolved:
        doubts.append(f"{unsolved} poses along the shortest path had no acceptable solution. Its "
                      "measures exclude them.")
    return doubts


def _change(before: float, after: float, sign: int) -> float | None:
    return 100.0 * sign * (after / before - 1.0) if before > 0.0 else None
