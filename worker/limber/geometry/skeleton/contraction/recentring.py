"""Recentring: contracted points move to the axis that the scan around them indicates.

Contraction draws points inward of bends. Where only one side was seen, it ends on that side, about
0.7 radii off the axis. The scanned points of a short piece of branch lie on a circle around its
axis, whichever part of it was seen. The centre of that circle is the right position.
"""

import numpy as np
from scipy.spatial import cKDTree

_WANTED = 48  # points to which a circle is fitted
_LEAST = 11
_CHUNK = 4096
_SITES = 6000  # points with a circle of their own; the others take their neighbours' axis
_LINE = 30
_ROUND_ENOUGH = 0.5  # residual over radius below which points count as a circle
_LARGEST = 4.0  # radius over the displacement; a half circle is displaced by 0.4 radii
_STRAIGHT = 0.8  # fraction of variance along one line below which there is no axis
_FARTHEST = 1.5  # largest offset of a point from its line, over its displacement


def recentred(points: np.ndarray, contracted: np.ndarray) -> np.ndarray:
    """Move contracted points across their own line to the centre of the scanned points' circle.

    Where the points around lie on no circle (forks, leaves, strays), a point only moves to the line
    of its neighbours.

    Args:
        points: Scanned points [m], shape [n, 3].
        contracted: The same points, contracted [m], shape [n, 3].

    Returns:
        Points on the axes [m], shape [n, 3].
    """
    count = len(points)
    if count <= _LEAST:
        return contracted
    tree = cKDTree(contracted)
    rng = np.random.default_rng(0)
    order = rng.permutation(count)
    site = order[:_SITES]
    drawn = np.linalg.norm(points - contracted, axis=1)
    drawn = np.median(drawn[tree.query(contracted[site], k=min(16, count))[1]], axis=1)
    some = slice(0, 400)
    inside = float(np.median(tree.query_ball_point(
        contracted[site[some]], drawn[some], return_length=True)))
    # Only every n-th point, so that the neighbours reach about as far as a branch is thick.
    chosen = order[:max(int(count * min(1.0, _WANTED / max(inside, 1.0))),
                        min(count, 3 * _WANTED))]
    distance, near = cKDTree(contracted[chosen]).query(
        contracted[site], k=min(3 * _WANTED // 2, len(chosen)))
    near = chosen[near]
    wide = np.maximum(np.maximum(drawn, distance[:, min(_LEAST, distance.shape[1] - 1)]), 1e-300)
    weight = np.exp(-(distance / wide[:, None])**2)
    centred = np.empty((len(site), 3))
    for begin in range(0, len(site), _CHUNK):
        part = slice(begin, begin + _CHUNK)
        own = site[part]
        centred[part] = _centres(contracted[own], contracted[near[part]], points[near[part]],
                                 weight[part], drawn[part])
    _, near = cKDTree(contracted[site]).query(contracted, k=min(_LINE, len(site)))
    return _on_lines(contracted, centred[near])


def _centres(own: np.ndarray, contracted: np.ndarray, points: np.ndarray, weight: np.ndarray,
             drawn: np.ndarray) -> np.ndarray:
    """Centres for points [n, 3] with neighbours [n, k, 3] and their weights [n, k]."""
    middle, straight, axes = _lines(contracted, weight)
    across, up, along = axes[:, :, 1], axes[:, :, 0], axes[:, :, 2]
    offset = points - middle[:, None]
    u, v = (offset @ across[..., None])[..., 0], (offset @ up[..., None])[..., 0]
    trust = weight
    for _ in range(3):
        a, b, radius = _circles(u, v, trust)
        residual = np.hypot(u - a[:, None], v - b[:, None]) - radius[:, None]
        spread = 1.4826 * np.median(np.abs(residual), axis=1) + 1e-300
        trust = weight * np.clip(1 - (residual / (3 * spread[:, None]))**2, 0, None)**2
    base = middle + np.einsum("nj,nj->n", own - middle, along)[:, None] * along
    good = ((spread < _ROUND_ENOUGH * radius) & (radius < _LARGEST * drawn)
            & (np.hypot(a, b) < _FARTHEST * np.maximum(drawn, 0.7 * radius))
            & (straight > _STRAIGHT))
    return base + np.where(good, a, 0.0)[:, None] * across + np.where(good, b, 0.0)[:, None] * up


def _on_lines(points: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Each point [n, 3] on the line of its neighbours [n, k, 3]."""
    middle, _, axes = _lines(near, np.ones(near.shape[:2]))
    along = axes[:, :, 2]
    return middle + np.einsum("nj,nj->n", points - middle, along)[:, None] * along


def _lines(near: np.ndarray, weight: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Mean, fraction of variance along the main axis, and axes (main one last) of neighbours."""
    total = weight.sum(axis=1)
    middle = (weight[:, None, :] @ near)[:, 0] / total[:, None]
    offset = near - middle[:, None]
    values, axes = np.linalg.eigh((offset * weight[..., None]).transpose(0, 2, 1) @ offset)
    return middle, values[:, 2] / np.maximum(values.sum(axis=1), 1e-300), axes


def _circles(u: np.ndarray, v: np.ndarray, weight: np.ndarray,
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Centre and radius of the circle through each row of weighted points, shape [n, k].

    Taubin's fit (1991), solved by Newton's iteration following Chernov: Circular and Linear
    Regression (2010), 5.10. It is nearly unbiased on arcs, where the plain algebraic fit shrinks.
    """
    weight = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-300)
    mean_u, mean_v = (weight * u).sum(axis=1), (weight * v).sum(axis=1)
    x, y = u - mean_u[:, None], v - mean_v[:, None]
    z = x * x + y * y
    xx, yy, xy, xz, yz, zz = ((weight * product).sum(axis=1) for product in (
        x * x, y * y, x * y, x * z, y * z, z * z))
    mean_z = xx + yy
    covariance, variance = xx * yy - xy**2, zz - mean_z**2
    a3, a2 = 4 * mean_z, -3 * mean_z**2 - zz
    a1 = variance * mean_z + 4 * covariance * mean_z - xz**2 - yz**2
    a0 = xz * (xz * yy - yz * xy) + yz * (yz * xx - xz * xy) - variance * covariance
    root = np.zeros(len(u))
    for _ in range(12):
        value = a0 + root * (a1 + root * (a2 + root * a3))
        slope = a1 + root * (2 * a2 + 3 * root * a3)
        following = root - value / np.where(slope == 0, 1e-300, slope)
        root = np.where(np.isfinite(following) & (following >= 0), following, root)
    scale = root**2 - root * mean_z + covariance
    # Points on a line give an infinite circle, which the caller's limits reject.
    scale = np.where(np.abs(scale) > 1e-12 * mean_z**2, scale, 1e-12 * mean_z**2 + 1e-300)
    a = (xz * (yy - root) - yz * xy) / scale / 2
    b = (yz * (xx - root) - xz * xy) / scale / 2
    return a + mean_u, b + mean_v, np.sqrt(a * a + b * b + mean_z)
