"""What is drawn about a branch beside its marks: rods with values, and the half ball of grasps.

All hidden at first: the panel's "Show" brings each into sight.
"""

import json

import bpy

from .branches import SCALE_KEY, ShownBranch, add_object
from .bridge import materials, meshes
from .scene_data import SceneData

_HALF_BALL = (0.35, 0.45, 0.55)


def add_rods(shown: ShownBranch, data: SceneData) -> None:
    """Add thin rods in colours: paths by energy, the skeleton's radii, distances of a fit."""
    for key, about in (data.info.get("rods") or {}).items():
        mesh = meshes.new_mesh(about["title"], data.arrays[f"rods:{key}"],
                               data.arrays[f"rod_faces:{key}"])
        meshes.set_colors(mesh, "color", data.arrays[f"rod_color:{key}"])
        thing = add_object(shown.collection, about["title"], mesh,
                                 materials.vertex_color_material(about["title"], "color"))
        thing[SCALE_KEY] = json.dumps(about["scale"])
        _hide(thing)
        shown.objects[f"rods:{key}"] = [thing]


def add_hemisphere(shown: ShownBranch, data: SceneData) -> None:
    """Add the half ball in which the grasp may be taken, as lines."""
    about = data.info.get("hemisphere")
    if not about:
        return
    thing = add_object(shown.collection, "Grasps in reach",
                             meshes.new_half_ball("Grasps in reach", about["radius_m"]))
    thing.location = about["centre_m"]
    thing.display_type, thing.color = "WIRE", (*_HALF_BALL, 1.0)
    _hide(thing)
    shown.objects["hemisphere"] = [thing]


def _hide(thing: bpy.types.Object) -> None:
    thing.hide_viewport = thing.hide_render = True
