"""Draws additional data of a branch: rods with values, the hemisphere of grasps, and points
measured in a pull.

All but the measured points are hidden at first. The panel's "Show" makes each of them visible.
"""

import json

import bpy
import numpy as np

from ..branch.branches import SCALE_KEY
from ..branch.parts import ShownBranch
from ..bridge import animation, materials, meshes
from .scene_data import SceneData

_HALF_BALL = (0.35, 0.45, 0.55)
MEASURED = (0.0, 0.376, 0.509)
"""Linear colour of measured data."""
_SHARE = 0.011
"""Radius of a measured point as a fraction of the branch's size."""


def add_rods(shown: ShownBranch, data: SceneData) -> None:
    """Add thin rods in colours: paths by energy, the skeleton's radii, distances of a fit."""
    for key, about in (data.info.get("rods") or {}).items():
        mesh = meshes.new_mesh(about["title"], data.arrays[f"rods:{key}"],
                               data.arrays[f"rod_faces:{key}"])
        meshes.set_values(mesh, "color", data.arrays[f"rod_color:{key}"], "FLOAT_COLOR")
        thing, is_new = shown.put(f"rods:{key}", about["title"], mesh,
                                  materials.vertex_color_material(about["title"], "color"))
        thing[SCALE_KEY] = json.dumps(about["scale"])
        if is_new:
            _hide(thing)


def add_cell(shown: ShownBranch, data: SceneData) -> None:
    """Add what the robot's cell file states: arm at its home, camera's view, obstacles."""
    for key, about in (data.info.get("cell") or {}).items():
        title, color = about["title"], tuple(about["color"])
        mesh = meshes.new_mesh(title, data.arrays[f"solid:{key}"],
                               data.arrays[f"solid_faces:{key}"])
        meshes.set_one_color(mesh, color)
        shown.put(f"cell:{key}", title, mesh,
                  materials.plain_material(title, color, alpha=about["alpha"]))


def add_hemisphere(shown: ShownBranch, data: SceneData) -> None:
    """Add the hemisphere of possible grasps, as lines."""
    about = data.info.get("hemisphere")
    if not about:
        return
    thing, is_new = shown.put("hemisphere", "Grasps in reach",
                              meshes.new_half_ball("Grasps in reach", about["radius_m"]))
    thing.delta_location = np.array(about["centre_m"]) + shown.place
    if is_new:
        thing.display_type, thing.color = "WIRE", (*_HALF_BALL, 1.0)
        _hide(thing)


def add_measured(shown: ShownBranch, data: SceneData) -> None:
    """Add the points observed in the shown pull, at their positions in each frame; hidden in frames
    without an observation.
    """
    if "observation_motion" not in data.arrays:
        return
    ball = meshes.new_sphere("Measured", 1.0)
    meshes.set_one_color(ball, MEASURED)
    material = materials.plain_material("Measured", MEASURED, alpha=0.6, roughness=0.3)
    places, seen = data.arrays["observation_motion"] + shown.place, data.arrays["observation_seen"]
    timing = {"frame_start": shown.start, "speed": shown.speed}
    for number in range(places.shape[1]):
        thing, is_new = shown.put("observed", f"Measured point {number + 1}", ball, material,
                                  str(number + 1))
        if is_new:
            thing.show_in_front = True
        animation.move_along(thing, places[:, number], **timing)
        animation.appear(thing, seen[:, number], _SHARE * data.info["size_m"], **timing)


def _hide(thing: bpy.types.Object) -> None:
    thing.hide_viewport = thing.hide_render = True
