"""Length and volume of all wood, as far as a scan determines them: expectation and uncertainty.

An uncertain twig counts by its probability, whether the skeleton has it or dropped it as unlikely;
so does the other place of a piece that may be attached there.
So two scans of one plant agree, even if one shows a twig a little better. The odds of all twigs of
a scan are off together, since scans differ. What a scan does not show at all is not counted.
Of a thin scan the likeliest tree counts as a whole, and its length is off as such trees' are.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.geometry.skeleton.alternatives import SearchDoubts, attachments
from limber.geometry.skeleton.confidence import probability_given_carrier
from limber.geometry.skeleton.qsm_tables import cylinders
from limber.geometry.skeleton.skeleton import BRIDGED, Skeleton

_TOGETHER = 10.0  # length, in median radii of a run, over which radius errors are correlated
_COMMON = 0.1  # fraction of the volume: its most certain radii show the common error
_BRIDGED = 0.1  # fraction of its length to which the path through a gap is known
# Standard deviation between sources of the logarithm of all their twigs' odds, fitted to the
# outcomes of benchmarks.scan_probabilities: 0 makes these, of seven sources, 440 times less likely.
_APART = 0.9
_SURE = 1.96  # standard deviations to each side of an interval that covers 95 %
_NOTHING_OPEN = SearchDoubts()


@dataclass(frozen=True)
class Total:
    """Mean and standard deviation of a sum over all wood [m or m^3]."""

    expected: float
    sigma: float

    @property
    def interval(self) -> list[float]:
        """The 95 % interval of a positive quantity, whose logarithm is off to both sides alike."""
        factor = float(np.exp(_SURE * np.sqrt(np.log1p((self.sigma / self.expected)**2))))
        return [self.expected / factor, self.expected * factor]


def total_length(skeleton: Skeleton, doubts: SearchDoubts = _NOTHING_OPEN) -> Total:
    """Return the length of all axes [m], by the nodes' probabilities. ``doubts`` are twigs no
    longer in the skeleton, and pieces that may be attached elsewhere."""
    runs = skeleton.runs()
    own, spread = np.empty(len(runs)), np.empty(len(runs))
    for run, members in enumerate(runs):
        step = np.linalg.norm(np.diff(skeleton.nodes[members], axis=0), axis=1)
        own[run] = step.sum()
        # A round end hides where its axis ends; a fork hides where in its carrier the axis began.
        gap = float(step[skeleton.radius_state[members[1:]] == BRIDGED].sum())
        spread[run] = np.linalg.norm([skeleton.radius[members[-1]], skeleton.radius[members[0]],
                                      _BRIDGED * gap])
    if doubts.length_spread is not None:  # of the likeliest tree as a whole
        return Total(skeleton.length, float(np.hypot(
            np.linalg.norm(spread), doubts.length_spread * skeleton.length)))
    mean, variance = _of_tree(skeleton, own, spread**2)
    elsewhere = attachments(skeleton, doubts.bridges)
    chance = np.array([*(twig["probability"] for twig in doubts.unlikely),
                       *(1 - one.probability for one in elsewhere)])
    length = np.array([*(twig["length"] for twig in doubts.unlikely),
                       *(one.longer for one in elsewhere)])
    high, low = (_of_tree(skeleton, own, spread**2, odds)[0] + float(_moved(chance, odds) @ length)
                 for odds in (_APART, -_APART))
    return Total(mean + float(chance @ length), float(np.sqrt(
        variance + (chance * (1 - chance)) @ length**2 + ((high - low) / 2)**2)))


def total_volume(skeleton: Skeleton) -> Total:
    """Return the volume [m^3] of all cylinders without the parts of twigs inside their parents, by
    the deviations of radii and the probabilities of nodes."""
    step, volume = cylinders(skeleton)
    runs = skeleton.runs()
    relative = skeleton.radius_sigma[1:] / np.maximum(skeleton.radius[1:], 1e-300)
    common = _share_of_all(relative, volume)
    alone = np.sqrt(np.maximum(relative**2 - common**2, 0.0))
    own, square = np.empty(len(runs)), np.empty(len(runs))
    for run, members in enumerate(runs):
        cylinder = members[1:] - 1
        hidden = _hidden_share(skeleton, members, step[cylinder]) if run else 0.0
        part = volume[cylinder] * (1 - hidden)
        own[run] = part.sum()
        block = np.cumsum(step[cylinder]) // max(
            _TOGETHER * float(np.median(skeleton.radius[members[1:]])), 1e-300)
        _, which = np.unique(block, return_inverse=True)
        square[run] = (np.bincount(which, 2 * part * alone[cylinder])**2).sum()
    mean, variance = _of_tree(skeleton, own, square)
    high, low = (_of_tree(skeleton, own, square, odds)[0] for odds in (_APART, -_APART))
    return Total(mean, float(np.linalg.norm([np.sqrt(variance), 2 * common * mean,
                                             (high - low) / 2])))


def totals(skeleton: Skeleton, doubts: SearchDoubts = _NOTHING_OPEN) -> dict[str, Any]:
    """Return both as numbers of a stage's result, with intervals that cover 95 %.
    ``volume_interval_m3`` is None where no radius has a deviation."""
    length, volume = total_length(skeleton, doubts), total_volume(skeleton)
    known = bool(skeleton.radius_sigma.any())
    return {"expected_length_m": length.expected, "length_interval_m": length.interval,
            "expected_volume_m3": volume.expected,
            "volume_interval_m3": volume.interval if known else None}


def _of_tree(skeleton: Skeleton, own: np.ndarray, variance: np.ndarray, odds: float = 0.0,
             ) -> tuple[float, float]:
    """Mean and variance of a sum of runs' ``own`` values [runs], of given ``variance``. ``odds`` is
    added to the logarithm of all odds."""
    chance = _moved(probability_given_carrier(skeleton), odds)
    mean, spread = own.astype(float), variance.astype(float)
    # A run carried by another one has a higher number.
    runs = skeleton.runs()
    for run in range(len(runs) - 1, 0, -1):
        carrier = int(skeleton.branch[runs[run][0]])
        mean[carrier] += chance[run] * mean[run]
        spread[carrier] += chance[run] * (spread[run] + (1 - chance[run]) * mean[run]**2)
    return float(mean[0]), float(spread[0])


def _moved(chance: np.ndarray, odds: float) -> np.ndarray:
    """Probabilities after ``odds`` is added to the logarithm of their odds, shape [k]."""
    return chance / (chance + (1 - chance) * np.exp(-odds))


def _share_of_all(relative: np.ndarray, volume: np.ndarray) -> float:
    """Relative deviation that all radii share: at most that of the most certain one."""
    order = np.argsort(relative)
    total = np.cumsum(volume[order])
    return float(relative[order[int(np.searchsorted(total, _COMMON * total[-1]))]])


def _hidden_share(skeleton: Skeleton, members: np.ndarray, step: np.ndarray) -> np.ndarray:
    """Fraction of each of a side run's cylinders that is inside its carrier, shape [k]."""
    end = np.cumsum(step)
    inside = float(skeleton.radius[members[0]]) - (end - step)
    return np.clip(inside / np.maximum(step, 1e-300), 0.0, 1.0)
