"""Shape functions of a mesh's tetrahedra, and gradients at quadrature points.

The elements are those of :mod:`limber.geometry.tets.element_types`. Everything refers to the rest
shape, so gradients are computed once; straight and curved sides differ only in the number of
quadrature points.
"""

import numpy as np

from limber.core.errors import InputError
from limber.geometry.tets.element_types import Quadrature, between_corners, element_with
from limber.geometry.tets.tet_mesh import TetMesh

CURVED_TOLERANCE = 1e-6
"""Relative offset of a middle node from the chord's middle above which a side is curved.
"""


def shape_functions(barycentric: np.ndarray, node_count: int) -> np.ndarray:
    """Return shape functions at barycentric points [q, 4], shape [q, node_count]."""
    return element_with(node_count).shape_functions(barycentric)


def shape_gradients(barycentric: np.ndarray, node_count: int) -> np.ndarray:
    """Return derivatives to the last three barycentric coordinates, shape [q, 3, node_count]."""
    # The first coordinate is 1 minus the others.
    to_local = np.array([[-1.0, 1, 0, 0], [-1.0, 0, 1, 0], [-1.0, 0, 0, 1]])
    return np.einsum("lk,qkn->qln", to_local, element_with(node_count).shape_gradients(barycentric))


def has_curved_sides(mesh: TetMesh) -> bool:
    """Whether any node between the corners is off their mean."""
    corners, parents = mesh.nodes[mesh.tets[:, :4]], mesh.element.parents
    if not parents:
        return False
    off = mesh.nodes[mesh.tets[:, 4:]] - between_corners(mesh.element, corners)
    chord = np.stack([corners[:, ends[-1]] - corners[:, ends[0]] for ends in parents], axis=1)
    return bool((np.linalg.norm(off, axis=2)
                 > CURVED_TOLERANCE * np.linalg.norm(chord, axis=2)).any())


def stiffness_quadrature(mesh: TetMesh) -> Quadrature:
    """Return the rule for forces and stiffness: 1 point linear, 4 straight, 14 curved."""
    return mesh.element.stiffness_rule(has_curved_sides(mesh))


def element_gradients(mesh: TetMesh, rule: Quadrature) -> tuple[np.ndarray, np.ndarray]:
    """Return gradients at rest [tet_count, q, 3, n] [1/m], and weights [tet_count, q] [m^3] that
    sum to the volume. InputError says which element is inverted or flat."""
    local = shape_gradients(rule.points, mesh.tets.shape[1])
    jacobian, determinant = _jacobian(mesh, local)
    _check_orientation(mesh, determinant)
    gradients = np.linalg.inv(jacobian) @ local
    return np.ascontiguousarray(gradients), determinant / 6.0 * rule.weights


def _jacobian(mesh: TetMesh, local: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Derivatives of positions to local coordinates [tet_count, q, 3, 3] and determinants
    [tet_count, q]; q is 1 for straight elements, where all points agree."""
    if not has_curved_sides(mesh):
        corners = mesh.nodes[mesh.tets[:, :4]]
        jacobian = (corners[:, 1:] - corners[:, :1])[:, None]
    else:
        jacobian = np.einsum("qla,eax->eqlx", local, mesh.nodes[mesh.tets])
    return jacobian, np.linalg.det(jacobian)


def node_weights(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return integrals of N_a N_b [tet_count, n, n] [m^3], and lumped [tet_count, n]: the diagonal
    scaled to the volume (Hinton, Rock and Zienkiewicz 1976), positive."""
    shape, weights = _weighted_shapes(mesh)
    consistent = np.einsum("eq,qa,qb->eab", weights, shape, shape, optimize=True)
    diagonal = np.einsum("eaa->ea", consistent)
    scale = weights.sum(axis=1) / diagonal.sum(axis=1)
    return consistent, diagonal * scale[:, None]


def volume_weights(mesh: TetMesh) -> np.ndarray:
    """Return the integral of each shape function [tet_count, n] [m^3]. Those of a quadratic
    element's corners are negative: gravity times density is consistent."""
    shape, weights = _weighted_shapes(mesh)
    return np.einsum("eq,qa->ea", weights, shape)


def _weighted_shapes(mesh: TetMesh) -> tuple[np.ndarray, np.ndarray]:
    """Return shape functions [q, n] and volume weights [m^3], [tet_count, q], for masses."""
    rule = mesh.element.mass_rule()
    determinant = _jacobian(mesh, shape_gradients(rule.points, mesh.tets.shape[1]))[1]
    return (shape_functions(rule.points, mesh.tets.shape[1]),
            determinant / 6.0 * rule.weights)


def _check_orientation(mesh: TetMesh, determinant: np.ndarray) -> None:
    scale = np.median(np.abs(determinant))
    volumes = 6 * mesh.volumes
    bad = np.flatnonzero((determinant <= 1e-12 * scale).any(axis=1) | (volumes <= 1e-12 * scale))
    if len(bad):
        centroid = ", ".join(f"{x:.4g}" for x in mesh.centroids[bad[0]])
        raise InputError(
            f"{len(bad)} tetrahedra are inverted or have no volume; the first is number {bad[0]} "
            f"at ({centroid}) m.", "Their stiffness is not defined.",
            "Orient the mesh (TetMesh.oriented) or mesh the surface again."
        ).at(mesh.centroids[bad[0]])
