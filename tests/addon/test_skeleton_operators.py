"""The skeleton edited in Blender and by the worker: what is done to its nodes is what comes out."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.addon.conftest import part
from tests.addon.test_panels import Layout

from limber.core.alignment import Alignment
from limber.geometry.io.skeletons import read_skeleton

pytestmark = pytest.mark.usefixtures("worker_here")

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"


@pytest.fixture()
def opened(bpy, registered, tmp_path):
    """The example's branch, copied and opened; returns its folder and its skeleton's object."""
    folder = tmp_path / "twig.branch"
    shutil.copytree(EXAMPLE, folder)
    bpy.ops.limber.open_result(directory=str(folder))
    scene = part("branch.branches")
    return folder, lambda: scene.find_skeleton(bpy.context.scene)


def _places(thing):
    return part("bridge.meshes").positions(thing.data)


def _move(thing, node, by):
    meshes = part("bridge.meshes")
    places = meshes.positions(thing.data)
    places[node] += by
    meshes.set_positions(thing.data, places)


def _tip(folder):
    skeleton = read_skeleton(folder / "skeleton.csv")
    return int(np.flatnonzero(skeleton.branch == 1)[-1])


@pytest.mark.slow
def test_edits_reach_the_mesh_and_are_marked(bpy, opened):
    """A node moved, a radius set, a twig's end cut: the worker's skeleton has it; it is marked."""
    folder, skeleton = opened
    before = read_skeleton(folder / "skeleton.csv")
    tip = _tip(folder)
    bpy.ops.limber.edit_skeleton()
    assert skeleton().mode == "EDIT" and not skeleton().hide_viewport
    assert bpy.ops.limber.edit_node(action="DELETE", node=tip) == {"FINISHED"}
    assert bpy.ops.limber.edit_node(action="RADIUS", node=3, radius=0.012) == {"FINISHED"}
    bpy.ops.object.mode_set(mode="OBJECT")
    _move(skeleton(), 4, [0.001, 0.0, 0.0])
    overlay = part("skeleton.node_marks")
    skeletons = part("bridge.skeletons")
    marks = overlay.marks_of(skeletons.nodes_of(skeleton()), skeleton().data)
    assert (marks.edit_count, marks.trouble) == (3, "")
    assert len(marks.points["pending"]) == 2
    assert bpy.ops.limber.apply_skeleton() == {"FINISHED"}
    after = read_skeleton(folder / "skeleton.csv")
    assert after.node_count == before.node_count - 1
    near = np.linalg.norm(after.nodes - before.nodes[4] - [0.001, 0, 0], axis=1).argmin()
    np.testing.assert_allclose(after.nodes[near], before.nodes[4] + [0.001, 0, 0], atol=1e-6)
    assert after.radius[np.linalg.norm(after.nodes - before.nodes[3], axis=1).argmin()] == (
        pytest.approx(0.012, rel=1e-5))
    # It is shown anew, still in sight, with what is edited marked.
    assert not skeleton().hide_viewport
    marks = overlay.marks_of(skeletons.nodes_of(skeleton()), skeleton().data)
    assert marks.edit_count == 0 and len(marks.points["edited"]) >= 2
    assert bpy.ops.limber.apply_skeleton(restore=True) == {"FINISHED"}
    again = read_skeleton(folder / "skeleton.csv")
    np.testing.assert_allclose(again.nodes, before.nodes, atol=1e-8)


@pytest.mark.slow
def test_edits_not_applied_outlive_opening_and_a_saved_file(bpy, opened, tmp_path):
    """What was moved stays where the same skeleton is opened again, and in the .blend."""
    folder, skeleton = opened
    was = _places(skeleton())[5]
    _move(skeleton(), 5, [0.0, 0.003, 0.0])
    bpy.ops.limber.edit_node(action="CONFIRM", node=6)
    bpy.ops.limber.open_result(directory=str(folder))
    np.testing.assert_allclose(_places(skeleton())[5] - was, [0, 0.003, 0], atol=1e-6)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "kept.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "kept.blend"))
    skeletons = part("bridge.skeletons")
    edits = part("skeleton.skeleton_edits")
    done = edits.edits_of(skeletons.as_given(skeleton().data), skeletons.nodes_of(skeleton()))
    assert [edit["do"] for edit in done] == ["move", "confirm"]
    assert bpy.ops.limber.discard_skeleton() == {"FINISHED"}
    np.testing.assert_allclose(_places(skeleton())[5], was, atol=1e-7)
    with pytest.raises(RuntimeError, match="Nothing has been edited"):
        bpy.ops.limber.apply_skeleton()


@pytest.mark.slow
def test_an_alternative_has_a_button(bpy, opened):
    """Beside an edit that is not applied yet; the panel says how it differs."""
    folder, _ = opened
    before, path = read_skeleton(folder / "skeleton.csv"), folder / "branch.json"
    content = json.loads(path.read_text())
    made = content["stages"]["reconstruct"]["result"]
    alignment = Alignment.model_validate(content["alignment"])
    tip = alignment.undo(before.nodes[_tip(folder)][None])[0].tolist()
    made["alternatives"] = [{"probability": 0.5, "length_m": before.length, "edits": []},
                            {"probability": 0.25, "length_m": 0.4,
                             "edits": [{"do": "delete", "at": tip}]}]
    path.write_text(json.dumps(content))
    panel = part("skeleton.panel_parts")
    assert panel.alternative_text(*made["alternatives"]) == (
        "0.5 times as likely, 400 mm: 1 branch less")
    drawn = Layout()
    panel.draw_skeleton(drawn, bpy.context)
    assert ("operator", "limber.apply_skeleton", "Use Alternative 2") in drawn.calls
    with pytest.raises(RuntimeError, match="has 1 alternatives"):
        bpy.ops.limber.apply_skeleton(alternative=3)
    bpy.ops.limber.edit_node(action="RADIUS", node=3, radius=0.012)
    assert bpy.ops.limber.apply_skeleton(alternative=2) == {"FINISHED"}
    after = read_skeleton(folder / "skeleton.csv")
    assert after.node_count == before.node_count - 1
    assert after.radius[np.linalg.norm(after.nodes - before.nodes[3], axis=1).argmin()] == (
        pytest.approx(0.012, rel=1e-5))


@pytest.mark.slow
def test_what_does_not_fit_is_said_and_nothing_is_lost(bpy, opened):
    """A cycle is the worker's error; the folder and what was marked stay."""
    folder, skeleton = opened
    tip = _tip(folder)
    before = (folder / "skeleton.csv").read_bytes()
    with pytest.raises(RuntimeError, match="Node 99999 does not exist"):
        bpy.ops.limber.edit_node(action="ROOT", node=99999)
    with pytest.raises(RuntimeError, match="The root carries the whole skeleton"):
        bpy.ops.limber.edit_node(action="DELETE", node=0)
    with pytest.raises(RuntimeError, match="Select nodes"):
        bpy.ops.limber.edit_node(action="BRIDGE", node=tip)
    bpy.ops.limber.edit_node(action="BRIDGE", node=1, target=tip)
    with pytest.raises(RuntimeError, match="cycle"):
        bpy.ops.limber.apply_skeleton()
    assert (folder / "skeleton.csv").read_bytes() == before
    skeletons = part("bridge.skeletons")
    assert skeletons.nodes_of(skeleton()).marks.sum() == 1
    bpy.ops.limber.edit_node(action="NONE", node=1)
    assert skeletons.nodes_of(skeleton()).marks.sum() == 0


@pytest.mark.slow
def test_loads_and_exports_have_a_button(bpy, opened, tmp_path):
    """A fruit and a cut at the 3D cursor: the answer stays with the button. A file is written."""
    folder, _ = opened
    axes = read_skeleton(folder / "skeleton.csv")
    steps = part("panels.steps")
    # Not the last section alone: that hangs on nodes of the one before.
    twig = np.flatnonzero(axes.branch == 1)
    for field, node in (("cut", twig[len(twig) // 2]), ("fruit", 40), ("fruit", 60)):
        bpy.context.scene.cursor.location = axes.nodes[node]
        assert bpy.ops.limber.from_cursor(stage="load", field=field) == {"FINISHED"}
    assert bpy.context.scene.limber.load.fruit.count(";") == 1
    assert bpy.ops.limber.load() == {"FINISHED"}
    assert steps.state_of(bpy.context.scene, "load")[0] is steps.StepState.DONE
    properties = part("properties")
    stages = part("jobs.stages").stages()

    def told(name):
        # The branch folder knows nothing of it: what was said stays with the button.
        return properties.outcome_of(bpy.context.scene, stages[name], str(folder))["result"]
    assert told("load")["added_mass_kg"] == pytest.approx(0.2)
    assert told("load")["cut_mass_kg"] > 0 and told("load")["sag_m"] > 0
    out = tmp_path / "twig.xml"
    assert bpy.ops.limber.export(output=str(out)) == {"FINISHED"}
    assert "<mujoco" in out.read_text()
    assert told("export")["link_count"] > 5
