"""Sparse symmetric matrices: CHOLMOD (through cvxopt) and its order of elimination.

Limber's own factors are :mod:`limber.mechanics.linear.supernodal`, for meshes of branches, and
:mod:`limber.geometry.skeleton.exact_factor`, whose digits are the same on every processor.
"""

import numpy as np
from scipy import sparse


class NotPositiveDefiniteError(ArithmeticError):
    """The matrix has a pivot that is not positive."""


class CholmodFactor:
    """Supernodal Cholesky factor of a matrix with a fixed pattern, analysed once: sorted entries
    [nnz] of the lower triangle by columns, ``size`` rows, in a good elimination order already."""

    def __init__(self, rows: np.ndarray, columns: np.ndarray, size: int):
        from cvxopt import matrix, spmatrix

        self._matrix = spmatrix(1.0, matrix(rows.astype(np.int64)),
                                matrix(columns.astype(np.int64)), (size, size))
        # A numpy view of cvxopt's memory saves a copy per factorisation.
        self._values = matrix(0.0, (len(rows), 1))
        self._view = np.asarray(self._values)[:, 0]
        self._rows, self._columns, self._size = rows, columns, size
        self._factor = None

    def twin(self) -> "CholmodFactor":
        """Return a factor of the same pattern with memory of its own."""
        return CholmodFactor(self._rows, self._columns, self._size)

    def factorise(self, values: np.ndarray) -> None:
        """Factorise the matrix with these ``values`` [nnz]; NotPositiveDefiniteError if it is
        not."""
        from cvxopt import cholmod, matrix

        self._view[:] = values
        self._matrix.V = self._values
        if self._factor is None:
            self._factor = cholmod.symbolic(self._matrix, matrix(np.arange(self._size)))
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


def little_fill(graph: sparse.csr_matrix) -> np.ndarray:
    """Return an order of elimination (new to old) of little fill, by approximate minimum degree on
    a symmetric pattern [n, n]."""
    from cvxopt import amd, matrix, spmatrix

    lower = sparse.tril(graph).tocoo()
    pattern = spmatrix(1.0, matrix(lower.row.astype(np.int64)),
                       matrix(lower.col.astype(np.int64)), graph.shape)
    return np.array(amd.order(pattern), np.int64).ravel()
