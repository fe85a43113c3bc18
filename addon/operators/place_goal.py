"""Show the ball of the plan's goal, to be moved by hand."""

from typing import ClassVar

import bpy

from .. import branches, goal_ball
from ..branches import GRASP_KEY
from .needs_result import NeedsBranchInObjectMode


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


CLASSES = (LIMBER_OT_place_goal,)
