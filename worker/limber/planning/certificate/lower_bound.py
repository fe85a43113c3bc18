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
from limber.core.numerics.rigid import any_normal
from limber.core.progress import SILENT, Progress
from limber.planning.certificate.subsolution import (
    CURVATURE_FACTOR,
    RIM,
    Terrain,
    corner_values,
    corners_of,
    least_between,
    least_in_cells,
    least_size,
    second_differences,
    spline_value,
    subsolution,
    terrain,
    widened,
)
from limber.planning.field.chart import Chart
from limber.planning.path_problem import (
    BlockedError,
    GentleProblem,
    least_over,
    no_path_error,
    not_found,
)
from limber.planning.search_files import BoundGrid, CostToGo

# The grid of the bound, with one axis off the low-energy surface and one towards the goal.
#
# Off the surface the energy bends up to a thousand times as strongly as along it. So the edges of
# a cell differ: each refinement divides an axis by as much as the energy bends along it.

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

# A path may also end where the goal meets the border of trust. A target's distance often grows
# mostly across that border, so beyond it a cell would seem to be in the goal, and a path to be
# short. Poses of the goal have a distance d <= 0 and a height h <= 0 above the border, so also
# d + k h <= 0 for any k >= 0, which may differ from place to place. The k that divides to the most,
# (d + k h) / |grad d + k grad h|, gives the distance to both together, as far as they are flat.

_BEYOND = 1.2  # factor on the steepest measured growth of the goal's distance
_FLAT = 0.5  # least fraction of that growth that its mean counts as
_ALONG = 0.05  # least fraction of that growth that counts as along the border
_FLATTENED = 2.0  # diagonals of a cell over which the cost flattens out inside the goal


@dataclass(frozen=True)
class AboutGoal:
    """A signed cost to the goal, negative ``inside``, where ``known``: each point of the goal is in
    a cell with all coefficients there, and a spline with no larger ones is at most 0 at it.
    ``meets``: an open cell may have a point of the goal. ``near``: the next grid's queried cells.
    """

    known: np.ndarray
    cost: np.ndarray
    inside: np.ndarray
    meets: bool
    near: np.ndarray


def about_goal(problem: GentleProblem, grid: Grid, ground: Terrain) -> AboutGoal:
    """Return the goal data."""
    edges, shape = ground.edges, ground.open_cells.shape
    cells, nothing = np.argwhere(ground.active & grid.about_goal), np.zeros(shape, bool)
    if len(cells) == 0:
        return AboutGoal(nothing, np.zeros(shape), nothing, False, nothing)
    goal, region = problem.bounded_goal, problem.energy_field.region
    centres = grid.points(cells + 0.5)
    # In the bounding box of these cells only, with a margin layer of unknown values.
    low, high = np.maximum(cells.min(axis=0) - 1, 0), cells.max(axis=0) + 2
    box = tuple(map(slice, low, high))
    open_cells = ground.open_cells[box]
    height, outward = region.height_and_slope(centres)
    alone, height, outward = (spread(open_cells.shape, cells - low, values) for values in (
        goal.excess(problem.energy_field, centres), height, outward @ grid.axes.T))
    distance, slope = _with_border(alone, height, outward, edges)
    filled, reach = np.nan_to_num(distance, nan=np.inf), _reach(distance, edges)
    # Where the border's plane changes, the distance to both jumps, but not the goal's alone.
    meets = (filled <= reach) & (np.nan_to_num(alone, nan=np.inf) <= _reach(alone, edges))
    touching, inside = open_cells & meets, filled < -reach
    rate = np.where(ground.level[box], ground.floor, corner_values(
        ground.rate[tuple(map(slice, low, high + 1))]).mean(axis=0))
    deep = np.minimum(goal.tolerance / slope, _FLATTENED * float(np.linalg.norm(edges)))
    cost = _cost_left(distance, deep, rate, edges)

    def whole(part: np.ndarray) -> np.ndarray:
        out = np.zeros(shape, part.dtype)
        out[box] = part
        return out
    # Cells next to closed ones count too: from a deep one left out, a cost below 0 would spread.
    known = scipy.ndimage.binary_dilation(meets, _NEAR) & np.isfinite(distance)
    cost -= _bent_up(cost, touching & ~inside)
    # A cell of the next grid queries up to 4 of its edges away; its centre is in this one.
    return AboutGoal(whole(known), whole(np.nan_to_num(cost)), whole(inside), bool(touching.any()),
                     whole(filled <= 9.0 * reach))


def _bent_up(cost: np.ndarray, border: np.ndarray) -> np.ndarray:
    """Return what to take off a cost (nan: not known) so that a spline with it as coefficients is
    nowhere in the cells of the ``border`` above the cost.

    The spline at a point is a mean of the coefficients of the cells next to its own, and differs
    from the cost there by at most ``h^2 / 8 sum_i max |second derivative|``. So as much comes off
    all of them, and evenly beyond.
    """
    # A cell's neighbours count as well.
    curved = sum(scipy.ndimage.maximum_filter(second, 3) for second in second_differences(cost))
    above = np.where(border, CURVATURE_FACTOR / 8.0 * curved, 0.0)
    return scipy.ndimage.uniform_filter(scipy.ndimage.maximum_filter(above, 7), 3)


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


def _with_border(distance: np.ndarray, height: np.ndarray, outward: np.ndarray,
                 edges: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return how far a path must go at least to the goal within the border of trust [m], from its
    ``distance`` and the ``height`` above the border, which grows by ``outward`` [..., 3], and by
    how much the distance grows per metre. The growth needs no reserve: the sub-solution is scaled
    down wherever it is too steep."""
    ahead_or_behind = _differences(distance, edges)
    known = np.isfinite(ahead_or_behind)
    steepest = np.abs(np.nan_to_num(ahead_or_behind)).max(axis=0)
    if steepest.max() <= 1.0 + 1e-9:  # a grasp's, which grows as little across the border as along
        return distance, np.ones_like(distance)
    mean = np.nan_to_num(ahead_or_behind).sum(axis=0) / np.maximum(known.sum(axis=0), 1)
    weight = known.any(axis=(0, 1)).astype(float)

    def smooth(values: np.ndarray) -> np.ndarray:
        return scipy.ndimage.uniform_filter(values * weight, 3) / np.maximum(
            scipy.ndimage.uniform_filter(weight, 3), 1e-9)
    slope = np.maximum(smooth(np.linalg.norm(mean, axis=0)), _FLAT * scipy.ndimage.maximum_filter(
        np.linalg.norm(steepest, axis=0), 3)) + 1e-12
    up = np.maximum((outward**2).sum(axis=-1), 1e-12)
    growth = np.stack([smooth(one) for one in mean], axis=-1)
    most = np.maximum(-(growth * outward).sum(axis=-1) / up, 0.0)
    along = np.maximum(((growth + most[..., None] * outward)**2).sum(axis=-1), (_ALONG * slope)**2)
    with np.errstate(divide="ignore", invalid="ignore"):
        best = np.nan_to_num(most + along * height / up / (distance + most * height))
    found = distance / slope
    for factor in (np.clip(best, 0.0, most), most):
        found = np.maximum(found, (distance + factor * height) / np.sqrt(
            along + (most - factor)**2 * up))
    return found, slope


def _reach(distance: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return by how much the goal's distance grows from a cell's centre to its corners at most.
    Across the surface it grows most, and there a cell is thin."""
    steepest = np.abs(np.nan_to_num(_differences(distance, edges))).max(axis=0)
    return _BEYOND * scipy.ndimage.maximum_filter(0.5 * np.einsum("i,i...", edges, steepest), 3)


def _differences(values: np.ndarray, edges: np.ndarray) -> np.ndarray:
    """Return the growth per metre to the next cells and from those before, [2, 3, ...]."""
    ahead, behind = [], []
    for axis, edge in enumerate(edges):
        unknown = np.full_like(values.take([0], axis), np.nan)
        step = np.diff(values, axis=axis) / edge
        ahead.append(np.concatenate([step, unknown], axis))
        behind.append(np.concatenate([unknown, step], axis))
    return np.array([ahead, behind])


_MOST_CELLS = 400_000  # in any grid's tube; a further refinement is skipped
_LEVELS = 6
_RESERVE = 0.8  # fraction of the edge that would suffice
_FLATTEST = 4.0  # largest ratio of a cell's edges
ENOUGH = 0.0115  # gap below which refinement is not worth its time
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
                                   is_first=level == 0, is_last=level == _LEVELS - 1)
    except (Cancelled, KeyboardInterrupt) as stop:
        if not all(one.levels and one.upper < np.inf for one in searches):
            raise Cancelled from stop
        stopped = True
    return [Certificate(one.lower, one.upper, one.levels, one.problem.field_error, one.to_go(),
                        stopped) for one in searches]


def _next_grid(searches: "list[_Search]", grid: Grid, cell: np.ndarray, *, is_first: bool,
               is_last: bool) -> tuple[Grid, np.ndarray] | None:
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
        if not one.is_done and not is_last:  # the cells to keep take half as long as the bound
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
        costs = np.where(has_cost, self.to_goal[box], np.nan).astype(np.float32)
        return BoundGrid(grid.points(low[None])[0], grid.edges, costs, known)

    def keep(self, upper: float) -> np.ndarray:
        """Return the cells through which a path could still be cheaper than ``upper``."""
        through = least_in_cells(self.to_goal + _from_start(self.rates, self.cell),
                                 self.open_cells)
        return self.open_cells & np.isfinite(through) & (through <= upper)


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
    to_goal = subsolution(rates, goal.known, goal.cost, goal.inside)
    return _Bounds(max(spline_value(to_goal, cell), 0.0), rates, to_goal, cell,
                   descent(grid, to_goal, cell), goal.near)


def _from_start(rates: Terrain, cell: np.ndarray) -> np.ndarray:
    h = float(rates.edges.max())
    offsets = [(edge * (np.arange(n) - k)).reshape([-1 if a == axis else 1 for a in range(3)])
               for axis, (n, k, edge) in enumerate(zip(
                   rates.open_cells.shape, cell, rates.edges, strict=True))]
    away = np.sqrt(sum(offset**2 for offset in offsets))
    rounded = np.sqrt(away**2 + 4.0 * h**2) - 2.0 * h  # a cone with a rounded tip, without a kink
    nothing = np.zeros(rates.open_cells.shape, bool)
    per_metre = rates.rate[tuple(slice(k, k + 2) for k in cell)].mean()
    u = subsolution(rates, away <= 3.0 * h, per_metre * rounded, nothing, rounds=2)
    return u - spline_value(u, cell)


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
    over, nodes = np.zeros(cells.shape, bool), np.argwhere(corners_of(cells))
    for one in problem.surely_limited():
        most = np.nan_to_num(corner_values(grid.spread(nodes, one.limit_at(grid.points(
            nodes)))).max(axis=0), nan=np.inf)
        if one.name == "force":
            over |= least_size(grid.spread(corners, force), cells) > most
            continue
        beside, values, slopes = corners, energy, force
        if one.name != "energy":
            beside = np.argwhere(widened(corners_of(cells)))
            values, slopes = one.smooth(grid.points(beside))
        over |= least_between(grid.spread(beside, values), grid.spread(
            beside, grid.along_edges(slopes)), cells) > one.smooth_limit(most)
    return over


def _separated(problem: GentleProblem, grid: Grid, open_cells: np.ndarray, wall: np.ndarray,
               ) -> BlockedError:
    share = 100.0 * open_cells.mean()
    return no_path_error(problem,
                         f"This is proven on a grid of {1e3 * grid.spacing:.1f} mm: forbidden "
                         f"cells separate the start from the goal ({share:.0f} % of the region's "
                         "box is open).").behind(least_over(problem, wall))
