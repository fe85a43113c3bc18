"""A mark in the view at the position of an error."""

import bpy
from mathutils import Matrix, Vector

from ..branch import branches
from ..branch.branches import FOLDER_KEY, OFFSET_KEY, SCAN_KEY
from .stages import Stage

_KEY = "limber_trouble"
"""Key of the mark: the stage whose error it shows."""
_SIZE_SHARE = 0.05


def show(scene: bpy.types.Scene, stage: Stage, place: list[float]) -> None:
    """Put the mark of a stage at a position: in the scan's file if the stage makes the branch, else
    in the branch's frame. If that is not in the scene, no mark is shown.
    """
    remove(scene, stage)
    thing = _scan(scene) if stage.makes_branch else branches.find_surface(scene)
    if thing is None:
        return
    # In a scan the offset was subtracted in the file's unit.
    offset = thing.get(OFFSET_KEY, (0.0,) * 3) if stage.makes_branch else (0.0,) * 3
    local = [a - b for a, b in zip(place, offset, strict=True)]
    mark = bpy.data.objects.new(f"Trouble: {stage.label}", None)
    mark[_KEY] = stage.name
    mark.empty_display_type = "SPHERE"
    mark.empty_display_size = _SIZE_SHARE * max(*thing.dimensions, 1e-3)
    mark.show_in_front = mark.show_name = True
    mark.matrix_world = Matrix.Translation(thing.matrix_world @ Vector(local))
    scene.collection.objects.link(mark)


def remove(scene: bpy.types.Scene, stage: Stage) -> None:
    """Remove the mark of a stage, if it has one."""
    for thing in [thing for thing in scene.objects if thing.get(_KEY) == stage.name]:
        bpy.data.objects.remove(thing)


def of(scene: bpy.types.Scene, stage: Stage) -> bpy.types.Object | None:
    """Return the mark of a stage; None without."""
    return next((thing for thing in scene.objects if thing.get(_KEY) == stage.name), None)


def _scan(scene: bpy.types.Scene) -> bpy.types.Object | None:
    path = branches.current_path(scene)
    return next((thing for thing in scene.objects if SCAN_KEY in thing
                 and thing.get(FOLDER_KEY) == path), None)
