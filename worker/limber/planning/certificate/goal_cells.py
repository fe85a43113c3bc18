"""Goal data on the cells of a grid: its position and the cost from there to it."""

from dataclasses import dataclass

import numpy as np
import scipy

from limber.planning.certificate.cell_bounds import CURVATURE_FACTOR
from limber.planning.certificate.grid import Grid, spread
from limber.planning.certificate.subsolution import Terrain, corner_values, second_differences
from limber.planning.path_problem import GentleProblem

_BEYOND = 1.2  # factor on the steepest measured growth of the goal's distance


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
    growth = _growth(distance, np.abs(filled) <= 4.0 * edges.max(), edges)
    corners = tuple(map(slice, low, high + 1))
    rate = np.where(ground.level[box], ground.floor,
                    corner_values(ground.rate[corners]).mean(axis=0))
    cost = _cost_left(distance / growth, goal.tolerance / growth, rate, edges)
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
    # A cell of the next grid queries up to 4 of its edges away, 7 times half its diagonal; its
    # centre is within ``half`` of this one's.
    return AboutGoal(whole(filled <= growth * 3.0 * half), whole(np.nan_to_num(cost)),
                      whole(inside), slack, bool(touching.any()),
                      whole(filled <= growth * 8.0 * half))


def _cost_left(length: np.ndarray, depth: float, rate: np.ndarray, edges: np.ndarray,
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


def _growth(distance: np.ndarray, near: np.ndarray, edges: np.ndarray) -> float:
    """Return the largest growth of the goal's distance per metre, among cells ``near`` it."""
    growth = 1.0
    for axis in range(3):
        step = np.abs(np.diff(distance, axis=axis)) / edges[axis]
        first, second = (np.take(near, range(k, near.shape[axis] - 1 + k), axis=axis)
                         for k in (0, 1))
        growth = max(growth, float(np.max(step, where=first & second, initial=0.0)))
    # A grasp's distance grows by at most a metre per metre; a target's by the field's rate plus a
    # reserve.
    return growth if growth <= 1.0 + 1e-9 else growth * _BEYOND * np.sqrt(3.0)
