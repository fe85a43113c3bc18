"""The goal's ball in the view: moving it by hand moves the plan's goal."""

import bpy
from bpy.app.handlers import persistent
from mathutils import Vector

from . import branches
from .branches import SHOWS_KEY, ShownBranch, add_object
from .bridge import materials, meshes
from .properties import OPEN

_PLACE_KEY = "limber_goal_m"
"""Position of the ball when the plan's goal was last set [m]."""
_FIELD_KEY = "limber_goal_field"
COLOUR = (0.02, 0.42, 0.08)
_FIELDS = {"grasp": "goal", "tip": "tip_goal", "target": "tip_goal"}
"""Field of the plan for each kind of goal."""
_OTHERS = ("goal", "tip_goal", "target_box", "goal_seed")
"""A plan takes one of these."""


def add(shown: ShownBranch, kind: str, place: list[float], radius: float) -> bpy.types.Object:
    """Show the ball of a goal: of ``kind``, at ``place`` in the branch's frame [m]."""
    ball = meshes.new_sphere("Goal", radius)
    meshes.set_one_color(ball, COLOUR)
    material = materials.plain_material("Goal", COLOUR, alpha=0.3)
    thing = add_object(shown.collection, "Goal", ball, material)
    thing.location = place
    thing[_PLACE_KEY], thing[_FIELD_KEY] = list(thing.location), _FIELDS.get(kind, "goal")
    thing[SHOWS_KEY] = "goal"
    shown.objects["goal"] = [thing]
    return thing


def of(branch: bpy.types.Collection | None) -> bpy.types.Object | None:
    """Return the ball of a branch; None without."""
    return None if branch is None else next(
        (thing for thing in branch.objects if _PLACE_KEY in thing), None)


def place_of(thing: bpy.types.Object) -> Vector | None:
    """Return where a goal's ball is, in the frame of its branch [m]; None if it is no such ball."""
    return Vector(thing.location) if _PLACE_KEY in thing else None


def follow(scene: bpy.types.Scene) -> None:
    """Set the plan's goal to the new position of the current branch's ball, if it was moved."""
    surface = branches.find_surface(scene)
    ball = None if surface is None else of(branches.branch_of(surface))
    if ball is None or list(ball[_PLACE_KEY]) == list(ball.location):
        return
    ball[_PLACE_KEY] = list(ball.location)
    plan = scene.limber.plan
    for name in _OTHERS:
        setattr(plan, OPEN + name, name == ball[_FIELD_KEY])
    setattr(plan, ball[_FIELD_KEY], ball.location)


@persistent
def _changed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if any(isinstance(update.id, bpy.types.Object) and update.is_updated_transform
           and _PLACE_KEY in update.id for update in depsgraph.updates):
        follow(scene)


def register() -> None:
    bpy.app.handlers.depsgraph_update_post.append(_changed)


def unregister() -> None:
    bpy.app.handlers.depsgraph_update_post.remove(_changed)
