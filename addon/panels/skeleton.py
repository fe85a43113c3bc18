"""The part of the skeleton's panel that edits its nodes."""

import bpy

from .. import branches
from ..lines import draw_text
from ..overlays import skeleton as overlay

_BUTTONS = (("DELETE", "CONFIRM"), ("BRIDGE", "MERGE"), ("SPLIT", "ROOT"), ("RADIUS", "NONE"))
_LABELS = {"DELETE": "Delete Branch", "CONFIRM": "Confirm", "BRIDGE": "Bridge", "MERGE": "Merge",
           "SPLIT": "Split", "ROOT": "Set Root", "RADIUS": "Set Radius", "NONE": "Unmark"}


def draw_skeleton(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the buttons that edit nodes, and those that apply or discard the edits."""
    thing = branches.find_skeleton(context.scene)
    if thing is None:
        return
    header, body = layout.panel("limber_skeleton_nodes", default_closed=True)
    header.label(text="Edit Nodes")
    if body is None:
        return
    if thing.mode != "EDIT":
        body.operator("limber.edit_skeleton", icon="EDITMODE_HLT")
    else:
        draw_text(body, context, "Move: G. To bridge, merge or split, select the branch, then "
                  "with Shift the node to attach to", "INFO")
        for pair in _BUTTONS:
            row = body.row(align=True)
            for action in pair:
                row.operator("limber.edit_node", text=_LABELS[action]).action = action
    column = body.column(align=True)
    for words in overlay.WORDS.values():
        draw_text(column, context, words, "DOT")
    marks = overlay.marks_in_sight(thing)
    count = marks.edit_count
    if marks.trouble:
        draw_text(body, context, marks.trouble, "ERROR")
    row = body.row()
    row.enabled = bool(count or marks.trouble)
    row.operator("limber.apply_skeleton", text=f"Apply {count} Edits" if count else "Apply Edits",
                 icon="CHECKMARK")
    row.operator("limber.discard_skeleton", icon="LOOP_BACK")
    body.operator("limber.apply_skeleton", text="Restore as Found").restore = True
