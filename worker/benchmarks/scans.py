"""Requirements on scans: `reconstruct` as a user calls it, on fresh seeds each run.

Sources that no constant was set on come first.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np

from benchmarks import peers, real_scans, sparse_scans
from benchmarks.part_training import scene
from benchmarks.scan_probabilities import skeletonised
from benchmarks.scan_scores import Outcomes, outcomes, seen_part
from benchmarks.table import Asked, Part, Row, Setting
from benchmarks.worlds.sources import BARE_VIEWS, LEFT_OUT, SOURCES, thinned_case
from limber.geometry.cloud.surroundings import find_supports
from limber.geometry.settings import OPEN

_COUNTS = {"one-sided": 60, "2-mm": 60, "3-mm": 60, "round": 60, "single-view": 20, "gaps": 60}
_QUICK = 15  # times as few
_BINOMIAL = 1.96  # standard deviations of a share of few, that its row tells beside it
_ALLOWED = 0.08
_NEAR = 0.03  # of a plant's size, within which an end is the root


# --- stated probabilities -----------------------------------------------------------------------

def probability_asked(name: str) -> tuple[Asked, ...]:
    """Requirements for stated probabilities; ``name`` identifies the cases."""
    return tuple(Asked(f"stated probability of {what}{name} against outcome, 10 bins",
                       f"within {100 * _ALLOWED:.0f} points (and the binomial error)")
                 for what in ("forks", "bridges", "nodes"))


def probability_rows(name: str, kinds: Sequence[Outcomes]) -> list[Row]:
    """Stated probabilities of forks, bridges and nodes against their actual frequency, in tenths.

    Nodes are counted by length; the number of their branches gives the certainty of their fraction.
    """
    nodes = sum((np.array(score["told_nodes"]) for one in kinds for score in one.scores),
                np.zeros((10, 4)))
    count = sum(len(one.scores) for one in kinds)
    tables = (_binned(kinds, "told_forks"), _binned(kinds, "told_bridges"), nodes)
    return [_probability_row(asked, bins, count) for asked, bins in zip(
        probability_asked(name), tables, strict=True)] if count else []


def _binned(kinds: Sequence[Outcomes], key: str) -> np.ndarray:
    """For each tenth: count, sum stated, sum correct, count, shape [10, 4]."""
    told = np.array([pair for one in kinds for score in one.scores for pair in score[key]],
                    float).reshape(-1, 2)
    place = np.minimum((10 * told[:, 0]).astype(int), 9)
    return np.stack([np.bincount(place, values, 10) for values in (
        np.ones(len(told)), told[:, 0], told[:, 1], np.ones(len(told)))], axis=1)


def _probability_row(asked: Asked, bins: np.ndarray, cases: int) -> Row:
    """For each tenth: count, sum stated, sum correct, number of independent ones."""
    texts, good, worst = [], True, 0.0
    for low, (count, stated, right, members) in enumerate(bins):
        if count == 0:
            continue
        said, was = stated / count, right / count
        slack = _BINOMIAL * np.sqrt(max(was * (1 - was), 0.25 / (members + 2)) / members)
        off = abs(said - was)
        worst = max(worst, off)
        good &= bool(off <= _ALLOWED + slack)
        texts.append(f"{low / 10:.1f}: said {100 * said:.0f}, were {100 * was:.0f} "
                     f"(+-{100 * slack:.0f}) of {members:.0f}")
    return Row(*asked, f"worst {100 * worst:.0f}; " + "; ".join(texts), good and bool(texts), cases)


# --- own generator ------------------------------------------------------------------------------

@dataclass(frozen=True)
class View:
    """Limits for scans of one view: fractions of forks found and false, centreline failures of 60,
    median radius error, worst volume error.
    """

    name: str
    limits: tuple[float, float, int, float, float]

    @property
    def rows(self) -> tuple[Asked, ...]:
        found, false, failures, radius, volume = self.limits
        return tuple(Asked(f"{self.name}: {what}", asked) for what, asked in (
            ("forks found / false", f"{found:.0%} / under {false:.0%}"),
            ("centreline failures", f"at most {failures} of 60"),
            ("radius, median error", f"{radius:.0%}"), ("mesh volume, worst", f"{volume:.0%}")))


ONE_SIDED = View("one-sided, noise 1 mm", (0.90, 0.08, 2, 0.12, 0.08))
ROUND = View("round", (0.97, 0.02, 0, 0.08, 0.05))
ROOT_ROW = Asked("worlds of 400 points and more, half turned any way: root right or asked; asked; "
                 "stated probability, Brier score", "39 of 40; at most 4; 0.05")
GAP_ROW = Asked("gaps of 20 to 80 mm, half at forks: main axis within a radius", "57 of 60")


def noise_asked(kind: str) -> tuple[Asked, ...]:
    """Requirements for one-sided scans with more noise."""
    name = f"one-sided, noise {kind}"
    return (Asked(f"{name}: radius bias", "under 8 %"),
            Asked(f"{name}: stated sigma covers the error", "88-99 %"))


def _view_rows(one: Outcomes, view: View) -> list[Row]:
    if not one.scores:
        return _nothing(view.rows, one)
    text, got, wrong = one.forks()
    error, volumes = one.column("radius_error"), np.abs(one.column("volume"))
    covered = one.column("covered").mean()
    found, false, failures, radius, volume = view.limits
    met = (bool(got >= found and wrong < false and not one.failed),
           one.centre_failures() <= failures * one.count / 60,
           bool(np.median(error) < radius), bool(volumes.max() < volume and not one.failed))
    measured = (
        text + one.told(),
        f"{one.centre_failures()} (mean {one.column('centre_radii').mean():.0%} of the radius, "
        f"worst {one.column('centre_radii').max():.0%})",
        f"median {np.median(error):.1%}, worst branch {error.max():.1%}, bias "
        f"{np.median(one.column('radius_bias')):+.1%}, sigma covers {covered:.0%}; the paper's "
        f"nearest-point radii differ by {np.median(one.column('paper')):.0%}",
        f"worst {volumes.max():.1%}, median {np.median(volumes):.1%}, "
        f"{int((volumes > 0.08).sum())} over 8 % (of what points show; of all wood worst "
        f"{np.abs((1 + one.column('volume')) * one.column('shown') - 1).max():.1%}; stated "
        f"intervals hold the volume of {int(one.column('volume_held').sum())}, the length of "
        f"{int(one.column('length_held').sum())}); {int(one.column('watertight').sum())} "
        f"watertight{one.told()}")
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
            bool(0.88 <= covered.mean() <= 0.99 and not one.failed), one.count)]


def _root_trial(task: tuple[str, int]) -> dict[str, Any]:
    """Whether the likeliest end of a thinned scan is the root, and its stated probability."""
    found, _, stated, _ = skeletonised(case := thinned_case(task[1]))
    truth = seen_part(case.truth, case.points)
    near = max(3 * truth.radius[0], _NEAR * float(np.linalg.norm(np.ptp(truth.nodes, axis=0))))
    return {"right": np.linalg.norm(found.nodes[0] - truth.nodes[0]) < near, "stated": stated}


def root_rows(setting: Setting) -> list[Row]:
    """Whether roots are right or asked for, and right as often as stated."""
    done = setting.trials("roots", [("root", seed) for seed in setting.seeds(40, 3)], _root_trial,
                          "geometry", workers=None, catch=Exception)
    one = Outcomes(done)
    right, stated = one.column("right"), one.column("stated")
    asked = stated < OPEN
    told, score = int((right + asked > 0).sum()), float(np.mean((stated - right)**2))
    return [Row(*ROOT_ROW, f"{told} of {one.count}; {asked.sum()}; {score:.3f}{one.told(2)}", bool(
        told >= 0.975 * one.count and asked.mean() <= 0.1 and score < 0.05), one.count)]


def gap_rows(gaps: Outcomes) -> list[Row]:
    """Whether the main axis continues across gaps."""
    if not gaps.scores:
        return _nothing((GAP_ROW,), gaps)
    off = gaps.column("main_axis_radii")
    held = int((off <= 1).sum())
    return [Row(*GAP_ROW, f"{held} of {gaps.count} (worst {off.max():.1f} radii); forks "
                f"{gaps.forks()[0]}{gaps.told()}", held >= 0.95 * gaps.count, gaps.count)]


def _nothing(rows: tuple[Asked, ...], one: Outcomes) -> list[Row]:
    """The rows of cases of which none was reconstructed; none if there was no case."""
    return [Row(*asked, f"none reconstructed: {'; '.join(one.failed[:3])}", False, one.count)
            for asked in rows] if one.count else []


def _part(kind: str, rows: Callable[[Outcomes], list[Row]], gives: tuple[Asked, ...]) -> Part:
    """The part for one kind of case, of as many as there is time for."""
    def of_kind(setting: Setting) -> list[Row]:
        count = setting.at_most(_COUNTS[kind], max(_COUNTS[kind] // _QUICK, 2))
        return rows(outcomes(setting, {kind: count})[kind])
    return Part(of_kind, 30, gives, grows=True)


# --- worlds -------------------------------------------------------------------------------------

_WORLD_COUNT, _WORLD_QUICK = 24, 1  # cases of a source and view
_DRESSED = 6  # cases of a source in leaf
# Forks found and false, twigs found and false, radius bias, worst volume.
_LIMITS = {"one-sided": (0.90, 0.08, 0.90, 0.05, 0.04, 0.10),
           "round": (0.96, 0.03, 0.95, 0.03, 0.02, 0.05)}
_HOLD = (0.88, 0.99)  # fraction of true values inside stated intervals

DROPPED = Asked("worlds, bare: points called leaf / dropped before; twigs lost so; refused",
                "under 1 % each; 0; 0")
LEAFY = Asked("worlds, leafy: wood's length found / right; leaf points called wood",
              "85 / 90 %; 5 %")
THINGS = Asked("worlds, half bare: pots, stakes and wires named / perhaps; plants' parts named so",
               "60 % together; 0")


def source_asked(source: str, view: str) -> Asked:
    """The measure and the limits of one source from one view."""
    forks, false, twigs, wrong, bias, volume = _LIMITS[view]
    told = "left out" if source in LEFT_OUT else "constants set on it"
    return Asked(f"worlds, {source} ({told}), {view}: forks found / false; twigs by length "
                 "found / false; radius bias; volume worst; intervals hold radius, length",
                 f"{forks:.0%} / {false:.0%}; {twigs:.0%} / {wrong:.0%}; {bias:.0%}; "
                 f"{volume:.0%}; 88-99 %")


def source_rows(source: str, view: str, one: Outcomes) -> list[Row]:
    """One source from one view."""
    if not one.count:
        return []
    asked = source_asked(source, view)
    if not one.scores:
        return [Row(*asked, f"none reconstructed: {'; '.join(one.failed[:2])}", False, one.count)]
    text, got, wrong = one.forks()
    total, found, false = (float(one.column(f"twig{key}_m").sum()) for key in (
        "", "_found", "_false"))
    twigs, untrue = found / max(total, 1e-9), false / max(total, 1e-9)
    bias = float(np.median(one.column("radius_bias")))
    volume = float(np.abs(one.column("volume")).max())
    radius, length = (float(one.column(key).mean()) for key in ("covered", "length_held"))
    limits = _LIMITS[view]
    met = (got >= limits[0] and wrong <= limits[1] and twigs >= limits[2] and untrue <= limits[3]
           and abs(bias) <= limits[4] and volume <= limits[5]
           and all(_HOLD[0] <= held for held in (radius, length)) and radius <= _HOLD[1])
    return [Row(*asked, f"{text}; {twigs:.0%} / {untrue:.0%} of {total:.1f} m; {bias:+.1%} (worst "
                f"{one.column('radius_bias')[np.abs(one.column('radius_bias')).argmax()]:+.1%}); "
                f"{volume:.1%}; {radius:.0%}, {length:.0%}{one.told(2)}",
                bool(met and not one.failed), one.count)]


def dropped_rows(bare: list[Outcomes]) -> list[Row]:
    """Points of bare plants that were not used as wood."""
    one = _together(bare)
    if not one.count:
        return []
    leaf, gone = (one.column(key) if one.scores else np.zeros(1) for key in ("called_leaf", "gone"))
    lost = int(one.column("twigs_lost").sum()) if one.scores else 0
    return [Row(*DROPPED, f"mean {leaf.mean():.1%}, worst {leaf.max():.0%} / mean {gone.mean():.1%}"
                f", worst {gone.max():.0%}; {lost}; {len(one.failed)}{one.told(2)}",
                bool(leaf.max() < 0.01 and gone.max() < 0.01 and not lost and not one.failed),
                one.count)]


def leafy_rows(leafy: list[Outcomes]) -> list[Row]:
    """Plants in leaf whose user asked to cut the leaves."""
    one = _together(leafy)
    if not one.scores:
        return [Row(*LEAFY, f"none reconstructed{one.told(2)}", False, one.count)] if (
            one.count) else []
    recall, right, taken = (one.column(key) for key in ("recall", "right", "leaf_points_on_stems"))
    return [Row(*LEAFY, f"{recall.mean():.0%} (worst {recall.min():.0%}) / {right.mean():.0%} "
                f"(worst {right.min():.0%}); {taken.mean():.0%} (worst {taken.max():.0%})"
                f"{one.told(2)}",
                bool(recall.mean() >= 0.85 and right.mean() >= 0.9 and taken.mean() <= 0.05),
                one.count)]


def _things_trial(task: tuple[str, int]) -> dict[str, int]:
    """Things in a scene, and how many of them and of plants' parts are named."""
    scan = scene(task[1], list(SOURCES)[task[1] % len(SOURCES)]).without("sheet", "ground")
    found = find_supports(scan.points, np.array([0.0, 0.0, 1.0])) if len(scan.points) else ()
    parts = [(part.probability >= OPEN, scan.overlap(part) > 0.5) for part in found]
    named, perhaps, false = map(parts.count, ((True, True), (False, True), (True, False)))
    there = len(np.unique(scan.thing[scan.thing > 0]))
    return {"there": there, "named": named, "perhaps": perhaps, "false": false}


def things_rows(setting: Setting) -> list[Row]:
    """Whether pots, stakes and wires are named, and no part of a plant."""
    one = Outcomes(setting.trials("things", [("things", seed) for seed in setting.seeds(
        100, 10)], _things_trial, "geometry", workers=None, catch=Exception))
    there, named, perhaps, false = (int(one.column(key).sum()) for key in (
        "there", "named", "perhaps", "false"))
    return [Row(*THINGS, f"{named} / {perhaps} of {there}; {false}{one.told(2)}", bool(
        named + perhaps >= 0.6 * there and not false), one.count)]


def world_rows(setting: Setting) -> list[Row]:
    """All rows of generated worlds."""
    count = setting.at_most(_WORLD_COUNT, _WORLD_QUICK)
    dressed = {f"{name}:leafy": setting.at_most(_DRESSED, _WORLD_QUICK) for name in SOURCES}
    done = outcomes(setting, {f"{name}:{view}": count for view in BARE_VIEWS for name in SOURCES}
                    | dressed)
    rows = [row for view in BARE_VIEWS for name in SOURCES
            for row in source_rows(name, view, done[f"{name}:{view}"])]
    rows += probability_rows(", worlds", [done[f"{name}:{view}"] for name in SOURCES
                                          for view in BARE_VIEWS])
    dress = {key: [done[f"{name}:{key}"] for name in SOURCES]
             for key in (*BARE_VIEWS, "leafy")}
    return [*rows, *dropped_rows(dress["one-sided"] + dress["round"]), *leafy_rows(dress["leafy"])]


def _together(several: list[Outcomes]) -> Outcomes:
    return Outcomes([trial for one in several for trial in one.trials])


WORLDS = {
    "worlds": Part(world_rows, 120, (*(source_asked(source, view) for view in BARE_VIEWS
                                       for source in SOURCES), *probability_asked(
                                           ", worlds"), DROPPED, LEAFY),
                   grows=True),
    "things": Part(things_rows, 30, (THINGS,), grows=True),
    "worlds-real": Part(real_scans.length_rows, 90, (real_scans.REAL, real_scans.BARE,
                                                     real_scans.WORSE), grows=True)}
SPARSE = {
    "sparse": Part(sparse_scans.sparse_rows, 60, sparse_scans.SPARSE, grows=True),
    "sparse-real": Part(sparse_scans.real_rows, 60, sparse_scans.REAL, grows=True),
    "perturbations": Part(sparse_scans.perturbation_rows, 90, (sparse_scans.PERTURBATIONS,),
                          grows=True),
    "peers": Part(peers.rows, 60, peers.PEERS, grows=True, alone=True)}
PARTS = {
    **SPARSE,
    **WORLDS,
    "one-sided": _part("one-sided", partial(_view_rows, view=ONE_SIDED), ONE_SIDED.rows),
    "round": _part("round", partial(_view_rows, view=ROUND), ROUND.rows),
    "real": Part(real_scans.real_rows, 60, (real_scans.REAL_ROW, real_scans.SURFACES,
                                            real_scans.QSM), grows=True),
    "gaps": _part("gaps", gap_rows, (GAP_ROW,)),
    "2-mm": _part("2-mm", partial(_noise_rows, kind="2 mm"), noise_asked("2 mm")),
    "3-mm": _part("3-mm", partial(_noise_rows, kind="3 mm"), noise_asked("3 mm")),
    "same-tree": Part(real_scans.same_tree_rows, 60, (real_scans.SAME_TREE,),
                      grows=True),
    "root": Part(root_rows, 30, (ROOT_ROW,), grows=True)}
"""The table, in order of importance."""
