"""The cube that Blender starts with: 2 m wide about the origin, it encloses most branches."""

import bpy
import numpy as np

from ..branch import branches
from ..bridge import meshes

_NAME, _MATERIAL = "Cube", "Material"
_CORNERS = np.array([(x, y, z) for x in (1, -1) for y in (1, -1) for z in (1, -1)], np.float32)
_HIDDEN_KEY = "limber_hid"
"""Key of a cube that was hidden once: a user who shows it again wants it there."""


def find(scene: bpy.types.Scene) -> bpy.types.Object | None:
    """Return the startup cube in its original state; None if a user changed it."""
    cube = scene.objects.get(_NAME)
    return cube if cube is not None and _is_untouched(cube) else None


def hide(scene: bpy.types.Scene, cube: bpy.types.Object) -> None:
    """Hide the cube in the 3D views, as H does, and in pictures."""
    cube[_HIDDEN_KEY] = True
    cube.hide_set(True, view_layer=branches.layer_of(scene))
    cube.hide_render = True


def _is_untouched(cube: bpy.types.Object) -> bool:
    is_plain = not (_HIDDEN_KEY in cube or cube.parent or cube.children or cube.modifiers
                    or cube.constraints or cube.animation_data or cube.vertex_groups
                    or cube.hide_viewport or cube.hide_render or cube.hide_get())
    return (is_plain and cube.type == "MESH" and cube.mode == "OBJECT"
            and cube.matrix_basis.is_identity and cube.matrix_world.is_identity
            and cube.data.name == _NAME and cube.data.users == 1 and len(cube.data.polygons) == 6
            and cube.data.shape_keys is None
            and [slot.name for slot in cube.material_slots] == [_MATERIAL]
            and np.array_equal(meshes.positions(cube.data), _CORNERS))
