"""Optimality gap of a path: a proven lower bound on the cost of every path.

On the field in three coordinates the gentlest path is a shortest path in a metric that stretches by
c = a_def E / (E0 L0) + a_dis / L0. A sub-solution on a grid
(:mod:`limber.planning.certificate.subsolution`) bounds its cost from below. The grid is refined
where a better path than the known one could still run. A cell is dropped if the bounds show that no
path through it is as cheap; a thin tube remains.

Limits: a cell where motion is surely not allowed, including the field's error, is closed; an
undecided cell stays open, so the bound stays valid. If closed cells separate start and goal, this
proves that no path exists.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
import scipy

from limber.core.errors import Cancelled, NoPathError
from limber.core.progress import SILENT, Progress
from limber.planning.certificate.cell_bounds import CURVATURE_FACTOR, least_between, least_size
from limber.planning.certificate.goal_cells import about_goal
from limber.planning.certificate.grid import COARSEST, FINEST, Grid, descent, first_grid, refined
from limber.planning.certificate.subsolution import (
    RIM,
    Terrain,
    corner_values,
    corners_of,
    least_in_cells,
    spline_value,
    subsolution,
    terrain,
    widened,
)
from limber.planning.path_problem import (
    BlockedError,
    GentleProblem,
    least_over,
    no_path_error,
    not_found,
)
from limber.planning.search_files import CostToGo

_MOST_CELLS = 450_000  # in any grid's tube; a further refinement is skipped
_LEVELS = 6
_RESERVE = 0.8  # fraction of the edge that would suffice
ENOUGH = 0.015  # gap below which refinement is not worth its time
_NEAR = np.ones((3, 3, 3))
COST, ENERGY = "cost", "energy_integral_jm"
"""Quantity that a certificate bounds: the planner's cost, or the integral of energy [J m]."""


@dataclass(frozen=True)
class Certificate:
    """A lower bound and how it was reached.

    Attributes:
        lower: No path that keeps the limits, on the field or on the branch, costs less to the
            field's position of the goal.
        upper: Cost of the best known path, infinite without one.
        levels: For each grid ``spacing_m``, ``open_cells``, ``lower``, ``upper`` and when [s].
        field_error_j: Subtracted from the energy before bounding [J].
        to_go: The bound from any position, on the first grid.
        stopped: Whether it was cancelled before the gap was small enough.
        quantity: Bounded quantity, ``COST`` or ``ENERGY``.
    """

    lower: float
    upper: float
    levels: list[dict[str, float]] = field(default_factory=list)
    field_error_j: float = 0.0
    to_go: CostToGo | None = None
    stopped: bool = False
    quantity: str = COST

    @property
    def gap(self) -> float:
        """Largest possible excess of the known path over the best: upper / lower - 1."""
        if self.upper == 0.0:
            return 0.0
        return self.upper / self.lower - 1.0 if self.lower > 0.0 else np.inf

    def describe(self) -> dict:
        """Return the certificate as plain data."""
        gap = 100.0 * self.gap if np.isfinite(self.gap) else None
        levels = [{name: value if np.isfinite(value) else None for name, value in level.items()}
                  for level in self.levels]
        return {"quantity": self.quantity, "lower_bound": self.lower,
                "upper_bound": self.upper, "gap_percent": gap,
                "field_error_j": self.field_error_j, "levels": levels}


Improve = Callable[[np.ndarray | None], float]
"""Takes a rough path [n, 3] along the cheapest path of a grid; returns the best known cost."""


def certify(problem: GentleProblem, improve: Improve, *, enough: float = ENOUGH,
            progress: Progress = SILENT) -> Certificate:
    """Return a lower bound on the cost of every path, refined until it is close to the known one.

    If cancelled (or by Ctrl-C) once a path is known, it returns the current result.

    Raises:
        NoPathError: closed cells separate start and goal; it is proven that no path exists.
    """
    search = _Search(problem, improve, enough, *first_grid(problem))
    stopped = False
    try:
        for level in range(_LEVELS):
            progress(level / _LEVELS, "bounding the best path", lower=search.lower,
                     upper=search.upper)
            if search.is_done_after(level):
                break
    except (Cancelled, KeyboardInterrupt) as stop:
        if not (search.levels and search.upper < np.inf):
            raise Cancelled from stop
        stopped = True
    return Certificate(search.lower, search.upper, search.levels, problem.field_error,
                       search.to_go, stopped)


@dataclass
class _Search:
    """The bound and the best path as they close in on each other, grid by grid."""

    problem: GentleProblem
    improve: Improve
    enough: float
    grid: Grid
    cell: np.ndarray
    lower: float = 0.0
    upper: float = np.inf
    levels: list[dict[str, float]] = field(default_factory=list)
    to_go: CostToGo | None = None
    began: float = field(default_factory=perf_counter)

    def is_done_after(self, level: int) -> bool:
        """Bound on the grid and refine it; return whether a finer grid is not worth its time."""
        try:
            found = _bound(self.problem, self.grid, self.cell)
        except NoPathError:
            if level == 0:
                # Corners this far apart do not resolve a narrow valley.
                self.grid, self.cell = refined(self.grid, self.grid.open_cells,
                                               self.grid.about_goal, self.cell)
                self.upper = self.improve(None)
                return False
            if self.upper < np.inf:
                # A path that keeps the limits is the stronger proof.
                self._note(0)
                return True
            raise
        if self.to_go is None:
            self.to_go = found.to_go(self.grid)
        if level == 0:
            self.upper = self.improve(None)  # after a bound that may prove that there is no path
        self.upper = min(self.upper, self.improve(found.rough_path))
        self.lower = max(self.lower, min(found.lower, self.upper))
        self._note(int(found.open_cells.sum()))
        if self.upper <= (1.0 + self.enough) * self.lower:
            return True
        keep = found.keep(self.upper)
        ratio = max(self._ratio(), float(np.cbrt(keep.sum() / _MOST_CELLS)))
        if ratio > COARSEST:
            return True
        self.grid, self.cell = refined(self.grid, keep, found.about_goal, self.cell, ratio)
        return False

    def _ratio(self) -> float:
        """Return the ratio of the next grid's cell edge to this one's: as fine as needed to close
        the gap, which is proportional to the square of the edge.
        """
        gap = self.upper / self.lower - 1.0 if self.lower > 0.0 else np.inf
        if not np.isfinite(gap):
            return FINEST
        return float(np.clip(_RESERVE * np.sqrt(self.enough / gap), FINEST, COARSEST))

    def _note(self, open_cells: int) -> None:
        self.levels.append({"spacing_m": self.grid.spacing, "open_cells": open_cells,
                            "lower": self.lower, "upper": self.upper,
                            "seconds": perf_counter() - self.began})


@dataclass(frozen=True)
class _Bounds:
    """The sub-solution of the goal on one grid, and its bound."""

    lower: float
    ground: Terrain
    to_goal: np.ndarray
    cell: np.ndarray
    slack: float
    rough_path: np.ndarray
    about_goal: np.ndarray

    @property
    def open_cells(self) -> np.ndarray:
        return self.ground.open_cells

    def to_go(self, grid: Grid) -> CostToGo:
        """Return the bound at the centres of open cells."""
        reached = self.open_cells & np.isfinite(self.to_goal)
        costs = np.where(reached, np.maximum(self.to_goal - self.slack, 0.0), np.nan)
        return CostToGo(grid.origin, grid.axes, grid.spacing, costs)

    def keep(self, upper: float) -> np.ndarray:
        """Return the cells through which a path could still be cheaper than ``upper``."""
        through = least_in_cells(self.to_goal + _from_start(self.ground, self.cell),
                                 self.open_cells)
        return self.open_cells & np.isfinite(through) & (through - self.slack <= upper)


def _bound(problem: GentleProblem, grid: Grid, cell: np.ndarray) -> _Bounds:
    ground, over = _ground(problem, grid, cell)
    goal = about_goal(problem, grid, ground)
    if not goal.meets:
        centres = grid.points(np.argwhere(ground.open_cells) + 0.5)
        if (problem.bounded_goal.uncertainty(problem.energy_field, centres) > 0.0).any():
            raise not_found(problem, f"On a grid of {1e3 * grid.spacing:.1f} mm the goal is out "
                            "of reach, but by less than the error of the energy field.")
        wall = over & scipy.ndimage.binary_dilation(ground.open_cells, _NEAR)
        raise _separated(problem, grid, ground.open_cells, grid.points(np.argwhere(wall) + 0.5))
    if problem.longest < np.inf:
        ground = ground._replace(
            open_cells=_short_enough(problem, grid, ground.open_cells, goal.near, cell))
    to_goal, factor = subsolution(ground, goal.known, goal.cost, goal.inside)
    slack = factor * goal.slack
    lower = spline_value(to_goal, cell) - slack
    return _Bounds(max(lower, 0.0), ground, to_goal, cell, slack, descent(grid, to_goal, cell),
                   goal.near)


def _ground(problem: GentleProblem, grid: Grid, cell: np.ndarray) -> tuple[Terrain, np.ndarray]:
    """Return the terrain of the cells connected to the start's, and the cells that limits close.

    What is evaluated for it is not kept: that would be most of the memory of what follows.
    """
    open_cells = grid.open_cells & ~_surely_outside(problem, grid)
    # One corner more than the active cells': for the second differences there.
    corners = np.argwhere(widened(corners_of(widened(open_cells, RIM))))
    points = grid.points(corners)
    # Rows for the corners that count, not the whole box.
    energy, force = problem.energy_field.energy(points), problem.energy_field.force(points)
    over = _surely_over(problem, grid, open_cells, corners, energy, force)
    open_cells &= ~over
    if not open_cells[tuple(cell)]:
        raise _separated(problem, grid, open_cells, grid.points(cell[None] + 0.5))
    # Only cells connected to the start, also by an edge or a corner of a cell.
    together = scipy.ndimage.label(open_cells, _NEAR)[0]
    open_cells = together == together[tuple(cell)]
    raw = energy - problem.field_error
    rate = problem.weights.length + problem.weights.energy * np.maximum(raw, 0.0)
    slopes = problem.weights.energy * grid.along_edges(force)
    return terrain(grid.spread(corners, rate), grid.spread(corners, slopes),
                   grid.spread(corners, raw) > 0.0, open_cells, grid.spacing,
                   problem.weights.length), over


def _short_enough(problem: GentleProblem, grid: Grid, open_cells: np.ndarray, near: np.ndarray,
                  cell: np.ndarray) -> np.ndarray:
    """Return the open cells that a path no longer than allowed may enter: an ellipsoid's, about the
    start and the cells ``near`` the goal."""
    numbers = np.argwhere(open_cells)
    nearest = scipy.ndimage.distance_transform_edt(~near, return_distances=False,
                                                   return_indices=True)[:, *numbers.T].T
    away = np.linalg.norm(numbers - cell, axis=1) + np.linalg.norm(numbers - nearest, axis=1)
    within = np.zeros_like(open_cells)
    # Half a diagonal in the cell itself, as much in the goal's, and at both ends of the path there.
    within[tuple(numbers.T)] = grid.spacing * (away - 1.5 * np.sqrt(3.0)) <= problem.longest
    within[tuple(cell)] = True
    together = scipy.ndimage.label(within, _NEAR)[0]
    return together == together[tuple(cell)]


def _from_start(ground: Terrain, cell: np.ndarray) -> np.ndarray:
    h = ground.spacing
    offsets = [(np.arange(n) - k).reshape([-1 if a == axis else 1 for a in range(3)])
               for axis, (n, k) in enumerate(zip(ground.open_cells.shape, cell, strict=True))]
    away = h * np.sqrt(sum(offset**2 for offset in offsets))
    rounded = np.sqrt(away**2 + 4.0 * h**2) - 2.0 * h  # a cone with a rounded tip, without a kink
    nothing = np.zeros(ground.open_cells.shape, bool)
    u, factor = subsolution(ground, away <= 3.0 * h, rounded, nothing, rounds=2)
    # At the start, the spline exceeds the zero of its blunt tip by at most its error there.
    return u - factor * CURVATURE_FACTOR * 3.0 * h / 16.0


def _surely_outside(problem: GentleProblem, grid: Grid) -> np.ndarray:
    """Return the open cells in which no point is trusted and in the workspace."""
    limits, outside = problem.limits, np.zeros(grid.open_cells.shape, bool)
    cells = np.argwhere(grid.open_cells)
    centres, halves = grid.points(cells + 0.5), 0.5 * grid.spacing * grid.axes
    beyond = np.maximum(limits.low - centres, centres - limits.high) > np.abs(halves).sum(axis=0)
    outside[tuple(cells.T)] = beyond.any(axis=1) | problem.energy_field.region.surely_outside(
        centres, halves)
    return outside


def _surely_over(problem: GentleProblem, grid: Grid, cells: np.ndarray, corners: np.ndarray,
                 energy: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return those of ``cells`` in which no point keeps the limits, including the field's error;
    ``energy`` [n] and ``force`` [n, 3] at ``corners`` [n, 3]: theirs and those next to them.
    """
    limits, field, over = problem.sure_limits, problem.energy_field, np.zeros(cells.shape, bool)
    nodes = np.argwhere(corners_of(cells))

    def spare(name: str) -> np.ndarray:
        at_nodes = grid.spread(nodes, problem.spare(name, grid.points(nodes)))
        return np.nan_to_num(corner_values(at_nodes).min(axis=0))
    if limits.max_energy < np.inf:
        over |= least_between(grid.spread(corners, energy),
                              grid.spread(corners, grid.along_edges(force)), cells) > (
            limits.max_energy + problem.field_error - spare("energy"))
    for name, limit in zip(field.load_names, limits.max_loads, strict=True):
        if limit < np.inf:
            beside = np.argwhere(widened(corners_of(cells)))
            points = grid.points(beside)
            load = field.load(points, name)
            slopes = 2.0 * load[:, None] * grid.along_edges(field.load_gradient(points, name))
            over |= least_between(grid.spread(beside, load**2), grid.spread(beside, slopes),
                                  cells) > (limit - spare(name))**2
    if limits.max_force < np.inf:
        over |= least_size(grid.spread(corners, force), cells) > limits.max_force - spare("force")
    return over


def _separated(problem: GentleProblem, grid: Grid, open_cells: np.ndarray, wall: np.ndarray,
               ) -> BlockedError:
    share = 100.0 * open_cells.mean()
    return no_path_error(problem,
                         f"This is proven on a grid of {1e3 * grid.spacing:.1f} mm: forbidden "
                         f"cells separate the start from the goal ({share:.0f} % of the region's "
                         "box is open).").behind(least_over(problem, wall))
