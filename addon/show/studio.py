"""Ground, light, camera and rendering for a self-explanatory picture of a branch."""

from dataclasses import dataclass

import bpy
import numpy as np
from mathutils import Vector

from .. import compat
from ..branch.branches import add_object
from ..bridge import materials, meshes
from .scene_data import SceneData

# Fraction of the picture's width that is kept free on the left, for the legend.
LEGEND_SHARE = 0.36


PAPER = (0.779, 0.8075, 0.836)
"""Linear colour behind the branch, and of the legend's own background."""


@dataclass(frozen=True)
class Picture:
    """A rendered picture: width [pixels], room for a legend."""

    width: int = 1120
    legend_share: float = LEGEND_SHARE
    """Fraction of the width that is kept free on the left, for a legend; 0 without one."""

    @property
    def height(self) -> int:
        return self.width * 3 // 4


def set_up_studio(scene: bpy.types.Scene, data: SceneData,
                  picture: Picture = Picture()) -> bpy.types.Object:
    """Add ground, lights and a camera that shows all of ``view_points``; returns the camera."""
    collection = bpy.data.collections.new("Studio")
    scene.collection.children.link(collection)
    _set_rendering(scene, picture)
    _set_world(scene)
    rim = _add_ground(collection, data)
    _add_lights(collection, data)
    return _add_camera(scene, collection, data, np.vstack([data.arrays["view_points"], rim]),
                       picture.legend_share)


def _set_rendering(scene: bpy.types.Scene, picture: Picture) -> None:
    render = scene.render
    render.engine = "CYCLES"
    render.resolution_x, render.resolution_y = picture.width, picture.height
    render.resolution_percentage = 100
    render.image_settings.file_format = "PNG"
    cycles = scene.cycles
    cycles.device = "CPU"
    cycles.use_denoising = compat.can_denoise()
    # Without a denoiser, use more samples instead.
    cycles.samples = 32 if compat.can_denoise() else 128
    # Most of the picture is plain background: it needs few samples, and a tenth of the time.
    cycles.use_adaptive_sampling = True
    if hasattr(cycles, "denoising_quality"):
        cycles.denoising_quality = "BALANCED"
    cycles.adaptive_min_samples = 4
    cycles.adaptive_threshold = 0.1 if compat.can_denoise() else 0.03
    cycles.max_bounces, cycles.diffuse_bounces, cycles.glossy_bounces = 2, 1, 1
    cycles.transparent_max_bounces = 16
    cycles.use_light_tree = False
    # Colours show numbers: no filmic curve may change them.
    scene.view_settings.view_transform = "Standard"


def _set_world(scene: bpy.types.Scene) -> None:
    world = scene.world or bpy.data.worlds.new("World")
    scene.world = world
    compat.use_nodes(world)
    world.cycles.sampling_method = "NONE"
    background = next(node for node in world.node_tree.nodes if node.type == "BACKGROUND")
    background.inputs["Color"].default_value = (*PAPER, 1.0)
    background.inputs["Strength"].default_value = 1.0


def _add_ground(collection: bpy.types.Collection, data: SceneData) -> np.ndarray:
    """Add a round plate below the branch; returns points of its rim [m], shape [4, 3].

    It receives the shadow, and no horizon crosses the branch.
    """
    size = data.info["size_m"]
    radius = 0.2 * size
    plate = meshes.new_cylinder("Ground", radius, 0.01 * size)
    material = materials.plain_material("Ground", (0.36, 0.37, 0.36), roughness=0.9)
    thing = add_object(collection, "Ground", plate, material)
    middle = (data.info.get("base") or {}).get("centre_m", data.arrays["view_points"].mean(axis=0))
    thing.location = (middle[0], middle[1], data.info["ground_m"] - 0.035 * size)
    across = radius * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0]])
    return np.array(thing.location) + across


def _add_lights(collection: bpy.types.Collection, data: SceneData) -> None:
    towards = Vector(data.arrays["view_direction"])
    side = towards.cross(Vector((0.0, 0.0, 1.0))).normalized()
    for name, direction, strength, angle in (
            ("Key light", towards - 0.9 * side + Vector((0, 0, -1.1)), 1.9, 0.12),
            ("Fill light", towards + 1.2 * side + Vector((0, 0, -0.4)), 0.5, 0.6)):
        light = bpy.data.lights.new(name, "SUN")
        light.energy, light.angle = strength, angle
        thing = bpy.data.objects.new(name, light)
        thing.rotation_mode = "QUATERNION"
        thing.rotation_quaternion = direction.to_track_quat("-Z", "Y")
        collection.objects.link(thing)


def _add_camera(scene: bpy.types.Scene, collection: bpy.types.Collection,
                data: SceneData, seen: np.ndarray, legend_share: float) -> bpy.types.Object:
    lens = bpy.data.cameras.new("Camera")
    camera = bpy.data.objects.new("Camera", lens)
    collection.objects.link(camera)
    scene.camera = camera
    lens.sensor_fit = "VERTICAL"
    lens.lens = 55
    lens.clip_start, lens.clip_end = 0.01 * data.info["size_m"], 100 * data.info["size_m"]
    camera.rotation_mode = "QUATERNION"
    camera.rotation_quaternion = Vector(data.arrays["view_direction"]).to_track_quat("-Z", "Y")
    _fit(scene, camera, seen, legend_share)
    return camera


def _fit(scene: bpy.types.Scene, camera: bpy.types.Object, points: np.ndarray,
         legend_share: float) -> None:
    """Move the camera back until all ``points`` [m] are visible, right of the legend."""
    render = scene.render
    width = render.resolution_x
    render.resolution_x = round(width * (1 - legend_share) * 0.92)
    bpy.context.view_layer.update()
    place, _ = camera.camera_fit_coords(
        bpy.context.evaluated_depsgraph_get(), np.asarray(points, np.float32).ravel())
    render.resolution_x = width
    towards = camera.rotation_quaternion @ Vector((0.0, 0.0, -1.0))
    distance = (Vector(points.mean(axis=0)) - place).dot(towards)
    camera.location = place - 0.06 * distance * towards
    # The shift is in sensor heights (sensor_fit is VERTICAL).
    camera.data.shift_x = -legend_share / 2 * width / render.resolution_y
    bpy.context.view_layer.update()
