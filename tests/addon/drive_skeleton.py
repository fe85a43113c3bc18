"""Edits a skeleton inside a Blender with a window; test_real_blender.py starts it.

FOLDER has twig.branch.
"""

import sys
from pathlib import Path

import bmesh
import bpy
import numpy as np

sys.path.insert(0, str(Path(__file__).parent))
from driving import FOLDER, clear, drive, is_tab_open, override, part, picture, seen, start, undo

state = {}


def skeleton():
    return part("branch.branches").find_skeleton(bpy.context.scene)


def marks():
    return part("skeleton.node_marks").marks_in_sight(skeleton())


def open_result():
    clear()
    with override():
        bpy.ops.limber.open_result(directory=str(FOLDER / "twig.branch"))
    return True


def open_tab():
    if not is_tab_open():
        return False
    with override():
        bpy.ops.limber.edit_skeleton()
        bpy.ops.ed.undo_push(message="editing")
        bpy.ops.view3d.view_axis(type="FRONT")
        bpy.ops.view3d.view_all()
    return True


def choose(*numbers):
    """Choose nodes as clicks with Shift do, the last one active."""
    builder = bmesh.from_edit_mesh(skeleton().data)
    layer = builder.verts.layers.int["node"]
    by_number = {vertex[layer]: vertex for vertex in builder.verts}
    for vertex in builder.verts:
        vertex.select = False
    builder.select_history.clear()
    for number in numbers:
        by_number[number].select = True
        builder.select_history.add(by_number[number])
    bmesh.update_edit_mesh(skeleton().data)


def edit():
    """A twig's tip is moved with G's operator, another twig hung elsewhere, a twig cut off."""
    given = part("bridge.skeletons").as_given(skeleton().data)
    carried = [int(k) for k in np.flatnonzero(np.bincount(
        given.parent[given.parent >= 0], minlength=len(given.parent)) == 0)]
    seen["node_count"], seen["tips"] = len(given.parent), carried
    one, other = carried[:2]
    state["tip"] = one
    with override():
        choose(one)
        bpy.ops.transform.translate(value=(0.01, 0.0, 0.0))
        seen["moved"] = marks().edit_count
        choose(other)
        bpy.ops.limber.edit_node("EXEC_DEFAULT", action="DELETE")
        seen["deleted"] = marks().edit_count
        # A user's clicks push these steps; calls from a script do not.
        bpy.ops.ed.undo_push(message="deleted")
        choose(int(given.parent[given.parent[one]]), 3)
        bpy.ops.limber.edit_node("EXEC_DEFAULT", action="SPLIT")
        seen["split"] = marks().edit_count
        bpy.ops.ed.undo_push(message="split")
    return True


def undone():
    seen["after_undo"] = marks().edit_count
    seen["still_editing"] = skeleton().mode
    return True


def applied():
    if part("jobs.jobs").is_running():
        return False
    thing = skeleton()
    if thing is None or marks().edit_count or not len(marks().points["edited"]):
        return False
    seen["node_count_after"] = len(thing.data.vertices)
    seen["edited"] = len(marks().points["edited"])
    return True


drive([open_result, open_tab, edit, picture("edited"), undo, undone, start("apply_skeleton"),
       applied, picture("applied")], longest=200)
