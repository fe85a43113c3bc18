"""Radial basis function interpolation of scattered values, and of their gradients where known.

    f(x) = sum_j c_j phi(|x - x_j|) - sum_j g_j . grad phi(|x - x_j|) + p(x)

With values alone this is the interpolation of the paper (Wright 2003). A finite element solution
gives, besides the energy, the force, which is the energy's gradient. The second sum
(Hermite-Birkhoff interpolation, Wu 1992) makes the field match both, so each solution contributes
``1 + dimension`` times as much data.

The fit is dense linear algebra. Values and gradients, in three coordinates, are evaluated by
native loops that the planner calls some million times, each over all samples
(``worker/kernels/planning/field.hpp``).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations_with_replacement

import numpy as np

from limber.core.errors import WorkError
from limber.kernels import Kernel, for_kernels
from limber.planning.field.chart import FAR, by_column

KERNELS = {"cubic": 0, "quintic": 1, "multiquadric": 2, "gaussian": 3}
"""Kernel name to its number in the native loops."""

_POINTS, _CHANNELS = "points float64[points, 3]", "channels int64[channels]"
_system = Kernel("radial_system", "centres float64[count, 3]", "out matrix float64[size, size]",
                 "shape float", "kernel int")
_values = Kernel("radial_values", _POINTS, _CHANNELS, "interpolant float64[interpolant]",
                 "out values float64[points, channels]")
_gradients = Kernel("radial_gradients", _POINTS, _CHANNELS, "interpolant float64[interpolant]",
                    "out gradients float64[points, 3, channels]")
_slacks = Kernel("slacks_at", _POINTS, "slack float64[slack]", "out found float64[points]",
                 "row int")
_slopes = Kernel("slack_slopes", _POINTS, "slack float64[slack]", "out found float64[points, 3]",
                 "row int")
_about = Kernel("means_about", _POINTS, "samples float64[samples, 3]", "squares float64[samples]",
                "out means float64[points]", "near float", "is_left_out int")

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
        asked = self._asked(channels)
        values = np.empty((len(points), len(asked)))
        _values(for_kernels(points), asked, self.numbers, values)
        return values

    def gradient(self, points: np.ndarray, channels: slice = slice(None)) -> np.ndarray:
        """Return their gradients, shape [n, 3, channels]."""
        asked = self._asked(channels)
        gradients = np.empty((len(points), 3, len(asked)))
        _gradients(for_kernels(points), asked, self.numbers, gradients)
        return gradients

    def _asked(self, channels: slice) -> np.ndarray:
        return np.arange(self.value_weights.shape[1])[channels]

    @cached_property
    def numbers(self) -> np.ndarray:
        """What the kernels read, shape [n]; samples along the last axes."""
        slopes = self.gradient_weights.transpose(0, 2, 1)
        parts = [by_column(part.reshape(len(part), -1), 0.0) for part in (
            self.centres, self.value_weights, slopes) if len(part)]
        return np.hstack([
            KERNELS[self.kernel], self.shape, self.scale, self.shift, parts[0].shape[1],
            *self.polynomial.shape[::-1], len(slopes) > 0, *(part.ravel() for part in parts),
            self.polynomial.ravel(), self.powers.ravel()])


def _frame(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Return shift and scale that bring points within a box of half edge 1."""
    shift = points.mean(axis=0)
    return shift, float(np.abs(points - shift).max()) or 1.0


def _bordered(centres: np.ndarray, powers: np.ndarray, kernel: str, shape: float, smoothing: float,
              with_gradients: bool) -> np.ndarray:
    """Return the system with the polynomial's rows and columns beside it."""
    size = len(centres) * (1 + centres.shape[1] * with_gradients)
    system = np.empty((size, size))
    _system(centres, system, shape, KERNELS[kernel])
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


@dataclass(frozen=True)
class Slack:
    """Tightening of limits by position, below 0 an extension; see :func:`slacks_at`. As
    :class:`LocalError`, a row a limit [limits, m]; factor 0: no tighter."""

    points: np.ndarray
    squares: np.ndarray
    factors: np.ndarray
    most: np.ndarray
    near: float

    @cached_property
    def numbers(self) -> np.ndarray:
        """What the kernels read, shape [n]."""
        points, squares = by_column(self.points, FAR), by_column(self.squares.T, 0.0)
        return np.hstack([len(self.factors), points.shape[1], self.near, self.factors, self.most,
                          points.ravel(), squares.ravel()])


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
        if name in known and np.array_equal(known[name].points, points):
            squares[row], factors[row] = known[name].squares, share * known[name].factor
    return Slack(np.ascontiguousarray(points), squares, factors, most,
                 1.0 if first is None else first.near)


def slacks_at(points: np.ndarray, row: int, slack: Slack) -> np.ndarray:
    """Return the tightening of the limit of a ``row`` at ``points`` [n, 3] of the chart, [n]."""
    out = np.empty(len(points))
    _slacks.of(points, slack.numbers, out, row)
    return out


def slack_slopes(points: np.ndarray, row: int, slack: Slack) -> np.ndarray:
    """Return its gradients at ``points`` [n, 3] of the chart, shape [n, 3]."""
    out = np.empty((len(points), 3))
    _slopes.of(points, slack.numbers, out, row)
    return out


def _away(points: np.ndarray, count: int) -> np.ndarray:
    """Return the distance of each sample from the ``count``-th nearest other [m], shape [m]."""
    from scipy.spatial import cKDTree

    return cKDTree(points).query(points, k=count + 1)[0][:, count]


def _means(points: np.ndarray, samples: np.ndarray, squares: np.ndarray, near: float,
           is_left_out: bool) -> np.ndarray:
    """Return means [n] of ``squares`` [m] of ``samples`` [m, 3] at ``points`` [n, 3]; if
    ``is_left_out``, without the sample of the same number."""
    out = np.empty(len(points))
    _about.of(points, samples, squares, out, near, is_left_out)
    return out
