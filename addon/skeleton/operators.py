"""Edit the skeleton: nodes are moved and deleted as in any mesh, the rest by these operators.

This module computes nothing: :class:`LIMBER_OT_apply_skeleton` passes the changes to the worker.
"""

import json
import tempfile
from pathlib import Path
from typing import ClassVar

import bmesh
import bpy

from ..branch import branches
from ..branch.needs_result import NeedsSkeleton, check_identity, is_open
from ..bridge import skeletons
from ..jobs.worker_operator import WorkerOperator
from .skeleton_edits import Mark, SkeletonEditError, edits_of

ACTIONS = (
    ("DELETE", "Delete Branch", "Delete the selected nodes and everything that they carry"),
    ("BRIDGE", "Bridge", "Attach the whole branch of the first node to the node selected last"),
    ("MERGE", "Merge", "Merge the branch, up to the first node, with the branch of the node "
                       "selected last"),
    ("SPLIT", "Split", "Cut at the first node and attach the part beyond it to the node selected "
                       "last"),
    ("ROOT", "Set Root", "Make the selected node the root"),
    ("RADIUS", "Set Radius", "Set the radius of the selected nodes"),
    ("CONFIRM", "Confirm", "Confirm that the branch of the selected nodes exists"),
    ("NONE", "Clear Mark", "Remove bridges, merges, splits and confirmations from the "
                           "selected nodes"))


class LIMBER_OT_edit_skeleton(NeedsSkeleton, bpy.types.Operator):
    """Show the skeleton and edit its nodes: move them with G, delete them with X"""

    bl_idname = "limber.edit_skeleton"
    bl_label = "Edit Nodes"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    def execute(self, context):
        thing = branches.find_skeleton(context.scene)
        if context.mode != "OBJECT":
            bpy.ops.object.mode_set(mode="OBJECT")
        thing.hide_viewport = False
        thing.hide_set(False)
        for other in context.selected_objects:
            other.select_set(False)
        thing.select_set(True)
        context.view_layer.objects.active = thing
        bpy.ops.object.mode_set(mode="EDIT")
        context.tool_settings.mesh_select_mode = (True, False, False)
        return {"FINISHED"}


class LIMBER_OT_edit_node(NeedsSkeleton, bpy.types.Operator):
    """Change how the selected nodes are attached. The worker changes the branch when you apply the
    edits"""

    bl_idname = "limber.edit_node"
    bl_label = "Edit Node"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    action: bpy.props.EnumProperty(name="What", items=ACTIONS)
    radius: bpy.props.FloatProperty(
        name="Radius [m]", default=0.005, min=1e-5, soft_max=0.5, precision=5,
        description="Radius of the selected nodes")
    node: bpy.props.IntProperty(
        name="Node", default=-1, min=-1, options={"SKIP_SAVE"},
        description="Number of the node; -1 uses the nodes selected in the view")
    target: bpy.props.IntProperty(
        name="Target", default=-1, min=-1, options={"SKIP_SAVE"},
        description="Number of the node to attach to; -1 uses the node selected last in the view")

    @classmethod
    def description(cls, _context, properties):
        return next(told for name, _, told in ACTIONS if name == properties.action)

    def invoke(self, context, event):
        thing = branches.find_skeleton(context.scene)
        if self.action != "RADIUS" or thing.mode != "EDIT":
            return self.execute(context)
        with skeletons.nodes_edited(thing, is_changed=False) as builder:
            chosen = [vertex for vertex in builder.verts if vertex.select]
            if chosen:
                self.radius = chosen[-1][builder.verts.layers.float["radius"]]
        return context.window_manager.invoke_props_dialog(self)

    def draw(self, context):
        self.layout.prop(self, "radius")

    def execute(self, context):
        thing = branches.find_skeleton(context.scene)
        try:
            with skeletons.nodes_edited(thing) as builder:
                self._act(thing, builder)
        except SkeletonEditError as error:
            self.report({"ERROR"}, str(error))
            return {"CANCELLED"}
        return {"FINISHED"}

    def _act(self, thing, builder: bmesh.types.BMesh) -> None:
        has_target = self.action in Mark.__members__ and Mark[self.action].has_target
        chosen, target = self._chosen(builder, has_target)
        number = builder.verts.layers.int["node"]
        if self.action == "DELETE":
            self._delete(thing, builder, chosen)
        elif self.action == "RADIUS":
            for vertex in chosen:
                vertex[builder.verts.layers.float["radius"]] = self.radius
        elif self.action == "ROOT":
            if len(chosen) != 1:
                raise SkeletonEditError("Select exactly one node to be the root.")
            skeletons.set_root(builder, chosen[0])
        else:
            for vertex in chosen:
                skeletons.mark(builder, vertex, Mark[self.action],
                               target[number] if target is not None else -1)

    def _chosen(self, builder: bmesh.types.BMesh, has_target: bool):
        """Return the selected nodes, and the one to which they attach; SkeletonEditError without.
        """
        number = builder.verts.layers.int["node"]
        by_number = {vertex[number]: vertex for vertex in builder.verts}
        for given in (self.node, self.target):
            if given >= 0 and given not in by_number:
                raise SkeletonEditError(f"Node {given} does not exist.")
        target = by_number.get(self.target)
        if has_target and target is None and self.node < 0:
            target = builder.select_history.active
            if not isinstance(target, bmesh.types.BMVert):
                raise SkeletonEditError("Select the node of the branch first, then with Shift the "
                                        "node to attach it to.")
        chosen = [by_number[self.node]] if self.node >= 0 else [
            vertex for vertex in builder.verts
            if vertex.select and not (has_target and vertex is target)]
        if not chosen or (has_target and target is None):
            raise SkeletonEditError("Select nodes of the skeleton in Edit Mode first"
                                    + (": first the node of the branch, then with Shift the node "
                                       "to attach it to." if has_target else "."))
        return chosen, target if has_target else None

    def _delete(self, thing, builder: bmesh.types.BMesh, chosen) -> None:
        layers = builder.verts.layers.int
        skeleton = skeletons.as_given(thing.data)
        by_number = {vertex[layers["node"]]: vertex for vertex in builder.verts}
        # Nodes reattached to another branch stay.
        stops = {number for number, vertex in by_number.items()
                 if Mark(vertex[layers["mark"]]).has_target}
        gone = set().union(*(skeleton.outwards(vertex[layers["node"]], stops)
                             for vertex in chosen))
        if skeleton.root in gone:
            raise SkeletonEditError("The root carries the whole skeleton, so nothing would be "
                                    "left.")
        bmesh.ops.delete(builder, geom=[by_number[number] for number in gone
                                        if number in by_number], context="VERTS")


class LIMBER_OT_apply_skeleton(WorkerOperator, bpy.types.Operator):
    """Make surface and mesh again with the edits of the skeleton. Later reconstructions keep the
    edits"""

    bl_idname = "limber.apply_skeleton"
    bl_label = "Apply Edits"
    title = "Applying edits"

    restore: bpy.props.BoolProperty(
        name="Restore", options={"SKIP_SAVE"},
        description="Undo all edits instead, also the applied ones")
    alternative: bpy.props.IntProperty(
        name="Alternative", default=0, min=0, options={"SKIP_SAVE"},
        description="Number of the alternative to use, from 2; 0 uses none. Edits that are not "
        "yet applied come first")
    _temporary = None

    @classmethod
    def can_start(cls, context):
        return is_open(cls, branches.find_skeleton(context.scene)) and super().can_start(context)

    def arguments(self, context):
        thing = branches.find_skeleton(context.scene)
        edits = [] if self.restore else edits_of(
            skeletons.as_given(thing.data), skeletons.nodes_of(thing))
        if not edits and not self.restore and not self.alternative:
            raise ValueError("Nothing has been edited yet. Move or delete nodes first.")
        self._folder = bpy.path.abspath(branches.branch_of(thing)[branches.FOLDER_KEY])
        check_identity(context.scene, Path(self._folder))
        self._temporary = tempfile.TemporaryDirectory(prefix="limber-edits-")
        path = Path(self._temporary.name) / "edits.json"
        path.write_text(json.dumps(edits), encoding="utf-8")
        how = [] if self.restore else ["--frame", "branch", "--append"]
        if self.alternative:
            how += ["--alternative", str(self.alternative)]
        return ["skeleton", "--edits", str(path), *how, "--", self._folder]

    def folder(self, context):
        return self._folder

    def finish(self, context, result):
        self.report({"INFO"}, f"{self.title}: done in {result['seconds']:.0f} s")
        thing = branches.skeleton_from(context.scene, Path(self._folder))
        if thing is not None:
            # They are in the folder now.
            branches.put_skeleton_back(thing)
        bpy.ops.limber.open_result("EXEC_DEFAULT" if bpy.app.background else "INVOKE_DEFAULT",
                                   directory=self._folder)

    def ended(self, context, outcome):
        self._temporary.cleanup()


class LIMBER_OT_discard_skeleton(NeedsSkeleton, bpy.types.Operator):
    """Discard the edits that are not yet applied"""

    bl_idname = "limber.discard_skeleton"
    bl_label = "Discard"
    bl_options: ClassVar = {"REGISTER", "UNDO"}

    def execute(self, context):
        thing = branches.find_skeleton(context.scene)
        if thing.mode == "EDIT":
            bpy.ops.object.mode_set(mode="OBJECT")
        branches.put_skeleton_back(thing)
        return {"FINISHED"}


CLASSES = (LIMBER_OT_edit_skeleton, LIMBER_OT_edit_node, LIMBER_OT_apply_skeleton,
            LIMBER_OT_discard_skeleton)
