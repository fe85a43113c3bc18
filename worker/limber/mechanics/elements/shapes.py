"""Tetrahedra with 4 or 10 nodes: shape functions, quadrature, gradients at quadrature points.

Node order is VTK's (:mod:`limber.geometry.tets.tet_mesh`). Everything refers to the rest shape, so
gradients are computed once; straight and curved sides differ only in the number of quadrature
points.
"""

from dataclasses import dataclass

import numpy as np

from limber.core.errors import InputError
from limber.geometry.tets.tet_mesh import EDGES, TetMesh

CURVED_TOLERANCE = 1e-6
"""Relative offset of a middle node from the chord's middle above which a side is curved.
"""


@dataclass(frozen=True)
class Quadrature:
    """Barycentric points [q, 4] and weights [q] that sum to 1."""

    points: np.ndarray
    weights: np.ndarray


def quadrature(degree: int) -> Quadrature:
    """Return a rule on the tetrahedron that integrates polynomials of ``degree`` (1 to 5) exactly.

    Degree 4 and 5 are Keast's and Walkington's rules (11 and 14 points).
    """
    if degree <= 1:
        return Quadrature(np.full((1, 4), 0.25), np.ones(1))
    if degree == 2:
        a, b = 0.5854101966249685, 0.1381966011250105
        return Quadrature(np.full((4, 4), b) + (a - b) * np.eye(4), np.full(4, 0.25))
    first, second = 0.31088591926330060980, 0.092735250310891226402
    edge = 0.045503704125649649492
    points = [np.full((4, 4), a) + (1 - 4 * a) * np.eye(4) for a in (first, second)]
    pairs = np.full((6, 4), edge)
    for row, (i, j) in enumerate([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]):
        pairs[row, [i, j]] = 0.5 - edge
    weights = np.repeat([0.11268792571801585080, 0.073493043116361949544,
                         0.042546020777081466438], [4, 4, 6])
    return Quadrature(np.vstack([*points, pairs]), weights)


def shape_functions(barycentric: np.ndarray, node_count: int) -> np.ndarray:
    """Return shape functions at barycentric points [q, 4], shape [q, node_count]."""
    if node_count == 4:
        return barycentric.copy()
    corner = barycentric * (2 * barycentric - 1)
    return np.hstack([corner, 4 * barycentric[:, EDGES[:, 0]] * barycentric[:, EDGES[:, 1]]])


def shape_gradients(barycentric: np.ndarray, node_count: int) -> np.ndarray:
    """Return derivatives to the last three barycentric coordinates, shape [q, 3, node_count]."""
    # The first coordinate is 1 minus the others.
    to_local = np.array([[-1.0, 1, 0, 0], [-1.0, 0, 1, 0], [-1.0, 0, 0, 1]])
    if node_count == 4:
        return np.repeat(to_local[None], len(barycentric), axis=0)
    by_barycentric = np.zeros((len(barycentric), 4, 10))
    for k in range(4):
        by_barycentric[:, k, k] = 4 * barycentric[:, k] - 1
    for number, (i, j) in enumerate(EDGES):
        by_barycentric[:, i, 4 + number] = 4 * barycentric[:, j]
        by_barycentric[:, j, 4 + number] = 4 * barycentric[:, i]
    return np.einsum("lk,qkn->qln", to_local, by_barycentric)


def has_curved_sides(mesh: TetMesh) -> bool:
    """Whether any middle node of a quadratic mesh is off the middle of its side."""
    if not mesh.is_quadratic:
        return False
    ends = mesh.nodes[mesh.tets[:, EDGES]]
    off = mesh.nodes[mesh.tets[:, 4:]] - ends.mean(axis=2)
    chord = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)
    return bool((np.linalg.norm(off, axis=2) > CURVED_TOLERANCE * chord).any())


def stiffness_quadrature(mesh: TetMesh) -> Quadrature:
    """Return the rule for forces and stiffness: 1 point linear, 4 straight, 14 curved.

    Four points integrate the linear stiffness of a straight-sided quadratic element exactly, and
    are used for StVK's energy consistently; on curved sides the gradients are not polynomial.
    """
    if not mesh.is_quadratic:
        return quadrature(1)
    return quadrature(5 if has_curved_sides(mesh) else 2)


def element_gradients(mesh: TetMesh, rule: Quadrature) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients of the shape functions at rest, and volume weights.

    Returns:
        gradients [1/m], shape [tet_count, q, 3, nodes a tetrahedron], and weights [m^3], shape
        [tet_count, q]; the weights of an element sum to its volume.

    Raises:
        InputError: an element is inverted or flat; its number and position are given.
    """
    corners = mesh.nodes[mesh.tets]
    local = shape_gradients(rule.points, mesh.tets.shape[1])
    jacobian = np.einsum("qla,eax->eqlx", local, corners)
    determinant = np.linalg.det(jacobian)
    _check_orientation(mesh, determinant)
    gradients = np.linalg.solve(jacobian, np.broadcast_to(local, (*jacobian.shape[:2],
                                                                  *local.shape[1:])))
    return np.ascontiguousarray(gradients), determinant / 6.0 * rule.weights


def node_weights(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return the integrals of N_a N_b over each element, consistent and lumped.

    Returns:
        consistent [m^3], shape [tet_count, n, n], and lumped [m^3], shape [tet_count, n]: the
        diagonal scaled to the element's volume (Hinton, Rock and Zienkiewicz 1976), positive.
    """
    shape, weights = _weighted_shapes(mesh)
    consistent = np.einsum("eq,qa,qb->eab", weights, shape, shape, optimize=True)
    diagonal = np.einsum("eaa->ea", consistent)
    scale = weights.sum(axis=1) / diagonal.sum(axis=1)
    return consistent, diagonal * scale[:, None]


def volume_weights(mesh: TetMesh) -> np.ndarray:
    """Return the integral of each shape function over each element [m^3], shape [tet_count, n].

    Those of the corners of a quadratic element are negative: gravity times density is consistent.
    """
    shape, weights = _weighted_shapes(mesh)
    return np.einsum("eq,qa->ea", weights, shape)


def _weighted_shapes(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return shape functions [q, n] and volume weights [m^3], [tet_count, q], of degree 5."""
    rule = quadrature(5)
    local = shape_gradients(rule.points, mesh.tets.shape[1])
    determinant = np.linalg.det(np.einsum("qla,eax->eqlx", local, mesh.nodes[mesh.tets]))
    return (shape_functions(rule.points, mesh.tets.shape[1]),
            determinant / 6.0 * rule.weights)


def _check_orientation(mesh: TetMesh, determinant: np.ndarray) -> None:
    scale = np.median(np.abs(determinant))
    volumes = 6 * mesh.volumes
    bad = np.flatnonzero((determinant <= 1e-12 * scale).any(axis=1) | (volumes <= 1e-12 * scale))
    if len(bad):
        place = ", ".join(f"{x:.4g}" for x in mesh.centroids[bad[0]])
        raise InputError(
            f"{len(bad)} tetrahedra are inverted or have no volume; the first is number {bad[0]} "
            f"at ({place}) m.", "Their stiffness is not defined.",
            "Orient the mesh (TetMesh.oriented) or mesh the surface again.")
