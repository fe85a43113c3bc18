"""Rows of the worlds in the bench `scans`: each source by itself, bare, in leaf and potted."""

from functools import partial

import numpy as np

from benchmarks.probability_rows import probability_asked, probability_rows
from benchmarks.scan_runs import Outcomes, outcomes
from benchmarks.table import Asked, Part, Row, Setting
from benchmarks.worlds.real_scans import BARE as REAL_BARE
from benchmarks.worlds.real_scans import REAL, WORSE, real_scan_rows
from benchmarks.worlds.sources import BARE_VIEWS, LEFT_OUT, SOURCES

_COUNT, _QUICK = 24, 1  # cases of a source and view
_DRESSED = 6  # cases of a source in leaf, and potted
# Forks found and false, twigs found and false, radius bias, worst volume.
_LIMITS = {"one-sided": (0.90, 0.08, 0.90, 0.05, 0.04, 0.10),
           "round": (0.96, 0.03, 0.95, 0.03, 0.02, 0.05)}
_HOLD = (0.88, 0.99)  # fraction of true values inside stated intervals
_SUPPORTS = ("pot", "stake", "post", "wire", "plants")  # words of a refusal that names them

DROPPED = Asked("worlds, bare: points called leaf / dropped before; twigs lost so; refused",
                "under 1 % each; 0; 0")
LEAFY = Asked("worlds, leafy: wood's length found / right; leaf points called wood",
              "85 / 90 %; 5 %")
POTTED = Asked("worlds, potted with stake and wire: named in a refusal, or wood found / right",
               "all named, or 90 / 95 %")


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
                f"{volume:.1%}; {radius:.0%}, {length:.0%}{_failures(one)}",
                bool(met and not one.failed), one.count)]


def dropped_rows(bare: list[Outcomes]) -> list[Row]:
    """Points of bare plants that were not used as wood."""
    one = _together(bare)
    if not one.count:
        return []
    leaf, gone = (one.column(key) if one.scores else np.zeros(1) for key in (
        "called_leaf", "gone"))
    lost = int(one.column("twigs_lost").sum()) if one.scores else 0
    return [Row(*DROPPED, f"mean {leaf.mean():.1%}, worst {leaf.max():.0%} / mean {gone.mean():.1%}"
                f", worst {gone.max():.0%}; {lost}; {len(one.failed)}{_failures(one)}",
                bool(leaf.max() < 0.01 and gone.max() < 0.01 and not lost and not one.failed),
                one.count)]


def leafy_rows(leafy: list[Outcomes]) -> list[Row]:
    """Plants in leaf whose user asked to cut the leaves."""
    one = _together(leafy)
    if not one.scores:
        return [Row(*LEAFY, f"none reconstructed{_failures(one)}", False, one.count)] if (
            one.count) else []
    recall, right, taken = (one.column(key) for key in ("recall", "right", "leaf_points_on_stems"))
    return [Row(*LEAFY, f"{recall.mean():.0%} (worst {recall.min():.0%}) / {right.mean():.0%} "
                f"(worst {right.min():.0%}); {taken.mean():.0%} (worst {taken.max():.0%})"
                f"{_failures(one)}",
                bool(recall.mean() >= 0.85 and right.mean() >= 0.9 and taken.mean() <= 0.05),
                one.count)]


def potted_rows(potted: list[Outcomes]) -> list[Row]:
    """Potted plants: refused by name, or right."""
    one = _together(potted)
    if not one.count:
        return []
    named = sum(any(word in text for word in _SUPPORTS) for text in one.failed)
    recall, right = (float(one.column(key).mean()) if one.scores else 1.0 for key in (
        "recall", "right"))
    return [Row(*POTTED, f"{named} of {len(one.failed)} refusals name them; of {len(one.scores)} "
                f"others {recall:.0%} / {right:.0%}",
                bool(named == len(one.failed) and recall >= 0.9 and right >= 0.95), one.count)]


def world_rows(setting: Setting, source: str | None = None) -> list[Row]:
    """All rows of generated worlds; of one ``source`` its own."""
    chosen = [source] if source else list(SOURCES)
    count = setting.at_most(_COUNT, _QUICK)
    dressed = {} if source else {
        f"{name}:{dress}": setting.at_most(_DRESSED, _QUICK)
        for dress in ("leafy", "potted") for name in chosen}
    done = outcomes(setting, {f"{name}:{view}": count for view in BARE_VIEWS for name in chosen}
                    | dressed)
    rows = [row for view in BARE_VIEWS for name in chosen
            for row in source_rows(name, view, done[f"{name}:{view}"])]
    rows += probability_rows(_of_worlds(source), [done[f"{name}:{view}"] for name in chosen
                                                  for view in BARE_VIEWS])
    if source:
        return rows
    dress = {key: [done[f"{name}:{key}"] for name in chosen]
             for key in (*BARE_VIEWS, "leafy", "potted")}
    return [*rows, *dropped_rows(dress["one-sided"] + dress["round"]), *leafy_rows(dress["leafy"]),
            *potted_rows(dress["potted"])]


def _of_worlds(source: str | None) -> str:
    return f", worlds, {source}" if source else ", worlds"


def _together(several: list[Outcomes]) -> Outcomes:
    return Outcomes([score for one in several for score in one.scores],
                    [text for one in several for text in one.failed])


def _failures(one: Outcomes) -> str:
    """The number of failed cases, and the first reasons."""
    return f"; {len(one.failed)} not reconstructed: {'; '.join(one.failed[:2])}" if (
        one.failed) else ""


PARTS = {
    "worlds": Part(world_rows, 120, (*(source_asked(source, view) for view in BARE_VIEWS
                                       for source in SOURCES), *probability_asked(
                                           _of_worlds(None)), DROPPED, LEAFY, POTTED),
                   grows=True),
    "worlds-real": Part(real_scan_rows, 90, (REAL, REAL_BARE, WORSE), grows=True)}
"""Parts of the bench `scans`; ``--only`` also accepts one source."""
PARTS |= {f"worlds:{source}": Part(
    partial(world_rows, source=source), 60, (
        *(source_asked(source, view) for view in BARE_VIEWS),
        *probability_asked(_of_worlds(source))), grows=True, alone=True)
    for source in SOURCES}
