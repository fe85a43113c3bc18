"""Marks on a mesh: which nodes are fixed, grasped, or stand for a control point."""

import numpy as np
from scipy.spatial import cKDTree

from limber.errors import MeshingError
from limber.geometry.settings import GRASP_FRACTION
from limber.geometry.skeleton.control_points import FRACTIONS, control_points
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh

"""Where a branch is held unless told otherwise: two thirds along its main path."""


def mark(mesh: TetMesh, skeleton: Skeleton, *, young: float, poisson: float, density: float,
         fractions: tuple[float, ...] = FRACTIONS, grasp_fraction: float = GRASP_FRACTION,
         ) -> TetMesh:
    """Return the mesh with material, base, control points and grasp patch as data.

    Args:
        mesh: Quadratic tetrahedra of the branch.
        skeleton: Its skeleton, in the same frame.
        young: Young's modulus [Pa], the same everywhere.
        poisson: Poisson's ratio.
        density: Density [kg/m^3].
        fractions: Places of the control points along the main path.
        grasp_fraction: Place of the grasp patch along the main path.

    Raises:
        MeshingError: the base or the grasp patch has under three nodes.
    """
    tree = cKDTree(mesh.nodes)
    control = np.full(mesh.node_count, -1, np.int64)
    # Last first: where two fall on one node, the earlier one keeps it.
    for k, point in reversed(list(enumerate(control_points(skeleton, fractions)))):
        control[tree.query(point)[1]] = k
    full = np.ones(mesh.tet_count)
    return mesh.with_data(
        cell_data={"young": young * full, "poisson": poisson * full, "density": density * full},
        point_data={"fixed": base_nodes(mesh, skeleton), "control_point": control,
                    "grasp": patch_nodes(mesh, skeleton, grasp_fraction)})


def base_nodes(mesh: TetMesh, skeleton: Skeleton) -> np.ndarray:
    """1 for the nodes on the flat cut at the root, else 0, shape [node_count]."""
    path = skeleton.main_path()
    direction = skeleton.nodes[path[1]] - skeleton.nodes[path[0]]
    direction /= np.linalg.norm(direction)
    offset = mesh.nodes - skeleton.nodes[path[0]]
    along = offset @ direction
    across = np.linalg.norm(offset - along[:, None] * direction, axis=1)
    radius = max(float(skeleton.radius[path[0]]), 1e-9)
    beside = across < 2.0 * radius
    # The lowest cross-section counts as the base even where the mesher has moved it a little.
    lowest = along[beside].min() if beside.any() else 0.0
    chosen = beside & (along < max(lowest, 0.0) + 0.2 * radius)
    return _checked(chosen, "base")


def patch_nodes(mesh: TetMesh, skeleton: Skeleton, fraction: float) -> np.ndarray:
    """1 for the nodes that a gripper at ``fraction`` of the main path holds, else 0."""
    centre = skeleton.point_at(fraction)
    ahead = skeleton.point_at(min(fraction + 0.01, 1.0))
    behind = skeleton.point_at(max(fraction - 0.01, 0.0))
    direction = (ahead - behind) / np.linalg.norm(ahead - behind)
    radius = skeleton.radius_at(fraction)
    offset = mesh.nodes - centre
    along = np.abs(offset @ direction)
    across = np.linalg.norm(offset - (offset @ direction)[:, None] * direction, axis=1)
    # Fingers are about as wide as the branch is thick; a coarse mesh may need a wider patch.
    for width in (1.0, 1.5, 2.0, 3.0, 5.0):
        chosen = (along < width * radius) & (across < 1.6 * radius)
        if chosen.sum() >= 6:
            break
    else:
        chosen = np.zeros(mesh.node_count, bool)
        chosen[np.argsort(np.linalg.norm(offset, axis=1))[:6]] = True
    return _checked(chosen, "grasp patch")


def _checked(chosen: np.ndarray, what: str) -> np.ndarray:
    if chosen.sum() < 3:
        raise MeshingError(f"The {what} has {int(chosen.sum())} nodes.",
                           "Three are needed to hold a branch.", "Use a finer mesh.")
    return chosen.astype(np.int64)
