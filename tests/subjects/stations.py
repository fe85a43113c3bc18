"""A branch seen by stations that are registered a little apart."""

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton

EYES = np.array([[1.0, 0.2, 0.3], [-0.6, 0.9, 0.0], [-0.4, -0.8, -0.2]])
SHIFTS = np.array([[-1e-3, 0.3e-3, 0.2e-3], [0.8e-3, -0.9e-3, 0.5e-3], [0.5e-3, 1e-3, -0.8e-3]])
RADIUS = 0.004


def merged(shifts: np.ndarray, eyes: np.ndarray) -> tuple[Skeleton, np.ndarray]:
    """A stem with a side branch, of one radius, and points [m] of rays that are evenly spaced."""
    rng = np.random.default_rng(5)
    stem = np.column_stack([np.zeros((76, 2)), np.linspace(0, 0.3, 76)])
    side = stem[40] + np.linspace(0.004, 0.15, 38)[:, None] * np.array([0.8, 0.1, 0.6])
    tree = Skeleton.from_edges(np.vstack([stem, side]), np.r_[-1:75, 40, 76:113],
                               np.full(114, RADIUS))
    points = []
    for eye, shift in zip(eyes, shifts, strict=True):
        node = rng.integers(1, tree.node_count, 1300)
        start = tree.nodes[tree.parent[node]]
        axis = tree.axes()[node]
        foot = start + rng.uniform(size=(1300, 1)) * (tree.nodes[node] - start)
        sight = eye / np.linalg.norm(eye)
        along = sight - (axis @ sight)[:, None] * axis
        along /= np.linalg.norm(along, axis=1)[:, None]
        beside = rng.uniform(-1, 1, 1300)
        skin = foot + RADIUS * (beside[:, None] * np.cross(axis, along)
                                 + np.sqrt(1 - beside**2)[:, None] * along)
        points.append(skin + rng.normal(0, 4e-4, (1300, 1)) * sight + shift)
    return tree, np.vstack(points)
