"""The grid of the bound, with one axis off the low-energy surface and one towards the goal.

Off the surface the energy bends up to a thousand times as strongly as along it. So the edges of a
cell differ: each refinement divides an axis by as much as the energy bends along it.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from limber.core.numerics.rigid import any_normal
from limber.planning.certificate.subsolution import (
    CURVATURE_FACTOR,
    RIM,
    Terrain,
    corner_values,
    second_differences,
)
from limber.planning.field.chart import Chart
from limber.planning.path_problem import GentleProblem

_FIRST_CELLS = 12_000  # cells of the first grid, over the whole sampled region
FINEST, COARSEST = 1.0 / 3.0, 0.75
"""Ratio of cell edges from one grid to the next: least and greatest."""
_ACROSS = 0.1  # fraction of the straight line that must run along the shell
_ROUND_OFF = 1e-9  # fraction of a cell
_PAD = RIM + 1  # closed cells around the grid, for its coefficients and second differences


@dataclass
class Grid:
    """Cells in the rotated frame; corner ``(i, j, k)`` is at ``origin + (i, j, k) * edges``. The
    distance to the goal is only needed in the cells ``about_goal``."""

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
        """Return slopes [n, 3] to the position as those along a cell's edges, by their length."""
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
    direction from ``start`` [3] to ``goal`` [3] as that allows. Without a shell it is along it."""
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
        normal = any_normal(first)
    return np.stack([first, np.cross(normal, first), normal])


def refined(grid: Grid, keep: np.ndarray, about_goal: np.ndarray, cell: np.ndarray,
            ratio: float | np.ndarray = FINEST) -> tuple[Grid, np.ndarray]:
    """Return cells of ``ratio`` (at most 1) times the edges over ``keep`` in the smallest box, and
    the start's, centred on the start. A new cell that overlaps a kept one is open."""
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


# Goal data on the cells of a grid: its position and the cost from there to it.

_BEYOND = 1.2  # factor on the steepest measured growth of the goal's distance
_FLAT = 0.5  # least fraction of that growth that its mean counts as


@dataclass(frozen=True)
class AboutGoal:
    """A signed cost to the goal, negative inside, where ``known``: each point of the goal is in a
    cell with all coefficients there, and the cost's spline is at most ``slack``. ``meets``: an open
    cell may have a point of the goal. ``near``: the next grid's queried cells."""

    known: np.ndarray
    cost: np.ndarray
    inside: np.ndarray
    slack: float
    meets: bool
    near: np.ndarray


def about_goal(problem: GentleProblem, grid: Grid, ground: Terrain) -> AboutGoal:
    """Return the goal data. A spline with a function's values as coefficients differs from it by
    ``h^2 / 8 sum_i max |second derivative|``."""
    edges, shape = ground.edges, ground.open_cells.shape
    cells = np.argwhere(ground.active & grid.about_goal)
    nothing = np.zeros(shape, bool)
    if len(cells) == 0:
        return AboutGoal(nothing, np.zeros(shape), nothing, 0.0, False, nothing)
    goal = problem.bounded_goal
    away = (goal.distance(problem.energy_field, grid.points(cells + 0.5))
            - goal.tolerance)
    # In the bounding box of these cells only, with a margin layer of unknown values.
    low, high = np.maximum(cells.min(axis=0) - 1, 0), cells.max(axis=0) + 2
    box = tuple(map(slice, low, high))
    open_cells = ground.open_cells[box]
    distance = spread(open_cells.shape, cells - low, away)
    filled = np.nan_to_num(distance, nan=np.inf)
    growth, slope = _growth(distance, edges)
    corners = tuple(map(slice, low, high + 1))
    rate = np.where(ground.level[box], ground.floor,
                    corner_values(ground.rate[corners]).mean(axis=0))
    cost = _cost_left(distance / slope, goal.tolerance / slope, rate, edges)
    curved = CURVATURE_FACTOR / 8.0 * sum(
        scipy.ndimage.maximum_filter(second, 3) for second in second_differences(cost))
    half = 0.5 * float(np.linalg.norm(edges))
    touching = open_cells & (filled <= growth * half)
    inside = filled < -growth * half
    border = touching & ~inside
    slack = float(curved[border].max()) if border.any() else 0.0

    def whole(part: np.ndarray) -> np.ndarray:
        out = np.zeros(shape, part.dtype)
        out[box] = part
        return out
    # A grasp's distance is exact, and used farther than the next cells. A target's is not: where
    # the target moves far with the grasp, cells far from the goal would count as near it.
    known = filled <= 3.0 * half if growth.max() <= 1.0 else (
        scipy.ndimage.binary_dilation(touching, np.ones((3, 3, 3))) & np.isfinite(distance))
    # A cell of the next grid queries up to 4 of its edges away, 7 times half its diagonal; its
    # centre is within ``half`` of this one's.
    return AboutGoal(whole(known), whole(np.nan_to_num(cost)),
                     whole(inside), slack, bool(touching.any()),
                     whole(filled <= growth * 8.0 * half))


def short_enough(problem: GentleProblem, grid: Grid, open_cells: np.ndarray, near: np.ndarray,
                 cell: np.ndarray) -> np.ndarray:
    """Return the open cells that a path no longer than allowed may enter: an ellipsoid's, about the
    start and the cells ``near`` the goal."""
    numbers = np.argwhere(open_cells)
    nearest = scipy.ndimage.distance_transform_edt(
        ~near, sampling=grid.edges, return_distances=False, return_indices=True)[:, *numbers.T].T
    away = sum(np.linalg.norm(grid.edges * (numbers - other), axis=1) for other in (cell, nearest))
    within = np.zeros_like(open_cells)
    # Half a diagonal in the cell itself, as much in the goal's, and at both ends of the path there.
    within[tuple(numbers.T)] = away - 1.5 * np.linalg.norm(grid.edges) <= problem.longest
    within[tuple(cell)] = True
    together = scipy.ndimage.label(within, np.ones((3, 3, 3)))[0]
    return together == together[tuple(cell)]


def _cost_left(length: np.ndarray, depth: np.ndarray, rate: np.ndarray, edges: np.ndarray,
               ) -> np.ndarray:
    """Return the cost of a length to the goal at the rate half-way, nan where not known. A single
    rate for all sides would be the smallest. Inside, the length flattens out towards the goal's
    middle, ``depth`` [m] below its surface."""
    flat = np.maximum(length, -depth)
    flat = np.where(flat < 0.0, flat + flat**2 / (2.0 * depth), flat)
    growing = sum(np.gradient(rate, edges[axis], axis=axis)
                  * np.gradient(length, edges[axis], axis=axis)
                  for axis in range(3))
    mid_rate = rate - 0.5 * length * np.nan_to_num(growing)
    return flat * np.where(length > 0.0, np.clip(mid_rate, 0.5 * rate, 1.5 * rate), rate)


def _growth(distance: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """The largest growth of the goal's distance per metre in each cell, and a smooth mean to divide
    by. It needs no reserve: the sub-solution is scaled down wherever it is too steep."""
    ahead, behind = [], []
    for axis, edge in enumerate(edges):
        unknown = np.full_like(distance.take([0], axis), np.nan)
        step = np.diff(distance, axis=axis) / edge
        ahead.append(np.concatenate([step, unknown], axis))
        behind.append(np.concatenate([unknown, step], axis))
    either = np.nan_to_num(np.stack([ahead, behind]))
    known = np.isfinite([ahead, behind])
    steepest = np.abs(either).max(axis=0)
    if steepest.max() <= 1.0 + 1e-9:  # a grasp's distance: by at most a metre per metre
        return np.ones_like(distance), np.ones_like(distance)
    growth = scipy.ndimage.maximum_filter(np.linalg.norm(steepest, axis=0), 3)
    mean = np.linalg.norm(either.sum(axis=0) / np.maximum(known.sum(axis=0), 1), axis=0)
    weight = known.any(axis=(0, 1)).astype(float)
    smooth = scipy.ndimage.uniform_filter(mean * weight, 3) / np.maximum(
        scipy.ndimage.uniform_filter(weight, 3), 1e-9)
    # A target's by the field's rate, and a reserve.
    return _BEYOND * growth, np.maximum(smooth, _FLAT * growth) + 1e-12
