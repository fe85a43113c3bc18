"""Drag the plan's goal in the view, by its handle or away from a mark; or move its ball by hand."""

from typing import ClassVar

import bpy
from bpy_extras.view3d_utils import region_2d_to_location_3d
from mathutils import Vector

from ..branch import branches
from ..branch.branches import GRASP_KEY
from ..branch.needs_result import NeedsBranchInObjectMode
from ..show import scene
from ..show.seeing import things_of
from . import energy_field, goal_ball

_GRASP, _TARGETS = "grasp", "targets"


class LIMBER_OT_drag_goal(NeedsBranchInObjectMode, bpy.types.Operator):
    """Drag to where the plan is to bring this, in the plane of the view. Esc puts it back"""

    bl_idname = "limber.drag_goal"
    bl_label = "Drag the Goal"
    bl_options: ClassVar = {"REGISTER", "UNDO", "INTERNAL"}

    mark: bpy.props.StringProperty(
        name="Mark", description="Name of the grasp or target that is dragged to its goal. Empty: "
                                 "the goal itself is dragged")
    move: bpy.props.FloatVectorProperty(
        name="Move [m]", size=3, subtype="TRANSLATION", description="In the world")

    _is_dragging = False

    def invoke(self, context, event):
        if not self._begin(context):
            return {"CANCELLED"}
        self._mouse = self._at_mouse(context, event)
        self._is_dragging = True
        self._reach = [(thing, thing.hide_viewport)
                       for thing in things_of(self._branch, "hemisphere")]
        for thing, _ in self._reach:
            thing.hide_viewport = False
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        if event.type == "MOUSEMOVE":
            self.move = self._at_mouse(context, event) - self._mouse
            energy_field.held[:] = [self._from + Vector(self.move)]
            self._apply()
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            self._end(context)
            if not Vector(self.move).length:
                return {"CANCELLED"}
            goal_ball.follow(context.scene)
            return {"FINISHED"}
        elif event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            self._before.put_back(context.scene, self._branch)
            self._end(context)
            return {"CANCELLED"}
        return {"RUNNING_MODAL"}

    def cancel(self, context):
        """Blender closes or loads another file."""
        energy_field.held.clear()

    def _end(self, context) -> None:
        """Hide again what is drawn while something is dragged."""
        energy_field.held.clear()
        for thing, was_hidden in self._reach:
            thing.hide_viewport = was_hidden
        context.area.tag_redraw()

    def execute(self, context):
        if not self._is_dragging and not self._begin(context):
            return {"CANCELLED"}
        self._apply()
        goal_ball.follow(context.scene)
        return {"FINISHED"}

    def _begin(self, context) -> bool:
        """Note where everything is; reports why nothing can be dragged."""
        self._surface = branches.find_surface(context.scene)
        self._branch = branches.branch_of(self._surface)
        things = branches.parts_of(self._branch).values()
        thing = next((thing for thing in things if thing.name == self.mark), None) if (
            self.mark) else goal_ball.of(self._branch)
        if thing is None:
            self.report({"ERROR"}, f"The branch has no {self.mark}." if self.mark else
                                   "There is no goal. Press Move the Goal by Hand first.")
            return False
        self._from = Vector(thing.matrix_world.translation)
        self._target = thing.get(goal_ball.TARGET_KEY)
        self._before = goal_ball.Before.of(context.scene, self._branch)
        return True

    def _apply(self) -> None:
        """Put the ball at its place; made where there is none."""
        ball = goal_ball.of(self._branch)
        into = self._surface.matrix_world.inverted()
        place = self._before.place
        if self.mark:
            place = into @ self._from
            ball = ball or goal_ball.add_by_hand(self._surface, list(place))
            goal_ball.aim(ball, self._target)
        ball.location = place + into.to_3x3() @ Vector(self.move)

    def _at_mouse(self, context, event) -> Vector:
        """Return the place under the mouse in the view's plane through what is dragged, in the
        world.
        """
        return region_2d_to_location_3d(context.region, context.region_data,
                                        (event.mouse_region_x, event.mouse_region_y), self._from)


class LIMBER_GGT_goal(bpy.types.GizmoGroup):
    """Handles of the plan's goal, the grasp and the targets: a ring about each, in the plane of the
    view.
    """

    bl_idname = "LIMBER_GGT_goal"
    bl_label = "Goal"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options: ClassVar = {"3D", "PERSISTENT"}

    @classmethod
    def poll(cls, context):
        return context.mode == "OBJECT" and bool(handles(context))

    def setup(self, context):
        self._rings = {}
        self.draw_prepare(context)

    def draw_prepare(self, context):
        marks = handles(context)
        # Rings are only added: one may be under the mouse.
        for name, (_, colour) in marks.items():
            if name not in self._rings:
                self._rings[name] = self._ring(name, colour)
        for name, ring in self._rings.items():
            ring.hide = name not in marks
            if not ring.hide:
                ring.matrix_basis.translation = marks[name][0].matrix_world.translation

    def _ring(self, name: str, colour: tuple[float, float, float]) -> bpy.types.Gizmo:
        ring = self.gizmos.new("GIZMO_GT_move_3d")
        ring.draw_options = {"ALIGN_VIEW", "FILL_SELECT"}
        ring.draw_style = "RING_2D"
        ring.scale_basis = 0.25
        ring.color, ring.alpha = colour, 0.9
        ring.color_highlight, ring.alpha_highlight = (1.0, 1.0, 1.0), 1.0
        ring.target_set_operator("limber.drag_goal").mark = name
        return ring


def handles(context: bpy.types.Context) -> dict[str, tuple]:
    """Return what can be dragged, in sight: objects and colours by name; empty for the goal."""
    surface = branches.find_surface(context.scene)
    if surface is None:
        return {}
    branch = branches.branch_of(surface)
    found = {} if (ball := goal_ball.of(branch)) is None else {"": (ball, goal_ball.COLOUR)}
    for thing in branches.parts_of(branch).values():
        kind = thing.get(branches.SHOWS_KEY)
        if kind in (_GRASP, _TARGETS):
            found[thing.name] = (thing, scene.COLORS[kind])
    return {name: mark for name, mark in found.items() if mark[0].visible_get()}


class LIMBER_OT_place_goal(NeedsBranchInObjectMode, bpy.types.Operator):
    """Select the ball of the plan's goal, to be moved with G. Where there is none, one is put at
    the plan's goal, or at the grasp"""

    bl_idname = "limber.place_goal"
    bl_label = "Move the Goal by Hand"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    def execute(self, context):
        surface, plan = branches.find_surface(context.scene), context.scene.limber.plan
        ball = goal_ball.of(branches.branch_of(surface))
        if ball is None:
            marked = surface.get(GRASP_KEY)
            if marked is None and not plan.use_goal:
                self.report({"ERROR"}, "The branch has no grasp. Reconstruct it with a grasp, or "
                                       "set Goal in the panel Plan.")
                return {"CANCELLED"}
            place = list(plan.goal) if plan.use_goal else list(marked[:3])
            ball = goal_ball.add_by_hand(surface, place)
        ball.hide_viewport = False
        context.view_layer.update()
        branches.activate(context.scene, ball)
        ball.select_set(True)
        self.report({"INFO"}, "Move the goal with G")
        return {"FINISHED"}


CLASSES = (LIMBER_OT_place_goal, LIMBER_OT_drag_goal, LIMBER_GGT_goal)
