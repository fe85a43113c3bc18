"""How close to the best a path is: a proven lower bound on the cost of every path.

On the field in three coordinates the gentlest path is a shortest path in a metric that stretches
by c = a_def E / (E0 L0) + a_dis / L0. A sub-solution on a grid
(:mod:`limber.planning.certificate.subsolution`) bounds its cost from below. The grid is turned so
that its first axis runs from the start to the goal, and refined where a better path than the known
one
could still run: a cell through which even the bounds say no path is as cheap drops out, and what
is left is a thin tube.

Limits: a cell where motion is surely not allowed, the field's error counted, is closed; a cell in
doubt stays open, so the bound stays one. If closed cells separate start and goal, that proves that
no path exists.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from time import perf_counter

import numpy as np
import scipy

from limber.core.errors import Cancelled, NoPathError
from limber.core.progress import SILENT, Progress
from limber.planning.certificate.cell_bounds import CURVATURE_FACTOR, least_between, least_size
from limber.planning.certificate.subsolution import (
    RIM,
    Terrain,
    corner_values,
    corners_of,
    least_in_cells,
    second_differences,
    spline_value,
    subsolution,
    terrain,
    widened,
)
from limber.planning.field.energy_field import LOADS
from limber.planning.problem import GentleProblem, NoWayError, no_way, not_found
from limber.planning.search_files import CostToGo

_FIRST_CELLS = 12_000  # of the first grid, over the whole sampled region
_MOST_CELLS = 800_000  # of any grid's tube; the next refinement is left away
_LEVELS = 5
_CUT = 3  # of a cell's edge from one grid to the next
_CHILDREN = _CUT**3
ENOUGH = 0.015  # gap below which no further refinement is worth its time
_NEAR = np.ones((3, 3, 3))
_PAD = RIM + 1  # closed cells about the grid, for the coefficients and second differences there
_BEYOND = 1.2  # on the steepest measured growth of the goal's distance


@dataclass(frozen=True)
class Certificate:
    """A lower bound and how it was reached.

    Attributes:
        lower: No path that keeps the limits, on the field or on the branch, costs less to where
            the goal is on the field.
        upper: Cost of the best path known, infinite without one.
        levels: For each grid ``spacing_m``, ``open_cells``, ``lower``, ``upper`` and when [s].
        field_error_j: What was subtracted from the energy before bounding [J].
        to_go: The bound from anywhere, on the first grid.
        stopped: It was cancelled before it was close enough.
    """

    lower: float
    upper: float
    levels: list[dict[str, float]] = field(default_factory=list)
    field_error_j: float = 0.0
    to_go: CostToGo | None = None
    stopped: bool = False

    @property
    def gap(self) -> float:
        """How far above the best the known path can be at most: upper / lower - 1."""
        if self.upper == 0.0:
            return 0.0
        return self.upper / self.lower - 1.0 if self.lower > 0.0 else np.inf

    def describe(self) -> dict:
        """Return the certificate as plain data."""
        gap = 100.0 * self.gap if np.isfinite(self.gap) else None
        levels = [{name: value if np.isfinite(value) else None for name, value in level.items()}
                  for level in self.levels]
        return {"lower_bound": self.lower, "upper_bound": self.upper, "gap_percent": gap,
                "field_error_j": self.field_error_j, "levels": levels}


Improve = Callable[[np.ndarray | None], float]
"""Takes a rough path [n, 3] along the cheapest way of a grid; returns the best known cost."""


@dataclass
class _Grid:
    """Cells in the turned frame; corner ``(i, j, k)`` lies at ``origin + (i, j, k) h``.

    How far the goal is need not be asked but in the cells ``about_goal``.
    """

    origin: np.ndarray
    axes: np.ndarray
    spacing: float
    open_cells: np.ndarray
    about_goal: np.ndarray

    def points(self, numbers: np.ndarray) -> np.ndarray:
        """Return the positions [n, 3] of corners ``numbers`` [n, 3]; halves are centres."""
        return self.origin + (numbers * self.spacing) @ self.axes

    def along_edges(self, vectors: np.ndarray) -> np.ndarray:
        """Return slopes [n, 3] to the position as those along a cell's edges, times their length.
        """
        return self.spacing * vectors @ self.axes.T

    def spread(self, corners: np.ndarray, values: np.ndarray) -> np.ndarray:
        """Return ``values`` [n, ...] at ``corners`` [n, 3] of the whole grid, nan elsewhere."""
        return _spread(tuple(n + 1 for n in self.open_cells.shape), corners, values)


def _spread(shape: tuple[int, ...], places: np.ndarray, values: np.ndarray) -> np.ndarray:
    whole = np.full((*shape, *values.shape[1:]), np.nan)
    whole[tuple(places.T)] = values
    return whole


def certify(problem: GentleProblem, improve: Improve, *, enough: float = ENOUGH,
            progress: Progress = SILENT) -> Certificate:
    """Return a lower bound on the cost of every path, refined until it is close to the known one.

    Cancelled (or by Ctrl-C) once a path is known, it returns what there is.

    Raises:
        NoPathError: closed cells separate start and goal; it is proven that no path exists.
    """
    grid, cell = _first_grid(problem)
    lower, upper, levels, to_go, stopped = 0.0, np.inf, [], None, False
    began = perf_counter()
    try:
        for level in range(_LEVELS):
            progress(level / _LEVELS, "bounding the best path", lower=lower, upper=upper)
            try:
                found = _bound(problem, grid, cell)
            except NoPathError:
                if level == 0:
                    # Corners so far apart say too little of what lies in a narrow valley.
                    grid, cell = _refined(grid, grid.open_cells, grid.about_goal, cell)
                    upper = improve(None)
                    continue
                if upper < np.inf:
                    # A path that keeps the limits is the better proof.
                    levels.append({"spacing_m": grid.spacing, "open_cells": 0, "lower": lower,
                                   "upper": upper, "seconds": perf_counter() - began})
                    break
                raise
            if to_go is None:
                to_go = found.to_go(grid)
            if level == 0:
                upper = improve(None)  # after the first bound, which may prove that there is none
            upper = min(upper, improve(found.rough_path))
            lower = max(lower, min(found.lower, upper))
            levels.append({"spacing_m": grid.spacing, "open_cells": int(found.open_cells.sum()),
                           "lower": lower, "upper": upper, "seconds": perf_counter() - began})
            if upper <= (1.0 + enough) * lower:
                break
            keep = found.keep(upper)
            if _CHILDREN * keep.sum() > _MOST_CELLS:
                break
            grid, cell = _refined(grid, keep, found.about_goal, cell)
    except (Cancelled, KeyboardInterrupt) as stop:
        if not (levels and upper < np.inf):
            raise Cancelled from stop
        stopped = True
    return Certificate(lower, upper, levels, problem.field_error, to_go, stopped)


@dataclass(frozen=True)
class _Bounds:
    """The sub-solution of the goal on one grid, and what it says."""

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

    def to_go(self, grid: "_Grid") -> CostToGo:
        """Return the bound at the centres of open cells."""
        reached = self.open_cells & np.isfinite(self.to_goal)
        costs = np.where(reached, np.maximum(self.to_goal - self.slack, 0.0), np.nan)
        return CostToGo(grid.origin, grid.axes, grid.spacing, costs)

    def keep(self, upper: float) -> np.ndarray:
        """Return the cells through which a path could still be cheaper than ``upper``."""
        through = least_in_cells(self.to_goal + _from_start(self.ground, self.cell),
                                 self.open_cells)
        return self.open_cells & np.isfinite(through) & (through - self.slack <= upper)


def _bound(problem: GentleProblem, grid: _Grid, cell: np.ndarray) -> _Bounds:
    open_cells = grid.open_cells & ~_surely_outside(problem, grid)
    # One corner more than the active cells': for the second differences there.
    corners = np.argwhere(widened(corners_of(widened(open_cells, RIM))))
    points = grid.points(corners)
    energy = grid.spread(corners, problem.energy_field.energy(points))
    force = grid.spread(corners, problem.energy_field.force(points))
    open_cells &= ~_surely_over(problem, grid, open_cells, energy, force)
    if not open_cells[tuple(cell)]:
        raise _separated(problem, grid, open_cells)
    # Only what hangs together with the start, also by an edge or a corner of a cell.
    together = scipy.ndimage.label(open_cells, _NEAR)[0]
    open_cells = together == together[tuple(cell)]
    raw = energy - problem.field_error
    rate = problem.weights.length + problem.weights.energy * np.maximum(raw, 0.0)
    slopes = problem.weights.energy * grid.along_edges(force)
    ground = terrain(rate, slopes, raw > 0.0, open_cells, grid.spacing, problem.weights.length)
    goal = _about_goal(problem, grid, ground)
    if not goal.meets:
        if problem.goal.doubt(problem.energy_field) > 0.0:
            raise not_found(problem, f"On a grid of {1e3 * grid.spacing:.1f} mm it is out of reach "
                            "by less than the energy field may be wrong by.")
        raise _separated(problem, grid, open_cells)
    to_goal, factor = subsolution(ground, goal.known, goal.cost, goal.inside)
    slack = factor * goal.slack
    lower = spline_value(to_goal, cell) - slack
    return _Bounds(max(lower, 0.0), ground, to_goal, cell, slack, _descent(grid, to_goal, cell),
                   goal.near)


@dataclass(frozen=True)
class _AboutGoal:
    """A signed cost of the way left, below 0 inside the goal, and where it is known.

    Every point of the goal lies in a cell that has all its coefficients among those ``known``;
    there the spline of the ``cost`` is at most ``slack``. ``inside`` are cells of the goal alone.
    ``meets``: whether any open cell may have a point of the goal. ``near``: where the cells of the
    next grid that are asked lie.
    """

    known: np.ndarray
    cost: np.ndarray
    inside: np.ndarray
    slack: float
    meets: bool
    near: np.ndarray


def _about_goal(problem: GentleProblem, grid: _Grid, ground: Terrain) -> _AboutGoal:
    """Return what is known about the goal.

    A spline whose coefficients are a function's values differs from it by
    ``h^2 / 8 sum_i max |second derivative|``.
    """
    h, shape = ground.spacing, ground.open_cells.shape
    cells = np.argwhere(ground.active & grid.about_goal)
    nothing = np.zeros(shape, bool)
    if len(cells) == 0:
        return _AboutGoal(nothing, np.zeros(shape), nothing, 0.0, False, nothing)
    away = (problem.goal.distance(problem.energy_field, grid.points(cells + 0.5))
            - problem.goal.tolerance)
    # In the box about them alone, with a layer in which nothing is known.
    low, high = np.maximum(cells.min(axis=0) - 1, 0), cells.max(axis=0) + 2
    box = tuple(map(slice, low, high))
    open_cells = ground.open_cells[box]
    distance = _spread(open_cells.shape, cells - low, away)
    filled = np.nan_to_num(distance, nan=np.inf)
    growth = _growth(distance, np.abs(filled) <= 4.0 * h, h)
    corners = tuple(map(slice, low, high + 1))
    rate = np.where(ground.level[box], ground.floor,
                    corner_values(ground.rate[corners]).mean(axis=0))
    cost = _way_left(distance / growth, problem.goal.tolerance / growth, rate, h)
    curved = CURVATURE_FACTOR / 8.0 * sum(
        scipy.ndimage.maximum_filter(second, 3) for second in second_differences(cost))
    half = 0.5 * h * np.sqrt(3.0)
    touching = open_cells & (filled <= growth * half)
    inside = filled < -growth * half
    border = touching & ~inside
    slack = float(curved[border].max()) if border.any() else 0.0

    def whole(part: np.ndarray) -> np.ndarray:
        out = np.zeros(shape, part.dtype)
        out[box] = part
        return out
    # A next cell asks up to 4 of its edges away; its centre lies within ``half`` of this one's.
    return _AboutGoal(whole(filled <= growth * 3.0 * half), whole(np.nan_to_num(cost)),
                      whole(inside), slack, bool(touching.any()),
                      whole(filled <= growth * (half + 6.0 * h / _CUT)))


def _way_left(length: np.ndarray, depth: float, rate: np.ndarray, h: float) -> np.ndarray:
    """Return what a ``length`` [m] to the goal costs, at the ``rate`` half-way, of cells with an
    edge of ``h`` [m]; nan where not known.

    One rate for all sides of the goal would be the least of them. Inside, where nothing is asked,
    the length flattens out to a goal's middle ``depth`` [m] below its outside: it has no tip there.
    """
    flat = np.maximum(length, -depth)
    flat = np.where(flat < 0.0, flat + flat**2 / (2.0 * depth), flat)
    growing = sum(np.gradient(rate, h, axis=axis) * np.gradient(length, h, axis=axis)
                  for axis in range(3))
    half_way = rate - 0.5 * length * np.nan_to_num(growing)
    return flat * np.where(length > 0.0, np.clip(half_way, 0.5 * rate, 1.5 * rate), rate)


def _growth(distance: np.ndarray, near: np.ndarray, h: float) -> float:
    """Return the most that the goal's distance grows a metre, among cells ``near`` it."""
    growth = 1.0
    for axis in range(3):
        step = np.abs(np.diff(distance, axis=axis)) / h
        first, second = (np.take(near, range(k, near.shape[axis] - 1 + k), axis=axis)
                         for k in (0, 1))
        growth = max(growth, float(np.max(step, where=first & second, initial=0.0)))
    # A grasp's distance grows by a metre at most; a target's by what the field says, and more.
    return growth if growth <= 1.0 + 1e-9 else growth * _BEYOND * np.sqrt(3.0)


def _from_start(ground: Terrain, cell: np.ndarray) -> np.ndarray:
    h = ground.spacing
    offsets = [(np.arange(n) - k).reshape([-1 if a == axis else 1 for a in range(3)])
               for axis, (n, k) in enumerate(zip(ground.open_cells.shape, cell, strict=True))]
    away = h * np.sqrt(sum(offset**2 for offset in offsets))
    rounded = np.sqrt(away**2 + 4.0 * h**2) - 2.0 * h  # a cone with a blunt tip: no kink
    nothing = np.zeros(ground.open_cells.shape, bool)
    u, factor = subsolution(ground, away <= 3.0 * h, rounded, nothing, rounds=2)
    # The spline lies above its blunt tip's zero at the start by at most its error there.
    return u - factor * CURVATURE_FACTOR * 3.0 * h / 16.0


def _surely_outside(problem: GentleProblem, grid: _Grid) -> np.ndarray:
    """Return the open cells in which no point is trusted and in the workspace."""
    limits, outside = problem.limits, np.zeros(grid.open_cells.shape, bool)
    cells = np.argwhere(grid.open_cells)
    centres, halves = grid.points(cells + 0.5), 0.5 * grid.spacing * grid.axes
    beyond = np.maximum(limits.low - centres, centres - limits.high) > np.abs(halves).sum(axis=0)
    outside[tuple(cells.T)] = beyond.any(axis=1) | problem.energy_field.region.surely_outside(
        centres, halves)
    return outside


def _surely_over(problem: GentleProblem, grid: _Grid, cells: np.ndarray, energy: np.ndarray,
                 force: np.ndarray) -> np.ndarray:
    """Return those of ``cells`` in which no point keeps the limits, the field's error counted;
    ``energy`` and ``force`` at their corners and next to them."""
    limits, field, over = problem.sure_limits, problem.energy_field, np.zeros(cells.shape, bool)
    if limits.max_energy < np.inf:
        over |= least_between(energy, grid.along_edges(force), cells) > (
            limits.max_energy + problem.field_error)
    for name, limit in zip(LOADS, limits.max_loads, strict=True):
        if limit < np.inf:
            nodes = np.argwhere(widened(corners_of(cells)))
            points = grid.points(nodes)
            load = field.load(points, name)
            slopes = 2.0 * load[:, None] * grid.along_edges(field.load_gradient(points, name))
            over |= least_between(grid.spread(nodes, load**2), grid.spread(nodes, slopes),
                                  cells) > limit**2
    if limits.max_force < np.inf:
        over |= least_size(force, cells) > limits.max_force
    return over


def _first_grid(problem: GentleProblem) -> tuple[_Grid, np.ndarray]:
    """Return a grid over the sampled region, and the cell in whose centre the start lies."""
    region, start = problem.energy_field.region, problem.start
    axes = _axes(problem.goal.centre(problem.energy_field) - start)
    corners = (region.outline - start) @ axes.T
    low = np.minimum(corners.min(axis=0), 0.0)
    high = np.maximum(corners.max(axis=0), 0.0)
    spacing = float(np.cbrt(np.prod(high - low) / _FIRST_CELLS))
    before = np.ceil(-low / spacing - 0.5).astype(int) + _PAD
    after = np.ceil(high / spacing - 0.5).astype(int) + _PAD + 1
    open_cells = np.pad(np.ones(tuple(before + after - 2 * _PAD), bool), _PAD)
    return _Grid(start - ((before + 0.5) * spacing) @ axes, axes, spacing, open_cells,
                 np.ones_like(open_cells)), before


def _axes(direction: np.ndarray) -> np.ndarray:
    """Return three unit rows, the first along ``direction``."""
    length = float(np.linalg.norm(direction))
    if length == 0.0:
        return np.eye(3)
    first = direction / length
    second = np.cross(first, np.eye(3)[np.argmin(np.abs(first))])
    second /= np.linalg.norm(second)
    return np.stack([first, second, np.cross(first, second)])


def _refined(grid: _Grid, keep: np.ndarray, about_goal: np.ndarray, cell: np.ndarray,
             ) -> tuple[_Grid, np.ndarray]:
    """Return cells of a third the edge over ``keep``, in the smallest box; and the start's.

    A third, not a half: so the start stays in the centre of a cell.
    """
    places = np.argwhere(keep)
    # A closed layer of whole cells about them is as deep as ``_PAD`` new ones.
    low = np.minimum(places.min(axis=0), cell) - 1
    high = np.maximum(places.max(axis=0), cell) + 2
    spacing = grid.spacing / _CUT

    def cut(cells: np.ndarray) -> np.ndarray:
        box = cells[tuple(map(slice, low, high))]
        for axis in range(3):
            box = np.repeat(box, _CUT, axis=axis)
        return box
    origin = grid.points(low[None].astype(float))[0]
    return (_Grid(origin, grid.axes, spacing, cut(keep), cut(about_goal)),
            _CUT * (cell - low) + _CUT // 2)


def _descent(grid: _Grid, u: np.ndarray, cell: np.ndarray) -> np.ndarray:
    """Return the way downhill from the start by cells' centres [n, 3]: the course of a path."""
    reach = np.stack(np.meshgrid(*[np.arange(-2, 3)] * 3, indexing="ij"), axis=-1).reshape(-1, 3)
    reach = reach[np.abs(reach).sum(axis=1) > 0]
    length = np.linalg.norm(reach, axis=1)
    way, here = [cell], cell
    while u[tuple(here)] > 0.0 and len(way) < sum(u.shape):
        near = here + reach
        within = ((near >= 0) & (near < u.shape)).all(axis=1)
        drop = (u[tuple(here)] - u[tuple(near[within].T)]) / length[within]
        best = int(np.argmax(drop))
        if not drop[best] > 0.0:
            break
        here = near[within][best]
        way.append(here)
    return grid.points(np.array(way) + 0.5)


def _separated(problem: GentleProblem, grid: _Grid, open_cells: np.ndarray) -> NoWayError:
    share = 100.0 * open_cells.mean()
    return no_way(problem, f"Proven on a grid of {1e3 * grid.spacing:.1f} mm: cells where motion "
                  f"is surely not allowed separate the two ({share:.0f} % of the region's box is "
                  "open).")
