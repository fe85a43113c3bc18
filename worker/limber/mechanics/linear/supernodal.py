"""Supernodal Cholesky factor, by fronts: ``worker/kernels/mechanics/supernodal.cpp``."""

import copy

import numpy as np

from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.kernels import Kernel
from limber.mechanics.linear.fronts import Fronts

_FRONTS = ("first int64[starts]", "row_start int64[starts]")
_factorise = Kernel(
    "factorise", "values float64[values]", "value_start int64[starts]", "targets int32[values]",
    *_FRONTS, "panel int64[starts]", "row_positions int32[rows]", "children int64[fronts]",
    "child_start int64[starts]", "work int64[fronts]", "depth int64[fronts]",
    "out even float64[even]", "out odd float64[odd]", "out factor float64[entries]",
    "out inverse float64[size]", returns="int")
_solve_down, _solve_up = (Kernel(
    name, *_FRONTS, "rows int32[rows]", "panel int64[starts]", "factor float64[entries]",
    "inverse float64[size]", "out solution float64[sides, size]")
    for name in ("solve_down", "solve_up"))


class SupernodalFactor:
    """Factor of a matrix with a fixed pattern."""

    def __init__(self, fronts: Fronts):
        self._fronts = fronts
        self._factor = np.zeros(fronts.panel[-1])
        self._inverse = np.zeros(3 * int(fronts.first[-1]))
        self._even, self._odd = (np.zeros(int(size)) for size in fronts.work_size)

    def twin(self) -> "SupernodalFactor":
        """Return a factor of the same pattern with memory of its own."""
        other = copy.copy(self)
        other._factor, other._inverse, other._even, other._odd = map(
            np.zeros_like, (self._factor, self._inverse, self._even, self._odd))
        return other

    def factorise(self, values: np.ndarray) -> None:
        """Factorise the matrix with these ``values``, lower triangle by columns.
        NotPositiveDefiniteError if it is not positive definite."""
        f = self._fronts
        if not _factorise(values, f.value_start, f.targets, f.first, f.row_start, f.panel,
                          f.row_positions, f.children, f.child_start, f.work, f.depth, self._even,
                          self._odd, self._factor, self._inverse):
            raise NotPositiveDefiniteError("a pivot is not positive")

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for right sides [size] or [size, k]. Three take the time of one,
        which goes into reading the factor; if they are mostly 0, four fifths of that."""
        return self.up(self.down(right))

    def down(self, right: np.ndarray) -> np.ndarray:
        """Return the first half of a solution (forward substitution), of the same shape. If the
        right sides are mostly 0, this takes almost no time."""
        return self._halved(right, _solve_down)

    def up(self, half: np.ndarray) -> np.ndarray:
        """Return the other half: the solution with the factor's transpose, of the same shape."""
        return self._halved(half, _solve_up)

    def _halved(self, right: np.ndarray, solve: Kernel) -> np.ndarray:
        if not right.any():
            return np.zeros_like(right)
        f = self._fronts
        solution = np.array(right.reshape(len(right), -1).T, float, order="C")
        solve(f.first, f.row_start, f.rows, f.panel, self._factor, self._inverse, solution)
        return np.ascontiguousarray(solution.T).reshape(right.shape)
