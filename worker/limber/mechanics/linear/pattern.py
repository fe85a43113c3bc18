"""Elimination order, sparsity pattern and vector layout of the elements' stiffness."""

import copy
from collections.abc import Sequence

import numpy as np
import scipy.sparse as sp

from limber.mechanics.elements.forces import lanes_last
from limber.mechanics.elements.stiffness_pairs import LANES
from limber.mechanics.linear.factor import elimination_order

_SCRATCH = 9
"""Length of the scratch space behind the values for entries of constrained nodes."""


class Pattern:
    """Lower triangle by columns of the free nodes' stiffness, three rows and columns per node.

    Args:
        tets: Node indices, shape [tet_count, n].
        node_count: Nodes of the mesh.
        free: Whether a node is free, shape [node_count].
        cliques: Further groups of coupled nodes (pinned patches).

    Attributes:
        order: Free nodes in elimination order; position: its inverse, -1 if constrained.
        node_starts, node_rows: The same triangle on nodes, by columns.
        diagonal: Positions of the diagonal, shape [3 free nodes].
    """

    def __init__(self, tets: np.ndarray, node_count: int, free: np.ndarray,
                 cliques: Sequence[np.ndarray] = ()):
        graph = _node_graph(tets, node_count, cliques)
        kept = np.flatnonzero(free)
        self.order = kept[elimination_order(graph[kept][:, kept])]
        self.position = np.full(node_count, -1)
        self.position[self.order] = np.arange(len(self.order))
        lower = sp.tril(graph[self.order][:, self.order]).tocsc()
        lower.sort_indices()
        count = np.diff(lower.indptr)
        self.node_starts, self.node_rows = lower.indptr, lower.indices
        self._keys = np.repeat(np.arange(len(count)), count) * node_count + lower.indices
        self.length = 3 * count
        self.start = np.concatenate([[0], np.cumsum(9 * count - 3)])
        self.value_count = int(self.start[-1])
        begin = self.start[:-1]
        self.diagonal = np.stack([begin, begin + self.length, begin + 2 * self.length - 1],
                                 axis=1).ravel()

    @property
    def size(self) -> int:
        """Number of equations."""
        return 3 * len(self.order)

    def scratch_values(self) -> np.ndarray:
        """Return zeros for the values, including the scratch space behind them."""
        return np.zeros(self.value_count + _SCRATCH)

    def slots(self, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return, for pairs of nodes, the start of their block and that column's length."""
        one, two = self.position[first], self.position[second]
        row, column = np.maximum(one, two), np.minimum(one, two)
        inside = column >= 0
        key = np.where(inside, column * len(self.position) + row, self._keys[0])
        found = np.searchsorted(self._keys, key)
        safe = np.where(inside, column, 0)
        slot = self.start[safe] + 3 * (found - self.node_starts[safe])
        return (np.where(inside, slot, self.value_count),
                np.where(inside, self.length[safe], 4))

    def scalar_entries(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the positions of entries xx, yy and zz of pairs of nodes, shape [..., 3]."""
        slot, length = self.slots(first, second)
        return np.stack([slot, slot + length, slot + 2 * length - 1], axis=-1)

    def entries(self) -> tuple[np.ndarray, np.ndarray]:
        """Return row and column of each value."""
        rows = np.empty(self.value_count, np.int64)
        columns = np.empty(self.value_count, np.int64)
        block_column = np.repeat(np.arange(len(self.length)), np.diff(self.node_starts))
        rank = np.arange(len(self.node_rows)) - self.node_starts[block_column]
        for j in range(3):
            base = (self.start[block_column] + j * self.length[block_column]
                    - (1 if j == 2 else 0) + 3 * rank - j)
            for i in range(3):
                keep = (rank > 0) | (i >= j)
                rows[base[keep] + i] = 3 * self.node_rows[keep] + i
                columns[base[keep] + i] = 3 * block_column[keep] + j
        return rows, columns


class LaneLayout:
    """Elements of a pattern in batches; element as last axis, earlier eliminated nodes first.

    Attributes:
        nodes [batch, n, LANES], gradients [batch, q, n, 3, LANES], weights [batch, q, LANES], slots
        and lengths [batch, pairs, LANES]: the arguments of the stiffness kernel.
    """

    def __init__(self, pattern: Pattern, tets: np.ndarray, gradients: np.ndarray,
                 weights: np.ndarray):
        position = pattern.position[tets]
        turn = np.argsort(position, axis=1, kind="stable")
        # Neighbours in the elimination order are neighbours in memory.
        order = np.argsort(position.max(axis=1), kind="stable")
        padding = -len(order) % LANES
        self._order = np.concatenate([order, np.repeat(order[-1:], padding)])
        self._real = len(order)
        self._turn = turn = turn[self._order]
        nodes = np.take_along_axis(tets[self._order], turn, axis=1)
        self.nodes = lanes_last(nodes.astype(np.int32))
        self._place(gradients, weights)
        later, earlier = np.tril_indices(tets.shape[1])
        slots, lengths = pattern.slots(nodes[:, later], nodes[:, earlier])
        self.slots = lanes_last(slots.astype(np.int32))
        self.lengths = lanes_last(lengths.astype(np.int32))

    def moved(self, gradients: np.ndarray, weights: np.ndarray) -> "LaneLayout":
        """Return the layout of the same tetrahedra at other positions."""
        other = copy.copy(self)
        other._place(gradients, weights)
        return other

    def _place(self, gradients: np.ndarray, weights: np.ndarray) -> None:
        weights = weights[self._order].copy()
        weights[self._real:] = 0.0
        self.weights = lanes_last(weights)
        self.gradients = lanes_last(np.swapaxes(np.take_along_axis(
            gradients[self._order], self._turn[:, None, None, :], axis=3), 2, 3))

    def per_element(self, values: np.ndarray) -> np.ndarray:
        """Return one number per tetrahedron in this layout, shape [batch, LANES]."""
        return values[self._order].reshape(-1, LANES)

    def per_point(self, values: np.ndarray) -> np.ndarray:
        """Return values [tet_count, q, k] in this layout, shape [batch, q, k, LANES]."""
        return lanes_last(values[self._order])


def _node_graph(tets: np.ndarray, node_count: int, cliques: Sequence[np.ndarray]) -> sp.csr_matrix:
    per_tet = tets.shape[1]
    nodes = np.concatenate([tets.ravel(), *(np.asarray(c).ravel() for c in cliques)])
    sizes = np.concatenate([np.full(len(tets), per_tet), [len(c) for c in cliques]]).astype(int)
    groups = np.repeat(np.arange(len(sizes)), sizes)
    incidence = sp.csr_matrix((np.ones(len(nodes), np.float32), (groups, nodes)),
                              shape=(len(sizes), node_count))
    return (incidence.T @ incidence).tocsr()
