"""Content of a Blender scene of a branch folder: arrays ready for display, and their meaning.

The add-on computes nothing. Colours, tick labels and the view direction are therefore computed
here. One ``.npz`` file passes them to Blender's process: plain arrays (nothing pickled), and
``info``, a JSON text. Vertices are those of the mesh's surface in the order of the PC2 frames:
``mesh.surface_faces()`` compacted by ``numpy.unique``.

Arrays (m, s, J, Pa; missing parts of a folder are omitted):

==============================================  ====================================================
``vertices`` [v, 3], ``faces`` [f, 3]           the surface
``scalar:NAME`` [v], ``color:NAME`` [v, 4]      values at rest, or the worst of all frames, and
                                                linear colours; NAME in ``info["scalars"]``
``frame_scalar:NAME`` [frames, v]               the same in each frame; ``info["frame_scalars"]``
``frame_level:NAME`` [frames, v] bytes,         its colours: which of the palette that the scale's
``palette:COLOURS`` [256, 4]                    ``colours`` names
``frame_times``, ``frame_energy``,              one number a frame: ``info["frames"]`` says
``frame_kinetic_energy``, ``frame_min_det_f``,  ``rate_hz`` and whether the times are those of a
``frame_strain`` [frames]                       motion (``is_timed``) or one pose a frame
``cloud`` [c, 3], ``cloud_color`` [c, 4]        the aligned scan
``skeleton`` [n, 3], ``skeleton_parent``,       the centreline; flags: 1 root, 2 fork, 4 tip, 8
``skeleton_radius``, ``skeleton_radius_sigma``  radius limited, 16 interpolated, 32 unresolved, 64
``skeleton_order``, ``skeleton_probability``,   bridged, 128 edited; the probability that a node
``skeleton_flags`` [n]                          is there
``control_points`` [k, 3], ``grasp`` [1, 3],    marks at rest, the radii of the balls that mark them
``targets`` [t, 3]; each with ``_radius``       (``info["targets"]`` names the targets)
``control_points_motion`` [frames, k, 3],       where they are in each frame
``targets_motion``, ``grasp_motion`` [frames, 3]
``path:KEY`` [p, 3], ``path_pose:KEY`` [p, 6],  paths of ``info["paths"]``: points, poses, energy
``path_energy:KEY`` ``path_force:KEY``          (colours by ``info["path_energy"]``), force, strain
``path_strain:KEY`` [p], ``path_color:KEY``
``tree:KEY`` [q, 3], ``tree_parent:KEY`` [q]    search trees of ``info["trees"]``: nodes, and which
                                                earlier one each hangs on (-1: none)
``rods:NAME`` [u, 3], ``rod_faces:NAME``        thin rods in the colours of ``info["rods"]``:
[x, 3], ``rod_color:NAME`` [u, 4]               ``plan``, ``baseline`` by energy, ``skeleton`` as
                                                thick as it is, ``fit`` along simulated points
                                                with balls at measured ones
``energy_grid`` [h, j, z],                      the field's energy on the grid of
``energy_grid_color`` [h, j, z, 4]              ``info["energy_grid"]`` (``low_m``, ``high_m``,
                                                ``scale``); transparent where it is not trusted
``observation`` [t, m, 3], ``observation_       what was measured in the pull that
visible`` [t, m], ``observation_times`` [t],    ``info["observation"]`` names, and the gripper
``observation_grasp`` [g, 3], ``observation_
grasp_times`` [g]
``observation_motion`` [frames, m, 3],          the same points in each frame, where the frames
``observation_seen`` [frames, m]                are of that pull
``robot_starts``, ``robot_ends`` [frames, n,    rods with round ends: the arm of the plan's dry
3], ``robot_radii`` [n]                         run from foot to wrist, then the gripper, of which
                                                ``info["robot"]`` says the name and the last rods
``solid:KEY`` [u, 3], ``solid_faces:KEY``       surfaces of a cell, of which ``info["cell"]``
[x, 3]                                          says title, colour and opacity
``frame_bounds`` [2, 3], ``view_points``,       what the camera must see, and its direction
``view_direction`` [3]
==============================================  ====================================================

``info`` also has ``graphs`` (see :mod:`limber.results.scene.graphs`), ``goal`` and ``hemisphere``
(centre, radius, axis), ``base``, ``alignment`` (4x4, scan's file to branch), ``map_offset`` (the
branch's origin in the scan's coordinates, double precision), ``uuid`` and ``source``.
"""

from collections.abc import Sequence

import numpy as np

from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.loads.loaded_branch import NamedTarget
from limber.results.findings import modulus_origin
from limber.results.motion_files import node_average
from limber.results.scene.animation import add_fit, add_motion, add_observation, add_plan
from limber.results.scene.colours import FORMAT, SceneData, colour_scale
from limber.results.scene.still_objects import (
    add_cloud,
    add_marks,
    add_reach,
    add_robot,
    add_scalar,
    add_skeleton,
    add_skeleton_rods,
    add_targets,
    add_view,
    alignment,
    map_offset,
)
from limber.store import Branch

__all__ = ["FORMAT", "SceneData", "scene_data"]


def scene_data(branch: Branch, plan: str | None = None, motion: str | None = None,
               targets: Sequence[NamedTarget] = (), strength: float | None = None) -> SceneData:
    """Collect what can be shown of ``branch``: a plan's paths, by default the newest's, a motion's
    frames, by default the plan's, else the newest, named ``targets``; ``strength``: breaking stress
    of the wood [Pa], else assumed. BranchFolderError without mesh, plan or frames, or if these
    belong to another mesh."""
    mesh = TetMesh.read(branch.require("mesh.vtu", "reconstruct"))
    faces = mesh.surface_faces()
    used, compact = np.unique(faces, return_inverse=True)
    data = SceneData({"vertices": mesh.nodes[used], "faces": compact.reshape(-1, 3)})
    matrix = alignment(branch)
    data.info = {"format": FORMAT, "name": branch.name, "folder": str(branch.folder.resolve()),
                 "uuid": branch.uuid, "unit": "m", "scalars": {}, "frame_scalars": {}, "paths": {},
                 "rods": {}, "graphs": {},
                 "notes": [_size_note(branch, mesh)], "source": branch.manifest.source,
                 "alignment": matrix, "map_offset": map_offset(matrix)}
    if "young" in mesh.cell_data:
        young = (node_average(mesh) @ mesh.cell_data["young"])[used]
        title = f"Young's modulus ({modulus_origin(branch)})"
        add_scalar(data, "young", young, colour_scale(young, title, "Pa", "viridis"))
    add_cloud(data, branch)
    add_skeleton(data, branch)
    add_skeleton_rods(data)
    add_marks(data, mesh, used)
    add_targets(data, targets)
    plan = add_plan(data, branch, plan)
    add_reach(data, branch)
    add_motion(data, branch, plan, motion, strength)
    add_robot(data, branch, plan)
    add_observation(data, branch)
    add_fit(data, branch, (data.info.get("observation") or {}).get("pull"))
    add_view(data)
    data.arrays = {name: np.ascontiguousarray(array) for name, array in data.arrays.items()}
    return data


def _size_note(branch: Branch, mesh: TetMesh) -> str:
    length = (branch.made.result if branch.made else {}).get("length_m")
    extent = f"{length:.2f} m of centreline" if length else f"{np.ptp(mesh.nodes[:, 2]):.2f} m high"
    return f"{extent}, {mesh.tet_count} tetrahedra"
