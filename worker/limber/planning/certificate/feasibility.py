"""Whether a path exists, decided on cells along the low-energy surface.

Cells (:mod:`limber.planning.certificate.cells`) are cut along the undecided axes, and only where
they are open. If open cells do not connect the start's cell to one that may contain a point
of the goal, no path exists. If cells that keep all limits at their corners do, a path usually
exists.

The bound has a grid of its own (:mod:`limber.planning.certificate.lower_bound`). Its splines want
cells that are straight and not too flat; these follow the curved surface, thirty times as long
along it as off it. For four limits of force about the least on an arc of 0.6 m, 22,000 nodes here
showed the path, and 1.4 million corners of the bound's grid did not.

Values and slopes at a cell's corners bound the limited quantity from below in the cell
(:mod:`limber.planning.certificate.subsolution`). This holds for the field. The branch itself may
keep a limit where the field does not. For a proof a cell is therefore closed only where the field
exceeds the limit by more than its error, and may contain a point of the goal where a target is as
near as its error.
"""

from dataclasses import dataclass, field, replace

import numpy as np
from scipy.spatial import cKDTree

from limber.planning.certificate.cells import AT, BESIDE, Cells
from limber.planning.certificate.subsolution import CURVATURE_FACTOR, off_zero
from limber.planning.cost import resample
from limber.planning.field.valid_region import nearest_of
from limber.planning.goals.goal import allowed_points
from limber.planning.path_problem import GentleProblem, least_over

_MOST_CELLS = 100_000  # most cells evaluated at once
_DOUBTED = 0.5  # fraction of the most uncertain axis above which another axis is cut too
_FINE = 0.001  # [m] between points of a path
_MOST_NEAREST = 500  # of the reached cells, those nearest to the goal
_NOWHERE = np.empty((0, 3))


@dataclass(frozen=True)
class Verdict:
    """What cells with last ``edges`` [3] [m] along and off the shell show: a proof, or a path [k,
    3]. ``wall`` [k, 3] are middles that block it, least over a limit first; ``nearest`` [k, 3]
    those reached, nearest to the goal first, where the field does not know the target exactly."""

    edges: np.ndarray
    proven: bool = False
    closed_by_field: bool = False
    path: np.ndarray | None = None
    wall: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))
    nearest: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))


def judge(problem: GentleProblem) -> Verdict:
    """Return a path on the field, or whether it is proven that none exists; undecided if that would
    take too many cells at once."""
    on_field = _judged(replace(problem, sure=problem.limits), is_exact=True)
    if not on_field.proven:
        return on_field
    return replace(_judged(problem), closed_by_field=True)


def _judged(problem: GentleProblem, is_exact: bool = False) -> Verdict:
    """Cut cells until they prove that no path keeps the sure limits and comes within the field's
    error of the goal (0 if ``is_exact``), or contain a path, or are too many."""
    cells, wall = Cells.over(problem.energy_field), _Wall(problem)
    while True:
        cells = cells.take(~_surely_outside(problem, cells))
        positions, nodes = cells.nodes()
        over, uncertainty = _surely_over(problem, cells, positions, nodes)
        begin = cells.holding(problem.start)
        away = problem.goal.excess(problem.energy_field, positions)[nodes]
        least, bends = _least(away)
        off = np.zeros(len(positions))
        if not is_exact:
            off = problem.goal.uncertainty(problem.energy_field, positions)
        short = least - off[nodes].max(axis=1)
        ends = ~over & (short <= 0.0)
        kept = allowed_points(positions, problem.limits)[nodes]
        open_cells = np.flatnonzero(~over | begin)
        wall.add(cells.take(np.flatnonzero(over & ~begin)))
        cells, begin, ends = cells.take(open_cells), begin[open_cells], ends[open_cells]
        connected = cells.connected(begin) if begin.any() else begin
        if not (connected & ends).any():
            reached = cells.take(connected)
            return Verdict(cells.edges, proven=True, wall=wall.about(reached), nearest=_nearest(
                reached, short[open_cells][connected]) if off.any() else _NOWHERE)
        free = kept[open_cells][:, AT].all(axis=1)
        reached = free & (away[open_cells][:, AT] <= 0.0).any(axis=1)
        inner = cells.take(free)
        path = inner.path(begin[free], reached[free])
        if path is not None:
            last = open_cells[free][path[-1]]
            end = nodes[last, AT[np.argmin(away[last, AT])]]
            chart = inner.chart
            flat = np.concatenate([chart.map(problem.start), inner.middles()[0][path],
                                   chart.map(positions[end])])
            # Along the shell: the chord of a curved cell may be well off it.
            return Verdict(cells.edges, path=chart.curved(resample(flat, _FINE)))
        uncertainty = np.maximum(uncertainty[open_cells][~free].sum(axis=0),
                                 (bends / problem.goal.tolerance)[open_cells][ends].sum(axis=0))
        parts = np.where(uncertainty >= _DOUBTED * uncertainty.max(), 2, 1)
        if connected.sum() * parts.prod() > _MOST_CELLS:
            return Verdict(cells.edges)
        cells = cells.take(connected).cut(parts)


def _nearest(cells: Cells, short: np.ndarray) -> np.ndarray:
    """Return the middles [k, 3] of the cells that are least ``short`` of the goal [n], in order."""
    return cells.middles()[1][np.argsort(short, kind="stable")[:_MOST_NEAREST]]


class _Wall:
    """Cells that were closed by limits, of all sizes."""

    def __init__(self, problem: GentleProblem):
        self.problem = problem
        self.closed: list[Cells] = []

    def add(self, cells: Cells) -> None:
        self.closed.append(cells)

    def about(self, reached: Cells) -> np.ndarray:
        """Return the middles [k, 3] of those that touch any of the cells ``reached``."""
        if not len(reached.numbers):
            return np.empty((0, 3))
        own = cKDTree(reached.middles()[0] / reached.edges)
        found = [np.empty((0, 3))]
        for cells in self.closed:
            middles, points = cells.middles()
            ahead = 0.5 * float((cells.edges / reached.edges).max()) + 0.6
            away = own.query(middles / reached.edges, p=np.inf, distance_upper_bound=ahead)[0]
            found.append(points[np.isfinite(away)])
        return least_over(self.problem, np.concatenate(found))


def _surely_outside(problem: GentleProblem, cells: Cells) -> np.ndarray:
    """Return which cells have no trusted point that is in the workspace, bool [n]."""
    region, limits = problem.energy_field.region, problem.limits
    middles, points = cells.middles()
    outside = region.plane_least(middles, 0.5 * cells.edges) > 0.0
    # Mapped back, a length grows by (R + w) / R at most.
    radius = region.chart.radius
    grown = 1.0 if radius == 0.0 else np.maximum(
        1.0, 1.0 + (middles[:, 2] + 0.5 * cells.edges[2]) / radius)
    reach = grown * 0.5 * float(np.linalg.norm(cells.edges))
    outside |= np.maximum(limits.low - points, points - limits.high).max(axis=1) > reach
    if len(region.rejected):
        nearer = (nearest_of(points, region.accepted)[0]
                  - nearest_of(points, region.rejected)[0])
        outside |= nearer > 2.0 * reach
    return outside


def _surely_over(problem: GentleProblem, cells: Cells, positions: np.ndarray, nodes: np.ndarray,
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Cells in which no point keeps the sure limits, bool [n], and this one's uncertainty by axis
    [n, 3]; ``nodes`` [n, 32] number each cell's ``positions`` [m, 3]."""
    over, uncertainty = np.zeros(len(nodes), bool), np.zeros((len(nodes), 3))
    for one in problem.surely_limited():
        most = one.limit_at(positions)[nodes[:, AT]].max(axis=1)
        if one.name == "force":
            force = problem.energy_field.force(positions)[nodes]
            bends = _bends(force)
            over |= off_zero(force[:, AT]) - bends.sum(axis=1) > most
            # Between corners it may be any value between theirs.
            corners = force[:, AT].reshape(-1, 2, 2, 2, 3)
            corners = np.stack([np.linalg.norm(np.diff(corners, axis=axis), axis=-1).max(
                axis=(1, 2, 3)) for axis in (1, 2, 3)], axis=1)
            uncertainty = np.maximum(uncertainty, (bends + corners) / one.largest)
            continue
        values, slopes = one.smooth(positions)
        along = cells.chart.push_forward(positions, slopes) * cells.edges
        least, bends = _least(values[nodes], along[nodes])
        over |= least > one.smooth_limit(most)
        uncertainty = np.maximum(uncertainty, bends / one.smooth_limit(most)[:, None])
    return over, uncertainty


def _least(values: np.ndarray, slopes: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """The lower bound [n] in cells of a function with values [n, 32] at their stencils, and slopes
    [n, 32, 3] along edges times their lengths; and what curvature takes off by axis [n, 3]."""
    corners = values[:, AT]
    bends = _bends(values[..., None])
    if slopes is not None:
        ends = slopes[:, AT].reshape(-1, 2, 2, 2, 3)
        turns = np.stack([np.diff(ends[..., axis], axis=axis + 1).max(axis=(1, 2, 3))
                          for axis in range(3)], axis=1)
        bends = np.maximum(bends, 0.25 * turns)
    return corners.min(axis=1) - bends.sum(axis=1), bends


def _bends(values: np.ndarray) -> np.ndarray:
    """The largest deviation of a function with values [n, 32, c] at the stencils from the corners'
    trilinear interpolation, by its second differences along each axis [n, 3]."""
    beside = values[:, BESIDE]
    second = beside[..., 0, :] - 2.0 * values[:, None, AT] + beside[..., 1, :]
    return CURVATURE_FACTOR / 8.0 * np.linalg.norm(second, axis=-1).max(axis=2)
