"""Imported scans as coloured points: Blender itself draws loose vertices black."""

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Matrix

from .. import compat
from ..branch.branches import SCAN_KEY
from ..bridge import meshes

COLOUR = "scan_color"
"""Attribute of a scan's vertices, if its file has colours."""
_PLAIN = (0.55, 0.75, 0.95, 1.0)
_SIZE = 3.0
_batches: dict[tuple, gpu.types.GPUBatch] = {}


def _draw() -> None:
    scans = [thing for thing in bpy.context.view_layer.objects
             if thing.type == "MESH" and SCAN_KEY in thing and thing.mode == "OBJECT"
             and thing.visible_get()]
    if not scans:
        return
    shader = gpu.shader.from_builtin(compat.COLOURED_POINT_SHADER)
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.point_size_set(_SIZE)
    with gpu.matrix.push_pop_projection():
        gpu.matrix.load_projection_matrix(_before_loose_vertices(
            gpu.matrix.get_projection_matrix(), bpy.context.region_data.view_distance))
        for thing in scans:
            key = (thing.data.name, len(thing.data.vertices))
            if key not in _batches:
                _batches[key] = batch_for_shader(shader, "POINTS", {
                    "pos": meshes.positions(thing.data), "color": colours_of(thing.data)})
            with gpu.matrix.push_pop():
                gpu.matrix.multiply_matrix(thing.matrix_world)
                _batches[key].draw(shader)
    gpu.state.depth_test_set("NONE")


def _before_loose_vertices(projection: Matrix, view_distance: float) -> Matrix:
    """Return a projection that draws slightly nearer than Blender 5 draws its own loose vertices.

    It moves those forward, by GPU_polygon_offset_calc, so that faces do not hide them.
    """
    is_perspective = projection[3][3] < 0.5
    nearer = -0.0125 * projection[2][3] if is_perspective else 5e-5 * view_distance
    shift = Matrix.Identity(4)
    shift[2][3] = -nearer
    return shift @ projection


def colours_of(mesh: bpy.types.Mesh) -> np.ndarray:
    """Return the sRGB colours of a scan's points, float32, shape [n, 4]."""
    return meshes.values_of(mesh, COLOUR) if COLOUR in mesh.attributes else np.tile(
        np.array(_PLAIN, np.float32), (len(mesh.vertices), 1))


def _changed(_scene, depsgraph=None) -> None:
    if depsgraph is None or any(update.is_updated_geometry for update in depsgraph.updates):
        _batches.clear()


DRAWN = (_draw, "POST_VIEW")
HANDLERS = tuple((event, _changed) for event in (
    "depsgraph_update_post", "undo_post", "redo_post", "load_post"))
unregister = _batches.clear
