"""Separation of leaves from stems by shape: planarity, thickness, curvature at several scales.

Around a point of a leaf the scan is a sheet: wide in two directions, thin in the third. On a stem
this holds only within a fraction of the stem's radius. Beyond it the stem is round or, where only
one side was seen, as curved as it is wide; farther out it is a line. So a neighbourhood that is
flat and wide at one scale, and neither round nor a line at the next ones, belongs to a leaf. In a
scan whose points are as far apart as its twigs are thick, twigs that fork in one plane are wide and
flat at a scale that
contains several of them. There each point is on a line at a finer scale; on a leaf it is not.
"""

from dataclasses import dataclass

import numpy as np
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from limber.geometry.cloud.canonical_frame import OwnFrame
from limber.geometry.cloud.preparation import voxel_thinned

_CELL = 0.25  # cell size, as a fraction of the scale
_FINEST = 4.0  # in point spacings
_STEP = 1.5  # ratio between scales
_SCALES = 8
_WIDE = 0.3  # second over first variance above which a neighbourhood is not a line
_FLAT = 0.06  # third over second variance below which it is flat
_CURVED = 0.12  # the same at the scales after the one where it is wide and flat
_AFTER = 3  # number of scales examined after it
_LEAST = 8  # fewest points of a neighbourhood
_SMALLEST = 40  # fewest points of a leaf
_PATCH = 0.1  # fraction of the largest leaf's area below which a piece is a patch of a stem
# Largest area of a stretch of stem, in areas of the largest leaf, and its least thickness over
# width: blades reach 0.14, stretches of stem and fork 0.34 and more.
_STRETCH, _THICK = 0.5, 0.25
# Thickness over width, measured on stretches as long as the piece is wide, up to which it is a
# blade: blades reach 0.26, stretches of branch that only noise makes flat 0.49 and more.
_BLADE, _ACROSS, _PLACES = 0.4, 0.6, 40
_FILLS = 33  # a point and its neighbours, by whose distances a piece is a sheet or lines
_NEAR = 3.0  # largest distance between connected points, in spacings
_AGREE = 0.5  # fraction of the neighbours that makes a point part of a leaf


@dataclass(frozen=True)
class Leaf:
    """One leaf, or several that touch.

    Attributes:
        points: Indices of its points.
        area: Area of its blade [m^2], one side.
    """

    points: np.ndarray
    area: float


def find_leaves(points: np.ndarray) -> list[Leaf]:
    """Find the leaves of a scan.

    Args:
        points: Positions [m], shape [n, 3].
    """
    own = OwnFrame.of(points)
    return [Leaf(own.order[leaf.points], leaf.area) for leaf in _found(own.coordinates)]


def _found(points: np.ndarray) -> list[Leaf]:
    if len(points) < _SMALLEST:
        return []
    spacing = float(np.median(cKDTree(points).query(points[::max(1, len(points) // 5000)], k=2)[0][
        :, 1]))
    if spacing <= 0:
        return []  # Most points coincide with another, so neighbourhoods have no shape.
    on_leaf = _on_sheets(points, spacing)
    tree = cKDTree(points)
    near = tree.query(points, k=min(16, len(points)))[1]
    for _ in range(2):
        on_leaf = on_leaf[near].mean(axis=1) > _AGREE
    return _pieces(points, _with_rims(points, on_leaf, _NEAR * spacing), _NEAR * spacing)


def _with_rims(points: np.ndarray, on_leaf: np.ndarray, reach: float) -> np.ndarray:
    """Add the remaining pieces that run along leaves: rims and folds, where a leaf is not a sheet.

    A stem touches its leaf only with its end. Specks are assigned to the nearest piece.
    """
    rest = np.flatnonzero(~on_leaf)
    if len(rest) == 0 or len(rest) == len(points):
        return on_leaf
    label, count = _labels(points[rest], reach)
    beside = cKDTree(points[on_leaf]).query(points[rest], distance_upper_bound=reach)[0] < np.inf
    rim = np.bincount(label, beside) > _AGREE * count
    large = count[label] >= _SMALLEST
    stem = rest[large & ~rim[label]]
    if len(stem):
        speck = np.flatnonzero(~large)
        blade = np.concatenate([points[on_leaf], points[rest[rim[label]]]])
        to_leaf, to_stem = (cKDTree(found).query(points[rest[speck]])[0]
                            for found in (blade, points[stem]))
        rim |= np.bincount(label[speck], to_leaf < to_stem, len(count)) > _AGREE * count
    found = on_leaf.copy()
    found[rest[rim[label]]] = True
    return found


def _labels(points: np.ndarray, reach: float) -> tuple[np.ndarray, np.ndarray]:
    """Which connected piece each point belongs to, shape [n], and the pieces' sizes."""
    pairs = cKDTree(points).query_pairs(reach, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), (len(points), len(points)))
    label = connected_components(graph, directed=False)[1]
    return label, np.bincount(label)


def _on_sheets(points: np.ndarray, spacing: float) -> np.ndarray:
    """Which points are on a sheet, shape [n]."""
    wide, flat, line = [], [], []
    for step in range(_SCALES + _AFTER):
        scale = _FINEST * spacing * _STEP**step
        chosen = voxel_thinned(points, _CELL * scale)
        values, count = _variances(points[chosen], scale)
        nearest = cKDTree(points[chosen]).query(points)[1]
        is_supported = count >= _LEAST
        broad = values[:, 1] > _WIDE * values[:, 2]
        wide.append((is_supported & broad)[nearest])
        line.append((is_supported & ~broad)[nearest])
        flat.append(np.where(is_supported, values[:, 0] / np.maximum(values[:, 1], 1e-300),
                             1.0)[nearest])
    wide, flat, line = np.array(wide), np.array(flat), np.array(line)
    found = np.zeros(len(points), bool)
    for step in range(_SCALES):
        after = flat[step + 1:step + 1 + _AFTER]
        sheet = wide[step] & ~line[:step].any(axis=0)
        found |= sheet & (flat[step] < _FLAT) & (after < _CURVED).all(axis=0)
    return found


def _variances(points: np.ndarray, scale: float) -> tuple[np.ndarray, np.ndarray]:
    """Variances of each point's neighbourhood [m^2], smallest first, [n, 3]; and its size [n]."""
    pairs = cKDTree(points).query_pairs(scale, output_type="ndarray")
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    total = len(points)
    count = 1 + np.bincount(one, minlength=total)
    offset = points[other] - points[one]
    first = np.stack([np.bincount(one, offset[:, k], total) for k in range(3)], axis=1)
    # Without a single pair, bincount returns integers, so there is no division in place.
    first = first / count[:, None]
    second = np.empty((total, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            moment = np.bincount(one, offset[:, i] * offset[:, j], total) / count
            second[:, i, j] = second[:, j, i] = moment - first[:, i] * first[:, j]
    return np.maximum(np.linalg.eigvalsh(second), 0.0), count


def _pieces(points: np.ndarray, on_leaf: np.ndarray, reach: float) -> list[Leaf]:
    """Connected points of leaves, without specks and patches of stems."""
    own = np.flatnonzero(on_leaf)
    if len(own) < _SMALLEST:
        return []
    tree = cKDTree(points[own])
    label, count = _labels(points[own], reach)
    k = min(9, len(own))
    around = tree.query(points[own], k=k)[0][:, -1]
    area = np.pi * around**2 / (k - 1)
    leaves, large = [], count[label] >= _SMALLEST
    if not large.any():
        return []
    # Specks are assigned to the nearest leaf.
    label = label[np.flatnonzero(large)[cKDTree(points[own[large]]).query(points[own])[1]]]
    for piece in np.flatnonzero(count >= _SMALLEST):
        members = np.flatnonzero(label == piece)
        # The median is used: at a leaf's edge, neighbours are missing on one side.
        leaves.append(Leaf(own[members], len(members) * float(np.median(area[members]))))
    leaves = [leaf for leaf in leaves if _is_blade(points[leaf.points], leaf.area)
              and _fills_a_sheet(points[leaf.points])]
    largest = max((leaf.area for leaf in leaves), default=0.0)
    return [leaf for leaf in leaves if leaf.area > _PATCH * largest and (
        leaf.area > _STRETCH * largest or _thickness(points[leaf.points]) < _THICK)]


def _is_blade(points: np.ndarray, area: float) -> bool:
    """Whether a piece [n, 3] of this area [m^2] is thin wherever it is as long as it is wide.

    As a whole, a bent strip may be as wide as its arc is high.
    """
    along = np.linalg.eigh(np.cov(points.T))[1][:, 2]
    tree, reach = cKDTree(points), _ACROSS * area / max(float(np.ptp(points @ along)), 1e-300)
    around = tree.query_ball_point(points[::max(len(points) // _PLACES, 1)], reach)
    thick = [_thickness(points[near]) for near in around if len(near) >= _LEAST]
    return not thick or float(np.median(thick)) < _BLADE


def _fills_a_sheet(points: np.ndarray) -> bool:
    """Whether a piece [n, 3] is likelier an evenly covered sheet than lines, as of flat twigs.

    The number of points within a distance grows with its square on a sheet, and with the distance
    itself on a line: logarithms of the ratios of distances to neighbours follow an exponential law
    of rate 2 or 1 (Levina and Bickel, 2004).
    """
    distance = cKDTree(points).query(points, k=min(_FILLS, len(points)))[0][:, 1:]
    ratio = distance[:, -1:] / np.maximum(distance[:, :-1], 1e-300)
    return bool(np.log(np.minimum(ratio, 1e6)).mean() < np.log(2))


def _thickness(points: np.ndarray) -> float:
    """Smallest extent of points [n, 3] over the next larger one, as standard deviations."""
    across, wide, _ = np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(points.T)), 0.0))
    return float(across / max(wide, 1e-300))
