"""A branch in a Blender scene: its surface coloured and moving, paths, goal and other marks."""

import json
import math
from pathlib import Path

import bpy
import numpy as np
from mathutils import Matrix

from ..branch import parts
from ..branch.branches import (
    ENERGY_KEY,
    FOLDER_KEY,
    FRAME_SCALAR_KEY,
    GRASP_KEY,
    ID_KEY,
    INFO_KEY,
    NAME_KEY,
    OFFSET_KEY,
    SCAN_KEY,
    UUID_KEY,
    VIEW_KEY,
    branches,
    info_of,
    layer_of,
    token_of,
)
from ..branch.parts import ShownBranch
from ..bridge import animation, curves, materials, meshes, node_groups, skeletons
from ..plan import energy_field, goal_ball
from ..skeleton.skeleton_edits import Skeleton
from . import annotations, frame_colours
from .scene_data import SceneData

_RANGE_KEY = "limber_range"
"""Key of a scene: the frame range that was set for a motion, until the user sets another."""
_DEFAULT_RANGE = [1, 250]
_REST_SHARE = 6e-4
"""Of the branch's size: so much thinner is its rest shape, which else covers a branch at rest."""
_CHOICE_KEY = "limber_colour"
"""Key of a surface: the scalar that was asked for, and the one that a result had instead."""
_SPEED_KEY = "limber_own_speed"
"""Key of a surface: frames of its motion per frame of the scene, in the motion's own time."""
_ALIGNMENT_KEY = "limber_alignment"
"""Key of a scan: the matrix by which it was put to its branch."""

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
NAMES = {
    "path:plan": "gentle path", "path:baseline": "shortest path", "goal": "goal", "grasp": "grasp",
    "control_points": "control points", "targets": "targets", "base": "fixed base",
    "rest": "rest shape", "robot": "robot", "observed": "measured in the pull"}
"""What the objects of each colour are, in the keys of pictures and views."""


def show_branch(scene: bpy.types.Scene, data: SceneData, scalar: str | None = None,
                ) -> ShownBranch:
    """Show the branch in ``scene``: its objects are changed in place, those it lacks are made.

    Args:
        scene: Target scene.
        data: Data that the worker found in the branch folder.
        scalar: Meaning of the colours: a name of ``data.info["scalars"]``; by default the user's
            choice, at first the first.

    Raises:
        bridge.animation.CacheError: the frames cannot move this surface; nothing has changed.
    """
    frames = data.info.get("frames")
    if frames:
        animation.check_cache(data.folder / frames["file"], len(data.arrays["vertices"]))
    parts.release_copies()
    uuid = str(data.info.get("uuid") or "")
    shown = parts.begin(scene, _shown_before(scene, data), data.info["name"], uuid)
    collection = shown.collection
    collection[FOLDER_KEY] = scene[FOLDER_KEY] = animation.shown_path(data.folder)
    collection[NAME_KEY] = data.info["name"]
    if uuid:
        collection[UUID_KEY] = uuid
    edited = _leave_mode(scene, shown)
    is_new = _put_surface(shown, data)
    _add_paths(shown, data)
    _add_trees(shown, data)
    _add_skeleton(shown, data)
    _add_points(shown, data)
    _add_goal(shown, data)
    _add_base(shown, data)
    annotations.add_rods(shown, data)
    annotations.add_cell(shown, data)
    annotations.add_hemisphere(shown, data)
    energy_field.add(shown, data)
    _add_motion(scene, shown, data)
    _colour(scene, shown, scalar, is_asked=is_new)
    goal_ball.keep_moved(shown)
    shown.end()
    if shown.is_first:
        fit_range(scene, shown.surface)
    if edited is not None and layer_of(scene).objects.active is not None:
        bpy.ops.object.mode_set(mode=edited)
    return shown


def place_scans(scene: bpy.types.Scene, data: SceneData) -> int:
    """Move imported scans to the branch made from them, which was set upright and to 0.

    Returns:
        Number of scans that were not there yet; where the user has moved them since, they stay.
    """
    count = 0
    for thing in scene.objects:
        if thing.get(SCAN_KEY) == data.info["source"].get("sha256", ""):
            # In double precision: offset and alignment subtract large coordinates from each other.
            matrix = np.array(data.info["alignment"], float)
            matrix[:3, 3] += matrix[:3, :3] @ np.array(thing.get(OFFSET_KEY, (0.0,) * 3))
            if list(thing.get(_ALIGNMENT_KEY, ())) == matrix.ravel().tolist():
                continue
            thing[_ALIGNMENT_KEY] = matrix.ravel().tolist()
            thing.matrix_world = Matrix(matrix.tolist())
            count += 1
    return count


def color_by(surface: bpy.types.Object, name: str, *, is_asked: bool = True) -> None:
    """Colour ``surface`` by scalar ``name``, in Solid mode and in rendering.

    Args:
        surface: The branch.
        name: A scalar of its description, or :data:`.materials.WOOD`.
        is_asked: Whether a material of the user is replaced.

    Raises:
        KeyError: the branch has no such scalar.
    """
    if name == materials.WOOD:
        material = materials.wood_material()
    else:
        scale = info_of(surface)["scalars"][name]
        # Without a remark such as "(assumed)": it may not hold for the next result.
        title = f"{surface.name} {scale['title'].partition(' (')[0]}"
        material = materials.scalar_material(
            title, name, low=scale["low"], high=scale["high"], log=scale["log"],
            stops=scale["stops"], owner=token_of(surface))
    materials.wear(surface, material, is_asked=is_asked)
    surface.pop(FRAME_SCALAR_KEY, None)
    surface[_CHOICE_KEY] = f"{name} {name}"
    surface.data.color_attributes.active_color = surface.data.color_attributes[f"{name}_color"]


def _colour(scene: bpy.types.Scene, shown: ShownBranch, scalar: str | None, *, is_asked: bool,
            ) -> None:
    """Colour the surface as the user had it, else by its first scalar."""
    surface = shown.surface
    scalars = [*info_of(surface)["scalars"], materials.WOOD]
    each = surface.get(FRAME_SCALAR_KEY)
    if each is not None and each in frame_colours.changing(surface):
        frame_colours.show(surface, each, scene.frame_current_final, is_asked=is_asked)
        return
    active = surface.data.color_attributes.active_color_name
    before = each or active.removesuffix("_color")
    choice, _, last = surface.get(_CHOICE_KEY, "").partition(" ")
    if before != last and f"{last}_color" in surface.data.color_attributes:
        # Chosen by the user among the attributes of the mesh.
        choice = before
    choice = scalar or choice
    if before == materials.WOOD:
        # Blender makes another attribute the active one where that is gone.
        before = ""
    name = next((name for name in (choice, before, *scalars) if name in scalars), None)
    if name is not None and (scalar or each or not active or before in scalars
                            or active in surface.data[meshes.GIVEN_KEY]):
        color_by(surface, name, is_asked=is_asked)
        # A result may lack what the user has asked for; the next one may have it again.
        surface[_CHOICE_KEY] = f"{choice or name} {name}"


def _shown_before(scene: bpy.types.Scene, data: SceneData) -> bpy.types.Collection | None:
    """Return the collection that shows the branch: in this scene, else in the file."""
    return next((branch for branch in (*branches(scene), *bpy.data.collections)
                 if branch.library is None and branch.override_library is None
                 and ID_KEY in branch and FOLDER_KEY in branch and _is_same(branch, data)),
                None)


def _leave_mode(scene: bpy.types.Scene, shown: ShownBranch) -> str | None:
    """Leave Edit Mode and the like if a part of the branch is in it; return which, to go back."""
    active = layer_of(scene).objects.active
    if active is None or all(thing.mode == "OBJECT" for thing in shown.before.values()):
        return None
    mode = active.mode
    bpy.ops.object.mode_set(mode="OBJECT")
    return mode


def _put_surface(shown: ShownBranch, data: SceneData) -> bool:
    """Show the branch itself; returns whether it is new."""
    before = shown.find("surface")
    if before is not None:
        shown.place = np.array(before.delta_location)
    name = data.info["name"]
    mesh = meshes.new_mesh(name, data.arrays["vertices"], data.arrays["faces"])
    for key, scale in data.info["scalars"].items():
        node_groups.colour_group(scale["colours"], scale["stops"])
        meshes.set_values(mesh, key, data.arrays[f"scalar:{key}"])
        meshes.set_values(mesh, f"{key}_color", data.arrays[f"color:{key}"], "FLOAT_COLOR")
    meshes.set_one_color(mesh, materials.WOOD_COLOUR, f"{materials.WOOD}_color")
    meshes.set_values(mesh, node_groups.REST, data.arrays["vertices"], "FLOAT_VECTOR")
    node_groups.add_styles()
    surface, is_new = shown.put("surface", name, mesh)
    shown.surface = surface
    # Not the folder: it may move, and the file with it.
    surface[INFO_KEY] = json.dumps({**data.info, "folder": None})
    surface[VIEW_KEY] = data.arrays["view_direction"].tolist()
    grasp = [*data.arrays["grasp"][0].tolist(), float(data.arrays["grasp_radius"][0])] if (
        "grasp" in data.arrays) else None
    energy = data.arrays.get("frame_energy") if data.info.get("frames") else None
    for key, values in ((OFFSET_KEY, data.info.get("map_offset")), (GRASP_KEY, grasp),
                        (ENERGY_KEY, energy)):
        surface.pop(key, None)
        if values is not None:
            surface[key] = [float(value) for value in values]
    if is_new and data.info["scalars"]:
        mesh.color_attributes.active_color_name = f"{next(iter(data.info['scalars']))}_color"
    return is_new


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
        material = materials.plain_material(title, COLORS[name], roughness=0.4, glow=0.6)
        shown.put(name, f"{title} path", tube, material)


def _add_trees(shown: ShownBranch, data: SceneData) -> None:
    """Add the planners' search trees as lines; hidden, since they cover all of the space."""
    for key, about in (data.info.get("trees") or {}).items():
        title = f"{about['title']} tree"
        mesh = _lines(title, data, f"tree:{key}", f"tree_parent:{key}")
        thing, is_new = shown.put(f"tree:{key}", title, mesh)
        if is_new:
            thing.color = (*COLORS[f"path:{key}"], 1.0)
            thing.hide_viewport = thing.hide_render = True


def _lines(name: str, data: SceneData, nodes: str, parents: str) -> bpy.types.Mesh:
    """Make a mesh of the edges of a tree."""
    parent = data.arrays[parents]
    hung = np.flatnonzero(parent >= 0)
    return meshes.new_lines(name, data.arrays[nodes], np.column_stack([parent[hung], hung]))


def _add_skeleton(shown: ShownBranch, data: SceneData) -> None:
    """Add the centreline with its radii, hidden at first: it is inside the branch.

    Edits that are not applied yet stay if it is the same skeleton.
    """
    if "skeleton" not in data.arrays:
        return
    skeleton = Skeleton(data.arrays["skeleton"], data.arrays["skeleton_radius"],
                        data.arrays["skeleton_parent"])
    before = shown.find("skeleton")
    if before is not None and skeletons.is_skeleton(before) and (
            not skeletons.is_of(before.data, skeleton) and skeletons.is_edited(before)):
        shown.notes.append("The skeleton was made again. Edits that were not applied are lost")
    mesh = skeletons.new_skeleton("Skeleton", skeleton, data.arrays["skeleton_flags"])
    meshes.set_values(mesh, "radius_sigma", data.arrays["skeleton_radius_sigma"])
    if "skeleton_probability" in data.arrays:
        meshes.set_values(mesh, "probability", data.arrays["skeleton_probability"])
    thing, is_new = shown.put("skeleton", "Skeleton", mesh)
    if is_new:
        thing.hide_viewport = thing.hide_render = thing.show_in_front = True


def _add_points(shown: ShownBranch, data: SceneData) -> None:
    for kind, title in (("control_points", "Control point"), ("grasp", "Grasp"),
                        ("targets", "Target")):
        points = data.arrays.get(kind, np.empty((0, 3)))
        if len(points) == 0:
            continue
        ball = meshes.new_sphere(title, 1.0)
        meshes.set_one_color(ball, COLORS[kind])
        material = materials.plain_material(title, COLORS[kind], roughness=0.35)
        for number, point in enumerate(points):
            named = data.info["targets"][number] if kind == "targets" else number + 1
            thing, _ = shown.put(kind, f"{title} {named}", ball, material, str(named))
            thing.delta_location = point + shown.place
            thing.delta_scale = [data.arrays[f"{kind}_radius"][number]] * 3
            if kind == "targets":
                thing[goal_ball.TARGET_KEY] = named


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
    thing, _ = shown.put("base", "Fixed base", block, material)
    thing.delta_location = np.array([*base["centre_m"][:2], bottom + height / 2]) + shown.place


def _add_robot(shown: ShownBranch, data: SceneData) -> None:
    """Add arm and gripper, one capsule per link, moving along with the frames."""
    if "robot_starts" not in data.arrays:
        return
    starts = data.arrays["robot_starts"] + shown.place
    ends = data.arrays["robot_ends"] + shown.place
    title = f"Robot {data.info['robot']['name']}"
    material = materials.plain_material(title, COLORS["robot"], roughness=0.5)
    for number, radius in enumerate(data.arrays["robot_radii"].tolist()):
        reach = starts[:, number], ends[:, number]
        length = math.dist(reach[0][0], reach[1][0])
        if length < radius / 4:
            # Two joints with intersecting axes: only the adjacent round ends are visible.
            continue
        link = f"{title} link {number + 1}"
        rod = meshes.new_capsule(link, radius, length)
        meshes.set_one_color(rod, COLORS["robot"])
        thing, is_new = shown.put("robot", link, rod, material, str(number + 1))
        if is_new:
            thing.rotation_mode = "QUATERNION"
        animation.move_between(thing, *reach, shown.start, speed=shown.speed)


def own_speed(scene: bpy.types.Scene, frames: dict) -> float:
    """Return the number of frames of a motion per frame of the scene, in its own time.

    A motion keeps its own time at the user's frame rate; a path has none, and plays pose by pose.
    """
    return frames["rate_hz"] * scene.render.fps_base / scene.render.fps if (
        frames["is_timed"]) else 1.0


def last_frame(first: float, count: int, speed: float) -> int:
    """Return the scene's frame in which the last of ``count`` frames is shown."""
    return max(math.ceil(first), math.ceil(first + (count - 1) / speed - 1e-6))


def fit_range(scene: bpy.types.Scene, surface: bpy.types.Object) -> None:
    """Set the scene's frame range to the motion of a branch, unless the user has set a range."""
    motion, frames = animation.motion_of(surface), info_of(surface).get("frames")
    now = [scene.frame_start, scene.frame_end]
    if motion is None or not frames or now not in (_DEFAULT_RANGE, [*scene.get(_RANGE_KEY, ())]):
        return
    start, speed = animation.timing_of(motion)
    scene.frame_start = min(1, math.floor(start))
    scene.frame_end = last_frame(start, frames["count"], speed)
    scene[_RANGE_KEY] = [scene.frame_start, scene.frame_end]


def _add_motion(scene: bpy.types.Scene, shown: ShownBranch, data: SceneData) -> None:
    frames, before = data.info.get("frames"), animation.motion_of(shown.surface)
    if not frames:
        if before is not None:
            shown.surface.modifiers.remove(before)
        return
    rest = meshes.new_mesh("Rest shape", data.arrays["vertices"], data.arrays["faces"])
    meshes.shrink(rest, _REST_SHARE * data.info["size_m"])
    material = materials.plain_material("Rest shape", COLORS["rest"], alpha=0.25)
    ghost, is_new = shown.put("rest", "Rest shape", rest, material)
    if is_new:
        # In the viewport, lines, and on demand: they cover colours that show numbers.
        ghost.display_type = "WIRE"
        ghost.hide_viewport = True
    shown.speed = own = own_speed(scene, frames)
    if before is not None and before.frame_scale:
        # The user may have set another start and speed.
        shown.start, speed = animation.timing_of(before)
        shown.speed *= speed / shown.surface.get(_SPEED_KEY, speed)
    shown.surface[_SPEED_KEY] = own
    header = animation.attach_cache(shown.surface, data.folder / frames["file"], shown.start,
                                    speed=shown.speed)
    shown.frame_count = header.frame_count
    for kind in ("grasp", "control_points", "targets"):
        motion = data.arrays.get(f"{kind}_motion")
        if motion is None:
            continue
        motion = motion.reshape(len(motion), -1, 3) + shown.place
        for number, thing in enumerate(shown.objects.get(kind, ())):
            animation.move_along(thing, motion[:, number], shown.start, speed=shown.speed)
    _add_robot(shown, data)
    annotations.add_measured(shown, data)
