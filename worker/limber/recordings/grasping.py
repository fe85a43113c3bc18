"""The recorded grasp on whatever mesh simulates it."""

import numpy as np

from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.grasp import Grasp, rotation_matrix
from limber.recordings.recording import GraspEntry


def grasp_on(mesh: TetMesh, entry: GraspEntry) -> Grasp:
    """Return the recorded grasp as a patch of a mesh.

    Which nodes lie within the radius differs from mesh to mesh, and with it the patch's centre: a
    few millimetres along a branch change its apparent stiffness by percents. The weights of a
    pinned grasp are therefore corrected, as little as possible, until their centre is the
    recorded point. A patch of under 6 nodes is widened.

    Raises:
        InputError: the point is not on the branch, or in its fixed base.
    """
    point = np.array(entry.point_m)
    distance = np.sort(np.linalg.norm(mesh.nodes - point, axis=1))
    if distance[0] > 3 * entry.radius_m:
        return Grasp.at(mesh, point, entry.radius_m, entry.mode)
    radius = max(entry.radius_m, distance[min(5, len(distance) - 1)] * (1 + 1e-9))
    grasp = Grasp.at(mesh, point, radius, entry.mode)
    if entry.mode == "clamped":
        return grasp
    positions = mesh.nodes[grasp.nodes] - point
    # Four conditions: the weights sum to 1 and their moment about the point vanishes.
    conditions = np.column_stack([np.ones(len(positions)), positions / radius])
    missing = np.array([1.0, 0, 0, 0]) - conditions.T @ grasp.weights
    scaled = conditions * grasp.weights[:, None]
    correction = scaled @ np.linalg.lstsq(conditions.T @ scaled, missing, rcond=1e-8)[0]
    weights = grasp.weights + correction
    return Grasp(grasp.nodes, weights, weights @ mesh.nodes[grasp.nodes], "pinned")


def pose_on(grasp: Grasp, entry: GraspEntry, pose: np.ndarray) -> np.ndarray:
    """Return the pose [m, rad] of a mesh's patch for a recorded pose of the grasp point."""
    arm = grasp.centre - np.array(entry.point_m)
    turn = rotation_matrix(pose[3:]) if grasp.mode == "clamped" else np.eye(3)
    return np.concatenate([pose[:3] + turn @ arm, pose[3:]])
