"""Ways in which scans of others are worse than ours: thinned, cut, seen from one side, noisy."""

from collections.abc import Callable

import numpy as np
from scipy.spatial import ConvexHull, cKDTree


def half(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Every second point, drawn at random."""
    return points[np.sort(rng.permutation(len(points))[:len(points) // 2])]


def one_sided(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """What one station sees: hidden points by the inverted hull (Katz, Tal, Basri 2007)."""
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    angle = rng.uniform(0, 2 * np.pi)
    seen = points - (points.mean(axis=0) + 2 * size * np.array([np.cos(angle), np.sin(angle), 0.1]))
    far = np.linalg.norm(seen, axis=1)
    flipped = seen * ((2 * 10**3.2 * far.max() - far) / far)[:, None]
    corners = ConvexHull(np.vstack([flipped, np.zeros(3)])).vertices
    return points[np.sort(corners[corners < len(points)])]


def cut(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """With three holes of 2 % of the size each, as where leaves or a clamp hid the wood."""
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    holes = points[rng.integers(len(points), size=3)]
    return points[cKDTree(holes).query(points)[0] > 0.01 * size]


def noisy(points: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """With heavy-tailed errors of a quarter of the point spacing."""
    spacing = float(np.median(cKDTree(points).query(points, k=2)[0][:, 1]))
    return points + 0.25 * spacing * rng.standard_t(3, size=points.shape)


DEGRADED: dict[str, Callable[[np.ndarray, np.random.Generator], np.ndarray]] = {
    "half": half, "one-sided": one_sided, "cut": cut, "noisy": noisy}
