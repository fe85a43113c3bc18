"""The recorded grasp on any mesh that simulates it."""

import numpy as np

from limber.core.numerics.rigid import rotation_matrix
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.grasp import Grasp
from limber.recordings.recording import GraspEntry

LEAST_NODES = 6
"""Fewest nodes of a patch; a smaller one is widened."""


def grasp_on(mesh: TetMesh, entry: GraspEntry) -> Grasp:
    """Return the recorded grasp as a patch of a mesh.

    Its centre is the recorded point. A patch of under 6 nodes is widened; the recorded length held
    by a clamping gripper is kept.

    Raises:
        InputError: the point is not on the branch, or is in its fixed base.
    """
    point = np.array(entry.point_m)
    distance = np.sort(np.linalg.norm(mesh.nodes - point, axis=1))
    if entry.mode == "rigid":
        is_off = distance[0] > 3 * entry.radius_m
        return Grasp.gripping(mesh, point, entry.radius_m, 1 if is_off else LEAST_NODES)
    if distance[0] > 3 * entry.radius_m:
        return Grasp.at(mesh, point, entry.radius_m, entry.mode)
    radius = max(entry.radius_m, distance[min(LEAST_NODES, len(distance)) - 1] * (1 + 1e-9))
    return Grasp.at(mesh, point, radius, entry.mode)


def pose_on(grasp: Grasp, entry: GraspEntry, pose: np.ndarray) -> np.ndarray:
    """Return the pose [m, rad] of a mesh's patch for a recorded pose of the grasp point."""
    arm = grasp.centre - np.array(entry.point_m)
    turn = rotation_matrix(pose[3:]) if grasp.mode == "rigid" else np.eye(3)
    return np.concatenate([pose[:3] + turn @ arm, pose[3:]])


def point_of(grasp: Grasp, entry: GraspEntry, pose: np.ndarray) -> np.ndarray:
    """Return the recorded grasp point [m], shape [3], for a pose of a mesh's patch [m, rad]."""
    arm = np.array(entry.point_m) - grasp.centre
    turn = rotation_matrix(pose[3:]) if grasp.mode == "rigid" else np.eye(3)
    return pose[:3] + turn @ arm
