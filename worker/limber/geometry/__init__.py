"""Geometry of a branch: from points to skeleton, surface and tetrahedra.

A generated branch and its scan, with the ground truth:

>>> from limber.geometry import generate_branch
>>> branch = generate_branch(1, length=0.3, fork_count=0)
>>> branch.skeleton.branch_count, len(branch.cloud) > 1000, branch.young.shape
(1, True, (4,))
"""

from limber.core.optional import exports

_PLACES = {
    "BranchSpec": "settings",
    "Cloud": "cloud.cloud",
    "MeshSurfaceSettings": "settings",
    "ReconstructSettings": "settings",
    "Reconstruction": "reconstruction",
    "Skeleton": "skeleton.skeleton",
    "Surface": "surface.surface",
    "TetMesh": "tets.tet_mesh",
    "control_points": "skeleton.skeleton",
    "generate_branch": "generated",
    "mesh_body": "bodies",
    "mesh_branch": "tets.tetrahedra",
    "read_points": "io.clouds",
    "register_element": "tets.element_types",
    "reconstruct_cloud": "reconstruction",
    "straight_beam": "tets.tree_sweep",
}

__getattr__, __dir__ = exports(__name__, _PLACES)
__all__ = list(_PLACES)
