"""The static parts of a scene: surface values, scan, skeleton, marks and the view."""

from collections.abc import Sequence
from itertools import combinations, product
from pathlib import Path
from typing import Any

import numpy as np

from limber.cell.arm import Rods
from limber.cell.cell_file import Cell
from limber.cell.known_arms import arm_named
from limber.cell.obstacles import Box, Obstacle, Solid
from limber.cell.reach_and_collision import GRIPPER, drawn_arm, drawn_gripper
from limber.core.constants import FOUND_SKELETON
from limber.core.errors import InputError
from limber.core.files.reading import read_arrays, require_shapes
from limber.core.files.tables import read_columns
from limber.core.numerics.rigid import any_normal, matrices, principal_axes
from limber.geometry.io.clouds import read_cloud
from limber.geometry.skeleton.edits import differing
from limber.geometry.skeleton.skeleton import BRIDGED, INTERPOLATED, LIMITED, UNRESOLVED, Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.loads.loaded_branch import NamedTarget
from limber.results.cell_picture import camera_edges
from limber.results.scene.colours import SceneData, add_rods, colour_scale, colours_of, linear_of
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
    if (colour := cloud.attributes.get("color")) is not None:
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
        "skeleton_probability": skeleton.probability, "skeleton_order": skeleton.order,
        "skeleton_flags": (ROOT * (skeleton.parent < 0) + FORK * (children > 1)
                           + TIP * (children == 0) + RADIUS_LIMITED * (state == LIMITED)
                           + RADIUS_INTERPOLATED * (state == INTERPOLATED)
                           + RADIUS_UNRESOLVED * (state == UNRESOLVED) + BRIDGE * (state == BRIDGED)
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
            data.info["base"] = {"centre_m": middle, "top_m": fixed[:, 2].max(), "radius_m": radius}


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
    """Return the branch's origin in the scan's coordinates and unit, shape [3], in double
    precision: the add-on stores it on the object, as a viewport's single precision loses map
    coordinates."""
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
    """Return a unit vector that looks across the main direction of ``points`` [n, 2], downwards,
    with the direction ``behind`` [2] behind them; zeros if nothing should be."""
    across = principal_axes(points)[0] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    # The same side is always chosen, so that a picture can be reproduced.
    side = behind @ across if np.any(behind) else across[1]
    across = across if side >= 0 else -across
    turned = np.array([across[0] - 0.3 * across[1], across[1] + 0.3 * across[0], -0.22])
    return turned / np.linalg.norm(turned)


def _corners(bounds: np.ndarray) -> np.ndarray:
    pick = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    return np.take_along_axis(bounds, pick, axis=0)


# A robot's cell in a scene: arm at its home, gripper, camera's view, obstacles, workspace.

_SIDES, _RINGS = 16, 5
_LINE_M = 0.002  # radius of drawn edges
_COLOURS = {"arm": (0.10, 0.20, 0.32), "tool": (0.02, 0.05, 0.09), "second_arm": (0.43, 0.27, 0.10),
            "camera": (0.43, 0.03, 0.12), "obstacle": (0.32, 0.32, 0.32),
            "workspace": (0.15, 0.07, 0.30)}
_OBSTACLE_ALPHA = 0.35
_CORNERS = np.array(list(product((-1.0, 1.0), repeat=3)))
_EDGES = [(a, b) for a, b in combinations(range(8), 2)
          if np.abs(_CORNERS[a] - _CORNERS[b]).sum() == 2]
_SIDES_OF_BOX = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                          [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])

_Part = tuple[np.ndarray, np.ndarray]
"""Vertices [v, 3] m and triangles [f, 3]."""


def add_cell(data: SceneData, cell: Cell, obstacles: Sequence[Obstacle]) -> None:
    """Add what a cell file states as ``solid:KEY`` and ``solid_faces:KEY``, with title, colour and
    opacity in ``info["cell"]``; the arm, with what it carries, only where the scene does not show
    its dry run."""
    data.info["cell"] = {}
    base = matrices(np.array(cell.base.pose))
    home = np.array(cell.arm.home, float)
    flange = base @ cell.arm.forward(home)
    name = Path(cell.arm.name).stem
    moves = "robot" in data.info
    if not moves:
        _add(data, "arm", f"Arm {name}", _capsules(drawn_arm(cell.arm, home[None], base)))
        _add(data, "tool", "Gripper", _capsules(drawn_gripper(cell, flange[None])))
        _widen_view(data, "arm", "tool")
    if cell.second_arm is not None:
        other = arm_named(cell.second_arm.model)
        _add(data, "second_arm", f"Second arm {Path(other.name).stem}", _capsules(drawn_arm(
            other, np.array([other.home], float), matrices(np.array(cell.second_arm.base_pose)))))
    if cell.camera is not None and not (moves and cell.camera.mount == "flange"):
        _add(data, "camera", "Camera's view", _lines(camera_edges(cell, flange)))
    if cell.workspace is not None:
        low, high = np.array(cell.workspace.low_m), np.array(cell.workspace.high_m)
        corners = 0.5 * (low + high) + 0.5 * (high - low) * _CORNERS
        _add(data, "workspace", "Workspace of the grasp",
             _lines([(corners[a], corners[b]) for a, b in _EDGES]))
    for number, obstacle in enumerate(obstacles):
        _add(data, f"obstacle{number + 1}", f"Obstacle {obstacle.name}", [_surface(obstacle)],
             kind="obstacle", alpha=_OBSTACLE_ALPHA)


def _add(data: SceneData, key: str, title: str, parts: Sequence[_Part], *, kind: str = "",
         alpha: float = 1.0) -> None:
    counts = np.cumsum([0, *(len(vertices) for vertices, _ in parts)])
    data.arrays[f"solid:{key}"] = np.concatenate([vertices for vertices, _ in parts])
    data.arrays[f"solid_faces:{key}"] = np.concatenate(
        [faces + first for (_, faces), first in zip(parts, counts[:-1], strict=True)])
    data.info["cell"][key] = {"title": title, "color": _COLOURS[kind or key], "alpha": alpha}


def _widen_view(data: SceneData, *keys: str) -> None:
    """Have the picture show all of some parts."""
    points = np.vstack([data.arrays[f"solid:{key}"] for key in keys])
    middle, half = 0.5 * (points.max(0) + points.min(0)), 0.5 * np.ptp(points, axis=0)
    seen = data.arrays.get("view_points", np.empty((0, 3)))
    data.arrays["view_points"] = np.vstack([seen, middle + half * _CORNERS])


def _surface(obstacle: Obstacle) -> _Part:
    if isinstance(obstacle, Box):
        return obstacle.centre + (_CORNERS * obstacle.half) @ obstacle.axes, _SIDES_OF_BOX
    assert isinstance(obstacle, Solid)
    return obstacle.surface.vertices, obstacle.surface.faces


def _lines(ends: Sequence[tuple[np.ndarray, np.ndarray]]) -> list[_Part]:
    return [_capsule(start, end, _LINE_M) for start, end in ends]


def _capsules(rods: Rods) -> list[_Part]:
    """Closed surfaces of the rods of one pose, with round ends."""
    return [_capsule(start, end, float(radius)) for start, end, radius in
            zip(rods.starts[0], rods.ends[0], rods.radii, strict=True)]


def _capsule(start: np.ndarray, end: np.ndarray, radius: float) -> _Part:
    vector = end - start
    length = float(np.linalg.norm(vector))
    axis = vector / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    first = any_normal(axis)
    around = 2 * np.pi * np.arange(_SIDES) / _SIDES
    circle = np.outer(np.cos(around), first) + np.outer(np.sin(around), np.cross(axis, first))
    round_end = np.linspace(0.0, 0.5 * np.pi, _RINGS + 1)[:-1]
    rings = [start - radius * np.sin(tilt) * axis + radius * np.cos(tilt) * circle
             for tilt in round_end[::-1]]
    rings += [end + radius * np.sin(tilt) * axis + radius * np.cos(tilt) * circle
              for tilt in round_end]
    poles = [start - radius * axis, end + radius * axis]
    count, k = len(rings), np.arange(_SIDES)
    after = (k + 1) % _SIDES
    quads = [np.concatenate([np.column_stack([k, after, k + _SIDES]),
                             np.column_stack([after, after + _SIDES, k + _SIDES])]) + _SIDES * row
             for row in range(count - 1)]
    low, high = count * _SIDES, (count - 1) * _SIDES
    caps = [np.column_stack([after, k, np.full(_SIDES, low)]),
            np.column_stack([k + high, after + high, np.full(_SIDES, low + 1)])]
    return np.vstack([*rings, poles]), np.concatenate([*quads, *caps])


# The robot along a path: poses of its links in each frame, from the joints of a dry run.

_FARTHEST_M = 0.02
"""Distance to the dry run above which a frame's grasp belongs to another motion."""
_POSE = ("x_m", "y_m", "z_m")


def add_robot(data: SceneData, branch: Branch, plan: str | None) -> None:
    """Add the arm in each frame of the plan's motion, if `limber execute` has checked it;
    InputError if the dry run's table is damaged."""
    entry = branch.manifest.stages.get(f"execute-preview:{plan}")
    name = f"executions/{plan}-preview.csv"
    grasps = data.arrays.get("grasp_motion")
    if entry is None or grasps is None or not branch.has(name):
        return
    if (data.info.get("frames") or {}).get("name") != plan:
        return
    try:
        arm = arm_named(entry.result["model"])
    except InputError:
        # The arm's file, or the package that provides the arm, is on another computer.
        return
    names = tuple(f"q{number + 1}_rad" for number in range(len(arm.joint_names)))
    table = read_columns(branch.path(name), (*_POSE, *names), "the table of a dry run")
    positions, joints = (np.column_stack([table[column] for column in columns])
                         for columns in (_POSE, names))
    rows = _rows(positions, grasps)
    if rows is None:
        return
    base = matrices(np.asarray(entry.result["base_pose"], float))
    # The gripper's rods at each flange: start, end and radius of each in the flange's frame.
    parts = np.asarray(entry.result["gripper_rods"], float).reshape(-1, 7)
    flange = (base @ arm.forward(joints[rows]))[:, None]
    starts, ends = (np.squeeze(flange[..., :3, :3] @ points[:, :, None], -1) + flange[..., :3, 3]
                    for points in (parts[:, :3], parts[:, 3:6]))
    shape = drawn_arm(arm, joints[rows], base).joined(
        Rods((GRIPPER,) * len(parts), starts, ends, parts[:, 6]))
    data.arrays |= {"robot_starts": shape.starts, "robot_ends": shape.ends,
                    "robot_radii": shape.radii}
    data.info["robot"] = {"name": Path(arm.name).stem, "gripper_rods": len(parts)}


def _rows(positions: np.ndarray, grasps: np.ndarray) -> np.ndarray | None:
    """Return the row of the dry run nearest to each frame, in ascending order, or None, by the
    grasp's positions [m], [rows, 3] and [frames, 3]."""
    first, rows = 0, []
    for grasp in grasps:
        distances = np.linalg.norm(positions[first:] - grasp, axis=1)
        first += int(distances.argmin())
        if distances.min() > _FARTHEST_M:
            return None
        rows.append(first)
    return np.array(rows)


# The reach of the grasp in a scene: its hemisphere, and the energy field on a grid.

_GRID = 48
"""Points along the longest edge of the grid: a cell is then thinner than the trusted region, which
follows the shell that the branch yields along."""


def add_reach(data: SceneData, branch: Branch) -> None:
    """Add the hemisphere about the base that bounds the grasp's positions, and the energy there if
    it was sampled."""
    if branch.has("energy.npz"):
        _add_energy_grid(data, branch)
    elif "grasp" in data.arrays and "skeleton" in data.arrays:
        from limber.planning.field.grasp_model import Reach

        reach = Reach.of(load_skeleton(branch), data.arrays["grasp"][0])
        _add_hemisphere(data, reach.base, reach.arc_length)


def _add_energy_grid(data: SceneData, branch: Branch) -> None:
    """Add ``energy_grid`` [h, j, z] J and its colours, transparent where the field is not trusted.
    """
    from limber.planning.field.energy_field import EnergyField

    path = branch.path("energy.npz")
    content = read_arrays(path, "an energy field")
    if {"chart_base_m", "arc_length_m"} <= set(content):
        require_shapes(path, content, {"chart_base_m": (3,), "arc_length_m": ()}, "an energy field")
        _add_hemisphere(data, content["chart_base_m"], float(content["arc_length_m"]))
    try:
        field = EnergyField.read(path)
    except InputError as error:
        data.info["notes"].append(f"the energy field cannot be shown: {error}")
        return
    low, high = field.region.low, field.region.high
    counts = np.maximum(np.ceil((high - low) / (high - low).max() * _GRID).astype(int), 2)
    axes = [np.linspace(*ends) for ends in zip(low, high, counts, strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    trusted = field.region.contains(points)
    if not trusted.any():
        return
    energies = np.zeros(len(points))
    energies[trusted] = field.energy(points[trusted])
    scale = colour_scale(energies[trusted], "energy with the grasp there", "J", "inferno")
    colours = colours_of(energies, scale)
    colours[:, 3] = trusted
    data.arrays |= {"energy_grid": energies.reshape(counts).astype(np.float32),
                    "energy_grid_color": colours.reshape(*counts, 4).astype(np.float32)}
    data.info["energy_grid"] = {"low_m": low.tolist(), "high_m": high.tolist(), "scale": scale}


def _add_hemisphere(data: SceneData, base: np.ndarray, radius: float) -> None:
    data.info["hemisphere"] = {"centre_m": np.asarray(base).tolist(), "radius_m": radius,
                               "axis": [0.0, 0.0, 1.0]}
