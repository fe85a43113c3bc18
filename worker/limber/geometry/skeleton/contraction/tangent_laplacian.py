"""Our own point-cloud Laplacian, for where the robust_laplacian wheel is missing."""

import numpy as np
import scipy.sparse as sparse
from scipy.spatial import Delaunay, QhullError, cKDTree


def tangent_laplacian(points: np.ndarray, neighbours: int) -> sparse.csc_matrix:
    """Return a cotangent Laplacian: Delaunay triangles around each point in its tangent plane.

    Belkin, Sun, Wang: Constructing Laplace operator from point clouds in R^d (2009); Cao et al. use
    it for contraction. Each triangle is seen from up to three points, hence the third.

    Args:
        points: Positions, shape [n, 3].
        neighbours: How many neighbours of each point are triangulated.
    """
    count = min(neighbours + 1, len(points))
    _, near = cKDTree(points).query(points, k=count)
    offset = points[near] - points[near].mean(axis=1, keepdims=True)
    _, axes = np.linalg.eigh(np.einsum("nij,nik->njk", offset, offset))
    flat = np.einsum("nij,njk->nik", offset, axes[:, :, 1:])
    triangles = [near[i][fan] for i in range(len(points)) if len(fan := _fan(flat[i]))]
    corner = np.vstack(triangles)
    rows, columns, values = [], [], []
    for k in range(3):
        a, b, c = corner[:, k], corner[:, (k + 1) % 3], corner[:, (k + 2) % 3]
        first, second = points[b] - points[a], points[c] - points[a]
        cross = np.linalg.norm(np.cross(first, second), axis=1)
        size = np.maximum(cross, 1e-3 * np.linalg.norm(first, axis=1)
                          * np.linalg.norm(second, axis=1) + 1e-300)
        # Negative cotangents (obtuse corners) would let points repel each other.
        half = np.clip(np.einsum("ij,ij->i", first, second) / size, 0.0, 10.0) / 6.0
        rows += [b, c]
        columns += [c, b]
        values += [half, half]
    shape = (len(points), len(points))
    weights = sparse.coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape).tocsc()
    return (sparse.diags(np.asarray(weights.sum(axis=1)).ravel()) - weights).tocsc()


def _fan(flat: np.ndarray) -> np.ndarray:
    """Triangles that touch point 0 in the Delaunay triangulation of points [k, 2]."""
    try:
        triangles = Delaunay(flat, qhull_options="QJ Qbb").simplices
    except QhullError:
        return np.empty((0, 3), np.int64)
    return triangles[(triangles == 0).any(axis=1)]
