"""Visible parts of a branch, and the meaning of its colours."""

from typing import ClassVar

import bpy

from ..branch import branches
from ..branch.needs_result import NeedsBranch
from ..bridge.materials import WOOD
from . import frame_colours, scene
from . import graph as viewport_graph

GROUPS = {
    "paths": ("Paths", ("path:plan", "path:baseline")),
    "energy": ("Paths by Energy", ("rods:plan", "rods:baseline")),
    "trees": ("Search Trees", ("tree:plan", "tree:baseline")),
    "goal": ("Goal", ("goal",)),
    "hemisphere": ("Grasps in Reach", ("hemisphere",)),
    "robot": ("Robot", ("robot",)),
    "marks": ("Grasp and Targets", ("grasp", "targets")),
    "control_points": ("Control Points", ("control_points",)),
    "skeleton": ("Skeleton", ("skeleton",)),
    "radii": ("Skeleton Radii", ("rods:skeleton",)),
    "fit": ("Measured over Simulated", ("rods:fit",)),
    "observed": ("Measured Points", ("observed",)),
    "rest": ("Rest Shape", ("rest",)),
    "base": ("Fixed Base", ("base",))}
"""Parts that can be shown and hidden: title, and the keys of the objects that show it."""
NO_FRAMES = ("The values of each frame are missing from the branch folder, so the worst value "
             "over all frames is shown. Open the result again.")


def things_of(branch: bpy.types.Collection, group: str) -> list[bpy.types.Object]:
    """Return the objects of a branch that belong to a group."""
    kinds = GROUPS[group][1]
    return [thing for thing in branches.parts_of(branch).values()
            if thing[branches.SHOWS_KEY] in kinds]


class LIMBER_OT_show(NeedsBranch, bpy.types.Operator):
    """Show or hide this"""

    bl_idname = "limber.show"
    bl_label = "Show"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    group: bpy.props.EnumProperty(
        name="What", items=[(name, title, "") for name, (title, _) in GROUPS.items()])
    hide: bpy.props.BoolProperty(name="Hide", options={"SKIP_SAVE"})

    def execute(self, context):
        branch = branches.branch_of(branches.find_surface(context.scene))
        things = things_of(branch, self.group)
        if not things:
            self.report({"ERROR"}, f"The branch has no {GROUPS[self.group][0].lower()} yet.")
            return {"CANCELLED"}
        for thing in things:
            thing.hide_viewport = thing.hide_render = self.hide
        return {"FINISHED"}


class LIMBER_OT_color_by(NeedsBranch, bpy.types.Operator):
    """Colour the branch by this quantity"""

    bl_idname = "limber.color_by"
    bl_label = "Colour By"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    scalar: bpy.props.StringProperty(
        name="Quantity", description="young, strain_energy, strain, stress, stress_over_strength, "
                                     "det_f or residual, if the branch has it; or wood")
    each_frame: bpy.props.BoolProperty(
        name="In Each Frame", description="Show the values of the current frame; otherwise the "
                                          "worst value over all frames")

    def execute(self, context):
        surface = branches.find_surface(context.scene)
        scalars = branches.info_of(surface).get("scalars", {})
        if self.scalar not in (*scalars, WOOD):
            self.report({"ERROR"}, f"The branch has no {self.scalar!r}. It has: "
                                   f"{', '.join(scalars)}, {WOOD}. Open the result again.")
            return {"CANCELLED"}
        if not self.each_frame or self.scalar not in (
                branches.info_of(surface).get("frame_scalars") or {}):
            scene.color_by(surface, self.scalar)
            return {"FINISHED"}
        try:
            frame_colours.show(surface, self.scalar, context.scene.frame_current_final)
        except KeyError:
            scene.color_by(surface, self.scalar)
            self.report({"WARNING"}, NO_FRAMES)
        return {"FINISHED"}


class LIMBER_OT_graph(NeedsBranch, bpy.types.Operator):
    """Show or hide this graph in the lower right corner of the 3D view"""

    bl_idname = "limber.graph"
    bl_label = "Show as a Graph"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    graph: bpy.props.EnumProperty(name="Graph", items=[
        (name, title, "") for name, title in viewport_graph.GRAPHS.items()])

    def execute(self, context):
        if self.graph not in viewport_graph.graphs_of(branches.find_surface(context.scene)):
            self.report({"ERROR"}, "The current branch has no such graph. Open the result again.")
            return {"CANCELLED"}
        settings = context.scene.limber
        settings.graph = viewport_graph.NONE if settings.graph == self.graph else self.graph
        return {"FINISHED"}


CLASSES = (LIMBER_OT_graph, LIMBER_OT_show, LIMBER_OT_color_by)
