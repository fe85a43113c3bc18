"""What the issue on real scans asked: `reconstruct` as a user calls it, on fresh seeds each run.

With ``--out`` every case is kept as it is done, and drawn: the same ``--seed`` goes on with them,
and ``--only`` takes the table's parts one after another.
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.scan_files import SCANS, metamorphic_rows, real_rows
from benchmarks.scan_runs import Outcomes, measure
from benchmarks.table import Row
from limber.progress import Progress

_COUNTS = {"one-sided": 60, "2-mm": 60, "3-mm": 60, "round": 60, "single-view": 20, "gaps": 60,
           "crowns": 12, "leafy": 8}
_QUICK = 15  # times as few
_BINOMIAL = 1.96  # standard deviations of a share of few, that its row tells beside it


def rows(quick: bool, progress: Progress, out: Path | None, seed: int,
         only: tuple[str, ...] = ()) -> list[Row]:
    """Measure the parts named in ``only``, or all; pictures and what is kept go to ``out``."""
    first, chosen = 1000 * seed, only or WHOLE
    # What several parts tell of is measured once.
    needed = [kind for kind in _COUNTS if any(kind in NEEDED.get(name, ()) for name in chosen)]
    done = measure({kind: range(first, first + (
        max(_COUNTS[kind] // _QUICK, 2) if quick else _COUNTS[kind])) for kind in needed},
        progress.part(0.0, 0.7), out)
    table = []
    for number, name in enumerate(chosen):
        if name in TOLD:
            table += TOLD[name](done)
            continue
        part = progress.part(*(0.7 + 0.3 * k / len(chosen) for k in (number, number + 1)))
        if name == "real":
            table += real_rows(quick, first, part, out)
        else:
            table += metamorphic_rows(quick, first, part, out, PARTS[name])
    return table


def _view_rows(name: str, one: Outcomes, found: float | None, false: float | None,
               failures: int | None, radius: float | None, volume: float | None) -> list[Row]:
    asked = found is not None
    if not one.scores:
        return [_nothing(name, one)]
    text, got, wrong = one.forks()
    error, volumes = one.column("radius_error"), np.abs(one.column("volume"))
    covered = one.column("covered").mean()
    return [
        Row(f"{one.count} {name}: forks found / false",
            f"{found:.0%} / under {false:.0%}" if asked else "report", text + one.told(),
            bool(got >= found and wrong < false and not one.failed) if asked else None),
        Row(f"{one.count} {name}: centreline failures",
            f"at most {failures} of 60" if asked else "report",
            f"{one.centre_failures()} (mean {one.column('centre_radii').mean():.0%} of the radius, "
            f"worst {one.column('centre_radii').max():.0%})",
            one.centre_failures() <= failures * one.count / 60 if asked else None),
        Row(f"{one.count} {name}: radius, median error", f"{radius:.0%}" if asked else "report",
            f"median {np.median(error):.1%}, worst branch {error.max():.1%}, bias "
            f"{np.median(one.column('radius_bias')):+.1%}, sigma covers {covered:.0%}",
            bool(np.median(error) < radius) if asked else None),
        Row(f"{one.count} {name}: mesh volume, worst", f"{volume:.0%}" if asked else "report",
            f"worst {volumes.max():.1%}, median {np.median(volumes):.1%}, "
            f"{int((volumes > 0.08).sum())} over 8 % (of what points show; of all wood worst "
            f"{np.abs((1 + one.column('volume')) * one.column('shown') - 1).max():.1%}; stated "
            f"intervals hold the volume of {int(one.column('volume_held').sum())}, the length of "
            f"{int(one.column('length_held').sum())}){one.told()}",
            bool(volumes.max() < volume and not one.failed) if asked else None)]


def _noise_rows(kind: str, one: Outcomes) -> list[Row]:
    name = f"one-sided, noise {kind}"
    if not one.scores:
        return [_nothing(name, one)]
    biases, covered = one.column("radius_bias"), one.column("covered")
    bias = float(np.median(biases))
    return [
        Row(f"{one.count} {name}: radius bias", "under 8 %",
            f"{bias:+.1%} (worst branch {biases[np.abs(biases).argmax()]:+.1%}; "
            f"{int((np.abs(biases) > 0.08).sum())} over 8 %){one.told()}",
            bool(abs(bias) < 0.08 and not one.failed)),
        Row(f"{one.count} {name}: stated sigma covers the error", "88-99 %",
            f"{covered.mean():.0%} (worst branch {covered.min():.0%}){one.told()}",
            bool(0.88 <= covered.mean() <= 0.99 and not one.failed)),
        Row(f"{one.count} {name}: forks; centreline failures", "report",
            f"{one.forks()[0]}; {one.centre_failures()}", None)]


def _root_row(views: list[Outcomes]) -> Row:
    rooted = np.concatenate([view.column("root_diameters") for view in views])
    total = sum(view.count for view in views)
    held = int((rooted <= 1).sum())
    return Row(f"{total} round and one-sided: root within one diameter", "118 of 120",
               f"{held} of {total} (worst {rooted.max(initial=0):.1f} diameters)",
               held >= total * 118 / 120)


def _gap_row(gaps: Outcomes) -> Row:
    if not gaps.scores:
        return _nothing("gaps", gaps)
    off = gaps.column("main_axis_radii")
    held = int((off <= 1).sum())
    return Row(f"{gaps.count} gaps of 20 to 80 mm, half at forks: main axis within a radius",
               "57 of 60", f"{held} of {gaps.count} (worst {off.max():.1f} radii); forks "
               f"{gaps.forks()[0]}{gaps.told()}", held >= 0.95 * gaps.count)


def probability_rows(name: str, kinds: list[Outcomes]) -> list[Row]:
    """Stated probabilities of forks and of nodes against how often they are there, in tenths.

    Nodes are counted by length; how many branches they lie on says how sure their share is.
    """
    forks = np.array([told for one in kinds for score in one.scores
                      for told in score["told_forks"]], float).reshape(-1, 2)
    place = np.minimum((10 * forks[:, 0]).astype(int), 9)
    counted = np.stack([np.bincount(place, values, 10) for values in (
        np.ones(len(forks)), forks[:, 0], forks[:, 1], np.ones(len(forks)))], axis=1)
    nodes = sum((np.array(score["told_nodes"]) for one in kinds for score in one.scores),
                np.zeros((10, 4)))
    return [_probability_row(f"forks{name}", counted), _probability_row(f"nodes{name}", nodes)]


def _probability_row(name: str, bins: np.ndarray) -> Row:
    """Of each tenth: count, sum stated, sum right, number of independent ones."""
    texts, good, worst = [], True, 0.0
    for low, (count, stated, right, members) in enumerate(bins):
        if count == 0:
            continue
        said, was = stated / count, right / count
        slack = _BINOMIAL * np.sqrt(max(was * (1 - was), 0.25 / (members + 2)) / members)
        off = abs(said - was)
        worst = max(worst, off)
        good &= bool(off <= 0.10 + slack)
        texts.append(f"{low / 10:.1f}: said {100 * said:.0f}, were {100 * was:.0f} "
                     f"(+-{100 * slack:.0f}) of {members:.0f}")
    return Row(f"stated probability of {name} against outcome, 10 bins",
               "within 10 points (and the binomial error)",
               f"worst {100 * worst:.0f}; " + "; ".join(texts), good and bool(texts))


def _crown_row(crowns: Outcomes) -> Row:
    if not crowns.scores:
        return _nothing("generated crowns", crowns)
    bias = crowns.column("resolved_bias")
    recall, right = (float(crowns.column(key).mean()) for key in ("recall", "right"))
    unsaid = float(crowns.column("unsaid_m").sum())
    return Row(f"{crowns.count} generated crowns, twigs to 1.5 mm, 1 to 5 spacings: radius bias "
               "where resolved; length recalled / right; left out unsaid", "10 %; 90 / 95 %; 0",
               f"{np.median(bias):+.1%} (worst {np.abs(bias).max():.1%}); {recall:.0%} (worst "
               f"{crowns.column('recall').min():.0%}) / {right:.0%} (worst "
               f"{crowns.column('right').min():.0%}); {1000 * unsaid:.0f} mm; sigma covers "
               f"{crowns.column('covered').mean():.0%}; forks {crowns.forks()[0]}{crowns.told()}",
               bool(np.abs(bias).max() < 0.10 and recall >= 0.90 and right >= 0.95
                    and unsaid == 0 and not crowns.failed))


def _leafy_row(leafy: Outcomes) -> Row:
    name = f"{leafy.count} leafy plants: stems recalled / right; leaf points on stems"
    asked = "90 / 90 %; under 5 % (or refused)"
    refused = f"{len(leafy.failed)} of {leafy.count} refused"
    if not leafy.scores:
        return Row(name, asked, refused, True)
    recall, right, taken = (float(leafy.column(key).mean()) for key in (
        "recall", "right", "leaf_points_on_stems"))
    return Row(name, asked, f"{recall:.0%} / {right:.0%}; {taken:.0%}; {refused}",
               recall >= 0.9 and right >= 0.9 and taken < 0.05)


def _nothing(name: str, one: Outcomes) -> Row:
    return Row(f"{one.count} {name}", "-", f"none reconstructed: {'; '.join(one.failed[:3])}",
               False)


def _kind_rows(done: dict[str, Outcomes], kind: str,
               told: Callable[[Outcomes], list[Row]]) -> list[Row]:
    return told(done[kind])


def _of(kind: str, told: Callable[[Outcomes], list[Row]]) -> Callable[[dict], list[Row]]:
    return partial(_kind_rows, kind=kind, told=told)


TOLD: dict[str, Callable[[dict[str, Outcomes]], list[Row]]] = {
    "one-sided": _of("one-sided", lambda one: _view_rows(
        "one-sided, noise 1 mm", one, 0.90, 0.08, 2, 0.12, 0.08)),
    "2-mm": _of("2-mm", lambda one: _noise_rows("2 mm", one)),
    "3-mm": _of("3-mm", lambda one: _noise_rows("3 mm", one)),
    "round": _of("round", lambda one: _view_rows("round", one, 0.97, 0.02, 0, 0.08, 0.05)),
    "single-view": _of("single-view", lambda one: _view_rows(
        "single-view", one, None, None, None, None, None)),
    "root": lambda done: [_root_row([done["one-sided"], done["round"]])],
    "gaps": _of("gaps", lambda one: [_gap_row(one)]),
    "crowns": _of("crowns", lambda one: [_crown_row(one)]),
    "leafy": _of("leafy", lambda one: [_leafy_row(one)]),
    "probabilities": lambda done: [
        *probability_rows("", [one for kind, one in done.items() if kind != "leafy"]),
        *probability_rows(" of leafy plants", [done["leafy"]])]}
"""Rows of generated cases, by part."""
NEEDED = {kind: (kind,) for kind in _COUNTS} | {
    "root": ("one-sided", "round"), "probabilities": tuple(_COUNTS)}
"""Kinds of cases that each part tells of."""
WHOLE = (*TOLD, "same-tree", "real")
"""The table's parts, in its order."""
PARTS: dict[str, str | None] = dict.fromkeys(WHOLE) | {
    f"same-tree:{Path(name).stem}": Path(name).stem for name in SCANS}
"""What ``--only`` knows: those, and one scan of the same tree's row."""
