"""Control points, grasp and targets go along while the branch is bent by hand."""

import bpy
import numpy as np
from mathutils import Vector

from .. import compat
from ..branch import branches
from ..show.seeing import things_of


class CarriedMarks:
    """The marks on a branch, each carried by the vertex that is nearest to it at rest.

    They move by their delta location, which is keyed where the branch has a motion.

    Args:
        surface: Surface of the branch.
        rest: Positions of its vertices at rest [m], shape [v, 3].
    """

    def __init__(self, surface: bpy.types.Object, rest: np.ndarray):
        self._surface, self._rest = surface, rest
        branch = branches.branch_of(surface)
        self._marks = [
            (thing, thing.delta_location.copy(), _at_rest(thing))
            for group in ("control_points", "marks") for thing in things_of(branch, group)]
        self._nearest = [int(((rest + surface.delta_location - np.array(place)) ** 2).sum(
            axis=1).argmin())
                         for _, _, place in self._marks]

    def show(self, positions: np.ndarray) -> None:
        """Carry them to the branch's present ``positions`` [m], shape [v, 3]."""
        turn = self._surface.matrix_world.to_3x3()
        for (thing, _, place), vertex in zip(self._marks, self._nearest, strict=True):
            moved = Vector((positions[vertex] - self._rest[vertex]).tolist())
            thing.delta_location = place + turn @ moved

    def end(self) -> None:
        """Put them back; one that the user has removed is skipped."""
        for thing, before, _ in self._marks:
            try:
                thing.delta_location = before
            except ReferenceError:
                continue


def _at_rest(thing: bpy.types.Object) -> Vector:
    """Return an object's delta location before its motion begins, if it has one."""
    place = thing.delta_location.copy()
    for curve in compat.fcurves_of(thing):
        if curve.data_path == "delta_location" and len(curve.keyframe_points):
            place[curve.array_index] = curve.keyframe_points[0].co[1]
    return place
