"""The pie menu: what is done most, around the mouse."""

import bpy

from .. import properties
from ..branch import branches
from .steps import next_stage

_KEY = {"type": "L", "value": "PRESS", "shift": True, "alt": True}
_shortcuts: list[tuple[bpy.types.KeyMap, bpy.types.KeyMapItem]] = []


class LIMBER_MT_pie(bpy.types.Menu):
    """What is done most with a branch; the next step is below."""

    bl_idname = "LIMBER_MT_pie"
    bl_label = "Limber"

    def draw(self, context):
        # Blender's order: left, right, below, above, and the corners.
        pie = self.layout.menu_pie()
        pie.operator("limber.grab", icon="VIEW_PAN")
        pie.operator("limber.place_goal", icon="SPHERE")
        following = next_stage(context.scene)
        if following is None:
            pie.operator("limber.open_result", icon="FILE_FOLDER")
        else:
            button = pie.operator(f"limber.{properties.attribute_name(following.name)}",
                                  text=f"Next: {following.label}", icon="FORWARD")
            button.branch_uuid = branches.current_uuid(context.scene)
        pie.operator("limber.play", icon="PLAY")
        if branches.find_surface(context.scene) is None:
            pie.operator("limber.open_example", icon="PLAY")
            pie.operator("limber.import_cloud", text="Import a Scan", icon="IMPORT").filepath = ""
            return
        pie.menu("LIMBER_MT_colours", text="Colour By", icon="COLOR")
        pie.operator("limber.set_up_picture", icon="IMAGE_DATA")


def register() -> None:
    bpy.utils.register_class(LIMBER_MT_pie)
    keys = bpy.context.window_manager.keyconfigs.addon
    if bpy.app.background or keys is None:
        return
    # Among the add-ons' shortcuts: the user's own have priority, and may change them.
    keymap = keys.keymaps.new("3D View", space_type="VIEW_3D")
    item = keymap.keymap_items.new("wm.call_menu_pie", **_KEY)
    item.properties.name = LIMBER_MT_pie.bl_idname
    _shortcuts.append((keymap, item))


def unregister() -> None:
    while _shortcuts:
        keymap, item = _shortcuts.pop()
        keymap.keymap_items.remove(item)
    bpy.utils.unregister_class(LIMBER_MT_pie)
