"""The energy field of a branch: points of a grid with the worker's energies and colours, hidden.

The view shows a slice of it (:mod:`overlays.energy_slice`); its attributes ``energy_j`` and
``color`` are there for geometry nodes. Points where the field is not trusted are left out.
"""

import json

import bpy
import numpy as np
from mathutils import Vector

from ..branch.branches import SCALE_KEY, part_of
from ..branch.parts import ShownBranch
from ..bridge import meshes
from ..show.scene_data import SceneData

_GRID_KEY = "limber_grid"
"""Points along the three edges of the grid, the last one fastest."""
_PLACE = "grid_place"
"""Attribute of a point: its number in the grid."""
_BOX_KEY = "limber_grid_box_m"
"""Its lower and upper corner, in the branch's frame [m]."""
held: list[Vector] = []
"""Where a goal is being dragged to, in the world: the slice follows it. Empty: none is."""


def add(shown: ShownBranch, data: SceneData) -> None:
    """Add the grid, where the energy has been sampled."""
    about = data.info.get("energy_grid")
    if not about:
        return
    energies = data.arrays["energy_grid"]
    axes = [np.linspace(*ends) for ends in zip(about["low_m"], about["high_m"], energies.shape,
                                               strict=True)]
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    colours = data.arrays["energy_grid_color"].reshape(-1, 4)
    trusted = np.flatnonzero(colours[:, 3] > 0)
    mesh = meshes.new_mesh("Energy field", points[trusted])
    meshes.set_values(mesh, _PLACE, trusted, "INT")
    meshes.set_values(mesh, "energy_j", energies.ravel()[trusted])
    meshes.set_values(mesh, "color", colours[trusted], "FLOAT_COLOR")
    thing, is_new = shown.put("energy_field", "Energy field", mesh)
    thing[_GRID_KEY] = list(energies.shape)
    thing[_BOX_KEY] = [*about["low_m"], *about["high_m"]]
    thing[SCALE_KEY] = json.dumps(about["scale"])
    if is_new:
        thing.hide_viewport = thing.hide_render = True


def of(branch: bpy.types.Collection) -> bpy.types.Object | None:
    """Return the grid of a branch; None without."""
    return part_of(branch, "energy_field")


def is_sliced(scene: bpy.types.Scene) -> bool:
    """Whether the view shows a slice: while a goal is dragged, or on demand."""
    return bool(held) or scene.limber.show_energy_slice


def box(thing: bpy.types.Object) -> np.ndarray:
    """Return the grid's lower and upper corner in the branch's frame [m], shape [2, 3]."""
    return np.array(thing[_BOX_KEY]).reshape(2, 3)


def colours_at(thing: bpy.types.Object, points: np.ndarray) -> np.ndarray:
    """Return linear colours at points [n, 3] in the branch's frame, shape [n, 4].

    Between the grid's points they are mixed; outside it they are transparent.
    """
    counts, (low, high) = np.array(thing[_GRID_KEY]), box(thing)
    colours = np.zeros((np.prod(counts), 4), np.float32)
    colours[meshes.values_of(thing.data, _PLACE)] = meshes.values_of(thing.data, "color")
    colours = colours.reshape(*counts, 4)
    place = (points - low) / (high - low) * (counts - 1)
    is_inside = ((place >= 0) & (place <= counts - 1)).all(axis=1)
    first = np.clip(np.floor(place).astype(int), 0, counts - 2)
    share = np.clip(place - first, 0.0, 1.0)
    found = np.zeros((len(points), 4))
    for corner in np.ndindex(2, 2, 2):
        weight = np.prod(np.where(corner, share, 1.0 - share), axis=1)
        found += weight[:, None] * colours[tuple((first + corner).T)]
    found[:, 3] *= is_inside
    return found
