"""Factorisation of a symmetric matrix whose pattern stays and whose values change.

Limber's own supernodal factor, made for slender branches; for the dense kernels of bulky meshes
CHOLMOD (through cvxopt), or SuperLU where cvxopt is missing.
"""

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from limber.mechanics.linear.fronts import make_fronts, postordered
from limber.mechanics.linear.supernodal import NotPositiveDefiniteError, SupernodalFactor
from limber.threads import one_thread

if TYPE_CHECKING:
    from limber.mechanics.linear.pattern import Pattern

_MOST_FLOPS = 1e11
"""Of a factorisation that Limber's own loops take on; at 1.5e10 they are still 1.7 times as fast
as CHOLMOD, whose share of fast dense kernels grows with the fronts."""


class CholmodFactor:
    """Supernodal Cholesky factor; the symbolic part is made once.

    Args:
        rows, columns: Entries of the lower triangle by columns, sorted, shape [nnz].
        size: Rows of the matrix.
    """

    def __init__(self, rows: np.ndarray, columns: np.ndarray, size: int):
        from cvxopt import matrix, spmatrix

        self._matrix = spmatrix(1.0, matrix(rows.astype(np.int64)),
                                matrix(columns.astype(np.int64)), (size, size))
        # A numpy view on cvxopt's own memory: one copy less for each factorisation.
        self._values = matrix(0.0, (len(rows), 1))
        self._view = np.asarray(self._values)[:, 0]
        self._rows, self._columns, self._size = rows, columns, size
        self._factor = None

    def twin(self) -> "CholmodFactor":
        """Return a factor of the same pattern with memory of its own."""
        return CholmodFactor(self._rows, self._columns, self._size)

    def factorise(self, values: np.ndarray) -> None:
        """Factorise the matrix with these ``values``, shape [nnz].

        Raises:
            NotPositiveDefiniteError: it is not positive definite.
        """
        from cvxopt import cholmod, matrix

        self._view[:] = values
        self._matrix.V = self._values
        if self._factor is None:
            # The order of elimination is ours, found once on nodes instead of rows.
            self._factor = cholmod.symbolic(self._matrix, matrix(np.arange(self._size)))
        try:
            cholmod.numeric(self._matrix, self._factor)
        except ArithmeticError as error:
            raise NotPositiveDefiniteError("a pivot is not positive") from error

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for right sides of shape [size] or [size, k]."""
        from cvxopt import cholmod, matrix

        work = matrix(np.asfortranarray(right.reshape(self._size, -1)))
        cholmod.solve(self._factor, work)
        return np.array(work).reshape(right.shape)


class SuperLuFactor:
    """The same from scipy, about five times slower and without a reused symbolic part."""

    def __init__(self, rows: np.ndarray, columns: np.ndarray, size: int):
        self._rows, self._columns, self._size = rows, columns, size
        self._factor = None

    def twin(self) -> "SuperLuFactor":
        """As :meth:`CholmodFactor.twin`."""
        return SuperLuFactor(self._rows, self._columns, self._size)

    def factorise(self, values: np.ndarray) -> None:
        """As :meth:`CholmodFactor.factorise`."""
        from scipy.sparse.linalg import splu

        lower = sp.csc_matrix((values, (self._rows, self._columns)), shape=(self._size,) * 2)
        whole = (lower + sp.tril(lower, -1).T).tocsc()
        try:
            self._factor = splu(whole, permc_spec="NATURAL", diag_pivot_thresh=0.0,
                                options={"SymmetricMode": True})
        except RuntimeError as error:
            raise NotPositiveDefiniteError("a pivot is zero") from error
        swapped = (self._factor.perm_r != np.arange(self._size)).any()
        if swapped or self._factor.U.diagonal().min() <= 0:
            raise NotPositiveDefiniteError("a pivot is not positive")

    def solve(self, right: np.ndarray) -> np.ndarray:
        """As :meth:`CholmodFactor.solve`."""
        return self._factor.solve(np.ascontiguousarray(right))


Factor = SupernodalFactor | CholmodFactor | SuperLuFactor


def make_factor(pattern: "Pattern") -> Factor:
    """Return the fastest factor for a pattern that is installed; one thread from now on.

    The pattern's order of elimination has loaded cvxopt, the last of the libraries to limit.
    """
    one_thread()
    fronts = make_fronts(pattern.node_starts, pattern.node_rows)
    if fronts.flops <= _MOST_FLOPS:
        return SupernodalFactor(fronts)
    rows, columns = pattern.entries()
    try:
        import cvxopt.cholmod  # noqa: F401
    except ImportError:
        return SuperLuFactor(rows, columns, pattern.size)
    return CholmodFactor(rows, columns, pattern.size)


def elimination_order(graph: sp.csr_matrix) -> np.ndarray:
    """Return an order of nodes (new to old) with little fill, by approximate minimum degree.

    Each subtree of the elimination is a run (postorder).

    Args:
        graph: Symmetric pattern of the nodes, [n, n].
    """
    try:
        from cvxopt import amd, matrix, spmatrix
    except ImportError:
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        order = reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
        return postordered(graph, order)
    lower = sp.tril(graph).tocoo()
    pattern = spmatrix(1.0, matrix(lower.row.astype(np.int64)),
                       matrix(lower.col.astype(np.int64)), graph.shape)
    return postordered(graph, np.array(amd.order(pattern), np.int64).ravel())
