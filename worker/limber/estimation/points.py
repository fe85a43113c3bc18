"""Observed points as a linear function of a mesh's nodal displacements."""

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from limber.geometry.tet_mesh import TetMesh

_CANDIDATES = 40


def point_operator(mesh: TetMesh, rest_points: np.ndarray) -> sparse.csr_matrix:
    """Return B, shape [3 m, 3 n], with displacements of the points = B @ displacements.ravel().

    A point inside a tetrahedron moves as its shape functions say. One outside, such as a marker
    glued onto the bark, moves with the nearest point inside and turns with the material there.

    Args:
        mesh: Linear or quadratic tetrahedra at rest.
        rest_points: [m], shape [m, 3].
    """
    tets, local, outside = _located(mesh, np.asarray(rest_points, float))
    values, gradients = _shape(local, mesh.is_quadratic)
    corners = mesh.nodes[mesh.tets[tets, :4]]
    edges = np.transpose(corners[:, 1:] - corners[:, :1], (0, 2, 1))
    # d xi / d x is the inverse of the edges; the first barycentric coordinate follows the others.
    inverse = np.linalg.inv(edges)
    slopes = np.einsum("mak,mkj->maj", gradients[:, :, 1:] - gradients[:, :, :1], inverse)
    weights = values + np.einsum("maj,mj->ma", slopes, outside)
    count, width = weights.shape
    rows = np.repeat(np.arange(count), width)
    scalar = sparse.csr_matrix((weights.ravel(), (rows, mesh.tets[tets, :width].ravel())),
                               shape=(count, mesh.node_count))
    return sparse.kron(scalar, sparse.identity(3), format="csr")


def _located(mesh: TetMesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tetrahedron, barycentric coordinates [m, 4] and what is left outside [m, 3] of each point."""
    count = min(_CANDIDATES, mesh.tet_count)
    near = cKDTree(mesh.centroids).query(points, k=count)[1].reshape(len(points), count)
    tets, local, outside = [], [], []
    for point, candidates in zip(points, near, strict=True):
        corners = mesh.nodes[mesh.tets[candidates, :4]]
        edges = np.transpose(corners[:, 1:] - corners[:, :1], (0, 2, 1))
        others = np.linalg.solve(edges, (point - corners[:, 0])[..., None])[..., 0]
        weights = np.column_stack([1 - others.sum(axis=1), others])
        inside = np.maximum(weights, 0.0)
        inside /= inside.sum(axis=1)[:, None]
        foot = np.einsum("ca,caj->cj", inside, corners)
        best = int(np.argmin(np.linalg.norm(point - foot, axis=1)))
        tets.append(candidates[best])
        local.append(inside[best])
        outside.append(point - foot[best])
    return np.array(tets), np.array(local), np.array(outside)


def _shape(local: np.ndarray, quadratic: bool) -> tuple[np.ndarray, np.ndarray]:
    """Shape functions [m, a] and their derivatives to barycentric coordinates [m, a, 4]."""
    count = len(local)
    if not quadratic:
        return local, np.broadcast_to(np.eye(4), (count, 4, 4))
    pairs = np.array([[0, 1], [1, 2], [2, 0], [0, 3], [1, 3], [2, 3]])
    first, second = local[:, pairs[:, 0]], local[:, pairs[:, 1]]
    values = np.hstack([local * (2 * local - 1), 4 * first * second])
    gradients = np.zeros((count, 10, 4))
    for corner in range(4):
        gradients[:, corner, corner] = 4 * local[:, corner] - 1
    for edge, (a, b) in enumerate(pairs):
        gradients[:, 4 + edge, a] = 4 * second[:, edge]
        gradients[:, 4 + edge, b] = 4 * first[:, edge]
    return values, gradients
