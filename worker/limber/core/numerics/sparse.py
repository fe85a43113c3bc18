"""Sparse symmetric matrices: CHOLMOD (through cvxopt) and its order of elimination; where it is not
installed, as in Blender's zips, SuperLU from scipy.

Limber's own factors are :mod:`limber.mechanics.linear.supernodal`, for meshes of branches, and
:mod:`limber.geometry.skeleton.exact_factor`, whose digits are the same on every processor.
"""

from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import reverse_cuthill_mckee

from limber.core.not_none import present

if TYPE_CHECKING:
    from scipy.sparse.linalg import SuperLU


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


class SuperLuFactor:
    """The scipy equivalent, about five times slower and without a reused symbolic part."""

    def __init__(self, rows: np.ndarray, columns: np.ndarray, size: int):
        self._rows, self._columns, self._size = rows, columns, size
        self._factor: SuperLU | None = None

    def twin(self) -> "SuperLuFactor":
        """As :meth:`CholmodFactor.twin`."""
        return SuperLuFactor(self._rows, self._columns, self._size)

    def factorise(self, values: np.ndarray) -> None:
        """As :meth:`CholmodFactor.factorise`."""
        from scipy.sparse.linalg import splu

        lower = sparse.csc_matrix((values, (self._rows, self._columns)), shape=(self._size,) * 2)
        whole = (lower + sparse.tril(lower, -1).T).tocsc()
        try:
            factor = splu(whole, permc_spec="NATURAL", diag_pivot_thresh=0.0,
                          options={"SymmetricMode": True})
        except RuntimeError as error:
            raise NotPositiveDefiniteError("a pivot is zero") from error
        self._factor = factor
        if (factor.perm_r != factor.perm_c).any() or factor.U.diagonal().min() <= 0:
            raise NotPositiveDefiniteError("a pivot is not positive")

    def solve(self, right: np.ndarray) -> np.ndarray:
        """As :meth:`CholmodFactor.solve`."""
        return present(self._factor, "factor").solve(np.ascontiguousarray(right))


def general_factor(rows: np.ndarray, columns: np.ndarray, size: int,
                   ) -> CholmodFactor | SuperLuFactor:
    """Return a factor of the fastest installed library; arguments as for CholmodFactor."""
    return (CholmodFactor if find_spec("cvxopt") else SuperLuFactor)(rows, columns, size)


def little_fill(graph: sparse.csr_matrix) -> np.ndarray:
    """Return an order of elimination (new to old) of little fill, by approximate minimum degree on
    a symmetric pattern [n, n]."""
    if not find_spec("cvxopt"):
        return reverse_cuthill_mckee(sparse.csr_matrix(graph), symmetric_mode=True).astype(np.int64)
    from cvxopt import amd, matrix, spmatrix

    lower = sparse.tril(graph).tocoo()
    pattern = spmatrix(1.0, matrix(lower.row.astype(np.int64)),
                       matrix(lower.col.astype(np.int64)), graph.shape)
    return np.array(amd.order(pattern), np.int64).ravel()
