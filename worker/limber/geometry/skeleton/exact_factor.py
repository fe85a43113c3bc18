"""Factor of a sparse matrix with the same digits on every processor.

Libraries choose the kernels of their dense blocks by the processor, so that last digits differ
between machines. Here every operation is rounded in the order in which it is written. The points of
a scan lie around curves: the columns are short, and dense blocks would gain little.
"""

import numpy as np
import scipy.sparse as sparse

from limber.core.errors import WorkError
from limber.core.numerics.compiled import compiled_exactly
from limber.core.numerics.sparse import little_fill


class ExactFactor:
    """L D L' of a symmetric ``matrix`` [n, n], row by row, up along its elimination tree (Davis:
    Algorithm 849, a concise sparse Cholesky factorization package, 2005). ``order`` is that of
    elimination, if it is known of another matrix with this pattern. WorkError if the matrix is not
    positive definite."""

    def __init__(self, matrix: sparse.csr_matrix, order: np.ndarray | None = None):
        self.order = little_fill(matrix) if order is None else order
        lower = sparse.tril(matrix[self.order][:, self.order], format="csr")
        lower.sort_indices()
        parent, below = _analysed(lower.indptr, lower.indices)
        self._starts = np.concatenate([[0], np.cumsum(below)])
        self._factor = _factorised(lower.indptr, lower.indices, lower.data, parent, self._starts)
        if not (self._factor[2] > 0).all():
            raise WorkError("A linear system of the skeleton is singular (a pivot is 0 or less).",
                            "Many points may coincide.", "Thin the cloud.")

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for right-hand sides, shape [n, k] or [n]."""
        solution = np.empty_like(right)
        solution[self.order] = _solved(self._starts, *self._factor, np.ascontiguousarray(
            right[self.order].T.reshape(-1, len(right)))).T.reshape(right.shape)
        return solution


@compiled_exactly
def _analysed(starts: np.ndarray, columns: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Parents in the elimination tree, -1 at roots, and the entries below each pivot, [n] each."""
    count = len(starts) - 1
    parent, seen, below = np.full(count, -1), np.full(count, -1), np.zeros(count, np.int64)
    for row in range(count):
        seen[row] = row
        for p in range(starts[row], starts[row + 1]):
            k = columns[p]
            while seen[k] != row:
                if parent[k] < 0:
                    parent[k] = row
                below[k] += 1
                seen[k] = row
                k = parent[k]
    return parent, below


@compiled_exactly
def _factorised(starts: np.ndarray, columns: np.ndarray, values: np.ndarray, parent: np.ndarray,
                begins: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Row and value of each entry of L, by columns, and the pivots [n]; from the first that is not
    positive on, these are 0."""
    count = len(parent)
    rows, factor, pivot = np.empty(begins[-1], np.int64), np.empty(begins[-1]), np.zeros(count)
    ends, seen, work = begins[:-1].copy(), np.full(count, -1), np.zeros(count)
    path, chain = np.empty(count, np.int64), np.empty(count, np.int64)
    for row in range(count):
        seen[row], top = row, count
        for p in range(starts[row], starts[row + 1]):
            k, length = columns[p], 0
            work[k] = values[p]
            while seen[k] != row:
                chain[length] = k
                length += 1
                seen[k] = row
                k = parent[k]
            while length > 0:
                top -= 1
                length -= 1
                path[top] = chain[length]
        rest, work[row] = work[row], 0.0
        for k in path[top:]:
            value, work[k] = work[k], 0.0
            for p in range(begins[k], ends[k]):
                work[rows[p]] -= factor[p] * value
            factor[ends[k]], rows[ends[k]] = value / pivot[k], row
            rest -= factor[ends[k]] * value
            ends[k] += 1
        if not rest > 0.0:
            break
        pivot[row] = rest
    return rows, factor, pivot


@compiled_exactly
def _solved(begins: np.ndarray, rows: np.ndarray, factor: np.ndarray, pivot: np.ndarray,
            right: np.ndarray) -> np.ndarray:
    """The solution for right-hand sides [k, n]."""
    solution = right.copy()
    for x in solution:
        for k in range(len(pivot)):
            for p in range(begins[k], begins[k + 1]):
                x[rows[p]] -= factor[p] * x[k]
        for k in range(len(pivot) - 1, -1, -1):
            x[k] /= pivot[k]
            for p in range(begins[k], begins[k + 1]):
                x[k] -= factor[p] * x[rows[p]]
    return solution
