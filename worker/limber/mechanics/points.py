"""Points of a branch as a linear function of a mesh's nodal displacements."""

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from limber.core.errors import InputError
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.elements.shape_functions import shape_functions, shape_gradients

_CANDIDATES = 40
_FARTHEST = 1e9  # [m]


def point_operator(mesh: TetMesh, rest_points: np.ndarray) -> sparse.csr_matrix:
    """Return B [3 m, 3 n] that moves points with the shape functions. One outside, as on a stalk,
    moves and turns with the section at its nearest point inside, by its mean gradient, in which
    bending cancels: the foot's own would stretch the stalk by the skin's strain."""
    points = np.asarray(rest_points, float)
    tets, local, outside = _located(mesh, points)
    values = shape_functions(local, mesh.tets.shape[1])
    count, width = values.shape
    rows = np.repeat(np.arange(count), width)
    scalar = sparse.csr_matrix((values.ravel(), (rows, mesh.tets[tets, :width].ravel())),
                               shape=(count, mesh.node_count))
    return sparse.kron(scalar + _stalks(mesh, points, outside), sparse.identity(3), format="csr")


def nearest_inside(mesh: TetMesh, points: np.ndarray) -> np.ndarray:
    """Return the points of a mesh that are nearest to given points [m], shape [m, 3]."""
    from trimesh.triangles import closest_point

    nearest = np.array(points, float)
    corners = mesh.nodes[mesh.surface_faces()]
    outside = np.linalg.norm(_located(mesh, nearest)[2], axis=1) > 0
    for number in np.flatnonzero(outside):
        feet = closest_point(corners, np.tile(nearest[number], (len(corners), 1)))
        nearest[number] = feet[np.linalg.norm(feet - nearest[number], axis=1).argmin()]
    return nearest


def _stalks(mesh: TetMesh, points: np.ndarray, outside: np.ndarray) -> sparse.csr_matrix:
    """Contribution of the section's rotation to a point off the section, shape [m, n]."""
    size = np.linalg.norm(outside, axis=1)
    corners = mesh.nodes[mesh.tets[:, :4]]
    volume = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])) / 6
    # Approximate thickness of a slender body.
    thickness = float(np.sqrt(volume.sum() / np.linalg.norm(np.ptp(mesh.nodes, axis=0))))
    tree, total = cKDTree(mesh.centroids), sparse.lil_matrix((len(points), mesh.node_count))
    for row in np.flatnonzero(size > 1e-3 * thickness):
        middle = points[row] - outside[row] * (1 + 0.5 * thickness / size[row])
        near = np.array(tree.query_ball_point(middle, 0.75 * thickness), int)
        near = near if len(near) else tree.query(middle, k=1)[1].reshape(1)
        slopes = _slopes(mesh, near)
        share = volume[near] / volume[near].sum()
        weights = np.einsum("t,taj,j->ta", share, slopes, outside[row])
        nodes = mesh.tets[near, :weights.shape[1]]
        summed = np.bincount(nodes.ravel(), weights.ravel(), mesh.node_count)
        used = np.flatnonzero(summed)
        total[row, used] = summed[used]
    return total.tocsr()


def _slopes(mesh: TetMesh, tets: np.ndarray) -> np.ndarray:
    """Gradients of the shape functions in space in the middle of tetrahedra [1/m] [t, nodes, 3]."""
    corners = mesh.nodes[mesh.tets[tets, :4]]
    edges = np.transpose(corners[:, 1:] - corners[:, :1], (0, 2, 1))
    # d xi / d x is the inverse of the edges.
    local = shape_gradients(np.full((1, 4), 0.25), mesh.tets.shape[1])[0]
    return np.einsum("ka,mkj->maj", local, np.linalg.inv(edges))


def _located(mesh: TetMesh, points: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Tetrahedron, barycentric coordinates [m, 4] and offset from the mesh [m, 3] of points."""
    if not (near := (np.abs(points) < _FARTHEST).all(axis=1)).all():
        raise InputError(
            f"A point at {points[~near][0]} m is farther than {_FARTHEST:g} m from the origin.",
            "No branch is that large.", "Check its coordinates and their unit."
        ).at(points[~near][0])
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
