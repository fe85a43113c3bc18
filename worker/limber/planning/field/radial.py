"""Radial basis function interpolation of scattered values, and of their gradients where known.

    f(x) = sum_j c_j phi(|x - x_j|) - sum_j g_j . grad phi(|x - x_j|) + p(x)

With values alone this is the interpolation of the paper (Wright 2003). A finite element solution
gives the force beside the energy, which is the energy's gradient: the second sum (Hermite-Birkhoff
interpolation, Wu 1992) makes the field match both, so the same number of solutions tells
``1 + dimension`` times as much.

The fit is dense linear algebra; values and gradients are evaluated by compiled loops that the
planner calls some hundred thousand times.
"""

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from limber.compiled import compiled
from limber.errors import WorkError

KERNELS = {"cubic": 0, "quintic": 1, "multiquadric": 2, "gaussian": 3}
"""Kernel name to its number in the compiled loops."""

# The polynomial that a kernel needs to be conditionally definite, or one degree more.
_DEGREE = {"cubic": 1, "quintic": 2, "multiquadric": 1, "gaussian": 1}


@dataclass(frozen=True)
class RadialInterpolant:
    """A fitted field of ``dimension`` coordinates and one or several channels.

    Attributes:
        kernel: One of ``KERNELS``.
        shape: Shape parameter of multiquadric and gaussian, in scaled coordinates.
        smoothing: Ridge added to the diagonal of the scaled system.
        shift, scale: Scaled coordinates are ``(x - shift) / scale``, shapes [dimension], [].
        centres: Scaled positions of the samples, shape [m, dimension].
        value_weights: ``c``, shape [m, channels].
        gradient_weights: ``g``, shape [m, dimension, channels], or [0, dimension, channels].
        polynomial: Shape [terms, channels]; exponents in ``powers``, shape [terms, dimension].
    """

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
        """Fit to ``values`` [m] or [m, channels] at ``points`` [m, dimension].

        ``gradients`` [m, dimension] or [m, dimension, channels], where given, are matched too.

        Raises:
            WorkError: the samples do not determine the field (too few, or coinciding).
        """
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
        """Return what a fit without a sample would miss there, in closed form.

        With ``A`` the system, ``b`` its right side and ``B`` the rows of one sample, the truth less
        the prediction of the fit to all others is ``((A^-1)_BB)^-1 (A^-1 b)_B`` (Rippa 1999, here
        for blocks of value and gradient).

        Args:
            points: Shape [m, dimension].
            values: Shape [m] or [m, channels].
            gradients: Shape [m, dimension] or [m, dimension, channels], where they are matched.

        Returns:
            Shape [m, 1 + dimension, channels]: value, gradient; [m, 1, channels] without gradients.
        """
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

    def value(self, points: np.ndarray) -> np.ndarray:
        """Return the field at ``points`` [n, dimension], shape [n, channels]."""
        return _values(np.ascontiguousarray(points, float), *self.arrays)

    def gradient(self, points: np.ndarray) -> np.ndarray:
        """Return its gradient, shape [n, dimension, channels]."""
        return _gradients(np.ascontiguousarray(points, float), *self.arrays)

    @property
    def arrays(self) -> tuple:
        """What the compiled loops take after the point."""
        return (KERNELS[self.kernel], self.shape, self.shift, self.scale, self.centres,
                self.value_weights, self.gradient_weights, self.polynomial, self.powers)

    def to_arrays(self, prefix: str) -> dict[str, np.ndarray]:
        """Return plain arrays for an ``npz`` file, names starting with ``prefix``."""
        names = ("shape", "smoothing", "shift", "scale", "centres", "value_weights",
                 "gradient_weights", "polynomial", "powers")
        return {f"{prefix}kernel": np.array(self.kernel)} | {
            prefix + name: np.asarray(getattr(self, name)) for name in names}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray], prefix: str) -> "RadialInterpolant":
        """Undo :meth:`to_arrays`."""
        part = {name.removeprefix(prefix): value for name, value in arrays.items()
                if name.startswith(prefix)}
        plain = {"kernel": str(part.pop("kernel")), "shape": float(part.pop("shape")),
                 "smoothing": float(part.pop("smoothing")), "scale": float(part.pop("scale"))}
        powers = np.ascontiguousarray(part.pop("powers"), np.int64)
        found = cls(**plain, powers=powers, **{
            name: np.ascontiguousarray(value, float) for name, value in part.items()})
        if found.kernel not in KERNELS or not (found.scale > 0 and found.shape > 0):
            raise ValueError(f"no kernel {found.kernel} of shape {found.shape}")
        if len(found.gradient_weights) not in (0, len(found.centres)) or not (
                (powers >= 0) & (powers <= 8)).all() or len(found.value_weights) != len(
                found.centres):
            raise ValueError("weights that do not fit their samples")
        return found


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
            "Sample more grasp poses, or a larger deflection.")
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
def value_at(point, channel, kernel, shape, shift, scale, centres, value_weights,
             gradient_weights, polynomial, powers):
    """Return one channel of the field at ``point`` [dimension]."""
    count, dimension = centres.shape
    with_gradients = gradient_weights.shape[0] > 0
    scaled = (point - shift) / scale
    total = 0.0
    for j in range(count):
        squared = 0.0
        along = 0.0
        for k in range(dimension):
            d = scaled[k] - centres[j, k]
            squared += d * d
            if with_gradients:
                along += d * gradient_weights[j, k, channel]
        phi, a, _b = radial_terms(kernel, shape, squared)
        total += value_weights[j, channel] * phi - a * along
    for t in range(powers.shape[0]):
        term = polynomial[t, channel]
        for k in range(dimension):
            if powers[t, k] > 0:
                term *= scaled[k] ** powers[t, k]
        total += term
    return total


@compiled
def gradient_at(point, channel, kernel, shape, shift, scale, centres, value_weights,
                gradient_weights, polynomial, powers, out):
    """Write the gradient of one channel at ``point`` into ``out`` [dimension]."""
    count, dimension = centres.shape
    with_gradients = gradient_weights.shape[0] > 0
    scaled = (point - shift) / scale
    for k in range(dimension):
        out[k] = 0.0
    for j in range(count):
        squared = 0.0
        along = 0.0
        for k in range(dimension):
            d = scaled[k] - centres[j, k]
            squared += d * d
            if with_gradients:
                along += d * gradient_weights[j, k, channel]
        _phi, a, b = radial_terms(kernel, shape, squared)
        radial = value_weights[j, channel] * a - b * along
        for k in range(dimension):
            d = scaled[k] - centres[j, k]
            out[k] += radial * d
            if with_gradients:
                out[k] -= a * gradient_weights[j, k, channel]
    for t in range(powers.shape[0]):
        for axis in range(dimension):
            if powers[t, axis] == 0:
                continue
            term = polynomial[t, channel] * powers[t, axis]
            for k in range(dimension):
                power = powers[t, k] - 1 if k == axis else powers[t, k]
                if power > 0:
                    term *= scaled[k] ** power
            out[axis] += term
    for k in range(dimension):
        out[k] /= scale


@compiled
def _values(points, kernel, shape, shift, scale, centres, value_weights, gradient_weights,
            polynomial, powers):
    out = np.empty((len(points), value_weights.shape[1]))
    for i in range(len(points)):
        for channel in range(value_weights.shape[1]):
            out[i, channel] = value_at(
                points[i], channel, kernel, shape, shift, scale, centres, value_weights,
                gradient_weights, polynomial, powers)
    return out


@compiled
def _gradients(points, kernel, shape, shift, scale, centres, value_weights, gradient_weights,
               polynomial, powers):
    channels = value_weights.shape[1]
    out = np.empty((len(points), points.shape[1], channels))
    slope = np.empty(points.shape[1])
    for i in range(len(points)):
        for channel in range(channels):
            gradient_at(points[i], channel, kernel, shape, shift, scale, centres,
                        value_weights, gradient_weights, polynomial, powers, slope)
            out[i, :, channel] = slope
    return out
