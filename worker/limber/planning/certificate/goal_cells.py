"""Goal data on the cells of a grid: its position and the cost from there to it."""

from dataclasses import dataclass

import numpy as np
import scipy

from limber.planning.certificate.cell_bounds import CURVATURE_FACTOR
from limber.planning.certificate.grid import Grid, spread
from limber.planning.certificate.subsolution import Terrain, corner_values, second_differences
from limber.planning.path_problem import GentleProblem

_BEYOND = 1.2  # factor on the steepest measured growth of the goal's distance
_FLAT = 0.5  # least fraction of that growth that its mean counts as


@dataclass(frozen=True)
class AboutGoal:
    """A signed cost to the goal, negative inside it, and the cells where it is known.

    Every point of the goal is in a cell that has all its coefficients among those ``known``; there
    the spline of the ``cost`` is at most ``slack``. ``inside``: cells entirely inside the goal.
    ``meets``: whether any open cell may contain a point of the goal. ``near``: where the queried
    cells of the next grid are.
    """

    known: np.ndarray
    cost: np.ndarray
    inside: np.ndarray
    slack: float
    meets: bool
    near: np.ndarray


def about_goal(problem: GentleProblem, grid: Grid, ground: Terrain) -> AboutGoal:
    """Return the goal data.

    A spline with a function's values as coefficients differs from it by ``h^2 / 8 sum_i max |second
    derivative|``.
    """
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
    """Return the cost of a ``length`` [m] to the goal, at the ``rate`` half-way, for cells with
    ``edges`` [3] [m]; nan where not known.

    A single rate for all sides of the goal would be the smallest of them. Inside, where no
    condition holds, the length flattens out to a goal's middle ``depth`` [m] below its surface: it
    has no tip there.
    """
    flat = np.maximum(length, -depth)
    flat = np.where(flat < 0.0, flat + flat**2 / (2.0 * depth), flat)
    growing = sum(np.gradient(rate, edges[axis], axis=axis)
                  * np.gradient(length, edges[axis], axis=axis)
                  for axis in range(3))
    mid_rate = rate - 0.5 * length * np.nan_to_num(growing)
    return flat * np.where(length > 0.0, np.clip(mid_rate, 0.5 * rate, 1.5 * rate), rate)


def _growth(distance: np.ndarray, edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest growth of the goal's ``distance`` per metre in each cell, and a smooth
    mean, of the same shape; by which the distance is divided to be a length.

    The mean needs no reserve: the sub-solution is scaled down wherever it is too steep.
    """
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
