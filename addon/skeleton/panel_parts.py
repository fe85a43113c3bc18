"""The parts of the skeleton's panel that choose an alternative of it and edit its nodes."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import bpy

from ..branch import branch_folder, branches
from ..panels.lines import draw_text
from . import node_marks as overlay
from .operators import ACTIONS

_BUTTONS = (("DELETE", "CONFIRM"), ("BRIDGE", "MERGE"), ("SPLIT", "ROOT"), ("RADIUS", "NONE"))
_DIFFERENCES = {"delete": ("branch less", "branches less"), "add": ("twig more", "twigs more"),
                "split": ("attached elsewhere",) * 2, "root": ("root elsewhere",) * 2}


def draw_skeleton(layout: bpy.types.UILayout, context: bpy.types.Context) -> None:
    """Draw the alternatives, the buttons that edit nodes, and those that apply or discard edits."""
    thing = branches.find_skeleton(context.scene)
    if thing is None:
        return
    _draw_alternatives(layout, context, thing)
    header, body = layout.panel("limber_skeleton_nodes", default_closed=True)
    header.label(text="Edit Nodes")
    if body is None:
        return
    if thing.mode != "EDIT":
        body.operator("limber.edit_skeleton", icon="EDITMODE_HLT")
    else:
        draw_text(body, context, "Move: G. To bridge, merge or split, select the branch, then "
                  "with Shift the node to attach to", "INFO")
        titles = {name: title for name, title, _ in ACTIONS}
        for pair in _BUTTONS:
            row = body.row(align=True)
            for action in pair:
                row.operator("limber.edit_node", text=titles[action]).action = action
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


def _draw_alternatives(layout: bpy.types.UILayout, context: bpy.types.Context,
                       thing: bpy.types.Object) -> None:
    """Draw a button for each other skeleton that the scan leaves possible."""
    record = branch_folder.read_record(
        bpy.path.abspath(branches.branch_of(thing)[branches.FOLDER_KEY]))
    made = record.stages.get("reconstruct") if record else None
    graphs = (made.result.get("alternatives") or []) if made else []
    if len(graphs) < 2:
        return
    header, body = layout.panel("limber_skeleton_alternatives", default_closed=True)
    header.label(text=f"Alternatives ({len(graphs) - 1})")
    if body is None:
        return
    draw_text(body, context, "Other skeletons that the scan allows, the most likely first. "
              "Using one makes surface and mesh again", "INFO")
    for number, graph in enumerate(graphs[1:], start=2):
        column = body.column(align=True)
        draw_text(column, context, alternative_text(graphs[0], graph), "DOT")
        column.operator("limber.apply_skeleton", text=f"Use Alternative {number}",
                        icon="CHECKMARK").alternative = number


def alternative_text(used: Mapping[str, Any], graph: Mapping[str, Any]) -> str:
    """Describe an alternative of the skeleton in use: how likely, how long, what differs."""
    count = Counter(edit["do"] for edit in graph["edits"])
    differs = ", ".join(f"{number} {_DIFFERENCES[kind][number > 1]}"
                        for kind, number in count.items())
    return (f"{graph['probability'] / max(used['probability'], 1e-300):.2g} times as likely, "
            f"{1e3 * graph['length_m']:.0f} mm: {differs}")
