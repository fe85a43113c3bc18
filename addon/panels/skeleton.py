"""The part of the skeleton's panel that edits its nodes."""

import textwrap

import bpy

from .. import branches
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
        body.label(text="Move: G. To bridge, merge or split, select", icon="INFO")
        body.label(text="the branch, then with Shift the node to attach to", icon="BLANK1")
        for pair in _BUTTONS:
            row = body.row(align=True)
            for action in pair:
                row.operator("limber.edit_node", text=_LABELS[action]).action = action
    column = body.column(align=True)
    for words in overlay.WORDS.values():
        column.label(text=words, icon="DOT")
    marks = overlay.marks_in_sight(thing)
    count = marks.edit_count
    for number, line in enumerate(textwrap.wrap(marks.trouble, 44)):
        body.label(text=line, icon="BLANK1" if number else "ERROR")
    row = body.row()
    row.enabled = bool(count or marks.trouble)
    row.operator("limber.apply_skeleton", text=f"Apply {count} Edits" if count else "Apply Edits",
                 icon="CHECKMARK")
    row.operator("limber.discard_skeleton", icon="LOOP_BACK")
    body.operator("limber.apply_skeleton", text="Restore as Found").restore = True
