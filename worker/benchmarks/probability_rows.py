"""Stated probabilities of forks, bridges and places against outcome, for the bench `scans`."""

from collections.abc import Sequence

import numpy as np

from benchmarks.scan_runs import Outcomes
from benchmarks.table import Asked, Row

_BINOMIAL = 1.96  # standard deviations of a share of few, that its row tells beside it
_ALLOWED = 0.08


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
    return Row(*asked, f"worst {100 * worst:.0f}; " + "; ".join(texts), good and bool(texts),
               cases)
