"""The path to the goal that exceeds the limits least, if no path keeps them.

The planners follow the cost; limits only forbid poses. Here what counts is the excess over its
limit of the worst pose of a path: on a grid over the trusted region, along the shell that the
samples follow and as dense across it as they are, the least level at which start and goal are
connected. If that is within the field's error, the field must be known better there.
"""

from dataclasses import dataclass

import numpy as np
import scipy
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import dijkstra

from limber.planning.cost import resample
from limber.planning.field.energy_field import EnergyField, FieldArrays, limited
from limber.planning.goals.goal import Goal

_ALONG, _ACROSS = 64, 48  # grid points along the surface in each direction, and across it
_FINE = 0.001  # [m] between points of the path
_HALVINGS = 24  # halvings of the smallest excess
_NEAR = np.ones((3, 3, 3))
_REFUSED = 10.0  # multiple of its limit that counts near a refused pose
_DEARER = 30.0  # weight of the length at a pose twice over its limit


@dataclass(frozen=True)
class LeastViolation:
    """A path ``points`` [n, 3] from the start into the goal; ``worst`` is the largest ratio of a
    quantity to its limit along it, 1 or less if all limits are kept."""

    points: np.ndarray
    worst: float


def easiest_path(field: EnergyField, limits: FieldArrays, start: np.ndarray, goal: Goal,
                 ) -> LeastViolation | None:
    """Return the path from ``start`` [3]; None if none stays among the samples, limits or not."""
    chart, points_of_grid = _grid(field)
    shape = points_of_grid.shape[:3]
    points = chart.curved(points_of_grid.reshape(-1, 3))
    shares = _shares(field, limits, points).reshape(shape)
    known = np.isfinite(shares)
    if not known.any():
        return None
    away = np.full(shape, np.inf)
    away[known] = goal.distance(field, points[known.ravel()])
    ends = away <= max(goal.tolerance, float(away.min()))
    distance = np.linalg.norm(points - start, axis=1).reshape(shape)
    begin = np.unravel_index(int(np.where(known, distance, np.inf).argmin()), shape)
    level = _least_level(shares, begin, ends)
    if level is None:
        return None
    numbers = _shortest(shares, points_of_grid, level, begin, ends)
    # Along the shell: chords are well off it.
    flat = np.concatenate([chart.map(start), chart.map(points[numbers])])
    path = chart.curved(resample(flat, _FINE))
    return LeastViolation(path, float(max(_shares(field, limits, path).max(), 0.0)))


def _grid(field: EnergyField) -> tuple:
    """Return the plain chart, and places [a, a, c, 3] in it."""
    region = field.region
    chart = region.chart.plain
    flat = chart.map(region.accepted)
    low, high = flat.min(axis=0), flat.max(axis=0)
    off = np.quantile(flat[:, 2], np.linspace(0.0, 1.0, _ACROSS)) if chart.radius > 0.0 else (
        np.linspace(low[2], high[2], _ALONG))
    ticks = [np.linspace(low[0], high[0], _ALONG), np.linspace(low[1], high[1], _ALONG),
             np.unique(off)]
    return chart, np.stack(np.meshgrid(*ticks, indexing="ij"), axis=-1)


def _shares(field: EnergyField, limits: FieldArrays, points: np.ndarray) -> np.ndarray:
    """Return the largest ratio of a quantity, its slack added, to its limit at ``points`` [n, 3],
    shape [n]; infinite outside the samples' hull and the workspace."""
    out = np.full(len(points), np.inf)
    within = field.region.height(points) <= 0.0
    within &= ((points >= limits.low) & (points <= limits.high)).all(axis=1)
    inside = points[within]
    shares = np.where(field.region.contains(inside), 0.0, _REFUSED)
    for one in limited(field, limits):
        shares = np.maximum(shares, one.share(inside))
    out[within] = shares
    return out


def _least_level(shares: np.ndarray, begin: tuple, ends: np.ndarray) -> float | None:
    """Return the least level at which places no higher connect ``begin`` to one of ``ends``."""
    def leads(level: float) -> bool:
        together = scipy.ndimage.label(shares <= level, _NEAR)[0]
        return together[begin] > 0 and bool((together[ends] == together[begin]).any())

    low, high = 0.0, float(shares[np.isfinite(shares)].max())
    if not leads(high):
        return None
    if leads(1.0):
        return 1.0
    for _ in range(_HALVINGS):
        middle = 0.5 * (low + high)
        low, high = (low, middle) if leads(middle) else (middle, high)
    return high


def _shortest(shares: np.ndarray, points: np.ndarray, level: float, begin: tuple,
              ends: np.ndarray) -> np.ndarray:
    """Return the numbers of the places on the shortest path that exceeds no ``level``; the part
    over its limit counts as longer."""
    open_cells = np.flatnonzero(shares.ravel() <= level)
    number = np.full(shares.size, -1)
    number[open_cells] = np.arange(len(open_cells))
    number = number.reshape(shares.shape)
    dear = 1.0 + _DEARER * np.maximum(shares - 1.0, 0.0)
    rows, columns, lengths = [], [], []
    for step in [(i, j, k) for i in (-1, 0, 1) for j in (-1, 0, 1) for k in (-1, 0, 1)
                 if (i, j, k) > (0, 0, 0)]:
        unshifted = tuple(slice(max(0, -s), n - max(0, s)) for s, n in zip(step, shares.shape,
                                                                           strict=True))
        shifted = tuple(slice(max(0, s), n - max(0, -s)) for s, n in zip(step, shares.shape,
                                                                         strict=True))
        both = (number[unshifted] >= 0) & (number[shifted] >= 0)
        rows.append(number[unshifted][both])
        columns.append(number[shifted][both])
        distance = np.linalg.norm(points[unshifted][both] - points[shifted][both], axis=1)
        lengths.append(distance * np.maximum(dear[unshifted][both], dear[shifted][both]))
    graph = coo_matrix((np.concatenate(lengths), (np.concatenate(rows), np.concatenate(columns))),
                       shape=(len(open_cells),) * 2).tocsr()
    away, before = dijkstra(graph, directed=False, indices=number[begin], return_predecessors=True)
    reached = number[ends & (number >= 0)]
    at = int(reached[np.argmin(away[reached])])
    path = [at]
    while before[path[-1]] >= 0:
        path.append(int(before[path[-1]]))
    return open_cells[path[::-1]]
