"""Scans read in pieces; only the points needed to find axes and leaves are kept."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np

from limber.geometry.cloud.cloud import Cloud

MOST_POINTS = 5_000_000
"""Most points kept of a scan: a tenth of a millimetre apart on a branch of one metre."""
PIECE_POINTS = 1_000_000
"""Points that readers take from a file at once."""
_FINEST = 1e-5  # first grid step, as a fraction of the scan's size


def gathered(pieces: Iterable[Cloud], most: int = MOST_POINTS) -> Cloud:
    """Put a scan together from its pieces; one point per cell of a grid if there are too many.

    Needs memory for twice ``most`` points and a piece.

    Args:
        pieces: At least one, all with the same attributes.
        most: Most points to keep.

    Returns:
        The first points in the cells of the finest grid that leaves no more than ``most``, of grids
        each twice as wide as the last; ``left_out`` has the number of the others. The result does
        not depend on the pieces: cells of one grid are within cells of the next.
    """
    grid = _Grid(most)
    held: list[Cloud] = []
    for piece in pieces:
        held.append(piece)
        if sum(map(len, held)) > 2 * most:
            held = [grid.thinned(_together(held))]
    whole = _together(held)
    return grid.thinned(whole) if len(whole) > most else whole


class _Grid:
    """A grid that becomes coarser; all points are measured from the first one."""

    def __init__(self, most: int) -> None:
        self._most = most
        self._anchor: np.ndarray | None = None
        self._size = 0.0

    def thinned(self, cloud: Cloud) -> Cloud:
        """One point per cell, in cells large enough to keep few enough points."""
        finite = np.isfinite(cloud.points).all(axis=1)
        lost = int((~finite).sum())
        cloud = replace(cloud.subset(finite), not_finite=cloud.not_finite + lost)
        if len(cloud) <= self._most:
            return cloud
        if self._anchor is None:
            self._anchor = cloud.points[0]
        extent = float(np.ptp(cloud.points, axis=0).max())
        if self._size == 0:
            self._size = 2.0**np.floor(np.log2(max(_FINEST * extent, 1e-300)))
        chosen = self._firsts(cloud.points)
        while len(chosen) > self._most and self._size < extent:
            self._size *= 2
            chosen = chosen[self._firsts(cloud.points[chosen])]
        return replace(cloud.subset(chosen), left_out=cloud.left_out + len(cloud) - len(chosen))

    def _firsts(self, points: np.ndarray) -> np.ndarray:
        cell = np.floor((points - self._anchor) / self._size).astype(np.int64)
        cell -= cell.min(axis=0)
        extent = cell.max(axis=0) + 1
        key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
        return np.sort(np.unique(key, return_index=True)[1])


def _together(pieces: list[Cloud]) -> Cloud:
    if len(pieces) == 1:
        return pieces[0]
    first = pieces[0]
    return replace(
        first, points=np.concatenate([piece.points for piece in pieces]),
        attributes={name: np.concatenate([piece.attributes[name] for piece in pieces])
                    for name in first.attributes},
        not_finite=sum(piece.not_finite for piece in pieces),
        left_out=sum(piece.left_out for piece in pieces))
