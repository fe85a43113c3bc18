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

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from time import perf_counter
from typing import NamedTuple

import numpy as np
import scipy

from limber.core.errors import Cancelled, NoPathError
from limber.core.progress import SILENT, Progress
from limber.planning.certificate.grid import (
    COARSEST,
    FINEST,
    Grid,
    about_goal,
    descent,
    first_grid,
    refined,
    short_enough,
)
from limber.planning.certificate.subsolution import (
    CURVATURE_FACTOR,
    RIM,
    Terrain,
    corner_values,
    corners_of,
    least_between,
    least_in_cells,
    least_size,
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
from limber.planning.search_files import BoundGrid, CostToGo

_MOST_CELLS = 400_000  # in any grid's tube; a further refinement is skipped
_LEVELS = 6
_RESERVE = 0.8  # fraction of the edge that would suffice
_FLATTEST = 4.0  # largest ratio of a cell's edges
ENOUGH = 0.015  # gap below which refinement is not worth its time
_NEAR = np.ones((3, 3, 3))
COST, ENERGY = "cost", "energy_integral_jm"
"""Quantity that a certificate bounds: the planner's cost, or the integral of energy [J m]."""


@dataclass(frozen=True)
class Certificate:
    """No path within the limits, on field or branch, costs under ``lower``; ``upper`` is the best
    known, or infinite. ``field_error_j`` came off the energy; ``to_go`` is the bound from anywhere
    (None: the first grid has none); ``stopped``: cancelled before the gap was small."""

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
    """Return a lower bound on every path's cost, refined until close to the known one, or cancelled
    with a path known. NoPathError if closed cells prove that there is no path."""
    return certify_all([problem], [improve], enough=[enough], progress=progress)[0]


def certify_all(problems: Sequence[GentleProblem], improve: Sequence[Improve], *,
                enough: Sequence[float], progress: Progress = SILENT) -> list[Certificate]:
    """Return the same for each of problems that differ in the weight of length alone. They share
    the grids and, on each, the energies of the field. NoPathError as for one."""
    searches = [_Search(*each) for each in zip(problems, improve, enough, strict=True)]
    following: tuple[Grid, np.ndarray] | None = first_grid(problems[0])
    stopped = False
    try:
        for level in range(_LEVELS):
            if following is None:
                break
            progress(level / _LEVELS, "bounding the best path", lower=searches[0].lower,
                     upper=searches[0].upper)
            following = _next_grid([one for one in searches if not one.is_done], *following,
                                   is_first=level == 0)
    except (Cancelled, KeyboardInterrupt) as stop:
        if not all(one.levels and one.upper < np.inf for one in searches):
            raise Cancelled from stop
        stopped = True
    return [Certificate(one.lower, one.upper, one.levels, one.problem.field_error, one.to_go(),
                        stopped) for one in searches]


def _next_grid(searches: "list[_Search]", grid: Grid, cell: np.ndarray, *, is_first: bool,
               ) -> tuple[Grid, np.ndarray] | None:
    """Bound on a grid; return the next one, None if a finer grid is not worth its time."""
    keep, near = np.zeros(grid.open_cells.shape, bool), grid.about_goal
    common, ratios = COARSEST, np.ones(3)
    on_grid: _FieldOnGrid | None = None
    for one in searches:
        try:
            on_grid = on_grid or _field_on_grid(searches[0].problem, grid, cell)
            found = _bound(one.problem, on_grid, grid, cell)
        except NoPathError as separated:
            return _unbounded(searches, grid, cell, separated, is_first=is_first)
        one.take(found, grid, is_first=is_first)
        if not one.is_done:
            own, near = found.keep(one.upper), found.about_goal
            common = min(common, one.ratio())
            ratios = np.minimum(ratios, _ratios(found.rates, own, one.ratio()))
            keep |= own
        del found
    if not keep.any():
        return None
    # No more cells than are allowed; cells that are hardly finer are not worth their time.
    coarser = max(float(np.cbrt(keep.sum() / ratios.prod() / _MOST_CELLS)), 1.0)
    if coarser > 1.0 and coarser * common > COARSEST:
        return None
    return refined(grid, keep, near, cell, np.minimum(1.0, coarser * ratios))


def _unbounded(searches: "list[_Search]", grid: Grid, cell: np.ndarray, separated: NoPathError, *,
               is_first: bool) -> tuple[Grid, np.ndarray] | None:
    """Go on, or end, after a grid whose closed cells separate the start from the goal."""
    if is_first:
        # Corners this far apart do not resolve a narrow valley.
        for one in searches:
            one.upper = one.improve(None)
        return refined(grid, grid.open_cells, grid.about_goal, cell)
    if not all(one.upper < np.inf for one in searches):
        raise separated
    # A path that keeps the limits is the stronger proof.
    for one in searches:
        one.note(grid, 0)
    return None


@dataclass
class _Search:
    """The bound and the best path as they close in on each other, grid by grid."""

    problem: GentleProblem
    improve: Improve
    enough: float
    lower: float = 0.0
    upper: float = np.inf
    levels: list[dict[str, float]] = field(default_factory=list)
    axes: np.ndarray = field(default_factory=lambda: np.eye(3))
    bounds: list[BoundGrid] = field(default_factory=list)
    began: float = field(default_factory=perf_counter)

    @property
    def is_done(self) -> bool:
        return self.upper <= (1.0 + self.enough) * self.lower

    def take(self, found: "_Bounds", grid: Grid, *, is_first: bool) -> None:
        """Keep the bound on a grid, and refine the path that it shows."""
        self.axes = grid.axes
        self.bounds.append(found.to_go(grid))
        if is_first:
            self.upper = self.improve(None)  # after a bound that may prove that there is no path
        self.upper = min(self.upper, self.improve(found.rough_path))
        self.lower = max(self.lower, min(found.lower, self.upper))
        self.note(grid, int(found.open_cells.sum()))

    def ratio(self) -> float:
        """Return the ratio of the next grid's cell edge to this one's: as fine as needed to close
        the gap, which is proportional to the square of the edge."""
        gap = self.upper / self.lower - 1.0 if self.lower > 0.0 else np.inf
        if not np.isfinite(gap):
            return FINEST
        return float(np.clip(_RESERVE * np.sqrt(self.enough / gap), FINEST, COARSEST))

    def to_go(self) -> CostToGo | None:
        return CostToGo(self.axes, tuple(self.bounds)) if self.bounds else None

    def note(self, grid: Grid, open_cells: int) -> None:
        self.levels.append({"spacing_m": grid.spacing, "open_cells": open_cells,
                            "lower": self.lower, "upper": self.upper,
                            "seconds": perf_counter() - self.began})


def _ratios(rates: Terrain, keep: np.ndarray, ratio: float) -> np.ndarray:
    """Return the ratios [3] of the next grid's edges to this one's that lower what the bends of c
    take off it as one common ratio would, with the fewest cells: bends are equal along each axis.
    None is too flat for the sub-solution, which bends near start and goal."""
    bends = np.array([axis[keep].mean() for axis in rates.bends])
    ratios = ratio * np.sqrt(bends.mean() / np.maximum(bends, 1e-9 * bends.mean() + 1e-300))
    ratios = np.clip(ratios, FINEST, 1.0)
    edges = ratios * rates.edges
    return np.minimum(edges, _FLATTEST * edges.min()) / rates.edges


@dataclass(frozen=True)
class _Bounds:
    """The sub-solution of the goal on one grid, and its bound."""

    lower: float
    rates: Terrain
    to_goal: np.ndarray
    cell: np.ndarray
    slack: float
    rough_path: np.ndarray
    about_goal: np.ndarray

    @property
    def open_cells(self) -> np.ndarray:
        return self.rates.open_cells

    def to_go(self, grid: Grid) -> BoundGrid:
        """Return the bound in open cells, in the smallest box with their coefficients."""
        cells = np.argwhere(self.open_cells)
        low, high = cells.min(axis=0) - 1, cells.max(axis=0) + 2
        box = tuple(map(slice, low, high))
        has_cost = np.isfinite(self.to_goal[box])
        known = self.open_cells[box] & scipy.ndimage.binary_erosion(has_cost, _NEAR)
        costs = np.where(has_cost, self.to_goal[box] - self.slack, np.nan).astype(np.float32)
        return BoundGrid(grid.points(low[None])[0], grid.edges, costs, known)

    def keep(self, upper: float) -> np.ndarray:
        """Return the cells through which a path could still be cheaper than ``upper``."""
        through = least_in_cells(self.to_goal + _from_start(self.rates, self.cell),
                                 self.open_cells)
        return self.open_cells & np.isfinite(through) & (through - self.slack <= upper)


class _FieldOnGrid(NamedTuple):
    """What a grid has for any weight of length: cells connected to the start, those that limits
    close, and at evaluated corners [n, 3] energy [n] [J] and its growth along edges [n, 3]."""

    open_cells: np.ndarray
    over: np.ndarray
    corners: np.ndarray
    energy: np.ndarray
    slopes: np.ndarray


def _field_on_grid(problem: GentleProblem, grid: Grid, cell: np.ndarray) -> _FieldOnGrid:
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
    return _FieldOnGrid(together == together[tuple(cell)], over, corners, energy,
                        grid.along_edges(force))


def _terrain(problem: GentleProblem, on_grid: _FieldOnGrid, grid: Grid) -> Terrain:
    """Return the terrain of a problem's own weights."""
    raw = on_grid.energy - problem.field_error
    rate = problem.weights.length + problem.weights.energy * np.maximum(raw, 0.0)
    return terrain(grid.spread(on_grid.corners, rate),
                   grid.spread(on_grid.corners, problem.weights.energy * on_grid.slopes),
                   grid.spread(on_grid.corners, raw) > 0.0, on_grid.open_cells, grid.edges,
                   problem.weights.length)


def _bound(problem: GentleProblem, on_grid: _FieldOnGrid, grid: Grid, cell: np.ndarray) -> _Bounds:
    rates = _terrain(problem, on_grid, grid)
    goal = about_goal(problem, grid, rates)
    if not goal.meets:
        centres = grid.points(np.argwhere(rates.open_cells) + 0.5)
        if (problem.bounded_goal.uncertainty(problem.energy_field, centres) > 0.0).any():
            raise not_found(problem, f"On a grid of {1e3 * grid.spacing:.1f} mm the goal is out "
                            "of reach, but by less than the error of the energy field.")
        wall = on_grid.over & scipy.ndimage.binary_dilation(rates.open_cells, _NEAR)
        raise _separated(problem, grid, rates.open_cells, grid.points(np.argwhere(wall) + 0.5))
    if problem.longest < np.inf:
        rates = rates._replace(
            open_cells=short_enough(problem, grid, rates.open_cells, goal.near, cell))
    to_goal, factor = subsolution(rates, goal.known, goal.cost, goal.inside)
    slack = factor * goal.slack
    lower = spline_value(to_goal, cell) - slack
    return _Bounds(max(lower, 0.0), rates, to_goal, cell, slack, descent(grid, to_goal, cell),
                   goal.near)


def _from_start(rates: Terrain, cell: np.ndarray) -> np.ndarray:
    h = float(rates.edges.max())
    offsets = [(edge * (np.arange(n) - k)).reshape([-1 if a == axis else 1 for a in range(3)])
               for axis, (n, k, edge) in enumerate(zip(
                   rates.open_cells.shape, cell, rates.edges, strict=True))]
    away = np.sqrt(sum(offset**2 for offset in offsets))
    rounded = np.sqrt(away**2 + 4.0 * h**2) - 2.0 * h  # a cone with a rounded tip, without a kink
    nothing = np.zeros(rates.open_cells.shape, bool)
    u, factor = subsolution(rates, away <= 3.0 * h, rounded, nothing, rounds=2)
    # At the start, the spline exceeds the zero of its blunt tip by at most its error there.
    return u - factor * CURVATURE_FACTOR * float((rates.edges**2).sum()) / (16.0 * h)


def _surely_outside(problem: GentleProblem, grid: Grid) -> np.ndarray:
    """Return the open cells in which no point is trusted and in the workspace."""
    limits, outside = problem.limits, np.zeros(grid.open_cells.shape, bool)
    cells = np.argwhere(grid.open_cells)
    centres, halves = grid.points(cells + 0.5), 0.5 * grid.edges[:, None] * grid.axes
    beyond = np.maximum(limits.low - centres, centres - limits.high) > np.abs(halves).sum(axis=0)
    outside[tuple(cells.T)] = beyond.any(axis=1) | problem.energy_field.region.surely_outside(
        centres, halves)
    return outside


def _surely_over(problem: GentleProblem, grid: Grid, cells: np.ndarray, corners: np.ndarray,
                 energy: np.ndarray, force: np.ndarray) -> np.ndarray:
    """Return those of ``cells`` in which no point keeps the limits, including the field's error;
    ``energy`` [n] and ``force`` [n, 3] at ``corners`` [n, 3]: theirs and those next to them."""
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
