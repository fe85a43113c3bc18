"""The tool in the toolbar, and the shortcut, to grab the branch."""

import bpy


class LIMBER_TOOL_grab(bpy.types.WorkSpaceTool):
    bl_space_type = "VIEW_3D"
    bl_context_mode = "OBJECT"
    bl_idname = "limber.grab_tool"
    bl_label = "Grab the Branch"
    bl_description = "Press on the branch and drag it. It bends like the real branch"
    bl_icon = "ops.pose.push"
    bl_keymap = (("limber.grab", {"type": "LEFTMOUSE", "value": "PRESS"}, None),)

    def draw_settings(self, layout, tool):
        layout.prop(tool.operator_properties("limber.grab"), "radius")


SHORTCUT = ({"name": "Object Mode"}, "limber.grab", "B", {})


def register() -> None:
    if not bpy.app.background:
        bpy.utils.register_tool(LIMBER_TOOL_grab, after={"builtin.transform"}, separator=True)


def unregister() -> None:
    if not bpy.app.background:
        bpy.utils.unregister_tool(LIMBER_TOOL_grab)
