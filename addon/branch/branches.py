"""The branches of a scene: identifies their objects and the current branch."""

import json
from functools import lru_cache
from pathlib import Path
from typing import Any

import bpy
from mathutils import Vector

from ..bridge import skeletons

FOLDER_KEY = "limber_folder"
"""The branch folder of a branch's collection, of a scan, and of a scene: the last used one."""
SCAN_KEY = "limber_scan_sha256"
NAME_KEY = "limber_name"
INFO_KEY = "limber_info"
ENERGY_KEY = "limber_energy_j"
GRASP_KEY = "limber_grasp_m"
"""Key of the marked grasp: its position on the branch as scanned, and its radius."""
UUID_KEY = "limber_uuid"
"""Key of a branch's collection: its identity, regardless of its folder and name."""
ID_KEY = "limber_id"
"""Key of a branch's collection, and of each object of a branch: that of the collection, what it
shows, and which of several: ``TOKEN/targets/flower``. Blender copies it with an object; see
:func:`parts.release_copies`.
"""
SHOWS_KEY = "limber_shows"
"""Key of each object of a branch: what it shows, a key of :attr:`parts.ShownBranch.objects`."""
SCALE_KEY = "limber_scale"
"""Key of a coloured object beside the branch: its scale, as JSON."""
VIEW_KEY = "limber_view"
"""Key of a surface: the direction from which the worker would view the branch."""
FRAME_SCALAR_KEY = "limber_frame_scalar"
"""Key of a surface: the value that its colours show in each frame; missing if none."""
OFFSET_KEY = "limber_map_offset"
"""The branch's origin in the scan's coordinates, in double precision: a viewport has single."""


def branches(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """Return the collections of the shown branches, the one opened last at the end."""
    return [collection for collection in scene.collection.children_recursive
            if FOLDER_KEY in collection]


def token_of(thing: bpy.types.Object) -> str:
    """Return the identity of the branch to which an object of ours belongs; else an empty text."""
    return str(thing.get(ID_KEY, "")).partition("/")[0]


def branch_of(thing: bpy.types.Object) -> bpy.types.Collection | None:
    """Return the collection of the branch to which an object, or its parent, belongs."""
    while thing is not None:
        shown = [branch for branch in bpy.data.collections if FOLDER_KEY in branch]
        within = [branch for branch in shown if branch.all_objects.get(thing.name) == thing]
        token = token_of(thing)
        found = next((branch for branch in (*within, *shown) if token
                      and branch.get(ID_KEY) == token), within[0] if within else None)
        if found is not None:
            return found
        thing = thing.parent
    return None


def parts_of(branch: bpy.types.Collection) -> dict[str, bpy.types.Object]:
    """Return the objects of a branch by their id, in whichever collection the user has put them."""
    token = branch.get(ID_KEY, "")
    found = [thing for thing in bpy.data.objects
             if thing.library == branch.library and token_of(thing) == token and token]
    # Of a copy and its original, the original.
    found.sort(key=lambda thing: (branch.all_objects.get(thing.name) != thing, thing.session_uid))
    return {thing[ID_KEY]: thing for thing in reversed(found)}


def surface_of(branch: bpy.types.Collection) -> bpy.types.Object | None:
    """Return the surface of a branch; None if the user has removed it."""
    thing = part_of(branch, "surface")
    return thing if thing is not None and any(
        is_in(scene, thing) for scene in bpy.data.scenes) else None


def is_in(scene: bpy.types.Scene, thing: bpy.types.Object) -> bool:
    """Whether a scene has an object; one linked from another file may have the same name."""
    found = scene.objects.get(thing.name)
    return found == thing or (found is not None and thing in scene.objects[:])


def part_of(branch: bpy.types.Collection, kind: str) -> bpy.types.Object | None:
    """Return the object of a branch that shows something of which it has one; None without."""
    # Mostly in its collection: panels ask often, and a file may have thousands of objects.
    return next((thing for things in (branch.all_objects, bpy.data.objects) for thing in sorted(
        (thing for thing in things if thing.get(SHOWS_KEY) == kind and ID_KEY in branch
         and token_of(thing) == branch[ID_KEY]), key=lambda thing: thing.session_uid)), None)


def info_of(surface: bpy.types.Object) -> dict[str, Any]:
    """Return what the worker reported about a branch; do not change it."""
    return _parsed(surface.get(INFO_KEY, "{}"))


@lru_cache(maxsize=8)
def _parsed(text: str) -> dict[str, Any]:
    """Read once: panels and frames ask repeatedly."""
    return json.loads(text)


def find_surface(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return the surface of the current branch; None if that branch is not shown."""
    branch, _ = _current(scene)
    return None if branch is None else surface_of(branch)


def current_folder(scene: bpy.types.Scene) -> Path | None:
    """Return the folder of the current branch, absolute; None if the scene has none.

    Every function for a branch asks here, or :func:`find_surface`, which one. It is that of the
    active object: a part of a branch, or a scan. Else it is the one last used, which may not be
    shown yet; else the one opened last.
    """
    path = current_path(scene)
    return Path(bpy.path.abspath(path)) if path else None


def current_uuid(scene: bpy.types.Scene) -> str:
    """Return the identity of the current branch when it was opened; empty if it is not shown."""
    branch, _ = _current(scene)
    return "" if branch is None else branch.get(UUID_KEY, "")


def current_name(scene: bpy.types.Scene) -> str:
    """Return the current branch's displayed name: that of its collection or folder; or empty.
    """
    branch, path = _current(scene)
    return Path(bpy.path.abspath(path)).stem if branch is None and path else (
        "" if branch is None else branch.name)


def shown_from(scene: bpy.types.Scene, folder: Path) -> bpy.types.Collection | None:
    """Return the branch shown from a folder, with its surface; None without."""
    return _shown_from(scene, str(folder))


def shown_with(scene: bpy.types.Scene, uuid: str) -> list[bpy.types.Collection]:
    """Return the shown branches with a UUID: several if a folder was copied."""
    return [branch for branch in branches(scene) if branch.get(UUID_KEY) == uuid]


def current_path(scene: bpy.types.Scene) -> str:
    """Return :func:`current_folder` as Blender keeps it: relative to a saved .blend, or empty."""
    return _current(scene)[1]


def use_folder(scene: bpy.types.Scene, path: str) -> None:
    """Make ``path`` the folder of the current branch; none if it is empty.

    The branch of that folder becomes active. If it is not shown, no other branch stays active.
    """
    scene[FOLDER_KEY] = path
    branch = _shown_from(scene, path)
    if branch is not None:
        activate(scene, surface_of(branch))
    elif not _is_same_folder(current_path(scene), path):
        activate(scene, None)


def choose(scene: bpy.types.Scene, branch: bpy.types.Collection) -> None:
    """Make a shown branch the current one."""
    use_folder(scene, branch[FOLDER_KEY])
    activate(scene, surface_of(branch))


def activate(scene: bpy.types.Scene, thing: bpy.types.Object | None) -> None:
    """Make ``thing`` the active object and the only selected one; in Object Mode."""
    layer = layer_of(scene)
    before = layer.objects.active
    if thing == before:
        return
    if before is not None and before.mode != "OBJECT":
        bpy.ops.object.mode_set(mode="OBJECT")
    for other in layer.objects:
        other.select_set(other == thing)
    # In a collection excluded from the view layer it cannot be active.
    layer.objects.active = thing if thing is None or thing.name in layer.objects else None


def remember(scene: bpy.types.Scene, *_: object) -> None:
    """Keep the folder of the active object: it stays the current one when a lamp is selected."""
    _, path = _of_active(scene)
    if path and scene.get(FOLDER_KEY) != path:
        scene[FOLDER_KEY] = path


def _current(scene: bpy.types.Scene) -> tuple[bpy.types.Collection | None, str]:
    """Return the collection of the current branch, None if it is not shown, and its folder."""
    branch, path = _of_active(scene)
    if branch is not None and branch.library is None:
        return branch, path
    path = path or scene.get(FOLDER_KEY)
    if path is not None:
        return _shown_from(scene, path), path
    # No branch was used here yet: a file made by `limber scene`, or appended branches.
    branch = next((one for one in reversed(branches(scene)) if surface_of(one) is not None), None)
    return branch, "" if branch is None else branch[FOLDER_KEY]


def _of_active(scene: bpy.types.Scene) -> tuple[bpy.types.Collection | None, str]:
    """Return the branch of the active object, None if it is of none, and its folder, or a scan's.
    """
    active = layer_of(scene).objects.active
    branch = branch_of(active)
    if branch is not None and branch in branches(scene) and surface_of(branch) is not None:
        return branch, branch[FOLDER_KEY]
    return None, active.get(FOLDER_KEY, "") if active is not None and SCAN_KEY in active else ""


def _shown_from(scene: bpy.types.Scene, path: str) -> bpy.types.Collection | None:
    """Return the branch that shows the folder ``path``, with its surface; None without."""
    shown = [branch for branch in branches(scene)
             if _is_same_folder(branch[FOLDER_KEY], path) and surface_of(branch) is not None]
    # Rather one that can be changed here than one linked from another file.
    return max(reversed(shown), key=lambda branch: branch.library is None, default=None)


def _is_same_folder(one: str, other: str) -> bool:
    if one == other or not one or not other:
        return one == other
    return Path(bpy.path.abspath(one)) == Path(bpy.path.abspath(other))


def layer_of(scene: bpy.types.Scene) -> bpy.types.ViewLayer:
    """Return the view layer in use of a scene."""
    return bpy.context.view_layer if bpy.context.scene == scene else scene.view_layers[0]


def in_branch(scene: bpy.types.Scene, place: Vector) -> Vector:
    """Return a position of the world in the frame of the current branch [m].

    They differ if branches are side by side; without a branch they are the same.
    """
    surface = find_surface(scene)
    return Vector(place) if surface is None else surface.matrix_world.inverted() @ Vector(place)


def find_skeleton(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return the skeleton of the current branch, if it has one."""
    return _skeleton_in(_current(scene)[0])


def skeleton_from(scene: bpy.types.Scene, folder: Path) -> bpy.types.Object | None:
    """Return the skeleton of the branch shown from a folder, whichever branch is current."""
    return _skeleton_in(shown_from(scene, folder))


def _skeleton_in(branch: bpy.types.Collection | None) -> bpy.types.Object | None:
    return None if branch is None else part_of(branch, "skeleton")


def put_skeleton_back(thing: bpy.types.Object) -> None:
    """Reset a skeleton to the nodes that the worker gave."""
    if thing.mode == "EDIT":
        bpy.ops.object.mode_set(mode="OBJECT")
    skeletons.put_back(thing.data)


def add_object(collection: bpy.types.Collection, name: str, data: bpy.types.ID,
               material: bpy.types.Material | None = None) -> bpy.types.Object:
    """Make an object of ``data`` in ``collection``."""
    thing = bpy.data.objects.new(name, data)
    collection.objects.link(thing)
    if material is not None:
        data.materials.clear()
        data.materials.append(material)
    return thing


HANDLERS = (("depsgraph_update_post", remember),)
