"""The static parts of a scene: surface values, scan, skeleton, marks and the view."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from limber.core.constants import FOUND_SKELETON
from limber.core.numerics.rigid import principal_axes
from limber.geometry.io.clouds import read_cloud
from limber.geometry.skeleton.edits import differing
from limber.geometry.skeleton.skeleton import BRIDGED, INTERPOLATED, LIMITED, UNRESOLVED, Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.loads.loaded_branch import NamedTarget
from limber.results.scene.arrays import SceneData
from limber.results.scene.colours import colour_scale, colours_of, linear_of
from limber.results.scene.rods import add_rods
from limber.store import Branch
from limber.store.loading import load_found_skeleton, load_skeleton

ROOT, FORK, TIP, RADIUS_LIMITED, RADIUS_INTERPOLATED = 1, 2, 4, 8, 16
RADIUS_UNRESOLVED, BRIDGE, EDITED = 32, 64, 128
"""Bits of ``skeleton_flags``."""
_WRIST_RODS = 2
"""Rods before those of the gripper that belong in the picture with it."""
CLOUD_LIMIT = 2_000_000
"""Most points of a scan that are passed on; of more, an even selection."""


def add_scalar(data: SceneData, name: str, values: np.ndarray, scale: dict[str, Any]) -> None:
    """Add a value at each vertex, and its colours by a scale."""
    data.info["scalars"][name] = scale
    data.arrays[f"scalar:{name}"] = np.asarray(values, float)
    data.arrays[f"color:{name}"] = colours_of(values, scale)


def add_cloud(data: SceneData, branch: Branch) -> None:
    """Add the aligned scan, with its colours if it has any."""
    if not branch.has("cloud.ply"):
        return
    cloud = read_cloud(branch.path("cloud.ply"))
    data.info["cloud"] = {"count": len(cloud), "shown": min(len(cloud), CLOUD_LIMIT)}
    if len(cloud) > CLOUD_LIMIT:
        cloud = cloud.subset(np.linspace(0, len(cloud) - 1, CLOUD_LIMIT).astype(int))
    data.arrays["cloud"] = cloud.points.astype(np.float32)
    colour = cloud.attributes.get("color")
    if colour is not None:
        linear = linear_of(np.asarray(colour, float) / 255)
        data.arrays["cloud_color"] = np.column_stack([linear, np.ones(len(linear))]
                                                     ).astype(np.float32)


def add_skeleton(data: SceneData, branch: Branch) -> None:
    """Add the centreline: nodes, parents, radii with standard deviation, uncertainty and flags."""
    if not branch.has("skeleton.swc"):
        return
    skeleton = load_skeleton(branch)
    children, state = skeleton.child_counts(), skeleton.radius_state
    data.arrays |= {
        "skeleton": skeleton.nodes, "skeleton_parent": skeleton.parent,
        "skeleton_radius": skeleton.radius, "skeleton_radius_sigma": skeleton.radius_sigma,
        "skeleton_probability": skeleton.probability,
        "skeleton_order": skeleton.order,
        "skeleton_flags": (ROOT * (skeleton.parent < 0) + FORK * (children > 1)
                           + TIP * (children == 0) + RADIUS_LIMITED * (state == LIMITED)
                           + RADIUS_INTERPOLATED * (state == INTERPOLATED)
                           + RADIUS_UNRESOLVED * (state == UNRESOLVED)
                           + BRIDGE * (state == BRIDGED)
                           + EDITED * _edited(branch, skeleton)).astype(np.int32)}


def add_skeleton_rods(data: SceneData) -> None:
    """Add the centreline with its reconstructed thickness, coloured by its radius."""
    if "skeleton" not in data.arrays:
        return
    parent, radius = data.arrays["skeleton_parent"], data.arrays["skeleton_radius"]
    hung = np.flatnonzero(parent >= 0)
    add_rods(data, "skeleton", "Radii of the skeleton", data.arrays["skeleton"],
             np.column_stack([parent[hung], hung]), radius, radius,
             colour_scale(radius, "radius of the skeleton", "m", "viridis"))


def _edited(branch: Branch, skeleton: Skeleton) -> np.ndarray:
    """Return which nodes are not as reconstruct found them, shape [n]."""
    made = branch.manifest.stages.get("reconstruct")
    if made is None or "edits" not in made.reads or not branch.has(f"{FOUND_SKELETON}.csv"):
        return np.zeros(skeleton.node_count, bool)
    found = load_found_skeleton(branch, branch.manifest.alignment, made.settings["unit"])
    return differing(skeleton, found)


def add_marks(data: SceneData, mesh: TetMesh, used: np.ndarray) -> None:
    """Add control points, grasp and base, if the mesh names them."""
    points = mesh.point_data
    if "control_point" in points:
        index = np.asarray(points["control_point"]).astype(int)
        nodes = [np.flatnonzero(index == k) for k in range(index.max() + 1)]
        data.arrays["control_points"] = np.array(
            [mesh.nodes[at].mean(axis=0) for at in nodes if len(at)]).reshape(-1, 3)
    if "grasp" in points:
        at = np.flatnonzero(np.asarray(points["grasp"]) > 0)
        if len(at):
            data.arrays["grasp"] = mesh.nodes[at].mean(axis=0).reshape(1, 3)
    for name, share in (("control_points", 0.011), ("grasp", 0.012)):
        add_radii(data, name, share)
    if "fixed" in points:
        fixed = data.arrays["vertices"][np.asarray(points["fixed"])[used] > 0]
        if len(fixed):
            middle = (fixed.min(axis=0) + fixed.max(axis=0)) / 2
            radius = np.linalg.norm((fixed - middle)[:, :2], axis=1).max()
            data.info["base"] = {"centre_m": middle, "top_m": fixed[:, 2].max(),
                                 "radius_m": radius}


def add_targets(data: SceneData, targets: Sequence[NamedTarget]) -> None:
    """Add named positions, in their order; ``info["targets"]`` names them."""
    data.info["targets"] = [target.name for target in targets]
    if targets:
        data.arrays["targets"] = np.array([target.position for target in targets], float)
        add_radii(data, "targets", 0.014)


def add_radii(data: SceneData, name: str, share: float) -> None:
    """Add the radii [m] of balls that mark points: large enough to be seen outside the branch."""
    points, vertices = data.arrays.get(name, np.empty((0, 3))), data.arrays["vertices"]
    if not len(points):
        return
    distance = np.linalg.norm(points[:, None] - vertices, axis=2)
    around = np.sort(distance, axis=1)[:, :4].mean(axis=1)
    least = share * np.ptp(vertices, axis=0).max()
    data.arrays[f"{name}_radius"] = np.clip(1.35 * around, least, 2.5 * least)


def alignment(branch: Branch) -> np.ndarray:
    """Return the 4x4 matrix that takes points of the scan's file to the branch's frame [m]."""
    transform = branch.manifest.alignment
    matrix = np.eye(4)
    matrix[:3, 3] = transform.apply(np.zeros((1, 3)))[0]
    matrix[:3, :3] = (transform.apply(np.eye(3)) - matrix[:3, 3]).T
    return matrix


def map_offset(matrix: np.ndarray) -> list[float]:
    """Return the branch's origin in the scan's coordinates and unit, shape [3].

    Double precision: the add-on stores it on the object, since map coordinates lose their digits in
    the single precision of a viewport.
    """
    return np.linalg.solve(matrix[:3, :3], -matrix[:3, 3]).tolist()


def add_view(data: SceneData) -> None:
    """Add what the camera must see, and its direction: perpendicular to the plane of the motion."""
    arrays = data.arrays
    vertices = arrays["vertices"]
    paths = [arrays[f"path:{name}"] for name in data.info["paths"]]
    seen: list[Any] = [vertices, *paths]
    if "frame_bounds" in arrays:
        seen.append(_corners(arrays["frame_bounds"]))
    goal = data.info.get("goal")
    if goal:
        radius = goal["radius_m"] or 0.0
        centre = np.array(goal["centre_m"])
        seen.append(_corners(np.array([centre - radius, centre + radius])))
    branch = np.vstack(seen)
    data.info["size_m"] = np.ptp(branch, axis=0).max()
    data.info["ground_m"] = branch[:, 2].min()
    gripper = _gripper_points(data)
    arrays["view_points"] = np.vstack([branch, gripper])
    # View in which the arm is behind the branch.
    behind = (gripper.mean(axis=0) - arrays["grasp"][0])[:2] if len(gripper) else np.zeros(2)
    arrays["view_direction"] = _view_direction(np.vstack(paths or [vertices])[:, :2], behind)


def _gripper_points(data: SceneData) -> np.ndarray:
    """Return the ends of gripper and wrist in the first and the last frame [m], shape [n, 3]."""
    if "robot_ends" not in data.arrays:
        return np.empty((0, 3))
    count = data.info["robot"]["gripper_rods"] + _WRIST_RODS
    return np.concatenate([data.arrays[name][::max(1, len(data.arrays[name]) - 1), -count:]
                           for name in ("robot_starts", "robot_ends")]).reshape(-1, 3)


def _view_direction(points: np.ndarray, behind: np.ndarray) -> np.ndarray:
    """Return a unit vector that looks across the main direction of ``points`` [n, 2], downwards.

    Args:
        behind: Direction of what should be behind them [2]; zeros if nothing should.
    """
    across = principal_axes(points)[0] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    # The same side is always chosen, so that a picture can be reproduced.
    side = behind @ across if np.any(behind) else across[1]
    across = across if side >= 0 else -across
    turned = np.array([across[0] - 0.3 * across[1], across[1] + 0.3 * across[0], -0.22])
    return turned / np.linalg.norm(turned)


def _corners(bounds: np.ndarray) -> np.ndarray:
    pick = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    return np.take_along_axis(bounds, pick, axis=0)
