"""Marks on a mesh: nodes that are fixed, grasped, or represent a control point."""

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import MeshingError
from limber.geometry.settings import GRASP_FRACTION
from limber.geometry.skeleton.control_points import FRACTIONS, control_points
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import EDGES, TetMesh

FACE_COSINE, FLAT_SHARE = 0.8, 0.5
"""Least cosine between a base face's normal and the axis; least fraction of the root's section that
these faces must cover, or there is no flat face.
"""
CLAMP_BAND = 0.2
"""Length that is held if there is no flat face, in radii of the root."""


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
        fractions: Positions of the control points along the main path.
        grasp_fraction: Position of the grasp patch along the main path.

    Raises:
        MeshingError: the base or the grasp patch has under three nodes.
    """
    tree = cKDTree(mesh.nodes)
    control = np.full(mesh.node_count, -1, np.int64)
    # Last first: where two are at the same node, the earlier one keeps it.
    for k, point in reversed(list(enumerate(control_points(skeleton, fractions)))):
        control[tree.query(point)[1]] = k
    full = np.ones(mesh.tet_count)
    return mesh.with_data(
        cell_data={"young": young * full, "poisson": poisson * full, "density": density * full},
        point_data={"fixed": base_nodes(mesh, skeleton), "control_point": control,
                    "grasp": patch_nodes(mesh, skeleton, grasp_fraction)})


def base_nodes(mesh: TetMesh, skeleton: Skeleton) -> np.ndarray:
    """1 for the nodes of the face at the root, else 0, shape [node_count].

    Only the face is held. Nodes in a band above it would be held too where the mesh is fine enough
    to have some there, and the branch would become shorter as the mesh becomes finer. Where there
    is no flat face (a scan that is rounded or ragged below), a band of ``CLAMP_BAND`` radii is
    held.
    """
    path = skeleton.main_path()
    ahead = skeleton.nodes[path[1:]] - skeleton.nodes[path[0]]
    # A fit to few points may put a node onto the root.
    direction = ahead[np.argmax(ahead.any(axis=1))]
    direction = direction / np.linalg.norm(direction)
    offset = mesh.nodes - skeleton.nodes[path[0]]
    along = offset @ direction
    across = np.linalg.norm(offset - along[:, None] * direction, axis=1)
    radius = max(float(skeleton.radius[path[0]]), 1e-9)
    beside = across < 2.0 * radius
    lowest = min(along[beside].min() if beside.any() else 0.0, 0.0)
    faces = mesh.surface_faces()
    corners = mesh.nodes[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = np.linalg.norm(normals, axis=1) / 2
    down = -(normals @ direction) / np.maximum(2 * area, 1e-300)
    # A mesher moves a flat face a little, and a cut may be oblique; its edge is still sharp.
    low = (along[faces].max(axis=1) < lowest + 0.5 * radius) & beside[faces].all(axis=1)
    face = low & (down > FACE_COSINE)
    if area[face].sum() < FLAT_SHARE * np.pi * radius**2:
        return _checked(beside & (along < max(lowest, 0.0) + CLAMP_BAND * radius), "base")
    return _checked(_nodes_of(mesh, faces[face]), "base")


def _nodes_of(mesh: TetMesh, faces: np.ndarray) -> np.ndarray:
    """Whether a node is on one of these faces, nodes halfway along their edges included."""
    chosen = np.zeros(mesh.node_count, bool)
    chosen[faces] = True
    if mesh.is_quadratic:
        edges = np.sort(faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
        keys = edges[:, 0] * mesh.node_count + edges[:, 1]
        ends = np.sort(mesh.tets[:, EDGES], axis=2)
        on_face = np.isin(ends[..., 0] * mesh.node_count + ends[..., 1], keys)
        chosen[mesh.tets[:, 4:][on_face]] = True
    return chosen


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
                           "At least three nodes are needed to hold a branch.", "Use a finer mesh.")
    return chosen.astype(np.int64)
