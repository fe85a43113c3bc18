"""A branch in a Blender scene: its surface coloured and moving, paths, goal and other marks."""

import json
import math
from dataclasses import dataclass
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from . import annotations, energy_field, goal_ball
from .branches import (
    ENERGY_KEY,
    FOLDER_KEY,
    FRAME_SCALAR_KEY,
    GRASP_KEY,
    INFO_KEY,
    NAME_KEY,
    OFFSET_KEY,
    SCAN_KEY,
    SHOWS_KEY,
    UUID_KEY,
    VIEW_KEY,
    ShownBranch,
    add_object,
)
from .bridge import animation, colour_nodes, curves, materials, meshes, skeletons
from .scene_data import SceneData
from .skeleton_edits import Skeleton

# Linear colours. Those of the marks are distinct from the colour map of the branch.
COLORS = {
    "path:plan": (0.78, 0.015, 0.06),
    "path:baseline": (0.01, 0.13, 0.62),
    "goal": goal_ball.COLOUR,
    "grasp": (0.95, 0.25, 0.0),
    "control_points": (0.62, 0.02, 0.55),
    "targets": (0.75, 0.45, 0.0),
    "base": (0.10, 0.075, 0.06),
    "rest": (0.22, 0.22, 0.22),
    "robot": (0.32, 0.40, 0.48),
    "observed": annotations.MEASURED,
}


def show_branch(scene: bpy.types.Scene, data: SceneData, scalar: str | None = None,
                ) -> ShownBranch:
    """Put the branch into a collection of ``scene``; an earlier one from that folder is removed.

    Args:
        scene: Target scene.
        data: Data that the worker found in the branch folder.
        scalar: Meaning of the colours: a name of ``data.info["scalars"]``, the first by default.

    Raises:
        bridge.animation.CacheError: the frames cannot move this surface.
    """
    if bpy.context.mode != "OBJECT":
        # The object in Edit Mode may be the one shown again.
        bpy.ops.object.mode_set(mode="OBJECT")
    before = _remove_shown(scene, data)
    shown = _new_branch(scene, data, scalar)
    scene[FOLDER_KEY] = shown.collection[FOLDER_KEY]
    _add_paths(shown, data)
    _add_trees(shown, data)
    _add_skeleton(shown, data, before)
    _add_points(shown, data)
    _add_goal(shown, data)
    _add_base(shown, data)
    annotations.add_rods(shown, data)
    annotations.add_cell(shown, data)
    annotations.add_hemisphere(shown, data)
    energy_field.add(shown, data)
    _add_motion(scene, shown, data)
    for kind, things in shown.objects.items():
        for thing in things:
            thing[SHOWS_KEY] = kind
            thing.delta_location = before.place
    shown.surface.delta_location = before.place
    return shown


def place_scans(scene: bpy.types.Scene, data: SceneData) -> int:
    """Move imported scans to the branch made from them, which was set upright and to 0.

    Returns:
        Number of scans.
    """
    count = 0
    for thing in scene.objects:
        if thing.get(SCAN_KEY) == data.info["source"].get("sha256", ""):
            # In double precision: offset and alignment subtract large coordinates from each other.
            matrix = np.array(data.info["alignment"], float)
            matrix[:3, 3] += matrix[:3, :3] @ np.array(thing.get(OFFSET_KEY, (0.0,) * 3))
            thing.matrix_world = Matrix(matrix.tolist())
            count += 1
    return count


def color_by(surface: bpy.types.Object, name: str) -> None:
    """Colour ``surface`` by scalar ``name``, in Solid mode and in rendering.

    Raises:
        KeyError: the branch has no such scalar.
    """
    scale = json.loads(surface[INFO_KEY])["scalars"][name]
    label = f"{surface.name} {scale['title']}"
    material = bpy.data.materials.get(label) or materials.scalar_material(
        label, name, low=scale["low"], high=scale["high"], log=scale["log"],
        stops=scale["stops"])
    surface.data.materials.clear()
    surface.data.materials.append(material)
    if FRAME_SCALAR_KEY in surface:
        del surface[FRAME_SCALAR_KEY]
    color = f"{name}_color"
    surface.data.color_attributes.active_color = surface.data.color_attributes[color]


def _new_branch(scene: bpy.types.Scene, data: SceneData, scalar: str | None) -> ShownBranch:
    name = data.info["name"]
    collection = bpy.data.collections.new(name)
    collection[FOLDER_KEY], collection[NAME_KEY] = animation.shown_path(data.folder), name
    if data.info.get("uuid"):
        collection[UUID_KEY] = str(data.info["uuid"])
    scene.collection.children.link(collection)
    mesh = meshes.new_mesh(name, data.arrays["vertices"], data.arrays["faces"])
    surface = add_object(collection, name, mesh)
    # Not the folder: it may move, and the file with it.
    surface[INFO_KEY] = json.dumps({**data.info, "folder": None})
    surface[VIEW_KEY] = data.arrays["view_direction"].tolist()
    if "map_offset" in data.info:
        surface[OFFSET_KEY] = [float(value) for value in data.info["map_offset"]]
    if "grasp" in data.arrays:
        surface[GRASP_KEY] = [*data.arrays["grasp"][0].tolist(),
                              float(data.arrays["grasp_radius"][0])]
    for key, scale in data.info["scalars"].items():
        colour_nodes.colour_group(scale["colours"], scale["stops"])
        meshes.set_scalars(mesh, key, data.arrays[f"scalar:{key}"])
        meshes.set_colors(mesh, f"{key}_color", data.arrays[f"color:{key}"])
    names = list(data.info["scalars"])
    if names:
        color_by(surface, scalar if scalar in names else names[0])
    return ShownBranch(collection, surface)


@dataclass
class _Before:
    """State kept from a branch that is shown again: its skeleton with edits not applied yet, and
    its position beside others [m].
    """

    edited: bpy.types.Mesh | None = None
    has_skeleton_in_sight: bool = False
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)


def _remove_shown(scene: bpy.types.Scene, data: SceneData) -> _Before:
    """Remove earlier objects of this branch, also when its folder has moved since."""
    found = _Before()
    for collection in list(scene.collection.children):
        if FOLDER_KEY not in collection or not _is_same(collection, data):
            continue
        for thing in list(collection.objects):
            mesh = thing.data if thing.type == "MESH" else None
            if INFO_KEY in thing:
                found.place = tuple(thing.delta_location)
            if mesh is not None and skeletons.NODES_KEY in mesh:
                found.has_skeleton_in_sight = not thing.hide_viewport
                found.edited = mesh if skeletons.is_edited(thing) else None
            bpy.data.objects.remove(thing)
        bpy.data.collections.remove(collection)
    return found


def _is_same(collection: bpy.types.Collection, data: SceneData) -> bool:
    """Whether a collection shows the branch: its folder, or one from before it moved."""
    before = Path(bpy.path.abspath(collection[FOLDER_KEY])).resolve()
    if before == data.folder.resolve():
        return True
    same = (collection[UUID_KEY] == data.info.get("uuid") if UUID_KEY in collection
            else collection[NAME_KEY] == data.info["name"])
    return same and not before.is_dir()


def _add_paths(shown: ShownBranch, data: SceneData) -> None:
    # The baseline is a little thinner: if both coincide, both are visible.
    for key, share in (("plan", 0.0035), ("baseline", 0.0026)):
        name = f"path:{key}"
        if name not in data.arrays:
            continue
        title = data.info["paths"][key]["title"]
        tube = curves.new_tube(title, data.arrays[name], share * data.info["size_m"])
        meshes.set_one_color(tube, COLORS[name])
        material = materials.plain_material(title, COLORS[name], roughness=0.4)
        shown.objects[name] = [add_object(shown.collection, f"{title} path", tube, material)]


def _add_trees(shown: ShownBranch, data: SceneData) -> None:
    """Add the planners' search trees as lines; hidden, since they cover all of the space."""
    for key, about in (data.info.get("trees") or {}).items():
        mesh = _lines(f"{about['title']} tree", data, f"tree:{key}", f"tree_parent:{key}")
        thing = add_object(shown.collection, f"{about['title']} tree", mesh)
        thing.color = (*COLORS[f"path:{key}"], 1.0)
        thing.hide_viewport = thing.hide_render = True
        shown.objects[f"tree:{key}"] = [thing]


def _lines(name: str, data: SceneData, nodes: str, parents: str) -> bpy.types.Mesh:
    """Make a mesh of the edges of a tree."""
    parent = data.arrays[parents]
    hung = np.flatnonzero(parent >= 0)
    return meshes.new_lines(name, data.arrays[nodes], np.column_stack([parent[hung], hung]))


def _add_skeleton(shown: ShownBranch, data: SceneData, before: _Before) -> None:
    """Add the centreline with its radii, hidden at first: it is inside the branch.

    Edits that are not applied yet stay if it is the same skeleton.
    """
    if "skeleton" not in data.arrays:
        return
    skeleton = Skeleton(data.arrays["skeleton"], data.arrays["skeleton_radius"],
                        data.arrays["skeleton_parent"])
    mesh = before.edited
    if mesh is not None and not skeletons.is_of(mesh, skeleton):
        data.info["notes"].append("The skeleton was made again. Edits that were not applied are "
                                  "lost")
        bpy.data.meshes.remove(mesh)
        mesh = None
    if mesh is None:
        mesh = skeletons.new_skeleton("Skeleton", skeleton, data.arrays["skeleton_flags"])
        meshes.set_scalars(mesh, "radius_sigma", data.arrays["skeleton_radius_sigma"])
        if "skeleton_probability" in data.arrays:
            meshes.set_scalars(mesh, "probability", data.arrays["skeleton_probability"])
    thing = add_object(shown.collection, "Skeleton", mesh)
    thing.hide_viewport = not before.has_skeleton_in_sight
    thing.hide_render = True
    thing.show_in_front = True
    shown.objects["skeleton"] = [thing]


def _add_points(shown: ShownBranch, data: SceneData) -> None:
    for name, title in (("control_points", "Control point"), ("grasp", "Grasp"),
                        ("targets", "Target")):
        points = data.arrays.get(name, np.empty((0, 3)))
        if len(points) == 0:
            continue
        ball = meshes.new_sphere(title, 1.0)
        meshes.set_one_color(ball, COLORS[name])
        material = materials.plain_material(title, COLORS[name], roughness=0.35)
        shown.objects[name] = []
        for number, point in enumerate(points):
            named = data.info["targets"][number] if name == "targets" else number + 1
            thing = add_object(shown.collection, f"{title} {named}", ball, material)
            thing.location = point
            thing.scale = [data.arrays[f"{name}_radius"][number]] * 3
            if name == "targets":
                thing[goal_ball.TARGET_KEY] = named
            shown.objects[name].append(thing)


def _add_goal(shown: ShownBranch, data: SceneData) -> None:
    goal = data.info.get("goal")
    if not goal:
        return
    # Never smaller than the part that is to reach it; the legend states the tolerance.
    least = 1.6 * data.arrays["grasp_radius"][0] if "grasp_radius" in data.arrays else (
        0.02 * data.info["size_m"])
    goal_ball.add(shown, goal["kind"], goal["centre_m"], max(goal["radius_m"] or 0.0, least))


def _add_base(shown: ShownBranch, data: SceneData) -> None:
    base = data.info.get("base")
    if not base:
        return
    size = data.info["size_m"]
    bottom = min(data.info["ground_m"], base["centre_m"][2]) - 0.03 * size
    height = base["top_m"] - bottom
    block = meshes.new_cylinder("Fixed base", max(2.2 * base["radius_m"], 0.03 * size), height)
    meshes.set_one_color(block, COLORS["base"])
    material = materials.plain_material("Fixed base", COLORS["base"], roughness=0.8)
    thing = add_object(shown.collection, "Fixed base", block, material)
    thing.location = (*base["centre_m"][:2], bottom + height / 2)
    shown.objects["base"] = [thing]


def _add_robot(shown: ShownBranch, data: SceneData, speed: float) -> None:
    """Add arm and gripper, one capsule per link, moving along with the frames."""
    if "robot_starts" not in data.arrays:
        return
    starts, ends = data.arrays["robot_starts"], data.arrays["robot_ends"]
    title = f"Robot {data.info['robot']['name']}"
    material = materials.plain_material(title, COLORS["robot"], roughness=0.5)
    shown.objects["robot"] = []
    for number, radius in enumerate(data.arrays["robot_radii"].tolist()):
        reach = starts[:, number], ends[:, number]
        length = math.dist(reach[0][0], reach[1][0])
        if length < radius / 4:
            # Two joints with intersecting axes: only the adjacent round ends are visible.
            continue
        rod = meshes.new_capsule(f"{title} link {number + 1}", radius, length)
        meshes.set_one_color(rod, COLORS["robot"])
        thing = add_object(shown.collection, f"{title} link {number + 1}", rod, material)
        animation.move_between(thing, *reach, speed=speed)
        shown.objects["robot"].append(thing)


def own_speed(scene: bpy.types.Scene, frames: dict) -> float:
    """Return the number of frames of a motion per frame of the scene, in its own time.

    A motion keeps its own time at the user's frame rate; a path has none, and plays pose by pose.
    """
    return frames["rate_hz"] * scene.render.fps_base / scene.render.fps if (
        frames["is_timed"]) else 1.0


def last_frame(first: int, count: int, speed: float) -> int:
    """Return the scene's frame in which the last of ``count`` frames is shown."""
    return max(first, first + math.ceil((count - 1) / speed - 1e-6))


def _add_motion(scene: bpy.types.Scene, shown: ShownBranch, data: SceneData) -> None:
    frames = data.info.get("frames")
    if not frames:
        return
    rest = meshes.new_mesh("Rest shape", data.arrays["vertices"], data.arrays["faces"])
    material = materials.plain_material("Rest shape", COLORS["rest"], alpha=0.25)
    ghost = add_object(shown.collection, "Rest shape", rest, material)
    # In the viewport, lines, and on demand: they cover colours that show numbers.
    ghost.display_type = "WIRE"
    ghost.hide_viewport = True
    shown.objects["rest"] = [ghost]
    speed = own_speed(scene, frames)
    header = animation.attach_cache(shown.surface, data.folder / frames["file"], speed=speed)
    shown.frame_count = header.frame_count
    scene.frame_start = 1
    scene.frame_end = last_frame(1, header.frame_count, speed)
    if "grasp_motion" in data.arrays and "grasp" in shown.objects:
        animation.move_along(shown.objects["grasp"][0], data.arrays["grasp_motion"], speed=speed)
    for name in ("control_points", "targets"):
        for number, thing in enumerate(shown.objects.get(name, ())):
            animation.move_along(thing, data.arrays[f"{name}_motion"][:, number], speed=speed)
    _add_robot(shown, data, speed)
    annotations.add_measured(shown, data, speed)
    # Last: keyed objects are then at the first frame, not at their last key.
    scene.frame_set(1)
    if "frame_energy" in data.arrays:
        shown.surface[ENERGY_KEY] = [float(value) for value in data.arrays["frame_energy"]]
