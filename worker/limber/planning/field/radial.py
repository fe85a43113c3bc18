"""Radial basis function interpolation of scattered values, and of their gradients where known.

    f(x) = sum_j c_j phi(|x - x_j|) - sum_j g_j . grad phi(|x - x_j|) + p(x),    phi(r) = r^3

With values alone this is the interpolation of the paper (Wright 2003). A finite element solution
gives, besides the energy, the force, which is the energy's gradient. The second sum
(Hermite-Birkhoff interpolation, Wu 1992) makes the field match both, so each solution contributes
four times as much data. ``p`` is linear, which a cubic needs to be conditionally definite.

The fit is dense linear algebra. Values and gradients are evaluated by compiled loops that the
planner calls some million times, each over all samples. Their arrays hold one coordinate each in
the order of the loop, so that the processor vectorises.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from limber.core.errors import WorkError
from limber.core.numerics.compiled import compiled


@dataclass(frozen=True)
class RadialInterpolant:
    """A fitted field in scaled coordinates ``(x - shift) / scale``: centres [m, 3], weights of
    values [m, channels] and of gradients [m, 3, channels], 0 if they were not given, and a linear
    ``polynomial`` [4, channels]."""

    shift: np.ndarray
    scale: float
    centres: np.ndarray
    value_weights: np.ndarray
    gradient_weights: np.ndarray
    polynomial: np.ndarray

    @classmethod
    def fit(cls, points: np.ndarray, values: np.ndarray, gradients: np.ndarray | None = None, *,
            smoothing: float = 0.0) -> "RadialInterpolant":
        """Fit values [m] or [m, channels] at points [m, 3], and gradients [m, 3] or [m, 3,
        channels] if given. ``smoothing`` is the ridge. WorkError if the samples do not determine
        the field."""
        full, right, shift, scale = _system(points, values, gradients, smoothing)
        count, channels = len(points), right.shape[1]
        size = np.abs(right[:count]).max(axis=0)
        size[size == 0] = 1.0
        try:
            weights = np.linalg.solve(full, right / size) * size
        except np.linalg.LinAlgError:
            weights = np.full_like(right, np.nan)
        if not np.isfinite(weights).all():
            raise WorkError(
                f"The interpolation of {count} samples has no unique solution.",
                "It needs at least 4 samples that do not coincide or lie in one plane.",
                "Sample more grasp poses, or use a larger deflection.")
        slopes = np.zeros((count, 3, channels))
        if gradients is not None:
            slopes[:] = weights[count:-4].reshape(-1, 3, channels)
        return cls(shift, scale, np.ascontiguousarray((points - shift) / scale),
                   weights[:count].copy(), slopes, weights[-4:].copy())

    @staticmethod
    def leave_one_out(points: np.ndarray, values: np.ndarray,
                      gradients: np.ndarray | None = None, *, smoothing: float = 0.0) -> np.ndarray:
        """Truth less the fit without a sample, at that sample [m, 4, channels], or [m, 1, channels]
        without gradients: ``((A^-1)_BB)^-1 (A^-1 b)_B`` with the rows B of a sample (Rippa 1999,
        here for blocks of value and gradient)."""
        full, right, _, scale = _system(points, values, gradients, smoothing)
        inverse = np.linalg.inv(full)
        rows = np.arange(len(points))[:, None]
        if gradients is not None:
            rows = np.hstack([rows, len(points) + 3 * rows + np.arange(3)])
        blocks = inverse[rows[:, :, None], rows[:, None, :]]
        missed = np.linalg.solve(blocks, (inverse @ right)[rows])
        missed[:, 1:] /= scale
        return missed

    def value(self, points: np.ndarray, channels: slice = slice(None)) -> np.ndarray:
        """Return ``channels`` of the field at ``points`` [n, 3], shape [n, channels]."""
        return _values(np.ascontiguousarray(points, float), self._asked(channels), *self.arrays)

    def gradient(self, points: np.ndarray, channels: slice = slice(None)) -> np.ndarray:
        """Return their gradients, shape [n, 3, channels]."""
        return _gradients(np.ascontiguousarray(points, float), self._asked(channels), *self.arrays)

    def _asked(self, channels: slice) -> np.ndarray:
        return np.arange(self.value_weights.shape[1])[channels]

    @cached_property
    def arrays(self) -> tuple:
        """Arguments of the compiled loops after the point; samples along the last axis."""
        return (self.scale, self.shift, np.ascontiguousarray(self.centres.T),
                np.ascontiguousarray(self.value_weights.T),
                np.ascontiguousarray(self.gradient_weights.transpose(2, 1, 0)), self.polynomial)


def _system(points: np.ndarray, values: np.ndarray, gradients: np.ndarray | None, smoothing: float,
            ) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return matrix [k, k] and right side [k, channels] of a fit, the polynomial's rows last, and
    shift and scale that bring the points within a box of half edge 1."""
    points, count = np.asarray(points, float), len(points)
    shift = points.mean(axis=0)
    scale = float(np.abs(points - shift).max()) or 1.0
    centres = np.ascontiguousarray((points - shift) / scale)
    right = np.asarray(values, float).reshape(count, -1)
    basis = np.hstack([np.ones((count, 1)), centres])
    if gradients is not None:
        slopes = scale * np.asarray(gradients, float).reshape(3 * count, -1)
        right = np.concatenate([right, slopes])
        basis = np.concatenate([basis, np.tile(np.eye(4)[1:], (count, 1))])
    matrix = _matrix(centres, gradients is not None)
    matrix[np.diag_indices(len(matrix))] += smoothing
    return (np.block([[matrix, basis], [basis.T, np.zeros((4, 4))]]),
            np.concatenate([right, np.zeros((4, right.shape[1]))]), shift, scale)


@compiled
def radial_terms(squared):
    """Return ``phi``, ``a``, ``b`` at squared distance: grad phi = a d, Hessian = a I + b d d^T."""
    r = np.sqrt(squared)
    return r * squared, 3.0 * r, 3.0 / r if r > 0.0 else 0.0


@compiled
def _matrix(centres, with_gradients):
    count = len(centres)
    size = 4 * count if with_gradients else count
    matrix = np.zeros((size, size))
    offset = np.empty(3)
    for i in range(count):
        for j in range(count):
            squared = 0.0
            for k in range(3):
                offset[k] = centres[i, k] - centres[j, k]
                squared += offset[k] * offset[k]
            phi, a, b = radial_terms(squared)
            matrix[i, j] = phi
            if not with_gradients:
                continue
            for k in range(3):
                row = count + i * 3 + k
                matrix[i, count + j * 3 + k] = -a * offset[k]
                matrix[row, j] = a * offset[k]
                for m in range(3):
                    matrix[row, count + j * 3 + m] = -b * offset[k] * offset[m]
                matrix[row, count + j * 3 + k] -= a
    return matrix


@compiled
def value_at(point, channel, scale, shift, centres, value_weights, gradient_weights, polynomial):
    """Return one channel of the field at ``point`` [3]; arrays as ``RadialInterpolant.arrays``."""
    x, y, z = _scaled(point, shift, scale)
    weights, slopes = value_weights[channel], gradient_weights[channel]
    first, second, third = centres[0], centres[1], centres[2]
    along_x, along_y, along_z = slopes[0], slopes[1], slopes[2]
    total = polynomial[0, channel] + polynomial[1, channel] * x + (
        polynomial[2, channel] * y + polynomial[3, channel] * z)
    for j in range(len(weights)):
        dx, dy, dz = x - first[j], y - second[j], z - third[j]
        phi, a, _b = radial_terms(dx * dx + dy * dy + dz * dz)
        total += weights[j] * phi - a * (dx * along_x[j] + dy * along_y[j] + dz * along_z[j])
    return total


@compiled
def gradient_at(point, channel, scale, shift, centres, value_weights, gradient_weights, polynomial,
                out):
    """Write the gradient of one channel at ``point`` [3] into ``out`` [3]."""
    x, y, z = _scaled(point, shift, scale)
    weights, slopes = value_weights[channel], gradient_weights[channel]
    first, second, third = centres[0], centres[1], centres[2]
    along_x, along_y, along_z = slopes[0], slopes[1], slopes[2]
    sum_x, sum_y, sum_z = (polynomial[1, channel], polynomial[2, channel], polynomial[3, channel])
    for j in range(len(weights)):
        dx, dy, dz = x - first[j], y - second[j], z - third[j]
        _phi, a, b = radial_terms(dx * dx + dy * dy + dz * dz)
        radial = weights[j] * a - b * (dx * along_x[j] + dy * along_y[j] + dz * along_z[j])
        sum_x += radial * dx - a * along_x[j]
        sum_y += radial * dy - a * along_y[j]
        sum_z += radial * dz - a * along_z[j]
    out[0], out[1], out[2] = sum_x / scale, sum_y / scale, sum_z / scale


@compiled
def _scaled(point, shift, scale):
    return ((point[0] - shift[0]) / scale, (point[1] - shift[1]) / scale,
            (point[2] - shift[2]) / scale)


@compiled
def _values(points, channels, scale, shift, centres, value_weights, gradient_weights, polynomial):
    out = np.empty((len(points), len(channels)))
    for i in range(len(points)):
        for c in range(len(channels)):
            out[i, c] = value_at(points[i], channels[c], scale, shift, centres, value_weights,
                                 gradient_weights, polynomial)
    return out


@compiled
def _gradients(points, channels, scale, shift, centres, value_weights, gradient_weights,
               polynomial):
    out = np.empty((len(points), 3, len(channels)))
    slope = np.empty(3)
    for i in range(len(points)):
        for c in range(len(channels)):
            gradient_at(points[i], channels[c], scale, shift, centres, value_weights,
                        gradient_weights, polynomial, slope)
            out[i, :, c] = slope
    return out


# Error bound of a field, as a function of the position.
#
# Each sample was left out of the fit once; the error there of the fit to the others is known. At
# any other position it is taken from the nearest samples: a mean of their squares, with weights
# that fall with the distance in the chart. The accuracy of this prediction is known as well, from
# each sample and the others: the mean is multiplied by the factor that covers the requested
# fraction of them (split conformal prediction: Vovk et al. 2005; with a local scale: Lei et al.
# 2018). States of the full model along plans join the samples, and with them these errors.

_LEAST = 0.2  # fraction of the median error that is stated even where the nearest samples are exact
_FEWEST = 8  # fewest samples with a known error


@dataclass(frozen=True)
class LocalError:
    """An error bound by position in the chart: squared errors [m] of samples with floor, ``near``
    [m^2], within which weights hardly differ, and a factor, infinite if nothing is known."""

    points: np.ndarray
    squares: np.ndarray
    near: float
    factor: float
    most: float = np.inf

    @classmethod
    def of(cls, points: np.ndarray, above: np.ndarray, covered: float, most: float = np.inf,
           ) -> "LocalError":
        """Bound the overestimate for a fraction ``covered`` of samples (1: all), from that of fits
        without the sample [m], below 0 if under, nan if unknown. ``most`` is the largest stated."""
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
    """Tightening of limits by position for compiled loops, below 0 an extension; see
    :func:`slack_at`. As :class:`LocalError`, a row a limit [limits, m]; factor 0: no tighter."""

    points: np.ndarray
    squares: np.ndarray
    factors: np.ndarray
    most: np.ndarray
    near: float


def slack_of(names: Sequence[str], errors: Mapping[str, LocalError], share: float) -> Slack:
    """Return a ``share`` of ``errors``, -1 to 1, as slack of the limits ``names``; none for the
    others."""
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
    ``is_left_out``, without the sample of the same number."""
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
