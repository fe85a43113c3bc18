"""Ground in a scan, rough or on a slope: one layer of points below everything else.

Seen from above in cells, ground is in most of them, roughly in one plane, no thicker than its
roughness, and with nothing just above it except where a plant stands. The lower side of a crown is
not ground: points continue above it.
"""

import numpy as np
import scipy

_CELL = 0.03  # fraction of the cloud's diagonal
_LEAST_CELLS = 40
_BROAD, _FILLED = 0.11, 0.25  # smallest deviation across, over the diagonal; share of its box
_STEEPEST = np.deg2rad(40.0)
_ROUGH = 0.03  # largest deviation of the ground from its plane, over the diagonal
_BELOW, _NOTHING = 4.0, 0.03  # standard deviations below the plane; largest fraction of cells there
_LAYER = 3.5  # standard deviations around a cell's ground within which points belong to it
_ABOVE = 0.3  # largest fraction of cells with points in the next layer (plants)
_ROUNDS = 10


def find_ground(points: np.ndarray, up: np.ndarray, least: float) -> np.ndarray | None:
    """Find the ground below a plant.

    Args:
        points: Positions [m], shape [n, 3].
        up: The up direction, shape [3].
        least: Smallest number of points of the ground.

    Returns:
        True where a point is on it, shape [n]; None if there is none.
    """
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    up = up / np.linalg.norm(up)
    across = np.linalg.svd(up[None])[2][1:]
    flat, height = points @ across.T, points @ up
    index = np.floor((flat - flat.min(axis=0)) / (_CELL * diagonal)).astype(np.int64)
    shape = tuple(index.max(axis=0) + 1)
    _, cell = np.unique(np.ravel_multi_index(tuple(index.T), shape), return_inverse=True)
    count = np.bincount(cell)
    middle = np.stack([np.bincount(cell, values) for values in flat.T], axis=1) / count[:, None]
    if not _is_broad(middle, diagonal):
        return None
    low = np.full(len(count), np.inf)
    np.minimum.at(low, cell, height)
    plane, rough = _plane(middle, low)
    off = low - plane(middle)
    slope = float(np.hypot(*(plane(np.eye(2)) - plane(np.zeros((1, 2))))))
    if (slope > np.tan(_STEEPEST) or rough > _ROUGH * diagonal
            or np.mean(off < -_BELOW * rough) > _NOTHING):
        return None
    # Bumps are followed from the lower points of the neighbouring cells; a stem's cell has none
    # lower.
    bumps = np.full(shape, np.nan)
    where = np.full(len(count), 0)
    where[cell] = np.ravel_multi_index(tuple(index.T), shape)
    bumps.ravel()[where] = np.clip(off, -_BELOW * rough, _BELOW * rough)
    bumps = scipy.ndimage.generic_filter(bumps, _known_median, size=3, mode="constant", cval=np.nan)
    over = height - plane(flat) - bumps.ravel()[where][cell]
    near = over < 2 * _BELOW * rough
    thick = 1.4826 * float(np.median(np.abs(over[near] - np.median(over[near]))))
    top = float(np.median(over[near])) + _LAYER * thick
    ground = over < top
    next_layer = np.bincount(cell[(over > top) & (over < 2 * top)], minlength=len(count)) > 0
    if ground.sum() < least or np.mean(next_layer) > _ABOVE or not _is_broad(
            middle[np.bincount(cell[ground], minlength=len(count)) > 0], diagonal):
        return None
    return ground


def _known_median(values: np.ndarray) -> float:
    known = values[~np.isnan(values)]
    return float(np.median(known)) if len(known) else np.nan


def _is_broad(middle: np.ndarray, diagonal: float) -> bool:
    """Whether cells [k, 2] fill an area in both directions."""
    if len(middle) < _LEAST_CELLS or middle.std(axis=0).min() < _BROAD * diagonal:
        return False
    box = float(np.prod(np.ptp(middle, axis=0)))
    return len(middle) * (_CELL * diagonal)**2 > _FILLED * box


def _plane(middle: np.ndarray, low: np.ndarray):
    """The plane through the cells' lowest points, and their median distance from it [m].

    Reweighted, since plants have lower points over the ground of some cells.
    """
    system = np.column_stack([middle, np.ones(len(middle))])
    weight = np.ones(len(middle))
    for _ in range(_ROUNDS):
        root = np.sqrt(weight)[:, None]
        found = np.linalg.lstsq(root * system, root[:, 0] * low, rcond=None)[0]
        off = low - system @ found
        rough = 1.4826 * float(np.median(np.abs(off))) + 1e-12
        weight = 1 / (1 + (off / rough)**2)

    def plane(flat: np.ndarray) -> np.ndarray:
        return flat @ found[:2] + found[2]
    return plane, rough
