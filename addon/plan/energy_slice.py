"""The energy field in the plane through the 3D cursor, or through a goal that is being dragged."""

import bpy
import gpu
import numpy as np
from gpu_extras.batch import batch_for_shader
from mathutils import Vector

from ..branch import branches
from ..show.legend import display
from . import energy_field

_LINES = 90
"""Lines each way of the net that is drawn."""
_ALPHA = 0.75


def net(thing: bpy.types.Object, surface: bpy.types.Object, place: Vector, across: Vector,
        up: Vector) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the slice through a place of the world: points [n, 3] of the world, colours [n, 4] as
    the screen shows them, and triangles [t, 3]; none where the field is not trusted.

    Args:
        thing: The grid of :mod:`energy_field`.
        surface: That of its branch.
        place: In the plane [m].
        across, up: Unit vectors that span the plane.
    """
    into = np.array(surface.matrix_world.inverted())
    corners = np.array(np.meshgrid(*energy_field.box(thing).T, indexing="ij")).reshape(3, -1).T
    corners = corners @ np.array(surface.matrix_world)[:3, :3].T + np.array(
        surface.matrix_world)[:3, 3] - np.array(place)
    spans = [np.linspace((corners @ axis).min(), (corners @ axis).max(), _LINES)
             for axis in (np.array(across), np.array(up))]
    first, second = np.meshgrid(*spans, indexing="ij")
    points = np.array(place) + first.reshape(-1, 1) * across + second.reshape(-1, 1) * up
    colours = energy_field.colours_at(thing, points @ into[:3, :3].T + into[:3, 3])
    colours[:, :3] = display(colours[:, :3])
    index = np.arange(_LINES * _LINES).reshape(_LINES, _LINES)
    corner = [index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]]
    triangles = np.concatenate([np.stack([corner[0], corner[k], corner[k + 1]], axis=-1)
                                for k in (1, 2)]).reshape(-1, 3)
    return points, colours, triangles[(colours[triangles, 3] > 0).any(axis=1)]


def _draw() -> None:
    context = bpy.context
    surface = branches.find_surface(context.scene)
    if surface is None or not energy_field.is_sliced(context.scene) or (
            not context.space_data.overlay.show_overlays):
        return
    thing = energy_field.of(branches.branch_of(surface))
    if thing is None:
        return
    turn = context.region_data.view_matrix.inverted().to_3x3()
    place = energy_field.held[0] if energy_field.held else context.scene.cursor.location
    points, colours, triangles = net(thing, surface, place, turn.col[0], turn.col[1])
    if not len(triangles):
        return
    colours[:, 3] *= _ALPHA
    shader = gpu.shader.from_builtin("SMOOTH_COLOR")
    gpu.state.depth_test_set("LESS_EQUAL")
    gpu.state.blend_set("ALPHA")
    batch_for_shader(shader, "TRIS", {
        "pos": np.ascontiguousarray(points, np.float32),
        "color": np.ascontiguousarray(colours, np.float32)},
        indices=np.ascontiguousarray(triangles, np.int32)).draw(shader)
    gpu.state.blend_set("NONE")
    gpu.state.depth_test_set("NONE")


DRAWN = (_draw, "POST_VIEW")
