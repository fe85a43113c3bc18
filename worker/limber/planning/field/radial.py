"""Radial basis function interpolation of scattered values, and of their gradients where known.

    f(x) = sum_j c_j phi(|x - x_j|) - sum_j g_j . grad phi(|x - x_j|) + p(x)

With values alone this is the interpolation of the paper (Wright 2003). A finite element solution
gives, besides the energy, the force, which is the energy's gradient. The second sum
(Hermite-Birkhoff interpolation, Wu 1992) makes the field match both, so each solution contributes
``1 + dimension`` times as much data.

The fit is dense linear algebra. Values and gradients, in three coordinates, are evaluated by
compiled loops that the planner calls some million times, each over all samples. Their arrays hold
one coordinate each in the order of the loop, so that the processor vectorises.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement
from typing import NamedTuple

import numpy as np

from limber.core.errors import WorkError
from limber.core.numerics.compiled import compiled

KERNELS = {"cubic": 0, "quintic": 1, "multiquadric": 2, "gaussian": 3}
"""Kernel name to its number in the compiled loops."""

# The polynomial that a kernel needs to be conditionally definite, or one degree more.
_DEGREE = {"cubic": 1, "quintic": 2, "multiquadric": 1, "gaussian": 1}


@dataclass(frozen=True)
class RadialInterpolant:
    """A fitted field in scaled coordinates ``(x - shift) / scale``: centres [m, dimension], weights
    of values [m, channels] and of gradients [m or 0, dimension, channels], and a polynomial [terms,
    channels] with ``powers`` [terms, dimension]. ``smoothing`` is the ridge."""

    kernel: str
    shape: float
    smoothing: float
    shift: np.ndarray
    scale: float
    centres: np.ndarray
    value_weights: np.ndarray
    gradient_weights: np.ndarray
    polynomial: np.ndarray
    powers: np.ndarray

    @classmethod
    def fit(cls, points: np.ndarray, values: np.ndarray, gradients: np.ndarray | None = None, *,
            kernel: str = "cubic", shape: float = 1.0, smoothing: float = 0.0,
            ) -> "RadialInterpolant":
        """Fit values [m] or [m, channels] at points [m, dimension], and gradients [m, dimension] or
        [m, dimension, channels] if given. WorkError if the samples do not determine the field."""
        points = np.asarray(points, float)
        values = np.asarray(values, float).reshape(len(points), -1)
        count, dimension = points.shape
        shift, scale = _frame(points)
        centres = np.ascontiguousarray((points - shift) / scale)
        powers = _monomials(dimension, _DEGREE[kernel])
        with_gradients = gradients is not None
        right = values
        if with_gradients:
            slopes = np.asarray(gradients, float).reshape(count, dimension, -1) * scale
            right = np.concatenate([values, slopes.reshape(count * dimension, -1)])
        size = np.abs(values).max(axis=0)
        size[size == 0] = 1.0
        weights = _solve(centres, right / size, powers, kernel, shape, smoothing, with_gradients)
        weights *= size
        ends = [count, len(right)]
        value_weights, gradient_weights, polynomial = np.split(weights, ends)
        return cls(kernel, float(shape), float(smoothing), shift, scale, centres,
                   np.ascontiguousarray(value_weights),
                   gradient_weights.reshape(-1, dimension, values.shape[1]).copy(),
                   np.ascontiguousarray(polynomial), powers)

    @staticmethod
    def leave_one_out(points: np.ndarray, values: np.ndarray,
                      gradients: np.ndarray | None = None, *, kernel: str,
                      shape: float = 1.0, smoothing: float = 0.0) -> np.ndarray:
        """Truth less the fit without a sample, at that sample [m, 1 + dimension, channels], or [m,
        1, channels] without gradients: ``((A^-1)_BB)^-1 (A^-1 b)_B`` with the rows B of a sample
        (Rippa 1999, here for blocks of value and gradient)."""
        points = np.asarray(points, float)
        count, dimension = points.shape
        shift, scale = _frame(points)
        centres = np.ascontiguousarray((points - shift) / scale)
        both = gradients is not None
        right = np.asarray(values, float).reshape(count, -1)
        if both:
            slopes = np.asarray(gradients, float).reshape(count * dimension, -1)
            right = np.concatenate([right, scale * slopes])
        full = _bordered(centres, _monomials(dimension, _DEGREE[kernel]), kernel, shape, smoothing,
                         both)
        inverse = np.linalg.inv(full)
        weights = inverse[:, :len(right)] @ right
        rows = np.arange(count)[:, None]
        if both:
            rows = np.hstack([rows, count + dimension * rows + np.arange(dimension)])
        blocks = inverse[rows[:, :, None], rows[:, None, :]]
        missed = np.linalg.solve(blocks, weights[rows])
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
        return (KERNELS[self.kernel], self.shape, self.scale, self.shift,
                np.ascontiguousarray(self.centres.T), np.ascontiguousarray(self.value_weights.T),
                np.ascontiguousarray(self.gradient_weights.transpose(2, 1, 0)), self.polynomial,
                self.powers)


def _frame(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return shift and scale that bring points within a box of half edge 1."""
    shift = points.mean(axis=0)
    return shift, float(np.abs(points - shift).max()) or 1.0


def _bordered(centres: np.ndarray, powers: np.ndarray, kernel: str, shape: float, smoothing: float,
              with_gradients: bool) -> np.ndarray:
    """Return the system with the polynomial's rows and columns beside it."""
    system = _system(centres, KERNELS[kernel], shape, with_gradients)
    system[np.diag_indices(len(system))] += smoothing
    basis = _polynomial_rows(centres, powers, with_gradients)
    terms = basis.shape[1]
    return np.block([[system, basis], [basis.T, np.zeros((terms, terms))]])


def _monomials(dimension: int, degree: int) -> np.ndarray:
    rows = [[0] * dimension]
    for total in range(1, degree + 1):
        for picked in combinations_with_replacement(range(dimension), total):
            rows.append([picked.count(axis) for axis in range(dimension)])
    return np.array(rows, np.int64)


def _solve(centres: np.ndarray, right: np.ndarray, powers: np.ndarray, kernel: str, shape: float,
           smoothing: float, with_gradients: bool) -> np.ndarray:
    full = _bordered(centres, powers, kernel, shape, smoothing, with_gradients)
    terms = len(powers)
    padded = np.concatenate([right, np.zeros((terms, right.shape[1]))])
    try:
        weights = np.linalg.solve(full, padded)
    except np.linalg.LinAlgError:
        weights = np.full_like(padded, np.nan)
    if not np.isfinite(weights).all():
        raise WorkError(
            f"The {kernel} interpolation of {len(centres)} samples has no unique solution.",
            f"It needs at least {terms} samples that do not coincide or lie in one plane.",
            "Sample more grasp poses, or use a larger deflection.")
    return weights


def _polynomial_rows(centres: np.ndarray, powers: np.ndarray, with_gradients: bool) -> np.ndarray:
    count, dimension = centres.shape
    rows = np.prod(centres[:, None, :] ** powers, axis=2)
    if not with_gradients:
        return rows
    slopes = np.zeros((count, dimension, len(powers)))
    for axis in range(dimension):
        lowered = powers.copy()
        lowered[:, axis] = np.maximum(lowered[:, axis] - 1, 0)
        slopes[:, axis] = powers[:, axis] * np.prod(centres[:, None, :] ** lowered, axis=2)
    return np.concatenate([rows, slopes.reshape(count * dimension, -1)])


@compiled
def radial_terms(kernel, shape, squared):
    """Return ``phi``, ``a``, ``b`` at squared distance: grad phi = a d, Hessian = a I + b d d^T."""
    if kernel == 0:
        r = np.sqrt(squared)
        return r * squared, 3.0 * r, 3.0 / r if r > 0.0 else 0.0
    if kernel == 1:
        r = np.sqrt(squared)
        return -r * squared * squared, -5.0 * r * squared, -15.0 * r
    square = shape * shape
    if kernel == 2:
        s = np.sqrt(1.0 + square * squared)
        return -s, -square / s, square * square / (s * s * s)
    phi = np.exp(-square * squared)
    return phi, -2.0 * square * phi, 4.0 * square * square * phi


@compiled
def _system(centres, kernel, shape, with_gradients):
    count, dimension = centres.shape
    size = count * (1 + dimension) if with_gradients else count
    matrix = np.zeros((size, size))
    offset = np.empty(dimension)
    for i in range(count):
        for j in range(count):
            squared = 0.0
            for k in range(dimension):
                offset[k] = centres[i, k] - centres[j, k]
                squared += offset[k] * offset[k]
            phi, a, b = radial_terms(kernel, shape, squared)
            matrix[i, j] = phi
            if not with_gradients:
                continue
            for k in range(dimension):
                row = count + i * dimension + k
                matrix[i, count + j * dimension + k] = -a * offset[k]
                matrix[row, j] = a * offset[k]
                for m in range(dimension):
                    matrix[row, count + j * dimension + m] = -b * offset[k] * offset[m]
                matrix[row, count + j * dimension + k] -= a
    return matrix


@compiled
def value_at(point, channel, kernel, shape, scale, shift, centres, value_weights,
             gradient_weights, polynomial, powers):
    """Return one channel of the field at ``point`` [3]; arrays as ``RadialInterpolant.arrays``."""
    scaled = _scaled(point, shift, scale)
    weights, slopes = value_weights[channel], gradient_weights[channel]
    # With the kernel's number written out, the choice is made outside the loop, as required.
    if kernel == 0:
        total = _value_sum(0, scaled, shape, centres, weights, slopes)
    elif kernel == 1:
        total = _value_sum(1, scaled, shape, centres, weights, slopes)
    elif kernel == 2:
        total = _value_sum(2, scaled, shape, centres, weights, slopes)
    else:
        total = _value_sum(3, scaled, shape, centres, weights, slopes)
    x, y, z = scaled
    for t in range(len(powers)):
        total += polynomial[t, channel] * (
            _power(x, powers[t, 0]) * _power(y, powers[t, 1]) * _power(z, powers[t, 2]))
    return total


@compiled
def _value_sum(kernel, scaled, shape, centres, weights, slopes):
    x, y, z = scaled
    first, second, third = centres[0], centres[1], centres[2]
    along_x, along_y, along_z = slopes[0], slopes[1], slopes[2]
    total = 0.0
    if len(along_x) > 0:
        for j in range(len(weights)):
            dx, dy, dz = x - first[j], y - second[j], z - third[j]
            phi, a, _b = radial_terms(kernel, shape, dx * dx + dy * dy + dz * dz)
            total += weights[j] * phi - a * (dx * along_x[j] + dy * along_y[j] + dz * along_z[j])
        return total
    for j in range(len(weights)):
        dx, dy, dz = x - first[j], y - second[j], z - third[j]
        phi, _a, _b = radial_terms(kernel, shape, dx * dx + dy * dy + dz * dz)
        total += weights[j] * phi
    return total


@compiled
def gradient_at(point, channel, kernel, shape, scale, shift, centres, value_weights,
                gradient_weights, polynomial, powers, out):
    """Write the gradient of one channel at ``point`` [3] into ``out`` [3]."""
    scaled = _scaled(point, shift, scale)
    weights, slopes = value_weights[channel], gradient_weights[channel]
    if kernel == 0:
        total = _slope_sum(0, scaled, shape, centres, weights, slopes)
    elif kernel == 1:
        total = _slope_sum(1, scaled, shape, centres, weights, slopes)
    elif kernel == 2:
        total = _slope_sum(2, scaled, shape, centres, weights, slopes)
    else:
        total = _slope_sum(3, scaled, shape, centres, weights, slopes)
    (x, y, z), (along_x, along_y, along_z) = scaled, total
    for t in range(len(powers)):
        p, q, r = powers[t, 0], powers[t, 1], powers[t, 2]
        term = polynomial[t, channel]
        along_x += term * p * _power(x, p - 1) * _power(y, q) * _power(z, r)
        along_y += term * q * _power(x, p) * _power(y, q - 1) * _power(z, r)
        along_z += term * r * _power(x, p) * _power(y, q) * _power(z, r - 1)
    out[0], out[1], out[2] = along_x / scale, along_y / scale, along_z / scale


@compiled
def _slope_sum(kernel, scaled, shape, centres, weights, slopes):
    x, y, z = scaled
    first, second, third = centres[0], centres[1], centres[2]
    along_x, along_y, along_z = slopes[0], slopes[1], slopes[2]
    sum_x, sum_y, sum_z = 0.0, 0.0, 0.0
    if len(along_x) > 0:
        for j in range(len(weights)):
            dx, dy, dz = x - first[j], y - second[j], z - third[j]
            _phi, a, b = radial_terms(kernel, shape, dx * dx + dy * dy + dz * dz)
            radial = weights[j] * a - b * (
                dx * along_x[j] + dy * along_y[j] + dz * along_z[j])
            sum_x += radial * dx - a * along_x[j]
            sum_y += radial * dy - a * along_y[j]
            sum_z += radial * dz - a * along_z[j]
        return sum_x, sum_y, sum_z
    for j in range(len(weights)):
        dx, dy, dz = x - first[j], y - second[j], z - third[j]
        _phi, a, _b = radial_terms(kernel, shape, dx * dx + dy * dy + dz * dz)
        sum_x += weights[j] * a * dx
        sum_y += weights[j] * a * dy
        sum_z += weights[j] * a * dz
    return sum_x, sum_y, sum_z


@compiled
def _scaled(point, shift, scale):
    return ((point[0] - shift[0]) / scale, (point[1] - shift[1]) / scale,
            (point[2] - shift[2]) / scale)


@compiled
def _power(x, exponent):
    out = 1.0
    for _ in range(exponent):
        out *= x
    return out


@compiled
def _values(points, channels, kernel, shape, scale, shift, centres, value_weights,
            gradient_weights, polynomial, powers):
    out = np.empty((len(points), len(channels)))
    for i in range(len(points)):
        for c in range(len(channels)):
            out[i, c] = value_at(points[i], channels[c], kernel, shape, scale, shift, centres,
                                 value_weights, gradient_weights, polynomial, powers)
    return out


@compiled
def _gradients(points, channels, kernel, shape, scale, shift, centres, value_weights,
               gradient_weights, polynomial, powers):
    out = np.empty((len(points), 3, len(channels)))
    slope = np.empty(3)
    for i in range(len(points)):
        for c in range(len(channels)):
            gradient_at(points[i], channels[c], kernel, shape, scale, shift, centres,
                        value_weights, gradient_weights, polynomial, powers, slope)
            out[i, :, c] = slope
    return out


# Error bound of a field, as a function of the position.
#
# Each sample was left out of the fit once; the error there of the fit to the others is known. At
# any other position it is taken from the nearest samples: a mean of their squares, with weights
# that fall with the distance in the chart. The accuracy of this prediction is known as well, from
# each sample and the others: the mean is multiplied by the factor that covers the requested
# fraction of them (split conformal prediction: Vovk et al. 2005; with a local scale: Lei et al.
# 2018; with weights: Tibshirani et al. 2019). States of the full model along plans join the
# samples, and with them these errors.

_LEAST = 0.2  # fraction of the median error that is stated even where the nearest samples are exact
_FEWEST = 8  # fewest samples with a known error
_ROOM = 3  # which neighbour of a sample is at the border of the room about it


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
        near = max(float(np.median(_away(points, 1)))**2, 1e-18)
        predicted = np.sqrt(_means(points, points, squares, near, True))
        shares = np.maximum(above, 0.0) / np.maximum(predicted, 1e-300)
        order, room = np.argsort(shares, kind="stable"), _away(points, _ROOM)**3 + 1e-30
        # One more than there are: the queried position counts as one more sample. Samples lie
        # closer where neighbours disagree, positions do not: each counts by the room about it.
        parts = np.cumsum(room[order]) / room.sum() * len(shares) / (len(shares) + 1)
        rank = min(int(np.searchsorted(parts, covered)), len(shares) - 1)
        return cls(points, squares, near, float(shares[order[rank]]), most)

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


def _away(points: np.ndarray, count: int) -> np.ndarray:
    """Return the distance of each sample from the ``count``-th nearest other [m], shape [m]."""
    from scipy.spatial import cKDTree

    return cKDTree(points).query(points, k=count + 1)[0][:, count]


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
