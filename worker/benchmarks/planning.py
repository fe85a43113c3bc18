"""Planning: on the paper's three arcs and three drawn forked branches, from rest and nine starts.

Each branch is sampled and planned on as a user would. Costs and bounds are of the field; whether
limits hold is asked of the full model. Nothing is left out: what failed is counted and told.

With ``--out`` fields and trials are kept as they are made: the same ``--seed`` goes on with them.
Starts are taken in turn over all branches, so that also a part of them speaks for all.
"""

import json
import time
from concurrent.futures import as_completed
from dataclasses import asdict, dataclass, field
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.kept_trials import keep, read_trials, source_digest
from benchmarks.planning_branches import ARC_NAMES, Subject, arcs, forked
from benchmarks.planning_confidence import Sure, run_sure, sure_rows
from benchmarks.planning_detours import Detour, detour_rows, run_detour
from benchmarks.planning_trials import Trial, no_path_seconds, run_trial
from benchmarks.table import Row
from limber.errors import LimberError
from limber.jobs import Pool
from limber.mechanics.reduced.cache import ReducedCache
from limber.plain import plain
from limber.planning.field.energy_field import EnergyField, fit_field
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.field.learnt import LearntGraspModel
from limber.planning.field.sampling import Sampled, sample_field, sample_positions
from limber.planning.goals import GraspGoal, default_goal
from limber.planning.settings import EnergySettings
from limber.progress import Progress

_ERRORS = (("energy", "energy", 100, (1, 5), "%"), ("force", "force", 100, (2, 8), "%"),
           ("tip", "target position", 1e3, (1, 4), "mm"))
"""Of a field at fresh poses: their name, in words, scale, median and 95 % asked, unit."""
_TIMED_STARTS = 3  # of each branch, where only times are asked


@dataclass(frozen=True)
class _Fresh:
    """Relative errors at fresh trusted poses of energy and force, of the tip [m], each shape [n].

    There the branch is as the motion brings it: coming from the nearest sample; nan where it does
    not come.
    """

    energy: np.ndarray
    force: np.ndarray
    tip: np.ndarray


@dataclass(frozen=True)
class _Fielded:
    """A branch with its field; ``lost`` is the share of its samples' hull that is not trusted."""

    subject: Subject
    known: EnergyField
    goal: GraspGoal
    seconds: float
    fresh: _Fresh
    lost: float


def rows(quick: bool, progress: Progress, out: Path | None, seed: int,
         only: tuple[str, ...] = ()) -> list[Row]:
    """Measure the parts named in ``only``, or all but what repeats times of others by themselves;
    ``quick`` takes one arc, one forked branch and three starts."""
    run = _Run(quick, progress, out, seed)
    table = [row for name in only or WHOLE for row in PARTS[name](run)]
    if out is not None and "trials" in (only or WHOLE):
        raw = {one.subject.name: {
            "field_seconds": one.seconds, "errors": one.known.errors, "goal": one.goal.describe(),
            "fresh": asdict(one.fresh), "trials": [asdict(t) for t in run.trials[one.subject.name]],
        } for one in run.fielded}
        (out / "planning.json").write_text(json.dumps(plain(raw), indent=1))
    return table


@dataclass
class _Run:
    """What the parts of the table share, made when it is asked for."""

    quick: bool
    progress: Progress
    out: Path | None
    seed: int
    failed: list[str] = field(default_factory=list)

    @property
    def starts(self) -> int:
        return 3 if self.quick else 10

    @property
    def draws(self) -> int:
        return 30 if self.quick else 100

    @cached_property
    def forked(self) -> list[Subject]:
        return forked(self.seed, 1 if self.quick else 3, self.progress)

    @cached_property
    def fielded(self) -> list[_Fielded]:
        subjects = [*(arcs()[1:2] if self.quick else arcs()), *self.forked]
        found = []
        for number, subject in enumerate(subjects):
            part = self.progress.part(0.3 * number / len(subjects),
                                      0.3 * (number + 1) / len(subjects))
            try:
                found.append(_fielded(subject, EnergySettings(seed=self.seed),
                                      15 if self.quick else 40,
                                      _own_seed(self.seed + 1, number, 0), self.out, part))
            except LimberError as error:
                self.failed.append(f"{subject.name}: {error}")
        return found

    @cached_property
    def trials(self) -> dict[str, list[Trial]]:
        return _trials(self.fielded, self.starts, self.seed, self.kept("trials"),
                       self.progress.part(0.3, 0.85))

    def kept(self, what: str) -> Path | None:
        return None if self.out is None else self.out / f"planning-{what}.jsonl"


def _source() -> str:
    return source_digest(("planning", "mechanics"), *Path(__file__).parent.glob("planning*.py"))


def _field_source() -> str:
    return source_digest(("planning/field", "mechanics"),
                         Path(__file__).parent / "planning_branches.py")


def _fielded(subject: Subject, settings: EnergySettings, fresh_count: int, fresh_seed: int,
             out: Path | None, progress: Progress) -> _Fielded:
    """Sample and fit, or read what an earlier run kept of the same branch."""
    kept = None if out is None else (
        out / f"field-{settings.seed}-{subject.name.replace(' ', '-')}-{_field_source()}.npz")
    if kept is not None and kept.is_file():
        known = EnergyField.read(kept)
        with np.load(kept) as file:
            fresh = _Fresh(*file["fresh"])
            seconds, lost = float(file["seconds"]), float(file["lost"])
        return _Fielded(subject, known, default_goal(known, 0.01), seconds, fresh, lost)
    found = _sampled(subject, settings, fresh_count, fresh_seed, progress)
    if kept is not None:
        found.known.write(kept, {"seconds": np.array(found.seconds), "lost": np.array(found.lost),
                                 "fresh": np.array(list(asdict(found.fresh).values()))})
    return found


def _sampled(subject: Subject, settings: EnergySettings, fresh_count: int, fresh_seed: int,
             progress: Progress) -> _Fielded:
    sampled, known, seconds = _timed_field(subject.model, settings, progress.part(0.0, 0.7))
    fresh, lost = _fresh(subject.model, known, sampled, settings, fresh_count, fresh_seed,
                         progress.part(0.7, 1.0))
    return _Fielded(subject, known, default_goal(known, 0.01), seconds, fresh, lost)


def _timed_field(model: GraspModel, settings: EnergySettings, progress: Progress,
                 ) -> tuple[Sampled, EnergyField, float]:
    """Return samples, field, and the seconds that both took."""
    began = time.perf_counter()
    sampled = sample_field(model, settings, progress=progress)
    known = fit_field(sampled.samples, sampled.valley.pivot, sampled.valley.radius)
    return sampled, known, time.perf_counter() - began


def _fresh(model: GraspModel, known: EnergyField, sampled: Sampled, settings: EnergySettings,
           count: int, seed: int, progress: Progress) -> tuple[_Fresh, float]:
    """Return errors at ``count`` fresh trusted poses, and the share of the hull not trusted."""
    targets = sample_positions(model.reach, model.rest_position, 4 * count, sampled.valley,
                               deflection=settings.deflection, seed=seed)
    targets = targets[known.region.height(targets) <= 0.0]
    trusted = known.region.contains(targets)
    lost, targets = float((~trusted).mean()), targets[trusted][:count]
    errors = np.full((3, len(targets)), np.nan)
    for number, place in enumerate(targets):
        progress(number / len(targets), "fresh poses")
        gaps = np.linalg.norm(sampled.samples.positions - place, axis=1)
        there = model.follow(place[None], sampled.displacements[int(gaps.argmin())])[0]
        if refusal(there):
            continue
        energy, force = model.energy(there), there.reaction_force
        errors[:, number] = (
            abs(known.energy(place)[0] - energy) / max(energy, 1e-12),
            np.linalg.norm(known.force(place)[0] - force) / np.linalg.norm(force),
            np.linalg.norm(known.tip(place)[0] - model.tip(there.displacement)))
    return _Fresh(*errors), lost


def _trials(fielded: list[_Fielded], count: int, seed: int, kept: Path | None,
            progress: Progress, limited: bool = True) -> dict[str, list[Trial]]:
    found: dict[str, list[Trial]] = {one.subject.name: [] for one in fielded}
    source, wanted = _source(), {}
    for number in range(count):
        for k, one in enumerate(fielded):
            wanted[one.subject.name, _own_seed(seed, k, number)] = one, number
    for trial in read_trials(Trial, kept):
        if trial.source == source and wanted.pop((trial.branch, trial.seed), None):
            found[trial.branch].append(trial)
    with Pool() as pool:
        futures = [pool.submit(partial(run_trial, branch=name, source=source, limited=limited),
                               one.subject.model, one.known, one.goal, number, own)
                   for (name, own), (one, number) in wanted.items()]
        for done, future in enumerate(as_completed(futures)):
            trial = future.result()
            keep(trial, kept)
            found[trial.branch].append(trial)
            progress((done + 1) / len(futures), "trials")
    return {name: sorted(trials, key=lambda trial: trial.number)
            for name, trials in found.items()}


def _detours(fielded: list[_Fielded], count: int, seed: int, kept: Path | None,
             progress: Progress) -> list[Detour]:
    """Plan on the paper's arcs within the paper's detour, from the starts of the trials."""
    source, wanted, found = _source(), {}, []
    for k, one in enumerate(fielded):
        for number in range(count if one.subject.name in ARC_NAMES else 0):
            wanted[one.subject.name, _own_seed(seed, k, number)] = one, number
    for detour in read_trials(Detour, kept):
        if detour.source == source and wanted.pop((detour.branch, detour.seed), None):
            found.append(detour)
    with Pool() as pool:
        futures = [pool.submit(partial(run_detour, branch=name, source=source), one.known,
                               one.goal, number, own)
                   for (name, own), (one, number) in wanted.items()]
        for done, future in enumerate(as_completed(futures)):
            found.append(future.result())
            keep(found[-1], kept)
            progress((done + 1) / len(futures), "paths within a detour")
    return found


def _sure(fielded: list[_Fielded], draws: int, seed: int, out: Path | None) -> list[Sure]:
    """Plan with confidence on each branch from rest, and try it on draws of the moduli."""
    source, kept = _source(), None if out is None else out / "planning-sure.jsonl"
    found = [one for one in read_trials(Sure, kept) if (one.source, one.seed) == (source, seed)]
    missing = [one for one in fielded if one.subject.name not in {done.branch for done in found}]
    with Pool() as pool:
        futures = [pool.submit(run_sure, one.subject, one.known, one.goal, draws, seed, source)
                   for one in missing]
        for future in as_completed(futures):
            found.append(future.result())
            keep(found[-1], kept)
    return found


def _own_seed(seed: int, branch: int, number: int) -> int:
    """The seed of a start follows from the base seed, the branch and the start's number."""
    return (seed + 1009 * branch + 101 * number) % (1 << 31)


def _saved_rows(trials: dict[str, list[Trial]]) -> list[Row]:
    good = [t for some in trials.values() for t in some if t.saved]
    table = []
    for name in ("RRT*, not smoothed", "RRT*", "straight line"):
        saved = [t.saved[name] for t in good if t.number > 0 and name in t.saved]
        added = [t.added[name] for t in good if t.number > 0 and name in t.saved]
        table.append(Row(
            f"random starts, default weights: saved against {name}", "-",
            f"{np.mean(saved):.1f} %, {np.mean(added):.1f} % longer, {len(saved)} trials"
            if saved else "none", None))
    rest = [t.saved["straight line"] for t in good if t.number == 0]
    table.append(Row("from rest, all branches: saved against the straight line", "-",
                     ", ".join(f"{value:.1f}" for value in rest) + " %", None))
    return table


def _bound_rows(trials: dict[str, list[Trial]]) -> list[Row]:
    every = [t for some in trials.values() for t in some]
    good = [t for t in every if np.isfinite(t.gap)]
    if not good:
        return [Row("certified gap", "2 / 5 %, in 10 s", _troubles(trials), False)]
    gaps = 100.0 * np.array([t.gap for t in good])
    tree = np.array([t.tree_to_optimum for t in good if np.isfinite(t.tree_to_optimum)])
    ratio = np.array([t.to_optimum for t in good if np.isfinite(t.to_optimum)])
    below = np.array([t.bound_to_optimum for t in good if np.isfinite(t.bound_to_optimum)])
    return [
        Row(f"success where a path exists, {len(every)} trials", "100 %", _troubles(trials) or
            "100 %", all(not t.trouble for t in every)),
        Row(f"certified gap, median / worst of {len(gaps)}", "2 / 5 %",
            f"{np.median(gaps):.2f} / {gaps.max():.2f} %",
            bool(np.median(gaps) <= 2.0 and gaps.max() <= 5.0)),
        *_time_rows(trials),
        Row("the same: D-RRT* of 3,000 iterations, over the best, median / worst", "2 %",
            f"{100 * np.median(tree - 1):.1f} / {100 * (tree.max() - 1):.1f} %, "
            f"{(tree <= 1.02).sum()} of {len(tree)} within" if len(tree) else "none",
            bool(len(tree) and np.median(tree) <= 1.02)),
        Row("cost over an independent optimum's, worst", "1 %",
            f"{100 * (ratio.max() - 1):.3f} % (best {100 * (ratio.min() - 1):.3f} %)",
            bool(ratio.max() <= 1.01)),
        Row("no path below the bound", "never", f"bound at most {below.max():.4f} of the best",
            bool(below.max() <= 1.0 + 1e-9))]


def _time_rows(trials: dict[str, list[Trial]]) -> list[Row]:
    good = [t for some in trials.values() for t in some if np.isfinite(t.check_seconds)]
    if not good:
        return [Row("in: plan, and check", "10 s", _troubles(trials), False)]
    seconds = np.array([t.seconds for t in good])
    soon = np.array([t.seconds_to_close for t in good])
    checks = np.array([t.check_seconds for t in good])
    return [
        Row(f"in: RRT*, D-RRT*, plan and bound, median / worst of {len(good)}, two at once", "10 s",
            f"{np.median(seconds):.1f} / {seconds.max():.1f} s", bool(seconds.max() <= 10.0)),
        Row("planning after the field to within 2 % of the best: eikonal, median / worst", "1 s",
            f"{np.nanmedian(soon):.1f} / {np.nanmax(soon):.1f} s, {np.isnan(soon).sum()} never",
            bool(np.median(soon) <= 1.0)),
        Row("full-model check of both paths, median / worst, one process, two at once", "10 s",
            f"{np.median(checks):.1f} / {checks.max():.1f} s", bool(checks.max() <= 10.0))]


def _field_rows(fielded: list[_Fielded], failed: list[str]) -> list[Row]:
    table = []
    for name, what, scale, asked, unit in _ERRORS:
        worst = max(fielded, key=lambda one: np.nanquantile(getattr(one.fresh, name), 0.95))
        there = scale * np.nanquantile(getattr(worst.fresh, name), 0.95)
        table.append(_error_row(
            what, np.concatenate([getattr(one.fresh, name) for one in fielded]), scale, asked,
            unit, f" (worst {worst.subject.name}: {there:.2g})"))
    missed = sum(int(np.isnan(one.fresh.tip).sum()) for one in fielded)
    table.append(Row(
        "of the samples' hull not trusted, mean / most; fresh trusted poses where the motion does "
        "not come", "-", f"{100 * np.mean([one.lost for one in fielded]):.0f} / "
        f"{100 * max(one.lost for one in fielded):.0f} %; {missed} of "
        f"{sum(len(one.fresh.tip) for one in fielded)}", None))
    slowest = max(fielded, key=lambda one: one.seconds)
    table.append(_cost_row("field, slowest branch", slowest.subject, slowest.known,
                           slowest.seconds, 35.0))
    heights = [float(one.known.region.height(one.known.rest[None])[0]) for one in fielded]
    table.append(Row("rest pose inside the sampled region: least depth", "inside",
                     f"{-1e3 * max(heights):.2f} mm", bool(max(heights) < 0.0)))
    if failed:
        table.append(Row("branches without a field", "none", "; ".join(failed), False))
    return table


def _error_row(what: str, values: np.ndarray, scale: float, asked: tuple[float, float], unit: str,
               more: str = "") -> Row:
    # A pose where the motion does not come is as wrong as can be.
    median, most = np.quantile(np.nan_to_num(scale * values, nan=np.inf), (0.5, 0.95),
                               method="higher")
    return Row(f"field error on fresh poses: {what}, median / 95 %",
               f"{asked[0]} / {asked[1]} {unit}", f"{median:.2g} / {most:.2g} {unit}{more}",
               bool(median <= asked[0] and most <= asked[1]))


def _cost_row(what: str, subject: Subject, known: EnergyField, seconds: float, asked: float,
              ) -> Row:
    samples, tets = len(known.samples.poses), subject.model.mesh.tet_count
    scaled = seconds * 300 / samples * 2500 / tets
    return Row(f"{what}, fit included", f"300 grasps, 2,500 tets: {asked:.0f} s",
               f"{seconds:.0f} s ({samples} grasps, {tets} tets: {scaled:.0f} s scaled)",
               scaled <= asked)


def _full_rows(trials: dict[str, list[Trial]]) -> list[Row]:
    every = [t for some in trials.values() for t in some]
    good = [t for t in every if np.isfinite(t.check_seconds)]
    accepted = [t for t in every if t.limited.startswith("accepted")]
    again = sum("after 1" not in t.limited for t in accepted)
    refused = [t.limited for t in every if t.limited.startswith("refused")]
    broken = [t.excess for t in accepted if not t.excess <= 1e-3]
    errors = [t.field_error for t in good] or [np.nan]
    first = [t.first_field_error for t in good] or [np.nan]
    moving = [t.moving_seconds for t in accepted if np.isfinite(t.moving_seconds)] or [np.nan]
    return [
        Row("the same in time, there and back, with a force that binds: median / worst", "10 s",
            f"{np.median(moving):.1f} / {np.max(moving):.1f} s; "
            f"{sum(t.slowings > 0 for t in accepted)} of {len(accepted)} slowed down, force at "
            f"most {np.max([t.moving_ratio for t in accepted] or [np.nan]):.3f} of the limit",
            bool(np.max(moving) <= 10.0)),
        Row("field's energy along planned paths (rms), median / worst", "-",
            f"{100 * np.median(errors):.2f} / {100 * np.max(errors):.2f} %, before samples were "
            f"added {100 * np.median(first):.2f} / {100 * np.max(first):.2f} %; "
            f"{np.mean([t.rounds for t in good] or [0]):.1f} rounds", None),
        Row(f"limits broken on the full model by an accepted plan, of {len(every)} with a force "
            "that binds", "none",
            f"{len(broken)} of {len(accepted)} accepted ({again} planned anew), "
            f"{len(refused)} refused" + (f"; worst {100 * max(broken):+.2f} %" if broken else "")
            + (f"; {refused[0]}" if refused else ""), bool(accepted) and not broken)]


def _no_path_rows(fielded: list[_Fielded]) -> list[Row]:
    found = {one.subject.name: no_path_seconds(one.known, one.goal) for one in fielded}
    slowest = max(seconds for cases in found.values() for seconds, _ in cases.values())
    wrong = [f"{name}, {word}: {said}" for name, cases in found.items()
             for word, (_, said) in cases.items() if said]
    count = sum(len(cases) for cases in found.values())
    return [Row("no path: force too low for the goal, goal outside the workspace",
                "said with its reason, in 10 s",
                f"{count - len(wrong)} of {count}, slowest {slowest:.1f} s" + "".join(
                    f"; {one}" for one in wrong), not wrong and slowest <= 10.0)]


def _troubles(trials: dict[str, list[Trial]]) -> str:
    return "; ".join(f"{name} {t.number}: {t.trouble}" for name, some in trials.items()
                     for t in some if t.trouble)


def _trial_rows(run: _Run) -> list[Row]:
    return [*_saved_rows(run.trials), *_bound_rows(run.trials), *_full_rows(run.trials)]


def _detour_table(run: _Run) -> list[Row]:
    return detour_rows(_detours(run.fielded, run.starts, run.seed, run.kept("detours"),
                                run.progress.part(0.85, 1.0)))


def _field_time(run: _Run) -> list[Row]:
    """The cost of a field by itself: of the largest forked branch, on an idle machine."""
    largest = max(run.forked, key=lambda one: one.model.mesh.tet_count)
    _, known, seconds = _timed_field(largest.model, EnergySettings(seed=run.seed, samples=300),
                                     run.progress)
    return [_cost_row(f"field of {largest.name} alone", largest, known, seconds, 35.0)]


def _reduced_time(run: _Run) -> list[Row]:
    """The cost of a field on a reduced model that was learnt before, and how good it is."""
    largest = max(run.forked, key=lambda one: one.model.mesh.tet_count)
    settings = EnergySettings(seed=run.seed, samples=300)
    with TemporaryDirectory() as folder:
        cache, began = ReducedCache(Path(folder)), time.perf_counter()
        LearntGraspModel.learnt(largest.model, cache, progress=run.progress.part(0.0, 0.5))
        learning, began = time.perf_counter() - began, time.perf_counter()
        learnt = LearntGraspModel.learnt(largest.model, cache)
        reading = time.perf_counter() - began
    sampled, known, seconds = _timed_field(learnt, settings, run.progress.part(0.5, 0.7))
    fresh, _ = _fresh(largest.model, known, sampled, settings, 15 if run.quick else 40,
                      _own_seed(run.seed + 1, 0, 0), run.progress.part(0.7, 1.0))
    reduced, whole = int(known.samples.reduced.sum()), len(known.samples.poses)
    return [_cost_row(f"field of {largest.name} on the reduced model (learnt in {learning:.0f} s; "
                      f"{reduced} of {whole} poses by it)", largest, known, reading + seconds,
                      5.0),
            *(_error_row(f"{what}, field on the reduced model", getattr(fresh, name), *row)
              for name, what, *row in _ERRORS)]


def _plan_time(run: _Run) -> list[Row]:
    """The times of plans by themselves, of three starts a branch."""
    return _time_rows(_trials(run.fielded, _TIMED_STARTS, run.seed, None,
                              run.progress.part(0.3, 1.0), limited=False))


WHOLE = {
    "detours": _detour_table,
    "trials": _trial_rows,
    "field": lambda run: _field_rows(run.fielded, run.failed),
    "no-path": lambda run: _no_path_rows(run.fielded),
    "sure": lambda run: sure_rows(_sure(run.fielded, run.draws, run.seed, run.out), run.draws),
    "reduced": _reduced_time,
}
PARTS = WHOLE | {"field-time": _field_time, "plan-time": _plan_time}
"""What ``--only`` knows: those, and the times by themselves, for a machine that does nothing else.
"""
