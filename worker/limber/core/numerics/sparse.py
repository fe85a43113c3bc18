"""Solvers for sparse symmetric matrices: choice of library and common interface.

CHOLMOD (through cvxopt) if installed, else SuperLU from scipy. Limber's own factorisation for
branches is :mod:`limber.mechanics.linear.supernodal`.
"""

from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse

from limber.core.not_none import present

if TYPE_CHECKING:
    from scipy.sparse.linalg import SuperLU


class NotPositiveDefiniteError(ArithmeticError):
    """The matrix has a pivot that is not positive."""


class CholmodFactor:
    """Supernodal Cholesky factor of a matrix with a fixed pattern, analysed once: sorted entries
    [nnz] of the lower triangle by columns, ``size`` rows, perhaps in a good elimination order
    already; else CHOLMOD finds one."""

    def __init__(self, rows: np.ndarray, columns: np.ndarray, size: int, *,
                 is_ordered: bool = True):
        from cvxopt import matrix, spmatrix

        self._matrix = spmatrix(1.0, matrix(rows.astype(np.int64)),
                                matrix(columns.astype(np.int64)), (size, size))
        # A numpy view of cvxopt's memory saves a copy per factorisation.
        self._values = matrix(0.0, (len(rows), 1))
        self._view = np.asarray(self._values)[:, 0]
        self._rows, self._columns, self._size = rows, columns, size
        self._is_ordered = is_ordered
        self._factor = None

    def twin(self) -> "CholmodFactor":
        """Return a factor of the same pattern with memory of its own."""
        return CholmodFactor(self._rows, self._columns, self._size, is_ordered=self._is_ordered)

    def factorise(self, values: np.ndarray) -> None:
        """Factorise the matrix with these ``values`` [nnz]; NotPositiveDefiniteError if it is
        not."""
        from cvxopt import cholmod, matrix

        self._view[:] = values
        self._matrix.V = self._values
        if self._factor is None:
            order = (matrix(np.arange(self._size)),) if self._is_ordered else ()
            self._factor = cholmod.symbolic(self._matrix, *order)
        try:
            cholmod.numeric(self._matrix, self._factor)
        except ArithmeticError as error:
            raise NotPositiveDefiniteError("a pivot is not positive") from error

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for right-hand sides of shape [size] or [size, k]."""
        from cvxopt import cholmod, matrix

        work = matrix(np.asfortranarray(right.reshape(self._size, -1)))
        cholmod.solve(self._factor, work)
        return np.array(work).reshape(right.shape)


class SuperLuFactor:
    """The scipy equivalent, about five times slower and without a reused symbolic part."""

    def __init__(self, rows: np.ndarray, columns: np.ndarray, size: int, *,
                 is_ordered: bool = True):
        self._rows, self._columns, self._size = rows, columns, size
        self._is_ordered = is_ordered
        self._factor: SuperLU | None = None

    def twin(self) -> "SuperLuFactor":
        """As :meth:`CholmodFactor.twin`."""
        return SuperLuFactor(self._rows, self._columns, self._size, is_ordered=self._is_ordered)

    def factorise(self, values: np.ndarray) -> None:
        """As :meth:`CholmodFactor.factorise`."""
        from scipy.sparse.linalg import splu

        lower = sparse.csc_matrix((values, (self._rows, self._columns)), shape=(self._size,) * 2)
        whole = (lower + sparse.tril(lower, -1).T).tocsc()
        try:
            factor = splu(
                whole, permc_spec="NATURAL" if self._is_ordered else "MMD_AT_PLUS_A",
                diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError as error:
            raise NotPositiveDefiniteError("a pivot is zero") from error
        self._factor = factor
        swapped = (factor.perm_r != factor.perm_c).any()
        if swapped or factor.U.diagonal().min() <= 0:
            raise NotPositiveDefiniteError("a pivot is not positive")

    def solve(self, right: np.ndarray) -> np.ndarray:
        """As :meth:`CholmodFactor.solve`."""
        return present(self._factor, "factor").solve(np.ascontiguousarray(right))


def general_factor(rows: np.ndarray, columns: np.ndarray, size: int, *,
                   is_ordered: bool = True) -> CholmodFactor | SuperLuFactor:
    """Return a factor of the fastest installed library; arguments as for CholmodFactor."""
    kind = CholmodFactor if has_cholmod() else SuperLuFactor
    return kind(rows, columns, size, is_ordered=is_ordered)


def has_cholmod() -> bool:
    """Whether cvxopt, which brings CHOLMOD and AMD, is installed."""
    try:
        import cvxopt.cholmod  # noqa: F401
    except ImportError:
        return False
    return True
