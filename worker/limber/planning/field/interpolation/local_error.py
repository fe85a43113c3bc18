"""Error bound of a field, as a function of the position.

Each sample was left out of the fit once; the error there of the fit to the others is known. At
any other position it is taken from the nearest samples: a mean of their squares, with weights that
fall with the distance in the chart. The accuracy of this prediction is known as well, from
each sample and the others: the mean is multiplied by the factor that covers the requested fraction
of them (split conformal prediction: Vovk et al. 2005; with a local scale: Lei et al. 2018). States
of the full model along plans join the samples, and with them these errors.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from limber.core.numerics.compiled import compiled

_LEAST = 0.2  # fraction of the median error that is stated even where the nearest samples are exact
_FEWEST = 8  # fewest samples with a known error


@dataclass(frozen=True)
class LocalError:
    """An error bound by position.

    Attributes:
        points: Positions of samples, in coordinates of the chart, shape [m, 3].
        squares: Squares of their errors, floor included, shape [m].
        near: Square of the distance within which weights hardly differ [m^2].
        factor: Covers the requested fraction of samples; infinite if nothing is known.
        most: Largest error that is stated.
    """

    points: np.ndarray
    squares: np.ndarray
    near: float
    factor: float
    most: float = np.inf

    @classmethod
    def of(cls, points: np.ndarray, above: np.ndarray, covered: float, most: float = np.inf,
           ) -> "LocalError":
        """Return the bound on the field's overestimate for a fraction ``covered`` of samples.

        Args:
            points: Positions of samples, in coordinates in which the field is smooth, shape [m, 3].
            above: Overestimate of the fit without the sample there, below 0 for an underestimate,
                nan if not known, shape [m].
            covered: 1: all of them.
            most: Largest error that is stated.
        """
        known = np.isfinite(above)
        points, above = np.ascontiguousarray(points[known], float), above[known]
        sizes = np.abs(above)
        if len(sizes) < _FEWEST:
            return cls(points, sizes**2, 1.0, np.inf, most)
        floor = _LEAST * float(np.median(sizes))
        squares = sizes**2 + floor**2
        near = max(_spacing(points)**2, 1e-18)
        predicted = np.sqrt(_means(points, points, squares, near, True))
        shares = np.sort(np.maximum(above, 0.0) / np.maximum(predicted, 1e-300))
        # One more than there are: the queried position counts as one more sample.
        rank = min(int(np.ceil(covered * (len(shares) + 1))), len(shares)) - 1
        return cls(points, squares, near, float(shares[rank]), most)

    def at(self, points: np.ndarray) -> np.ndarray:
        """Return the error at ``points`` [n, 3] of the chart, shape [n]."""
        if not np.isfinite(self.factor):
            return np.full(len(points), self.most)
        points = np.ascontiguousarray(points, float)
        means = _means(points, self.points, self.squares, self.near, False)
        return np.minimum(self.factor * np.sqrt(means), self.most)


class Slack(NamedTuple):
    """Tightening of limits by position, for compiled loops; see :func:`slack_at`. Below 0: they are
    extended.

    Attributes:
        points: Positions of samples in the plain chart, shape [m, 3].
        squares: Squares of their errors, one row per limit, shape [limits, m].
        factors, most: As in :class:`LocalError`, shape [limits]; a factor of 0: no tighter.
        near: As in :class:`LocalError`.
    """

    points: np.ndarray
    squares: np.ndarray
    factors: np.ndarray
    most: np.ndarray
    near: float


def slack_of(names: Sequence[str], errors: Mapping[str, LocalError], share: float) -> Slack:
    """Return a ``share`` of ``errors``, -1 to 1, as slack of the limits ``names``; none for the
    others.
    """
    known = {name: error for name, error in errors.items() if np.isfinite(error.factor)}
    first = next(iter(known.values()), None)
    points = np.empty((0, 3)) if first is None else first.points
    squares = np.zeros((len(names), len(points)))
    factors, most = np.zeros(len(names)), np.zeros(len(names))
    for row, name in enumerate(names):
        if name in errors:
            factors[row], most[row] = np.inf, share * errors[name].most
        if name in known and len(known[name].points) == len(points):
            squares[row], factors[row] = known[name].squares, share * known[name].factor
    return Slack(np.ascontiguousarray(points), squares, factors, most,
                 1.0 if first is None else first.near)


@compiled
def slack_at(point: np.ndarray, row: int, slack: Slack) -> float:
    """Return the tightening of the limit of a ``row`` at ``point`` [3] of the chart."""
    factor = slack.factors[row]
    if factor == 0.0 or factor == np.inf:
        return slack.most[row] if factor == np.inf else 0.0
    total, weights = 0.0, 0.0
    for i in range(len(slack.points)):
        distance = slack.near
        for k in range(3):
            distance += (point[k] - slack.points[i, k]) ** 2
        weight = 1.0 / (distance * distance * distance)
        total += weight * slack.squares[row, i]
        weights += weight
    tighter = factor * np.sqrt(total / weights)
    return min(tighter, slack.most[row]) if factor > 0.0 else max(tighter, slack.most[row])


@compiled
def slacks_at(points: np.ndarray, row: int, slack: Slack) -> np.ndarray:
    """Return the same at ``points`` [n, 3], shape [n]."""
    out = np.empty(len(points))
    for n in range(len(points)):
        out[n] = slack_at(points[n], row, slack)
    return out


@compiled
def slack_slopes(points: np.ndarray, row: int, slack: Slack) -> np.ndarray:
    """Return its gradients at ``points`` [n, 3] of the chart, shape [n, 3]."""
    out = np.zeros((len(points), 3))
    factor = slack.factors[row]
    if factor == 0.0 or factor == np.inf:
        return out
    along, of_weights = np.empty(3), np.empty(3)
    for n in range(len(points)):
        total, weights = 0.0, 0.0
        along[:], of_weights[:] = 0.0, 0.0
        for i in range(len(slack.points)):
            distance = slack.near
            for k in range(3):
                distance += (points[n, k] - slack.points[i, k]) ** 2
            weight = 1.0 / (distance * distance * distance)
            total += weight * slack.squares[row, i]
            weights += weight
            for k in range(3):
                change = -6.0 * weight / distance * (points[n, k] - slack.points[i, k])
                along[k] += change * slack.squares[row, i]
                of_weights[k] += change
        mean = total / weights
        if abs(factor * np.sqrt(mean)) < abs(slack.most[row]):
            for k in range(3):
                out[n, k] = 0.5 * factor / np.sqrt(mean) * (
                    along[k] - mean * of_weights[k]) / weights
    return out


def _spacing(points: np.ndarray) -> float:
    """Return the median distance of a sample from the nearest other [m]."""
    from scipy.spatial import cKDTree

    return float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))


@compiled
def _means(points: np.ndarray, samples: np.ndarray, squares: np.ndarray, near: float,
           is_left_out: bool) -> np.ndarray:
    """Return means [n] of ``squares`` [m] of ``samples`` [m, 3] at ``points`` [n, 3]; if
    ``is_left_out``, without the sample of the same number.
    """
    out = np.empty(len(points))
    for n in range(len(points)):
        total, weights = 0.0, 0.0
        for i in range(len(samples)):
            if is_left_out and i == n:
                continue
            distance = near
            for k in range(3):
                distance += (points[n, k] - samples[i, k]) ** 2
            weight = 1.0 / (distance * distance * distance)
            total += weight * squares[i]
            weights += weight
        out[n] = total / weights
    return out
