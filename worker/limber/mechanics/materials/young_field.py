"""Interpolation of Young's modulus from a few control points to all tetrahedra."""

import numpy as np

from limber.core.errors import InputError
from limber.geometry.tets.tet_mesh import TetMesh


def young_weights(mesh: TetMesh, control_points: np.ndarray, power: float = 2) -> np.ndarray:
    """Return W so that Young's modulus of the tetrahedra is ``W @ young_at_control_points``.

    Inverse-distance weighting (Shepard) from control points to centroids, as in the paper. It is
    linear in Young's modulus; rows sum to 1.

    Args:
        control_points: Positions [m], shape [K, 3].
        power: Exponent of the distance.

    Returns:
        Shape [tet_count, K].

    Raises:
        InputError: there is no control point, or one is not finite.
    """
    points = np.asarray(control_points, float)
    if points.ndim != 2 or points.shape[1] != 3 or not len(points) or not np.isfinite(points).all():
        raise InputError(f"The control points have shape {points.shape}.",
                         "At least one finite position is needed.", "Give an array [K, 3].")
    distance = np.linalg.norm(mesh.centroids[:, None] - points[None], axis=2)
    # Relative to the nearest, so that no power overflows; a centroid on a control point has that
    # point's weight 1.
    nearest = np.maximum(distance.min(axis=1, keepdims=True), np.finfo(float).tiny)
    weights = (nearest / np.maximum(distance, nearest)) ** power
    return weights / weights.sum(axis=1, keepdims=True)
