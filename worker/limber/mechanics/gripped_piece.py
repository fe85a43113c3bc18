"""The piece of a branch inside a clamping gripper, on any mesh.

A branch does not bend inside the gripper, and the length of that piece matters: held over 5 mm
less, a branch is softer by several percent, and by a half if the piece between gripper and the next
point is short. On a mesh the held nodes end up to an element short of the gripper's end; if force
and torque drive the pull, no node is held at all. The tetrahedra in the gripper are therefore
made stiffer: of a tetrahedron with the fraction p of its length along the branch inside,
only the remainder bends, in series with it. Its compliance is 1 - p of the material's.
"""

import numpy as np

from limber.core.numerics.rigid import principal_axes
from limber.geometry.tets.tet_mesh import TetMesh

STIFFEST = 100.0
"""Stiffness factor of elements that are entirely inside: a hundredth of their length bends."""
_NEAR_RADII, _NEAR_NODES = 4.0, 30
"""Distance in half lengths, and fewest nodes, that define the branch's axis there."""
_BESIDE = 3.0
"""Distance from the axis, relative to the mean of the neighbours, above which a node belongs to a
twig.
"""


def parts_between(mesh: TetMesh, point: np.ndarray, half_length: float) -> np.ndarray:
    """Return the fraction of each tetrahedron's length along the branch in a gripper, [tet_count].

    Args:
        point: Centre of the gripper [m], on the branch.
        half_length: Half the length of the piece that it holds [m].
    """
    along, is_beside = _placed(mesh, point, half_length)
    corners = mesh.tets[:, :4]
    first, last = along[corners].min(axis=1), along[corners].max(axis=1)
    inside = np.minimum(last, half_length) - np.maximum(first, -half_length)
    parts = np.clip(inside / np.maximum(last - first, 1e-300), 0.0, 1.0)
    parts[is_beside[corners].any(axis=1)] = 0.0
    return parts


def nodes_between(mesh: TetMesh, point: np.ndarray, half_length: float) -> np.ndarray:
    """Return the nodes that a gripper holds; arguments as for :func:`parts_between`.

    Nodes between corners of which not all are inside are left out: they would hold more of a
    tetrahedron cut by the gripper's end than its part inside.
    """
    along, is_beside = _placed(mesh, point, half_length)
    held = (np.abs(along) <= half_length) & ~is_beside
    corners = held[mesh.tets[:, :4]]
    for number, parents in enumerate(mesh.element.parents):
        cut = ~corners[:, list(parents)].all(axis=1)
        held[mesh.tets[cut, 4 + number]] = False
    return np.flatnonzero(held)


def _placed(mesh: TetMesh, point: np.ndarray, half_length: float) -> tuple[np.ndarray, np.ndarray]:
    """Positions of nodes along the branch's axis at a point [m], and which nodes belong to another
    branch.
    """
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
    """Return the stiffness factors of tetrahedra with these fractions inside a gripper.
    """
    return 1.0 / np.maximum(1.0 - parts, 1.0 / STIFFEST)
