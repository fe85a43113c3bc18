"""Checks that a mesh can be computed, and that its fixed nodes hold it."""

import numpy as np
import scipy.sparse as sp
from scipy.sparse.csgraph import connected_components

from limber.core.errors import InputError
from limber.geometry.tets.element_types import is_known
from limber.geometry.tets.tet_mesh import TetMesh


def fixed_mask(mesh: TetMesh, fixed: np.ndarray | None) -> np.ndarray:
    """Return the mask of fixed nodes.

    Raises:
        InputError: fewer than three, or all on a line, so that the branch could rotate freely.
    """
    if fixed is None:
        fixed = mesh.point_data.get("fixed", np.zeros(mesh.node_count))
        fixed = np.asarray(fixed) > 0.5
    fixed = np.asarray(fixed)
    if fixed.dtype != bool:
        mask = np.zeros(mesh.node_count, bool)
        mask[fixed] = True
        fixed = mask
    points = mesh.nodes[fixed]
    spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) if len(points) else [0]
    if len(points) < 3 or spread[1] < 1e-6 * max(spread[0], 1e-12):
        raise InputError(f"{len(points)} nodes are fixed: fewer than three, or all on one line.",
                         "The branch could move freely, so the static problem has no solution.",
                         "Mark the nodes of the base in point data `fixed`.")
    return fixed


def check_mesh(mesh: TetMesh) -> None:
    """Raise InputError for a mesh that cannot be computed: not finite, unused nodes, pieces."""
    if not np.isfinite(mesh.nodes).all():
        raise InputError("The mesh has nodes that are not finite.", "Each node needs a position.",
                         "Mesh the surface again.")
    if mesh.tets.ndim != 2 or not is_known(mesh.tets.shape[1]) or not mesh.tet_count:
        raise InputError(f"The tetrahedra have shape {mesh.tets.shape}.",
                         "Each tetrahedron needs 4 or 10 nodes, or those of a registered "
                         "element.", "Mesh the surface again.")
    used = np.zeros(mesh.node_count, bool)
    used[mesh.tets] = True
    if not used.all():
        raise InputError(f"{np.count_nonzero(~used)} nodes do not belong to any tetrahedron.",
                         "These nodes could move freely.", "Remove them from the mesh.")
    corners = mesh.tets[:, :4]
    links = sp.csr_matrix((np.ones(3 * len(corners)), (np.repeat(corners[:, 0], 3),
                                                       corners[:, 1:].ravel())),
                          (mesh.node_count, mesh.node_count))
    _, label = connected_components(links, directed=False)
    pieces = np.unique(label[np.unique(corners)], return_counts=True)[1]
    if len(pieces) > 1:
        raise InputError(f"The mesh has {len(pieces)} separate pieces with "
                         f"{', '.join(map(str, sorted(pieces)[::-1]))} corner nodes.",
                         "A piece without a connection to the fixed base could move freely.",
                         "Join the parts of the surface before meshing, or keep the largest part.")
