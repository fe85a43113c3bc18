"""Requirements on real scans: `reconstruct` as a user calls it, on fresh seeds each run.

With ``--out``, every case is also drawn.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np

from benchmarks.probability_rows import probability_asked, probability_rows
from benchmarks.same_tree import same_tree_asked, same_tree_rows, subjects
from benchmarks.scan_files import REAL_ROW, real_rows
from benchmarks.scan_runs import Outcomes, outcomes
from benchmarks.table import Asked, Part, Row, Setting
from benchmarks.worlds import rows as worlds

_COUNTS = {"one-sided": 60, "2-mm": 60, "3-mm": 60, "round": 60, "single-view": 20, "gaps": 60,
           "crowns": 12, "leafy": 8}
_QUICK = 15  # times as few


@dataclass(frozen=True)
class View:
    """Limits for scans of one view: fractions of forks found and false, centreline failures of 60,
    median radius error, worst volume error. None: only reported.
    """

    name: str
    limits: tuple[float, float, int, float, float] | None = None

    @property
    def rows(self) -> tuple[Asked, ...]:
        found, false, failures, radius, volume = self.limits or (0.0, 0.0, 0, 0.0, 0.0)
        told = (f"{found:.0%} / under {false:.0%}", f"at most {failures} of 60", f"{radius:.0%}",
                f"{volume:.0%}") if self.limits else ("report",) * 4
        return tuple(Asked(f"{self.name}: {what}", asked) for what, asked in zip((
            "forks found / false", "centreline failures", "radius, median error",
            "mesh volume, worst"), told, strict=True))


ONE_SIDED = View("one-sided, noise 1 mm", (0.90, 0.08, 2, 0.12, 0.08))
ROUND = View("round", (0.97, 0.02, 0, 0.08, 0.05))
SINGLE_VIEW = View("single-view")
ROOT_ROW = Asked("round and one-sided: root within one diameter", "118 of 120")
GAP_ROW = Asked("gaps of 20 to 80 mm, half at forks: main axis within a radius", "57 of 60")
CROWN_ROW = Asked("generated crowns, twigs to 1.5 mm, 1 to 5 spacings: radius bias where resolved; "
                  "length recalled / right; left out unsaid", "10 %; 90 / 95 %; 0")
LEAFY_ROW = Asked("leafy plants: stems recalled / right; leaf points on stems",
                  "90 / 90 %; under 5 % (or refused)")


def noise_asked(kind: str) -> tuple[Asked, ...]:
    """Requirements for one-sided scans with more noise."""
    name = f"one-sided, noise {kind}"
    return (Asked(f"{name}: radius bias", "under 8 %"),
            Asked(f"{name}: stated sigma covers the error", "88-99 %"),
            Asked(f"{name}: forks; centreline failures", "report"))


def _view_rows(one: Outcomes, view: View) -> list[Row]:
    if not one.scores:
        return _nothing(view.rows, one)
    text, got, wrong = one.forks()
    error, volumes = one.column("radius_error"), np.abs(one.column("volume"))
    covered = one.column("covered").mean()
    met: tuple[bool | None, ...] = (None,) * 4
    if view.limits:
        found, false, failures, radius, volume = view.limits
        met = (bool(got >= found and wrong < false and not one.failed),
               one.centre_failures() <= failures * one.count / 60,
               bool(np.median(error) < radius), bool(volumes.max() < volume and not one.failed))
    measured = (
        text + one.told(),
        f"{one.centre_failures()} (mean {one.column('centre_radii').mean():.0%} of the radius, "
        f"worst {one.column('centre_radii').max():.0%})",
        f"median {np.median(error):.1%}, worst branch {error.max():.1%}, bias "
        f"{np.median(one.column('radius_bias')):+.1%}, sigma covers {covered:.0%}",
        f"worst {volumes.max():.1%}, median {np.median(volumes):.1%}, "
        f"{int((volumes > 0.08).sum())} over 8 % (of what points show; of all wood worst "
        f"{np.abs((1 + one.column('volume')) * one.column('shown') - 1).max():.1%}; stated "
        f"intervals hold the volume of {int(one.column('volume_held').sum())}, the length of "
        f"{int(one.column('length_held').sum())}){one.told()}")
    return [Row(*asked, told, is_met, one.count)
            for asked, told, is_met in zip(view.rows, measured, met, strict=True)]


def _noise_rows(one: Outcomes, kind: str) -> list[Row]:
    asked = noise_asked(kind)
    if not one.scores:
        return _nothing(asked, one)
    biases, covered = one.column("radius_bias"), one.column("covered")
    bias = float(np.median(biases))
    return [
        Row(*asked[0], f"{bias:+.1%} (worst branch {biases[np.abs(biases).argmax()]:+.1%}; "
            f"{int((np.abs(biases) > 0.08).sum())} over 8 %){one.told()}",
            bool(abs(bias) < 0.08 and not one.failed), one.count),
        Row(*asked[1],
            f"{covered.mean():.0%} (worst branch {covered.min():.0%}){one.told()}",
            bool(0.88 <= covered.mean() <= 0.99 and not one.failed), one.count),
        Row(*asked[2], f"{one.forks()[0]}; {one.centre_failures()}", None, one.count)]


def _root_rows(views: list[Outcomes]) -> list[Row]:
    total = sum(view.count for view in views)
    scored = [view.column("root_diameters") for view in views if view.scores]
    rooted = np.concatenate(scored) if scored else np.zeros(0)
    held = int((rooted <= 1).sum())
    return [Row(*ROOT_ROW, f"{held} of {total} (worst {rooted.max(initial=0):.1f} diameters)",
                held >= total * 118 / 120, total)]


def gap_rows(gaps: Outcomes) -> list[Row]:
    """Whether the main axis continues across gaps."""
    if not gaps.scores:
        return _nothing((GAP_ROW,), gaps)
    off = gaps.column("main_axis_radii")
    held = int((off <= 1).sum())
    return [Row(*GAP_ROW, f"{held} of {gaps.count} (worst {off.max():.1f} radii); forks "
                f"{gaps.forks()[0]}{gaps.told()}", held >= 0.95 * gaps.count, gaps.count)]


def _crown_rows(crowns: Outcomes) -> list[Row]:
    if not crowns.scores:
        return _nothing((CROWN_ROW,), crowns)
    bias = crowns.column("resolved_bias")
    recall, right = (float(crowns.column(key).mean()) for key in ("recall", "right"))
    unsaid = float(crowns.column("unsaid_m").sum())
    return [Row(*CROWN_ROW,
                f"{np.median(bias):+.1%} (worst {np.abs(bias).max():.1%}); {recall:.0%} (worst "
                f"{crowns.column('recall').min():.0%}) / {right:.0%} (worst "
                f"{crowns.column('right').min():.0%}); {1000 * unsaid:.0f} mm; sigma covers "
                f"{crowns.column('covered').mean():.0%}; forks {crowns.forks()[0]}{crowns.told()}",
                bool(np.abs(bias).max() < 0.10 and recall >= 0.90 and right >= 0.95
                     and unsaid == 0 and not crowns.failed), crowns.count)]


def _leafy_rows(leafy: Outcomes) -> list[Row]:
    refused = f"{len(leafy.failed)} of {leafy.count} refused"
    if not leafy.scores:
        return [Row(*LEAFY_ROW, refused, True, leafy.count)] if leafy.count else []
    recall, right, taken = (float(leafy.column(key).mean()) for key in (
        "recall", "right", "leaf_points_on_stems"))
    return [Row(*LEAFY_ROW, f"{recall:.0%} / {right:.0%}; {taken:.0%}; {refused}",
                recall >= 0.9 and right >= 0.9 and taken < 0.05, leafy.count)]


def _nothing(rows: tuple[Asked, ...], one: Outcomes) -> list[Row]:
    """The rows of cases of which none was reconstructed; none if there was no case."""
    return [Row(*asked, f"none reconstructed: {'; '.join(one.failed[:3])}", False, one.count)
            for asked in rows] if one.count else []


def _probabilities(done: dict[str, Outcomes]) -> list[Row]:
    return [*probability_rows("", [one for kind, one in done.items() if kind != "leafy"]),
            *probability_rows(LEAFY, [done["leafy"]])]


def _rows_of(setting: Setting, kinds: tuple[str, ...],
             rows: Callable[[dict[str, Outcomes]], list[Row]]) -> list[Row]:
    """The rows of cases of some kinds, as many as there is time for."""
    return rows(outcomes(setting, {
        kind: setting.at_most(_COUNTS[kind], max(_COUNTS[kind] // _QUICK, 2)) for kind in kinds}))


def _part(kind: str, rows: Callable[[Outcomes], list[Row]], gives: tuple[Asked, ...],
          seconds: float = 30.0) -> Part:
    """The part for one kind of case."""
    of_kind = partial(_rows_of, kinds=(kind,), rows=lambda done: rows(done[kind]))
    return Part(of_kind, seconds, gives, grows=True)


LEAFY = " of leafy plants"
PARTS = {
    "one-sided": _part("one-sided", partial(_view_rows, view=ONE_SIDED), ONE_SIDED.rows),
    "round": _part("round", partial(_view_rows, view=ROUND), ROUND.rows),
    **worlds.PARTS,
    "real": Part(real_rows, 60, (REAL_ROW,), grows=True),
    "gaps": _part("gaps", gap_rows, (GAP_ROW,)),
    "2-mm": _part("2-mm", partial(_noise_rows, kind="2 mm"), noise_asked("2 mm")),
    "3-mm": _part("3-mm", partial(_noise_rows, kind="3 mm"), noise_asked("3 mm")),
    "same-tree": Part(same_tree_rows, 60, (same_tree_asked("scans"),), grows=True),
    "root": Part(partial(_rows_of, kinds=("one-sided", "round"), rows=lambda done: _root_rows(
        list(done.values()))), 30, (ROOT_ROW,), grows=True),
    "leafy": _part("leafy", _leafy_rows, (LEAFY_ROW,), 60),
    "crowns": _part("crowns", _crown_rows, (CROWN_ROW,), 90),
    "probabilities": Part(partial(_rows_of, kinds=tuple(_COUNTS), rows=_probabilities), 30, (
        *probability_asked(""), *probability_asked(LEAFY)), grows=True),
    "single-view": _part("single-view", partial(_view_rows, view=SINGLE_VIEW), SINGLE_VIEW.rows)}
"""The table, in order of importance; ``--only`` also accepts one source of the worlds, and one scan
of the same tree's row.
"""
PARTS |= {f"same-tree:{name}": Part(
    partial(same_tree_rows, only=name), 60, (same_tree_asked(name),), grows=True, alone=True)
    for name in subjects()}
