"""A cloud of two leaves on a stem, whose blades no cylinder fits."""

import numpy as np


def curved_leaves(count: int = 21_000) -> tuple[np.ndarray, np.ndarray]:
    """Points of a stem and two bent leaves.

    Args:
        count: Of points, a seventh of them on the stem.

    Returns:
        Points [m], shape [count, 3], and places along the leaves' midribs [m], shape [100, 3].
    """
    rng = np.random.default_rng(3)
    low = count // 7
    turn, height = rng.uniform(0, 2 * np.pi, low), rng.uniform(0, 0.06, low)
    parts, ribs = [np.stack([0.0015 * np.cos(turn), 0.0015 * np.sin(turn), height], axis=1)], []
    for side in (-1.0, 1.0):
        share, across = rng.uniform(0, 1, 3 * low), rng.uniform(-1, 1, 3 * low)
        ribs.append(_rib(side, np.linspace(0, 1, 50)))
        leaf = _rib(side, share)
        leaf[:, 1] += across * (0.001 + 0.009 * np.sin(np.pi * share)**0.7)
        parts.append(leaf)
    points = np.vstack(parts)
    return points + rng.normal(0, 1e-4, points.shape), np.vstack(ribs)


def _rib(side: float, share: np.ndarray) -> np.ndarray:
    angle = 2.2 * share
    return np.stack([side * 0.03 * np.sin(angle / 1.2), 0 * share,
                     0.06 + 0.02 * np.sin(1.3 * angle)], axis=1)
