"""Factor of a sparse matrix with the same digits on every processor.

Libraries choose the kernels of their dense blocks by the processor, so that last digits differ
between machines. Here every operation is rounded in the order in which it is written. The points of
a scan lie around curves: the columns are short, and dense blocks would gain little.
"""

import numpy as np
import scipy.sparse as sparse

from limber.core.errors import WorkError
from limber.core.numerics.sparse import little_fill
from limber.kernels import Kernel

_LOWER = ("starts int32[starts]", "columns int32[entries]")
_analysed = Kernel("exact_analysed", *_LOWER, "out parent int64[nodes]", "out below int64[nodes]")
_factorised = Kernel(
    "exact_factorised", *_LOWER, "values float64[entries]", "parent int64[nodes]",
    "begins int64[begins]", "out rows int64[below]", "out factor float64[below]",
    "out pivot float64[nodes]")
_solved = Kernel(
    "exact_solved", "begins int64[begins]", "rows int64[below]", "factor float64[below]",
    "pivot float64[nodes]", "out sides float64[sides, nodes]")


class ExactFactor:
    """L D L' of a symmetric ``matrix`` [n, n], row by row, up along its elimination tree (Davis:
    Algorithm 849, a concise sparse Cholesky factorization package, 2005). ``order`` is that of
    elimination, if it is known of another matrix with this pattern. WorkError if the matrix is not
    positive definite."""

    def __init__(self, matrix: sparse.csr_matrix, order: np.ndarray | None = None):
        self.order = little_fill(matrix) if order is None else order
        lower = sparse.tril(matrix[self.order][:, self.order], format="csr")
        lower.sort_indices()
        parent, below = np.empty((2, lower.shape[0]), np.int64)
        _analysed.of(lower.indptr, lower.indices, parent, below)
        self._starts = np.concatenate([[0], np.cumsum(below)])
        entries = int(self._starts[-1])
        self._factor = np.empty(entries, np.int64), np.empty(entries), np.empty(len(parent))
        _factorised.of(lower.indptr, lower.indices, lower.data, parent, self._starts, *self._factor)
        if not (self._factor[2] > 0).all():
            raise WorkError("A linear system of the skeleton is singular (a pivot is 0 or less).",
                            "Many points may coincide.", "Thin the cloud.")

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for right-hand sides, shape [n, k] or [n]."""
        solution = np.empty_like(right)
        sides = np.array(right[self.order].T.reshape(-1, len(right)), order="C")
        _solved(self._starts, *self._factor, sides)
        solution[self.order] = sides.T.reshape(right.shape)
        return solution
