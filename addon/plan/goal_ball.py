"""The goal's ball in the view: moving it by hand moves the plan's goal."""

from dataclasses import dataclass
from typing import Any

import bpy
import numpy as np
from mathutils import Vector

from ..branch import branches, parts
from ..branch.branches import GRASP_KEY
from ..branch.parts import ShownBranch
from ..bridge import materials, meshes
from ..properties import OPEN

_PLACE_KEY = "limber_goal_m"
"""Position of the ball when the plan's goal was last set [m]."""
_FIELD_KEY = "limber_goal_field"
TARGET_KEY = "limber_target"
"""Name of the target that a target's mark shows, or that a goal is for."""
COLOUR = (0.02, 0.42, 0.08)
_FIELDS = {"grasp": "goal", "tip": "tip_goal", "target": "tip_goal"}
"""Field of the plan for each kind of goal."""
_KINDS = ("goal", "tip_goal", "target_box", "goal_seed")
"""A plan takes one of these."""
_GIVEN_KEY = "limber_goal_shown"
"""The goal of the result that is shown; missing for a ball that was put by hand."""
_KEYS = (_PLACE_KEY, _FIELD_KEY, TARGET_KEY)


def add(shown: ShownBranch, kind: str, place: list[float], radius: float) -> bpy.types.Object:
    """Show the ball of a goal: of ``kind``, at ``place`` in the branch's frame [m]."""
    ball = meshes.new_sphere("Goal", radius)
    meshes.set_one_color(ball, COLOUR)
    material = materials.plain_material("Goal", COLOUR, alpha=0.3)
    thing, _ = shown.put("goal", "Goal", ball, material)
    if thing.get(_GIVEN_KEY) != (given := f"{kind} {np.float32(place).tolist()}"):
        # Else the user may have moved it to the next goal.
        thing.location, thing[_GIVEN_KEY] = place, given
        thing[_PLACE_KEY], thing[_FIELD_KEY] = list(thing.location), _FIELDS.get(kind, "goal")
    return thing


def add_by_hand(surface: bpy.types.Object, place: list[float]) -> bpy.types.Object:
    """Show the ball of a new goal of the grasp, at ``place`` in the branch's frame [m]."""
    marked = surface.get(GRASP_KEY)
    radius = max(surface.dimensions) / 50 if marked is None else 1.6 * marked[3]
    shown = ShownBranch(branches.branch_of(surface), surface, place=surface.delta_location)
    ball = add(shown, "grasp", place, radius)
    del ball[_GIVEN_KEY]
    return ball


def keep_moved(shown: ShownBranch) -> None:
    """Keep a ball that the user has put or moved by hand, though the result has no goal."""
    ball = shown.find("goal")
    if ball is not None and _is_by_hand(ball):
        shown.before.pop(ball[branches.ID_KEY])


def tell_again(scene: bpy.types.Scene) -> None:
    """Set the plan's goal to a ball that was put by hand: a plan to it has not been made yet."""
    surface = branches.find_surface(scene)
    ball = None if surface is None else of(branches.branch_of(surface))
    if ball is not None and _is_by_hand(ball):
        _tell(scene.limber.plan, ball)


def _is_by_hand(ball: bpy.types.Object) -> bool:
    return ball.get(_GIVEN_KEY, "").partition(" ")[2] != str([*ball.location])


def of(branch: bpy.types.Collection | None) -> bpy.types.Object | None:
    """Return the ball of a branch; None without."""
    return None if branch is None else branches.part_of(branch, "goal")


def place_of(thing: bpy.types.Object) -> Vector | None:
    """Return where a goal's ball is, in the frame of its branch [m]; None if it is no such ball."""
    return Vector(thing.location) if _PLACE_KEY in thing else None


def aim(ball: bpy.types.Object, target: str | None) -> None:
    """Make a ball the goal of the grasp (None) or of a named target."""
    ball[_FIELD_KEY] = _FIELDS["grasp" if target is None else "target"]
    if target is not None:
        ball[TARGET_KEY] = target
    elif TARGET_KEY in ball:
        del ball[TARGET_KEY]


def follow(scene: bpy.types.Scene) -> None:
    """Set the plan's goal to the new position of the current branch's ball, if it was moved."""
    surface = branches.find_surface(scene)
    ball = None if surface is None else of(branches.branch_of(surface))
    if ball is None or list(ball[_PLACE_KEY]) == list(ball.location):
        return
    _tell(scene.limber.plan, ball)


def put(scene: bpy.types.Scene, surface: bpy.types.Object, field: str, place: Vector) -> None:
    """Set the plan's goal, of the grasp (``goal``) or of a target (``tip_goal``), to ``place`` in
    the branch's frame [m]: its ball goes there, made where there is none.
    """
    ball = of(branches.branch_of(surface)) or add_by_hand(surface, list(place))
    ball.location, ball[_FIELD_KEY], ball.hide_viewport = place, field, False
    if TARGET_KEY in ball:
        del ball[TARGET_KEY]
    _tell(scene.limber.plan, ball)


def choose(plan: bpy.types.PropertyGroup, field: str) -> None:
    """Switch one kind of goal on and the others off."""
    for name in _KINDS:
        setattr(plan, OPEN + name, name == field)


def _tell(plan: bpy.types.PropertyGroup, ball: bpy.types.Object) -> None:
    """Make the ball the plan's only goal."""
    ball[_PLACE_KEY] = list(ball.location)
    choose(plan, ball[_FIELD_KEY])
    setattr(plan, ball[_FIELD_KEY], ball.location)
    if TARGET_KEY in ball:
        plan.target = ball[TARGET_KEY]


@dataclass(frozen=True)
class Before:
    """The ball and the plan's goal before a drag, to be put back. ``place`` is None: no ball."""

    place: Vector | None
    keys: dict[str, Any]
    plan: dict[str, Any]

    @classmethod
    def of(cls, scene: bpy.types.Scene, branch: bpy.types.Collection) -> "Before":
        ball, plan = of(branch), scene.limber.plan
        names = [*_KINDS, *(OPEN + name for name in _KINDS), "target"]
        return cls(None if ball is None else Vector(ball.location),
                   {} if ball is None else {key: _plain(ball[key]) for key in _KEYS if key in ball},
                   {name: _plain(getattr(plan, name)) for name in names})

    def put_back(self, scene: bpy.types.Scene, branch: bpy.types.Collection) -> None:
        ball = of(branch)
        if self.place is None and ball is not None:
            parts.remove(ball)
        elif ball is not None:
            ball.location = self.place
            for key in _KEYS:
                if key in self.keys:
                    ball[key] = self.keys[key]
                elif key in ball:
                    del ball[key]
        for name, value in self.plan.items():
            setattr(scene.limber.plan, name, value)


def _plain(value: Any) -> Any:
    """Return a property's value as a copy."""
    return value if isinstance(value, str | int | float | bool) else list(value)


def _changed(scene: bpy.types.Scene, depsgraph: bpy.types.Depsgraph) -> None:
    if any(isinstance(update.id, bpy.types.Object) and update.is_updated_transform
           and _PLACE_KEY in update.id for update in depsgraph.updates):
        follow(scene)


HANDLERS = (("depsgraph_update_post", _changed),)
