"""A bar of a round length beside a branch: it shows the scale of a picture."""

import bpy
import numpy as np
from mathutils import Vector

from ..branch.branches import add_object
from ..bridge import materials, meshes

_SHARE = 0.25
"""Greatest length of the bar as a fraction of the branch's size."""
_LENGTHS = [digit * 10.0**power for power in range(-5, 4) for digit in (1, 2, 5)]
_UNITS = ((1.0, "m"), (0.01, "cm"), (0.001, "mm"))
_INK = (0.012, 0.014, 0.018)


def length_for(size: float) -> float:
    """Return the longest round length of at most a quarter of ``size`` [m]."""
    return max((length for length in _LENGTHS if length <= _SHARE * size), default=_LENGTHS[0])


def words_for(length: float) -> str:
    """Return a round length with its unit: 5 cm."""
    metres, unit = next(((each, name) for each, name in _UNITS if length >= 0.999 * each),
                        _UNITS[-1])
    return f"{length / metres:g} {unit}"


def add(collection: bpy.types.Collection, camera: bpy.types.Object, foot: np.ndarray,
        size: float) -> None:
    """Put a bar on the ground right of the branch, its length beside it, facing the camera.

    Args:
        foot: Base of the branch on the ground [m], shape [3].
        size: Size of the branch [m].
    """
    length, thin = length_for(size), 0.006 * size
    right = camera.rotation_quaternion @ Vector((1.0, 0.0, 0.0))
    place = Vector(foot) + 0.11 * size * right
    material = materials.plain_material("Scale bar", _INK, roughness=0.9)
    bar = add_object(collection, "Scale bar", meshes.new_cylinder("Scale bar", thin, length),
                     material)
    bar.location = place + Vector((0.0, 0.0, length / 2))
    text = bpy.data.curves.new("Scale bar length", "FONT")
    text.body, text.size = words_for(length), 0.045 * size
    text.align_y = "CENTER"
    label = add_object(collection, "Scale bar length", text,
                       materials.flat_material("Scale bar length", _INK))
    label.location = bar.location + 3 * thin * right
    label.rotation_mode = "QUATERNION"
    label.rotation_quaternion = camera.rotation_quaternion
