"""Cells in the chart of the low-energy surface, cut where a question needs it.

Off the shell, a force grows a hundred times as fast as along it. Cells in the chart's coordinates
(:mod:`limber.planning.field.chart`) are therefore cut along some axes and in some places only. They
tell whether the goal can be reached (:mod:`limber.planning.certificate.feasibility`), and which way
exceeds the limits least (:mod:`limber.planning.planners.least_violation`).
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix, csr_matrix
from scipy.sparse.csgraph import (
    breadth_first_order,
    connected_components,
    dijkstra,
    minimum_spanning_tree,
)

from limber.planning.field.chart import Chart
from limber.planning.field.energy_field import EnergyField

_ALONG, _ACROSS = 20, 40  # cells along the surface in each direction; across it
_EVEN = 26  # cells in each direction without a surface
_WIDE = 1 << 20  # more cells than along any axis
_CORNERS = np.array([(i, j, k) for i in (0, 1) for j in (0, 1) for k in (0, 1)])
STENCIL = np.unique(np.concatenate([_CORNERS + side * step for step in np.eye(3, dtype=int)
                                     for side in (-1, 0, 1)]), axis=0)
_AHEAD = np.array([(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)
                   if (i, j, k) > (0, 0, 0)])


def _column(offset: np.ndarray) -> int:
    return int(np.flatnonzero((offset == STENCIL).all(axis=1))[0])


AT = np.array([_column(corner) for corner in _CORNERS])
BESIDE = np.array([[[_column(corner - step), _column(corner + step)] for corner in _CORNERS]
                    for step in np.eye(3, dtype=int)])


@dataclass(frozen=True)
class Cells:
    """Cells ``numbers`` [n, 3]; corner ``k`` [3] is at ``low + k * edges`` in the plain chart."""

    field: EnergyField
    low: np.ndarray
    edges: np.ndarray
    numbers: np.ndarray

    @classmethod
    def over(cls, field: EnergyField) -> "Cells":
        """Return cells over the sampled region."""
        chart = field.region.chart.plain
        flat = chart.map(field.region.accepted)
        low, high = flat.min(axis=0), flat.max(axis=0)
        counts = np.array([_ALONG, _ALONG, _ACROSS] if chart.radius > 0.0 else 3 * [_EVEN])
        return cls(field, low, np.maximum(high - low, 1e-9), np.zeros((1, 3), int)).cut(counts)

    def take(self, which: np.ndarray) -> "Cells":
        return Cells(self.field, self.low, self.edges, self.numbers[which])

    def cut(self, parts: np.ndarray) -> "Cells":
        """Return the cells cut into ``parts`` [3] along each axis."""
        inner = np.stack(np.meshgrid(*map(np.arange, parts), indexing="ij"), -1).reshape(-1, 3)
        return Cells(self.field, self.low, self.edges / parts,
                      (self.numbers[:, None] * parts + inner).reshape(-1, 3))

    def middles(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the middles in the chart's coordinates and in space [m], [n, 3] each."""
        flat = self.low + (self.numbers + 0.5) * self.edges
        return flat, self.chart.curved(flat)

    def nodes(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the positions [m, 3] of all corners and of those next to them along an axis, and
        the numbers of each cell's in ``STENCIL``, [n, 32]."""
        keys, where = np.unique(_keys(self.numbers[:, None] + STENCIL), return_inverse=True)
        indices = np.stack([keys // _WIDE**2, keys // _WIDE % _WIDE, keys % _WIDE], axis=1) - 1
        return (self.chart.curved(self.low + indices * self.edges),
                where.reshape(len(self.numbers), -1))

    def holding(self, point: np.ndarray) -> np.ndarray:
        """Return which cells contain ``point`` [3] or touch the cell that does, bool [n]."""
        number = np.floor((self.chart.map(point)[0] - self.low) / self.edges)
        return (np.abs(self.numbers - number) <= 1).all(axis=1)

    def connected(self, some: np.ndarray) -> np.ndarray:
        """Return which cells are connected to any of ``some``, bool [n]."""
        together = connected_components(self._neighbours(), directed=False)[1]
        return np.isin(together, together[some])

    def path(self, begin: np.ndarray, ends: np.ndarray, dear: np.ndarray | None = None,
             ) -> np.ndarray | None:
        """Return the cells [k] of the shortest path from ``begin`` to ``ends``, where a metre
        counts ``dear`` [n] times; None if not connected."""
        if not begin.any() or not ends.any():
            return None
        away, before, _ = dijkstra(self._neighbours(dear), directed=False, min_only=True,
                                   indices=np.flatnonzero(begin), return_predecessors=True)
        last = np.flatnonzero(ends)[np.argmin(away[ends])]
        if not np.isfinite(away[last]):
            return None
        numbers = [last]
        while before[numbers[-1]] >= 0:
            numbers.append(before[numbers[-1]])
        return np.array(numbers[::-1])

    def levels(self, heights: np.ndarray, first: int) -> np.ndarray:
        """Return the least level [n] at which cells no higher connect each to the ``first``, from
        ``heights`` above 0 [n]; infinite where nothing does."""
        graph = self._neighbours()
        rows, columns = graph.nonzero()
        graph.data = np.maximum(heights[rows], heights[columns])
        order, before = breadth_first_order(minimum_spanning_tree(graph), first, directed=False)
        found = np.full(len(heights), np.inf)
        found[order] = heights[order]
        for cell in order[1:]:
            found[cell] = max(found[before[cell]], found[cell])
        return found

    def _neighbours(self, dear: np.ndarray | None = None) -> csr_matrix:
        """Return the distances [m] in the chart of cells that touch, [n, n], each once; longer by
        ``dear``."""
        keys = _keys(self.numbers)
        order = np.argsort(keys)
        rows, columns, lengths = [], [], []
        for step in _AHEAD:
            shifted = _keys(self.numbers + step)
            found = order[np.searchsorted(keys, shifted, sorter=order).clip(max=len(keys) - 1)]
            beside = np.flatnonzero(keys[found] == shifted)
            rows.append(beside)
            columns.append(found[beside])
            lengths.append(np.linalg.norm(step * self.edges) * (
                np.ones(len(beside)) if dear is None else np.maximum(dear[beside],
                                                                     dear[found[beside]])))
        pairs = np.concatenate(rows), np.concatenate(columns)
        return coo_matrix((np.concatenate(lengths), pairs), shape=2 * (len(keys),)).tocsr()

    @property
    def chart(self) -> Chart:
        """The plain chart of the field's region."""
        return self.field.region.chart.plain


def _keys(numbers: np.ndarray) -> np.ndarray:
    """Return one number for each of ``numbers`` [..., 3], of which none is below -1."""
    x, y, z = np.moveaxis(numbers + 1, -1, 0)
    return (x * _WIDE + y) * _WIDE + z
