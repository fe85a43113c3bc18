"""Planning: the paper's comparison of RRT* and D-RRT* on its three branches, and what it rests on.

Each branch has the paper's Young's modulus on a shape of its own size, is sampled and planned on
as a user would, and both paths of every trial are solved again by finite elements: the energies
compared are never the field's.
"""

import json
import time
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from tests.subjects.paper_branches import BRANCHES, FRACTIONS, PaperBranch

from benchmarks.table import Row
from limber.errors import WorkError
from limber.geometry.skeleton.control_points import control_points
from limber.geometry.tets.marks import mark
from limber.jobs import Pool
from limber.mechanics import BranchModel, Grasp, solve_static, young_weights
from limber.mechanics.loaded import LoadedBranch
from limber.plain import plain
from limber.planning.compare import PlanSettings, plan_pair, random_start
from limber.planning.cost import measure_path
from limber.planning.field.energy_field import EnergyField, error_measures, fit_field
from limber.planning.field.grasp_model import GraspModel, grasp_model_of
from limber.planning.field.sampling import sample_branch, sample_positions, without_taut
from limber.planning.goals import GraspGoal, default_goal
from limber.planning.planners.ompl_engine import ompl_missing
from limber.planning.resolve import resolve_path
from limber.progress import Progress
from limber.stages.energy import EnergySettings

_PAPER_SAVED, _PAPER_ADDED = 35.69, 8.10  # percent, means over the paper's three branches


@dataclass(frozen=True)
class _Trial:
    """One start to the common goal; ``trouble`` where the full model could not follow."""

    seed: int
    seconds: float
    resolve_seconds: float
    baseline: dict[str, float]
    plan: dict[str, float]
    field_error: float
    trouble: str = ""


def rows(quick: bool, progress: Progress, out: Path | None) -> list[Row]:
    """Measure; ``quick`` takes one branch and four trials instead of three and ten."""
    branches = BRANCHES[1:2] if quick else BRANCHES
    table: list[Row] = []
    saved, added, raw = [], [], {}
    for number, branch in enumerate(branches):
        part = progress.part(number / len(branches), (number + 1) / len(branches))
        model = _grasp_model(branch)
        field, seconds, samples_row = _field(branch, model, part.part(0.0, 0.4))
        table += samples_row
        table += _fresh_rows(branch, model, field, 15 if quick else 40, part.part(0.4, 0.55))
        goal = default_goal(field, 0.01)
        trials = _trials(model, field, goal, 4 if quick else 10, part.part(0.55, 0.95))
        good = [trial for trial in trials if not trial.trouble]
        table += _trial_rows(branch, trials, good)
        saved.append(_percent(good, "energy_sum_nmm", -1))
        added.append(_percent(good, "length_m", 1))
        raw[branch.name] = {"field_seconds": seconds, "errors": field.errors,
                            "goal": goal.describe(),
                            "trials": [asdict(trial) for trial in trials]}
        if number == 0:
            table += _natural_rotation(model, field) + _engines(field, goal, 3 if quick else 10)
    table.insert(0, Row("energy saved, mean over branches", f"paper: {_PAPER_SAVED} %",
                        f"{np.mean(saved):.1f} %", bool(np.mean(saved) >= _PAPER_SAVED)))
    table.insert(1, Row("length added, mean over branches", f"paper: {_PAPER_ADDED} %",
                        f"{np.mean(added):.1f} %", bool(np.mean(added) <= _PAPER_ADDED)))
    if out is not None:
        (out / "planning.json").write_text(json.dumps(plain(raw), indent=1))
    return table


def _grasp_model(branch: PaperBranch) -> GraspModel:
    skeleton = branch.skeleton
    mesh = mark(branch.mesh(slice_length=2.0, sides=6), skeleton, young=1.0,
                poisson=branch.poisson, density=900.0)
    young = young_weights(mesh, control_points(skeleton, FRACTIONS)) @ np.array(branch.young)
    mesh = mesh.with_data(cell_data={"young": young})
    # The paper's moduli are too soft to stand under their own weight.
    model = BranchModel(mesh, young=young, poisson=branch.poisson, density=900.0, gravity=None)
    return grasp_model_of(LoadedBranch(model), skeleton)


def _field(branch: PaperBranch, model: GraspModel, progress: Progress,
           ) -> tuple[EnergyField, float, list[Row]]:
    settings = EnergySettings()
    started = time.perf_counter()
    targets = sample_positions(model.reach, model.rest_position, settings.samples,
                               deflection=settings.deflection, stretch=settings.stretch)
    samples, reasons = sample_branch(model, targets, progress=progress)
    samples, taut = without_taut(samples)
    field = fit_field(samples, model.reach.base)
    seconds = time.perf_counter() - started
    rejected = sum(reasons.values())
    found = (f"{len(samples.poses)} kept, {taut} taut, {rejected} rejected"
             f" ({model.mesh.tet_count} tets)")
    errors = field.errors
    held = (f"energy {100 * errors['energy_error']:.1f} %, its gentle half "
            f"{100 * errors['gentle_energy_error']:.1f} %, "
            f"force {100 * errors['force_error']:.0f} %")
    return field, seconds, [
        Row(f"{branch.name}: energy stage", "90 s on two cores", f"{seconds:.0f} s; {found}",
            seconds <= 90),
        Row(f"{branch.name}: field error, held out (rms)", "-", held, None)]


def _fresh_rows(branch: PaperBranch, model: GraspModel, field: EnergyField, count: int,
                progress: Progress) -> list[Row]:
    """The field's error at poses of another sequence, solved along another tree."""
    settings = EnergySettings()
    targets = sample_positions(model.reach, model.rest_position, 3 * count, seed=99,
                               deflection=settings.deflection, stretch=settings.stretch)
    targets = targets[field.region.contains(targets)][:count]
    fresh, _ = sample_branch(model, targets, progress=progress)
    errors = error_measures(fresh, field.energy(fresh.positions), field.force(fresh.positions))
    return [Row(f"{branch.name}: field error, {len(targets)} fresh poses (rms)", "-",
                f"energy {100 * errors['energy_error']:.1f} %, its gentle half "
                f"{100 * errors['gentle_energy_error']:.1f} %, "
                f"force {100 * errors['force_error']:.0f} %", None)]


def _trials(model: GraspModel, field: EnergyField, goal: GraspGoal, count: int,
            progress: Progress) -> list[_Trial]:
    found = []
    with Pool() as pool:
        futures = [pool.submit(_trial, model, field, goal, seed) for seed in range(count)]
        for future in as_completed(futures):
            found.append(future.result())
            progress(len(found) / count, "trials")
    return sorted(found, key=lambda trial: trial.seed)


def _trial(model: GraspModel, field: EnergyField, goal: GraspGoal, seed: int) -> _Trial:
    settings = PlanSettings(seed=seed)
    started = time.perf_counter()
    start = random_start(field, goal, settings, seed)
    pair = plan_pair(field, start, goal, settings)
    planned = time.perf_counter()
    try:
        baseline, plan = (resolve_path(model, path.points, pair.approach)
                          for path in (pair.baseline, pair.plan))
    except WorkError as error:
        return _Trial(seed, planned - started, time.perf_counter() - planned, {}, {}, np.nan,
                      str(error))
    off = field.energy(plan.solved.poses[:, :3]) - np.maximum(plan.solved.energies, 0.0)
    return _Trial(seed, planned - started, time.perf_counter() - planned,
                  asdict(baseline.measures), asdict(plan.measures),
                  float(np.sqrt(np.mean(off**2) / np.mean(plan.solved.energies**2))))


def _trial_rows(branch: PaperBranch, trials: list[_Trial], good: list[_Trial]) -> list[Row]:
    def spread(key: str, name: str, scale: float = 1.0) -> str:
        values = scale * np.array([getattr(trial, key)[name] for trial in good])
        return f"{values.mean():.4g}±{values.std():.2g}"

    energy = f"{spread('baseline', 'energy_sum_nmm')} to {spread('plan', 'energy_sum_nmm')} N mm"
    length = f"{spread('baseline', 'length_m')} to {spread('plan', 'length_m')} m"
    peak = _percent(good, "peak_energy_j", -1)
    force = _percent(good, "peak_force_n", -1)
    errors = [trial.field_error for trial in good]
    slowest = max(trial.seconds + trial.resolve_seconds for trial in trials)
    return [
        Row(f"{branch.name}: energy saved, {len(good)} of {len(trials)} trials", "-",
            f"{_percent(good, 'energy_sum_nmm', -1):.1f} % ({energy})", None),
        Row(f"{branch.name}: length added", "-",
            f"{_percent(good, 'length_m', 1):.1f} % ({length})", None),
        Row(f"{branch.name}: peak energy, peak force saved", "-", f"{peak:.1f} %, {force:.1f} %",
            None),
        Row(f"{branch.name}: field against full model on planned paths (rms)", "-",
            f"median {100 * np.median(errors):.1f} %, worst {100 * np.max(errors):.1f} %", None),
        Row(f"{branch.name}: plan stage, slowest trial, two at once", "40 s", f"{slowest:.0f} s",
            bool(slowest <= 40))]


def _percent(trials: list[_Trial], name: str, sign: int) -> float:
    """Change of the trials' mean from baseline to plan, as the paper's table has it."""
    before = np.mean([trial.baseline[name] for trial in trials])
    after = np.mean([trial.plan[name] for trial in trials])
    return float(100.0 * sign * (after / before - 1.0))


def _natural_rotation(model: GraspModel, field: EnergyField) -> list[Row]:
    """A firm gripper at the planned rotation must not bend the branch more than a loose one."""
    firm = Grasp.from_mesh(model.mesh, mode="clamped")
    order = np.argsort(field.samples.energies)
    picked = order[np.linspace(len(order) // 4, len(order) - 1, 5).astype(int)]
    ratios = []
    for index in picked:
        start = model.follow(field.samples.positions[index][None], model.rest.displacement)[0]
        result = solve_static(model.model, grasp=firm, pose=model.pose(start.displacement),
                              start=start.displacement)
        if start.converged and result.converged:
            ratios.append(model.energy(result) / model.energy(start) - 1.0)
    worst = f"{100 * max(ratios):+.1f} %" if ratios else "none converged"
    return [Row(f"firm grasp at the natural rotation: energy, worst of {len(ratios)}",
                "as planned", worst, None)]


def _engines(field: EnergyField, goal: GraspGoal, count: int) -> list[Row]:
    if reason := ompl_missing():
        return [Row("RRT* engines, OMPL against own", "-", f"no OMPL: {reason}", None)]
    found: dict[str, list[Any]] = {"own": [], "ompl": []}
    for engine, results in found.items():
        for seed in range(count):
            settings = PlanSettings(seed=seed, engine=engine, planner="d-rrt-star")
            started = time.perf_counter()
            pair = plan_pair(field, random_start(field, goal, settings, seed), goal, settings)
            seconds = time.perf_counter() - started
            measures = measure_path(pair.plan.points, field.energy(pair.plan.points),
                                    np.linalg.norm(field.force(pair.plan.points), axis=1))
            results.append((pair.plan.tree_cost, pair.plan.cost, seconds, asdict(measures)))
    shown = "; ".join(
        f"{engine}: tree cost {np.mean([r[0] for r in results]):.3f}, final "
        f"{np.mean([r[1] for r in results]):.3f}, {min(r[2] for r in results):.1f} s"
        for engine, results in found.items())
    return [Row(f"RRT* engines, mean of {count} starts", "-", shown, None)]
