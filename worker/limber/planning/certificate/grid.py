"""The grid of the bound, with one axis off the low-energy surface and one towards the goal.

Off the surface the energy bends up to a thousand times as strongly as along it. So the edges of a
cell differ: each refinement divides an axis by as much as the energy bends along it.
"""

from dataclasses import dataclass

import numpy as np

from limber.planning.certificate.subsolution import RIM
from limber.planning.field.interpolation.chart import Chart
from limber.planning.path_problem import GentleProblem

_FIRST_CELLS = 12_000  # cells of the first grid, over the whole sampled region
FINEST, COARSEST = 1.0 / 3.0, 0.75
"""Ratio of cell edges from one grid to the next: least and greatest."""
_ACROSS = 0.1  # fraction of the straight line that must run along the shell
_ROUND_OFF = 1e-9  # fraction of a cell
_PAD = RIM + 1  # closed cells around the grid, for its coefficients and second differences


@dataclass
class Grid:
    """Cells in the rotated frame; corner ``(i, j, k)`` is at ``origin + (i, j, k) * edges``.

    The distance to the goal is only needed in the cells ``about_goal``.
    """

    origin: np.ndarray
    axes: np.ndarray
    edges: np.ndarray
    open_cells: np.ndarray
    about_goal: np.ndarray

    @property
    def spacing(self) -> float:
        """Edge of a cube with a cell's volume [m]."""
        return float(np.cbrt(self.edges.prod()))

    def points(self, numbers: np.ndarray) -> np.ndarray:
        """Return the positions [n, 3] of corners ``numbers`` [n, 3]; halves are centres."""
        return self.origin + (numbers * self.edges) @ self.axes

    def along_edges(self, vectors: np.ndarray) -> np.ndarray:
        """Return slopes [n, 3] to the position as those along a cell's edges, times their length.
        """
        return vectors @ self.axes.T * self.edges

    def spread(self, corners: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return ``values`` [n, ...] at ``corners`` [n, 3] of the whole grid, nan elsewhere."""
        return spread(tuple(n + 1 for n in self.open_cells.shape), corners, values)


def spread(shape: tuple[int, ...], indices: np.ndarray, values: np.ndarray) -> np.ndarray:
    """Return ``values`` [n, ...] at ``indices`` [n, 3] in an array of a shape, nan elsewhere."""
    whole = np.full((*shape, *values.shape[1:]), np.nan)
    whole[tuple(indices.T)] = values
    return whole


def first_grid(problem: GentleProblem) -> tuple[Grid, np.ndarray]:
    """Return a grid over the sampled region, and the cell with the start at its centre."""
    region, start = problem.energy_field.region, problem.start
    axes = _axes(start, problem.goal.centre(problem.energy_field), region.chart)
    corners = (region.outline - start) @ axes.T
    low = np.minimum(corners.min(axis=0), 0.0)
    high = np.maximum(corners.max(axis=0), 0.0)
    spacing = float(np.cbrt(np.prod(high - low) / _FIRST_CELLS))
    before = np.ceil(-low / spacing - 0.5).astype(int) + _PAD
    after = np.ceil(high / spacing - 0.5).astype(int) + _PAD + 1
    open_cells = np.pad(np.ones(tuple(before + after - 2 * _PAD), bool), _PAD)
    return Grid(start - ((before + 0.5) * spacing) @ axes, axes, np.full(3, spacing), open_cells,
                 np.ones_like(open_cells)), before


def _axes(start: np.ndarray, goal: np.ndarray, chart: Chart) -> np.ndarray:
    """Return three unit rows: the last is normal to the shell half-way, the first as near to the
    direction from ``start`` [3] to ``goal`` [3] as that allows. Without a shell it is along it.
    """
    direction = goal - start
    length = float(np.linalg.norm(direction))
    if length == 0.0:
        return np.eye(3)
    normal = np.zeros(3)
    if chart.radius > 0.0:
        normal = 0.5 * (start + goal) - chart.pivot
        normal /= np.linalg.norm(normal)
    along = direction - (direction @ normal) * normal
    if np.linalg.norm(along) < _ACROSS * length:
        along, normal = direction, np.zeros(3)
    first = along / np.linalg.norm(along)
    if not normal.any():
        normal = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
        normal /= np.linalg.norm(normal)
    return np.stack([first, np.cross(normal, first), normal])


def refined(grid: Grid, keep: np.ndarray, about_goal: np.ndarray, cell: np.ndarray,
            ratio: float | np.ndarray = FINEST) -> tuple[Grid, np.ndarray]:
    """Return cells of ``ratio`` times the edges, for all or [3], at most 1, over ``keep``, in the
    smallest box; and the start's.

    The start stays in the centre of a cell. A new cell that overlaps a kept one is open.
    """
    indices, centre, ratio = np.argwhere(keep), cell + 0.5, np.full(3, ratio)
    low, high = np.minimum(indices.min(axis=0), cell), np.maximum(indices.max(axis=0), cell) + 1
    before = np.ceil((centre - low) / ratio - 0.5 - _ROUND_OFF).astype(int) + _PAD
    after = np.ceil((high - centre) / ratio - 0.5 - _ROUND_OFF).astype(int) + _PAD + 1
    first = centre - (before + 0.5) * ratio
    overlapped = []
    for axis, count in enumerate(before + after):
        edges = first[axis] + ratio[axis] * np.arange(count)
        overlapped.append([np.floor(edges + _ROUND_OFF).astype(int),
                           np.floor(edges + ratio[axis] - _ROUND_OFF).astype(int)])

    def cut(cells: np.ndarray) -> np.ndarray:
        padded = np.pad(cells, _PAD + 1)
        found = np.zeros(tuple(before + after), bool)
        for sides in np.ndindex(2, 2, 2):
            which = [np.clip(overlapped[axis][side] + _PAD + 1, 0, padded.shape[axis] - 1)
                     for axis, side in enumerate(sides)]
            found |= padded[np.ix_(*which)]
        return found
    return (Grid(grid.points(first[None])[0], grid.axes, ratio * grid.edges, cut(keep),
                 cut(about_goal)), before)


def descent(grid: Grid, u: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Return the descent from the start through the cells' centres [n, 3]: an approximate path."""
    reach = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    reach = reach[np.abs(reach).sum(axis=1) > 0]
    length = np.linalg.norm(reach * grid.edges, axis=1)
    path, here = [cell], cell
    while u[tuple(here)] > 0.0 and len(path) < sum(u.shape):
        near = here + reach
        within = ((near >= 0) & (near < u.shape)).all(axis=1)
        drop = (u[tuple(here)] - u[tuple(near[within].T)]) / length[within]
        best = int(np.argmax(drop))
        if not drop[best] > 0.0:
            break
        here = near[within][best]
        path.append(here)
    return grid.points(np.array(path) + 0.5)
