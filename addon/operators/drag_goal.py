"""Drag the plan's goal in the view by its handle."""

from typing import ClassVar

import bpy
from bpy_extras.view3d_utils import region_2d_to_location_3d
from mathutils import Vector

from .. import branches, goal_ball
from .needs_result import NeedsBranchInObjectMode


class LIMBER_OT_drag_goal(NeedsBranchInObjectMode, bpy.types.Operator):
    """Drag the goal of the plan in the plane of the view. Esc puts it back"""

    bl_idname = "limber.drag_goal"
    bl_label = "Drag the Goal"
    bl_options: ClassVar = {"REGISTER", "UNDO", "INTERNAL"}

    move: bpy.props.FloatVectorProperty(
        name="Move [m]", size=3, subtype="TRANSLATION", description="In the world")

    def invoke(self, context, event):
        ball = current_ball(context)
        if ball is None:
            return {"CANCELLED"}
        self._begin = self._at_mouse(context, event, ball.matrix_world.translation)
        self._before = Vector(ball.location)
        context.window_manager.modal_handler_add(self)
        return {"RUNNING_MODAL"}

    def modal(self, context, event):
        ball = current_ball(context)
        if ball is None:
            return {"CANCELLED"}
        if event.type == "MOUSEMOVE":
            self.move = self._at_mouse(context, event, self._begin) - self._begin
            ball.location = self._before
            _move(context, ball, self.move)
        elif event.type == "LEFTMOUSE" and event.value == "RELEASE":
            goal_ball.follow(context.scene)
            return {"FINISHED"}
        elif event.type in {"ESC", "RIGHTMOUSE"} and event.value == "PRESS":
            ball.location = self._before
            return {"CANCELLED"}
        return {"RUNNING_MODAL"}

    def execute(self, context):
        ball = current_ball(context)
        if ball is None:
            self.report({"ERROR"}, "There is no goal. Press Move the Goal by Hand first.")
            return {"CANCELLED"}
        _move(context, ball, self.move)
        goal_ball.follow(context.scene)
        return {"FINISHED"}

    def _at_mouse(self, context, event, place: Vector) -> Vector:
        """Return the place under the mouse in the view's plane through ``place``, in the world."""
        return region_2d_to_location_3d(context.region, context.region_data,
                                        (event.mouse_region_x, event.mouse_region_y), place)


class LIMBER_GGT_goal(bpy.types.GizmoGroup):
    """The handle of the plan's goal: a ring about it, in the plane of the view."""

    bl_idname = "LIMBER_GGT_goal"
    bl_label = "Goal"
    bl_space_type = "VIEW_3D"
    bl_region_type = "WINDOW"
    bl_options: ClassVar = {"3D", "PERSISTENT"}

    @classmethod
    def poll(cls, context):
        ball = current_ball(context)
        return context.mode == "OBJECT" and ball is not None and ball.visible_get()

    def setup(self, context):
        self._handle = self.gizmos.new("GIZMO_GT_move_3d")
        self._handle.draw_options = {"ALIGN_VIEW", "FILL_SELECT"}
        self._handle.draw_style = "RING_2D"
        self._handle.scale_basis = 0.25
        self._handle.color, self._handle.alpha = goal_ball.COLOUR, 0.9
        self._handle.color_highlight, self._handle.alpha_highlight = (1.0, 1.0, 1.0), 1.0
        self._handle.target_set_operator("limber.drag_goal")

    def draw_prepare(self, context):
        ball = current_ball(context)
        if ball is not None:
            self._handle.matrix_basis.translation = ball.matrix_world.translation


def current_ball(context: bpy.types.Context) -> bpy.types.Object | None:
    """Return the ball of the current branch's goal; None without."""
    surface = branches.find_surface(context.scene)
    return None if surface is None else goal_ball.of(branches.branch_of(surface))


def _move(context: bpy.types.Context, ball: bpy.types.Object, move: Vector) -> None:
    """Move the ball by a displacement in the world [m]; its location is in the branch's frame."""
    surface = branches.find_surface(context.scene)
    into = surface.matrix_world.inverted().to_3x3()
    ball.location = Vector(ball.location) + into @ Vector(move)


def register() -> None:
    bpy.utils.register_class(LIMBER_OT_drag_goal)
    bpy.utils.register_class(LIMBER_GGT_goal)


def unregister() -> None:
    bpy.utils.unregister_class(LIMBER_GGT_goal)
    bpy.utils.unregister_class(LIMBER_OT_drag_goal)
