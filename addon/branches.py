"""The branches of a scene: how their objects are known again, and which of them is meant."""

import json
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import bpy
from mathutils import Vector

from .bridge import skeletons

FOLDER_KEY = "limber_folder"
SCAN_KEY = "limber_scan_sha256"
NAME_KEY = "limber_name"
INFO_KEY = "limber_info"
ENERGY_KEY = "limber_energy_j"
GRASP_KEY = "limber_grasp_m"
"""Of the marked grasp: its place on the branch as it was scanned, and its radius."""
UUID_KEY = "limber_uuid"
"""Of a branch's collection: which branch it is, wherever its folder is and whatever its name."""
SHOWS_KEY = "limber_shows"
"""Of each object of a branch: what it shows, a key of :attr:`ShownBranch.objects`."""
SCALE_KEY = "limber_scale"
"""Of a coloured object beside the branch: its scale, as JSON."""
FRAME_SCALAR_KEY = "limber_frame_scalar"
"""Of a surface: which value its colours show in each frame; missing where none."""
OFFSET_KEY = "limber_map_offset"
"""The branch's origin in the scan's coordinates, in double precision: a viewport has single."""


@dataclass
class ShownBranch:
    """What :func:`show_branch` made: the objects by what they show."""

    collection: bpy.types.Collection
    surface: bpy.types.Object
    objects: dict[str, list[bpy.types.Object]] = field(default_factory=dict)
    frame_count: int = 1


def branches(scene: bpy.types.Scene) -> list[bpy.types.Collection]:
    """Return the collections of the branches that are shown, that opened last at the end."""
    return [collection for collection in scene.collection.children_recursive
            if FOLDER_KEY in collection]


def branch_of(thing: bpy.types.Object) -> bpy.types.Collection | None:
    """Return the collection of the branch that an object belongs to."""
    return next((collection for collection in thing.users_collection if FOLDER_KEY in collection),
                None)


def surface_of(branch: bpy.types.Collection) -> bpy.types.Object | None:
    """Return the surface of a branch; None where the user has removed it."""
    return next((thing for thing in branch.objects if INFO_KEY in thing), None)


def info_of(surface: bpy.types.Object) -> dict[str, Any]:
    """Return what the worker said of a branch; not to be changed."""
    return _parsed(surface.get(INFO_KEY, "{}"))


@lru_cache(maxsize=8)
def _parsed(text: str) -> dict[str, Any]:
    """Read once: panels and frames ask again and again."""
    return json.loads(text)


def find_surface(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return the surface of the branch that is meant: the active one, else that opened last."""
    shown = branches(scene)
    layer = scene.view_layers[0] if bpy.context.scene != scene else bpy.context.view_layer
    active = layer.objects.active
    chosen = branch_of(active) if active is not None else None
    if chosen in shown and (surface := surface_of(chosen)) is not None:
        return surface
    found = (surface_of(branch) for branch in reversed(shown))
    return next((surface for surface in found if surface is not None), None)


def in_branch(scene: bpy.types.Scene, place: Vector) -> Vector:
    """Return a place of the world in the frame of the branch that is meant [m].

    They differ where branches stand side by side; without a branch they are one.
    """
    surface = find_surface(scene)
    return Vector(place) if surface is None else surface.matrix_world.inverted() @ Vector(place)


def find_skeleton(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return the skeleton of the branch last opened in ``scene``, if it has one."""
    surface = find_surface(scene)
    return None if surface is None else next(
        (thing for thing in branch_of(surface).objects
         if thing.type == "MESH" and skeletons.NODES_KEY in thing.data), None)


def put_skeleton_back(thing: bpy.types.Object) -> None:
    """Give a skeleton its nodes as the worker gave them."""
    before = thing.data
    if thing.mode == "EDIT":
        bpy.ops.object.mode_set(mode="OBJECT")
    thing.data = skeletons.as_it_was(before)
    bpy.data.meshes.remove(before)


def add_object(collection: bpy.types.Collection, name: str, data: bpy.types.ID,
               material: bpy.types.Material | None = None) -> bpy.types.Object:
    """Make an object of ``data`` in ``collection``."""
    thing = bpy.data.objects.new(name, data)
    collection.objects.link(thing)
    if material is not None:
        data.materials.clear()
        data.materials.append(material)
    return thing
