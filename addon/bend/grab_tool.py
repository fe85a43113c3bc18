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


_shortcuts: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


def register() -> None:
    if bpy.app.background:
        return
    bpy.utils.register_tool(LIMBER_TOOL_grab, after={"builtin.transform"}, separator=True)
    # Among the add-ons' shortcuts: the user's own have priority, and may change them.
    keys = bpy.context.window_manager.keyconfigs.addon
    if keys is not None:
        keymap = keys.keymaps.new("Object Mode")
        _shortcuts.append((keymap, keymap.keymap_items.new(
            "limber.grab", "B", "PRESS", shift=True, alt=True)))


def unregister() -> None:
    while _shortcuts:
        keymap, item = _shortcuts.pop()
        keymap.keymap_items.remove(item)
    if not bpy.app.background:
        bpy.utils.unregister_tool(LIMBER_TOOL_grab)
