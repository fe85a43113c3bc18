"""Rotation of a branch to upright: its principal growth direction along z."""

import numpy as np
from scipy.spatial.transform import Rotation

from limber.geometry.skeleton.skeleton import Skeleton


def upright_rotation(skeleton: Skeleton, up: np.ndarray, upright: bool) -> np.ndarray:
    """Return the rotation to the branch's frame, shape [3, 3].

    The paper aligns the principal growth direction with the global z axis; that is the first
    principal axis of the main path, from root to tip. The rotation is the shortest one after ``up``
    of the file has become z.

    Args:
        skeleton: In the file's axes.
        up: The up direction in the file's axes, shape [3].
        upright: False only rotates ``up`` to z.
    """
    first = shortest_turn(np.asarray(up, float), np.array([0.0, 0.0, 1.0]))
    if not upright:
        return first
    path = skeleton.nodes[skeleton.main_path()]
    offset = path - path.mean(axis=0)
    growth = np.linalg.svd(offset, full_matrices=False)[2][0]
    growth = growth if growth @ (path[-1] - path[0]) > 0 else -growth
    return shortest_turn(first @ growth, np.array([0.0, 0.0, 1.0])) @ first


def shortest_turn(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """Rotation by the smallest angle from direction ``start`` to ``end``, shape [3, 3]."""
    start, end = start / np.linalg.norm(start), end / np.linalg.norm(end)
    axis, cosine = np.cross(start, end), float(start @ end)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-12:
        if cosine > 0:
            return np.eye(3)
        side = np.cross(start, np.eye(3)[int(np.argmin(np.abs(start)))])
        return Rotation.from_rotvec(np.pi * side / np.linalg.norm(side)).as_matrix()
    return Rotation.from_rotvec(axis / sine * np.arctan2(sine, cosine)).as_matrix()
