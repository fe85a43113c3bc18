"""The path to the goal that exceeds the limits least, if no path keeps them.

The planners follow the cost; limits only forbid poses. Here what counts is the excess over its
limit of the worst pose of a path: the least level at which cells of the trusted region connect
start and goal (:mod:`limber.planning.certificate.cells`). They are cut where the level may be
lower. If it is within the field's error, the field must be known better there.
"""

from dataclasses import dataclass

import numpy as np

from limber.planning.certificate.cells import Cells
from limber.planning.cost import resample
from limber.planning.field.energy_field import EnergyField, FieldArrays, limited
from limber.planning.goals.goal import Goal

_CUTS = 3  # of the first cells, where it counts
_MOST_CELLS = 60_000
_TURNED = 0.5  # fraction of the steepest axis's change in a cell above which another is cut too
_FINE = 0.001  # [m] between points of the path
_REFUSED = 10.0  # multiple of its limit that counts near a refused pose
_DEARER = 30.0  # weight of the length at a pose twice over its limit
_LEAST = 1e-9  # share that counts as any


@dataclass(frozen=True)
class LeastViolation:
    """A path ``points`` [n, 3] from the start into the goal; ``worst`` is the largest ratio of a
    quantity to its limit along it, 1 or less if all limits are kept."""

    points: np.ndarray
    worst: float


def easiest_path(field: EnergyField, limits: FieldArrays, start: np.ndarray, goal: Goal,
                 ) -> LeastViolation | None:
    """Return the path from ``start`` [3]; None if none stays among the samples, limits or not."""
    cells, chart = Cells.over(field), field.region.chart.plain
    for number in range(_CUTS + 1):
        shares, changes = _shares(field, limits, cells.middles()[1], cells.edges)
        known = np.isfinite(shares)
        if not known.any():
            return None
        cells, shares, changes = cells.take(known), shares[known], changes[known]
        flat, points = cells.middles()
        away = goal.excess(field, points)
        ends = away <= max(0.0, float(away.min()))
        first = int(np.linalg.norm(points - start, axis=1).argmin())
        level = max(float(cells.levels(np.maximum(shares, _LEAST), first)[ends].min()), 1.0)
        if not np.isfinite(level):
            return None
        lower = np.flatnonzero(shares - changes.sum(axis=1) <= level)
        turned = changes[lower].sum(axis=0)
        parts = np.where(turned >= _TURNED * turned.max(), 2, 1)
        if number == _CUTS or len(lower) * parts.prod() > _MOST_CELLS:
            break
        cells = cells.take(lower).cut(parts)
    some = shares <= level
    path = cells.take(some).path((np.arange(len(some)) == first)[some], ends[some],
                                 1.0 + _DEARER * np.maximum(shares[some] - 1.0, 0.0))
    if path is None:
        return None
    # Along the shell: chords are well off it.
    points = chart.curved(resample(np.concatenate([chart.map(start), flat[some][path]]), _FINE))
    return LeastViolation(points, float(max(_shares(field, limits, points)[0].max(), 0.0)))


def _shares(field: EnergyField, limits: FieldArrays, points: np.ndarray,
            edges: np.ndarray | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Return the largest ratio of a quantity, its slack added, to its limit at ``points`` [n, 3],
    shape [n], infinite outside the samples' hull and the workspace; and its change from the middle
    of a cell with ``edges`` [3] in the plain chart to its sides, [n, 3] (None: 0)."""
    shares, changes = np.full(len(points), np.inf), np.zeros((len(points), 3))
    within = field.region.height(points) <= 0.0
    within &= ((points >= limits.low) & (points <= limits.high)).all(axis=1)
    inside = points[within]
    most, change = np.where(field.region.contains(inside), 0.0, _REFUSED), changes[within]
    for one in limited(field, limits):
        share = one.share(inside)
        above = share > most
        most[above] = share[above]
        if edges is not None and above.any():
            slope = field.region.chart.plain.push_forward(inside[above], one.slope(inside[above]))
            change[above] = 0.5 * np.abs(slope) * edges / one.limit
    shares[within], changes[within] = most, change
    return shares, changes
