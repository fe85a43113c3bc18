"""The piece of a branch inside a clamping gripper, on whatever mesh.

Inside its gripper a branch does not bend, and how long that piece is counts: held over 5 mm less, a
branch is softer by percents, and where little of it is left between gripper and the next point, by
a half. On a mesh the held nodes end up to an element short of where the gripper does; and where the
gripper's force and torque lead, no node is held at all. So the tetrahedra in the gripper are as
stiff as they have to be: of one that is inside with the part p of its length along the branch,
only the rest bends, which is in series with it: its compliance is 1 - p of the material's.
"""

import numpy as np

from limber.core.numerics.rigid import principal_axes
from limber.geometry.tets.tet_mesh import EDGES, TetMesh

STIFFEST = 100.0
"""What is all inside is so much stiffer than its material: of its length a hundredth bends."""
_NEAR_RADII, _NEAR_NODES = 4.0, 30
"""Nodes nearer than so many half lengths, at least so many, tell the branch's axis there."""
_BESIDE = 3.0
"""What is farther from the axis than so many times its neighbours' mean distance is a twig."""


def parts_between(mesh: TetMesh, point: np.ndarray, half_length: float) -> np.ndarray:
    """Return how much of each tetrahedron's length along the branch is in a gripper, [tet_count].

    Args:
        point: The gripper's middle [m], on the branch.
        half_length: Of the piece that it holds [m].
    """
    along, is_beside = _placed(mesh, point, half_length)
    corners = mesh.tets[:, :4]
    first, last = along[corners].min(axis=1), along[corners].max(axis=1)
    inside = np.minimum(last, half_length) - np.maximum(first, -half_length)
    parts = np.clip(inside / np.maximum(last - first, 1e-300), 0.0, 1.0)
    parts[is_beside[corners].any(axis=1)] = 0.0
    return parts


def nodes_between(mesh: TetMesh, point: np.ndarray, half_length: float) -> np.ndarray:
    """Return the nodes of what a gripper holds, arguments as of :func:`parts_between`.

    Those halfway along an edge of which only one end is in there are left out: they would hold
    more of a tetrahedron that the gripper's end cuts than its part inside.
    """
    along, is_beside = _placed(mesh, point, half_length)
    held = (np.abs(along) <= half_length) & ~is_beside
    if mesh.is_quadratic:
        cut = ~held[mesh.tets[:, EDGES]].all(axis=2)
        held[mesh.tets[:, 4:][cut]] = False
    return np.flatnonzero(held)


def _placed(mesh: TetMesh, point: np.ndarray, half_length: float) -> tuple[np.ndarray, np.ndarray]:
    """Where nodes are along the branch's axis at a point [m], and which are not of this branch."""
    away = mesh.nodes - np.asarray(point, float)
    distance = np.linalg.norm(away, axis=1)
    reach = max(_NEAR_RADII * half_length, np.sort(distance)[min(
        _NEAR_NODES, mesh.node_count) - 1])
    near = distance <= reach
    axis = principal_axes(away[near])[0]
    along = away @ axis
    beside = np.linalg.norm(away - along[:, None] * axis, axis=1)
    return along, beside > max(2 * half_length, _BESIDE * beside[near].mean())


def stiffening(parts: np.ndarray) -> np.ndarray:
    """Return by how much tetrahedra with these parts in a gripper are stiffer than their material.
    """
    return 1.0 / np.maximum(1.0 - parts, 1.0 / STIFFEST)
