"""Planning: on the paper's three arcs and three drawn forked branches, from rest and nine starts.

Each branch is sampled and planned on as a user would. Costs and bounds are on the field; whether
limits hold is checked on the full model. Nothing is left out: failures are counted and reported.

With ``--out``, fields and trials are kept as they are made: a run with the same ``--seed``
continues with them. Starts take turns over all branches, so that even a part of them represents
all.
"""

import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import cache, cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.planning_trials import (
    AGAINST,
    ARC_NAMES,
    COVERED_ROW,
    DETOUR_ROWS,
    GOAL_ROWS,
    LIMITED,
    NEAR_ROWS,
    SURE_ROW,
    Start,
    Subject,
    arc_of,
    arcs,
    coverage,
    covered_row,
    detour_rows,
    forked,
    goal_rows,
    near_rows,
    run_detour,
    run_near_limit,
    run_region_goal,
    run_sure,
    run_trial,
    saved_and_added,
    spread,
    sure_rows,
)
from benchmarks.table import Asked, Part, Row, Setting
from benchmarks.trials import Trial, column, sound, source_digest
from limber.core.errors import LimberError
from limber.core.progress import Progress
from limber.planning.field.energy_field import EnergyField, fit_field
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.field.sampling import Sampled, sample_field, sample_positions
from limber.planning.settings import EnergySettings

_ERRORS = (("energy", "energy", 100, (1, 5), "%"), ("force", "force", 100, (2, 8), "%"),
           ("tip", "target position", 1e3, (1, 4), "mm"))
"""Errors of a field at fresh poses: name, description, scale, required median and 95 %, unit."""
_SEEDS_APART = 101  # of a branch's starts
_PACKAGES = ("planning", "mechanics")


@dataclass(frozen=True)
class _Fresh:
    """Relative errors at fresh trusted poses of energy and force, of the tip [m], each shape [n].

    The branch's state there is the one that the motion gives, coming from the nearest sample; nan
    if it does not arrive.
    """

    energy: np.ndarray
    force: np.ndarray
    tip: np.ndarray


@dataclass(frozen=True)
class _Fielded:
    """A branch with its field.

    Attributes:
        seconds: Time of sampling and fit [s].
        all_seconds: The same with the fresh poses [s].
        lost: Fraction of the samples' hull that is not trusted.
    """

    subject: Subject
    known: EnergyField
    seconds: float
    all_seconds: float
    fresh: _Fresh
    lost: float


class _Run:
    """Shared by the parts of the table: branches, and fields of as many as there was time for.

    Args:
        setting: Setting of the calling part.
        share: Fraction of the part's time for fields that do not exist yet.
    """

    def __init__(self, setting: Setting, share: float = 0.5):
        self.setting = setting
        self.failed: list[str] = []
        self._share = share

    @cached_property
    def fielded(self) -> list[_Fielded]:
        """Branches with fields, arcs and forked ones in turn, so that a few represent all.

        Raises:
            RuntimeError: no branch has a field.
        """
        setting, found, longest = self.setting, [], 0.0
        subjects = [*(arcs()[1:2] if setting.quick else arcs()),
                    *_forked(setting.seed, setting.at_most(3, 1))]
        half = (len(subjects) + 1) // 2
        budget = setting.budget.part(self._share * setting.budget.remaining)
        for number in sorted(range(len(subjects)), key=lambda k: (k % half, k)):
            name = subjects[number].name
            kept = setting.kept / (f"field-{setting.seed}-{setting.at_most(40, 15)}-"
                                   f"{name.replace(' ', '-')}-{_field_source()}.npz")
            if found and not kept.is_file() and budget.remaining <= longest:
                continue
            part = setting.progress.part(0.5 * len(found) / len(subjects),
                                         0.5 * (len(found) + 1) / len(subjects))
            try:
                found.append(_fielded(subjects[number], EnergySettings(seed=setting.seed),
                                      setting.at_most(40, 15),
                                      _own_seed(setting.seed + 1, number, 0), kept, part))
                longest = max(longest, found[-1].all_seconds)
            except LimberError as error:
                self.failed.append(f"{name}: {error}")
        if not found:
            raise RuntimeError(f"no branch of the bench has a field: {'; '.join(self.failed)}")
        return found

    def trials(self, part: str, work: Callable[[Start], dict[str, Any]], count: int,
               names: tuple[str, ...] = ()) -> list[Trial]:
        """Trials of ``count`` starts of each branch with a field, or of those named, in turn over
        the branches: as many as there is time for. Their tasks are branch, number and seed.
        """
        fields = {one.subject.name: one for one in self.fielded}
        seeds = {(name, number): _own_seed(self.setting.seed, k, number)
                 for number in range(count) for k, name in enumerate(fields)
                 if name in (names or fields)}

        def start(task: tuple[str, int, int]) -> Start:
            name, number, seed = task
            # One goal for each of the quantities that take turns.
            return Start(fields[name].subject, fields[name].known, number, seed,
                         seed - _SEEDS_APART * (number % len(LIMITED)))
        return self.setting.trials(
            part, [(*which, seed) for which, seed in seeds.items()], work, *_PACKAGES,
            workers=None, catch=LimberError, given=start,
            progress=self.setting.progress.part(0.5, 1.0))


@cache
def _field_source() -> str:
    return source_digest(("planning/field", "mechanics"))


@cache
def _forked(seed: int, count: int) -> list[Subject]:
    return forked(seed, count)


def _fielded(subject: Subject, settings: EnergySettings, fresh_count: int, fresh_seed: int,
             kept: Path, progress: Progress) -> _Fielded:
    """Sample and fit, or read the result of an earlier part or run for the same branch."""
    if kept.is_file():
        known = EnergyField.read(kept)
        with np.load(kept) as file:
            fresh = _Fresh(*file["fresh"])
            times = float(file["seconds"]), float(file["all_seconds"])
            lost = float(file["lost"])
        return _Fielded(subject, known, *times, fresh, lost)
    began = time.perf_counter()
    sampled, known, seconds = _timed_field(subject.model, settings, progress.part(0.0, 0.7))
    fresh, lost = _fresh(subject.model, known, sampled, settings, fresh_count, fresh_seed,
                         progress.part(0.7, 1.0))
    times = seconds, time.perf_counter() - began
    written = kept.with_name(f"writing-{kept.name}")
    known.write(written, {"seconds": np.array(times[0]), "all_seconds": np.array(times[1]),
                         "lost": np.array(lost), "fresh": np.array(list(asdict(fresh).values()))})
    written.replace(kept)
    return _Fielded(subject, known, *times, fresh, lost)


def _timed_field(model: GraspModel, settings: EnergySettings, progress: Progress,
                 ) -> tuple[Sampled, EnergyField, float]:
    """Return samples, field, and the time of both [s]."""
    began = time.perf_counter()
    sampled = sample_field(model, settings, progress=progress)
    known = fit_field(sampled.samples, sampled.energy_surface.pivot, sampled.energy_surface.radius)
    return sampled, known, time.perf_counter() - began


def _fresh(model: GraspModel, known: EnergyField, sampled: Sampled, settings: EnergySettings,
           count: int, seed: int, progress: Progress) -> tuple[_Fresh, float]:
    """Return errors at ``count`` fresh trusted poses, and the fraction of the hull not trusted."""
    targets = sample_positions(model.reach, model.rest_position, 4 * count, sampled.energy_surface,
                               deflection=settings.deflection, seed=seed)
    targets = targets[known.region.height(targets) <= 0.0]
    trusted = known.region.contains(targets)
    lost, targets = float((~trusted).mean()), targets[trusted][:count]
    errors = np.full((3, len(targets)), np.nan)
    for number, place in enumerate(targets):
        progress(number / len(targets), "fresh poses")
        gaps = np.linalg.norm(sampled.samples.positions - place, axis=1)
        there = model.follow(place[None], sampled.samples.displacements[int(gaps.argmin())])[0]
        if refusal(there):
            continue
        energy, force = model.energy(there), there.reaction_force
        errors[:, number] = (
            abs(known.energy(place)[0] - energy) / max(energy, 1e-12),
            np.linalg.norm(known.force(place)[0] - force) / np.linalg.norm(force),
            np.linalg.norm(known.tip(place)[0] - model.tip(there.displacement)))
    return _Fresh(*errors), lost


def _own_seed(seed: int, branch: int, number: int) -> int:
    """The seed of a start follows from the base seed, the branch and the start's number."""
    return (seed + 1009 * branch + _SEEDS_APART * number) % (1 << 31)


def _troubles(trials: list[Trial]) -> str:
    return "; ".join(f"{one.task[0]} {one.task[1]}: {one.failure}" for one in trials if one.failure)


def _trial_rows(setting: Setting) -> list[Row]:
    trials = _Run(setting).trials("plans", run_trial, setting.at_most(10, 3))
    return [*_bound_rows(trials), *_time_rows(trials), *_full_rows(trials),
            *_saved_rows(sound(trials))]


def _saved_rows(good: list[Trial]) -> list[Row]:
    table = []
    for asked, name in zip(_SAVED, AGAINST, strict=True):
        saved, added = saved_and_added([one for one in good if one.task[1] > 0], name)
        table.append(Row(*asked, f"{np.mean(saved):.1f} %, {np.mean(added):.1f} % longer"
                         if saved else "none", None, len(saved)))
    rest = [one["saved"]["straight line"] for one in good if one.task[1] == 0]
    return [*table, Row(*_FROM_REST, ", ".join(f"{value:.1f}" for value in rest) + " %", None,
                        len(rest))]


def _bound_rows(trials: list[Trial]) -> list[Row]:
    good = sound(trials)
    if not good:
        return [Row(*asked, _troubles(trials), False, len(trials)) for asked in _BOUND_ROWS]
    gaps, ratio, below = (column(good, name) for name in ("gap", "to_optimum", "bound_to_optimum"))
    gaps = 100 * gaps
    return [
        Row(*_BOUND_ROWS[0], _troubles(trials) or "100 %", len(good) == len(trials), len(trials)),
        Row(*_BOUND_ROWS[1], spread(gaps, " %", 2),
            bool(np.median(gaps) <= 1.5 and gaps.max() <= 3.0), len(gaps)),
        Row(*_BOUND_ROWS[2],
            f"{100 * (ratio.max() - 1):.3f} % (best {100 * (ratio.min() - 1):.3f} %)",
            bool(ratio.max() <= 1.01), len(ratio)),
        Row(*_BOUND_ROWS[3], f"bound at most {below.max():.4f} of the best",
            bool(below.max() <= 1.0 + 1e-9), len(below))]


def _time_rows(trials: list[Trial]) -> list[Row]:
    good = sound(trials)
    if not good:
        return [Row(*asked, _troubles(trials), False, len(trials)) for asked in _TIME_ROWS]
    seconds, soon, checks = (column(good, name) for name in (
        "seconds", "seconds_to_close", "check_seconds"))
    in_time = soon[np.isfinite(soon)]
    return [
        Row(*_TIME_ROWS[0], spread(seconds, " s"), bool(seconds.max() <= 10.0), len(good)),
        Row(*_TIME_ROWS[1], f"{spread(in_time, ' s') if len(in_time) else 'none'}, "
            f"{len(soon) - len(in_time)} never", bool(np.median(soon) <= 1.0), len(good)),
        Row(*_TIME_ROWS[2], spread(checks, " s"), bool(checks.max() <= 10.0), len(good))]


def _field_rows(setting: Setting) -> list[Row]:
    run = _Run(setting, share=1.0)
    fielded, table = run.fielded, []
    for row, (name, _, scale, asked, unit) in zip(_FIELD_ERRORS, _ERRORS, strict=True):
        worst = max(fielded, key=lambda one: np.nanquantile(getattr(one.fresh, name), 0.95))
        there = scale * np.nanquantile(getattr(worst.fresh, name), 0.95)
        table.append(_error_row(
            row, np.concatenate([getattr(one.fresh, name) for one in fielded]), scale, asked,
            unit, f" (worst {worst.subject.name}: {there:.2g})"))
    heights = [float(one.known.region.height(one.known.rest[None])[0]) for one in fielded]
    table.append(Row(*_REST_INSIDE, f"{-1e3 * max(heights):.2f} mm", bool(max(heights) < 0.0),
                     len(fielded)))
    table.append(Row(*_WITHOUT_FIELD, "; ".join(run.failed) or "none", not run.failed,
                     len(fielded) + len(run.failed)))
    missed = sum(int(np.isnan(one.fresh.tip).sum()) for one in fielded)
    return [*table, Row(
        *_NOT_TRUSTED, f"{100 * np.mean([one.lost for one in fielded]):.0f} / "
        f"{100 * max(one.lost for one in fielded):.0f} %; {missed} of "
        f"{sum(len(one.fresh.tip) for one in fielded)}", None, len(fielded))]


def _error_row(row: Asked, values: np.ndarray, scale: float, asked: tuple[float, float], unit: str,
               more: str = "") -> Row:
    # A pose where the motion does not arrive has the largest possible error.
    median, most = np.quantile(np.nan_to_num(scale * values, nan=np.inf), (0.5, 0.95),
                               method="higher")
    return Row(*row, f"{median:.2g} / {most:.2g} {unit}{more}",
               bool(median <= asked[0] and most <= asked[1]), len(values))


def _full_rows(trials: list[Trial]) -> list[Row]:
    good = sound(trials)
    accepted = [one for one in good if "accepted_after" in one.values]
    refused = [one["refused"] for one in good if "refused" in one.values]
    again = sum(one["accepted_after"] > 1 for one in accepted)
    broken = [one["excess"] for one in accepted if not one["excess"] <= 1e-3]
    errors, first, rounds = (column(good, name) if good else np.full(1, np.nan) for name in (
        "field_error", "first_field_error", "rounds"))
    moving, ratio = (column(accepted, name) if accepted else np.full(1, np.nan) for name in (
        "moving_seconds", "moving_ratio"))
    return [
        Row(*_FULL_ROWS[0], f"{spread(moving, ' s')}; "
            f"{sum(one['slowings'] > 0 for one in accepted)} of {len(accepted)} slowed down, force "
            f"at most {ratio.max():.3f} of the limit", bool(moving.max() <= 10.0), len(accepted)),
        Row(*_FULL_ROWS[2], f"{spread(100 * errors, ' %', 2)}, before samples were added "
            f"{spread(100 * first, ' %', 2)}; {rounds.mean():.1f} rounds", None, len(good)),
        Row(*_FULL_ROWS[1],
            f"{len(broken)} of {len(accepted)} accepted ({again} planned anew), "
            f"{len(refused)} refused" + (f"; worst {100 * max(broken):+.2f} %" if broken else "")
            + (f"; {refused[0]}" if refused else ""), bool(accepted) and not broken, len(trials))]


def _stated_errors(setting: Setting) -> list[Row]:
    return [covered_row([coverage(one.subject.model, one.known, setting.at_most(60, 20),
                                  setting.seed + 7) for one in _Run(setting).fielded])]


def _sure(setting: Setting) -> list[Row]:
    """Plan with confidence on each branch from rest, and test the plan on draws of the moduli."""
    draws = setting.at_most(100, 30)
    return sure_rows(_Run(setting).trials("sure", partial(run_sure, draws=draws), 1), draws)


def _field_cost(setting: Setting) -> list[Row]:
    """Time of a field of 300 poses on branches of about 900 and 2,500 tetrahedra."""
    found = []
    for k, subject in enumerate((arc_of(1.5), arc_of(0.9, 8))):
        settings = EnergySettings(seed=setting.seed, samples=300)
        _, known, seconds = _timed_field(subject.model, settings, setting.progress.part(
            0.5 * k, 0.5 * (k + 1)))
        found.append((f"{seconds:.1f} s ({subject.model.mesh.tet_count} tets, "
                      f"{len(known.samples.poses)} poses)", seconds))
    return [Row(*_FIELD_COST, ", ".join(words for words, _ in found),
                found[0][1] <= 10.0 and found[1][1] <= 22.0, len(found))]


_SAVED = tuple(Asked(f"random starts, default weights: saved against {name}", "-")
               for name in AGAINST)
_FROM_REST = Asked("from rest, all branches: saved against the straight line", "-")
_BOUND_ROWS = (
    Asked("success where a path exists", "100 %"),
    Asked("certified gap, median / worst", "1.5 / 3 %"),
    Asked("cost over an independent optimum's, worst", "1 %"),
    Asked("no path below the bound", "never"))
_TIME_ROWS = (
    Asked("in: RRT*, plan and bound, median / worst, two at once", "10 s"),
    Asked("planning after the field to within 2 % of the best: eikonal, median / worst", "1 s"),
    Asked("full-model check of both paths, median / worst, one process, two at once", "10 s"))
_FULL_ROWS = (
    Asked("the same in time, there and back, with a force that binds: median / worst", "10 s"),
    Asked("limits broken on the full model by an accepted plan with a force that binds", "none"),
    Asked("field's energy along planned paths (rms), median / worst", "-"))
_FIELD_COST = Asked("field of 300 poses, fit included, at 900 and 2,500 tetrahedra", "10 s, 22 s")
_REST_INSIDE = Asked("rest pose inside the sampled region: least depth", "inside")
_WITHOUT_FIELD = Asked("branches without a field", "none")
_NOT_TRUSTED = Asked("of the samples' hull not trusted, mean / most; fresh trusted poses where the "
                     "motion does not come", "-")
_FIELD_ERRORS = tuple(Asked(f"field error on fresh poses: {what}, median / 95 %",
                            f"{median} / {most} {unit}")
                      for _, what, _, (median, most), unit in _ERRORS)

PARTS = {
    "field": Part(_field_rows, 120, (*_FIELD_ERRORS, _REST_INSIDE, _WITHOUT_FIELD, _NOT_TRUSTED),
                  grows=True),
    "field-cost": Part(_field_cost, 60, (_FIELD_COST,)),
    "detours": Part(lambda setting: detour_rows(_Run(setting).trials(
        "detours", run_detour, setting.at_most(10, 3), ARC_NAMES)), 100, DETOUR_ROWS, grows=True),
    "trials": Part(_trial_rows, 150, (*_BOUND_ROWS, *_TIME_ROWS, *_FULL_ROWS, *_SAVED, _FROM_REST),
                   grows=True),
    "near-limits": Part(lambda setting: near_rows(_Run(setting).trials(
        "near limits", run_near_limit, setting.at_most(34, 2))), 150, NEAR_ROWS, grows=True),
    "goals": Part(lambda setting: goal_rows(_Run(setting).trials(
        "goals", run_region_goal, setting.at_most(12, 2))), 150, GOAL_ROWS, grows=True),
    "stated-errors": Part(_stated_errors, 60, (COVERED_ROW,), grows=True),
    "sure": Part(_sure, 120, (SURE_ROW,), grows=True)}
"""The table, in order of importance."""
