"""A recorded pull over the branch: what was measured follows the frames, and so do force and
distance."""

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.addon.conftest import part

from limber.results.scene.animation import scene_data
from limber.store import Branch

EXAMPLE = Path(__file__).parents[2] / "blend_files" / "bending_branch"
SEEN = np.array([[0.0, 0, 0.5], [0.1, 0, 0.5], [0.2, 0, 0.5]])


@pytest.fixture()
def pulled(beam):
    """The beam with a pull of 2.5 s: its mark was seen at 0, 1.25 and 2.5 s, not at 0.625 s."""
    branch = Branch.open(beam.folder)
    with branch.stage("pull:p") as stage:
        stage.path("pulls/p/pull.toml").write_text(
            "observation = 'markers'\nrest_points_m = [[0.0, 0.0, 0.5]]\n[grasp]\n"
            "point_m = [0.0, 0.0, 0.4]\nradius_m = 0.02\n")
        with open(stage.path("pulls/p/robot.csv"), "w", newline="") as stream:
            writer = csv.writer(stream)
            writer.writerow("t_s x_m y_m z_m rx_rad ry_rad rz_rad fx_n fy_n fz_n tx_nm ty_nm tz_nm"
                            .split())
            writer.writerows([[t, 0.1 * t, 0, 0.4, 0, 0, 0, t, 0, 0, 0, 0, 0]
                              for t in (0, 1.25, 2.5)])
        rows = [[0, *SEEN[0]], [0.625, "", "", ""], [1.25, *SEEN[1]], [2.5, *SEEN[2]]]
        stage.path("pulls/p/markers.csv").write_text("t_s,m0_x_m,m0_y_m,m0_z_m\n" + "".join(
            ",".join(map(str, row)) + "\n" for row in rows))
    with branch.stage("replay:p") as stage:
        shutil.copy(branch.path("frames/to-goal.pc2"), stage.path("frames/p.pc2"))
        stage.path("frames/p.json").write_text(json.dumps(
            {"rate": 2.0, "times_s": [0, 0.5, 1.0, 1.5, 2.0, 2.5]}))
    return beam


@pytest.fixture()
def opened(bpy, worker_here, pulled, tmp_path):
    """The pull's motion in a scene of 24 frames a second: twelve to each frame of it."""
    scene_data(Branch.open(pulled.folder), motion="p").write(tmp_path / "scene.npz")
    data = part("show.scene_data").read_scene_data(tmp_path / "scene.npz")
    bpy.context.scene.limber.branch_folder = str(pulled.folder)
    shown = part("show.scene").show_branch(bpy.context.scene, data)
    assert not part("show.frame_colours").keep(data)
    return shown.surface


def _mark(bpy):
    return bpy.data.objects["Measured point 1"]


def test_what_was_measured_follows_the_frames(bpy, opened, tmp_path):
    """At its place in each frame, on the line between two looks; gone where it was not seen; also
    in a file that was closed and opened again."""
    scene = bpy.context.scene

    def seen_at(seconds):
        bpy.context.scene.frame_set(1 + round(24 * seconds))
        return [*_mark(bpy).matrix_world.translation, _mark(bpy).delta_scale.x > 0]
    assert seen_at(0.0) == pytest.approx([0, 0, 0.5, True])
    assert seen_at(1.5) == pytest.approx([0.12, 0, 0.5, True], abs=1e-6)
    assert seen_at(2.5) == pytest.approx([0.2, 0, 0.5, True], abs=1e-6)
    assert seen_at(0.5)[3] == 0, "not seen about 0.6 s"
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "scene.blend"))
    assert seen_at(1.5) == pytest.approx([0.12, 0, 0.5, True], abs=1e-6)
    # Started later and slower, it still goes with the branch.
    bpy.ops.limber.retime(frame_start=11, speed=0.5)
    bpy.context.scene.frame_set(11 + 72)
    assert _mark(bpy).matrix_world.translation.x == pytest.approx(0.12, abs=1e-6)
    assert scene is not None


@pytest.mark.slow
def test_it_is_hidden_and_gone_with_its_pull(bpy, opened, pulled, tmp_path):
    """A button hides it; another motion of the branch does not have it."""
    bpy.ops.limber.show(group="observed", hide=True)
    assert _mark(bpy).hide_viewport and _mark(bpy).hide_render
    bpy.context.scene.limber.scene.motion = ""
    bpy.ops.limber.open_result(directory=str(pulled.folder))
    assert "Measured point 1" not in bpy.data.objects
    assert part("branch.branches").info_of(part("branch.branches").find_surface(bpy.context.scene))[
        "observation"]["is_shown"] is False


def test_force_and_distance_follow_too(bpy, opened):
    """The graph's cursor stands at the frame in sight; so does the colour of the distance."""
    graph, scene = part("show.graph"), bpy.context.scene
    places = [graph.cursor_of("force", opened, scene) for frame in (1, 31, 61)
              if not scene.frame_set(frame)]
    assert places == pytest.approx([0.0, 0.5, 1.0], abs=0.11) and places == sorted(places)
    assert bpy.ops.limber.color_by(scalar="residual", each_frame=True) == {"FINISHED"}
    greatest = []
    for frame in (1, 61):
        scene.frame_set(frame)
        greatest.append(part("bridge.meshes").values_of(opened.data, "now").max())
    # Measured 0.2 m to the side; the beam's formula has 0.25 m there.
    assert greatest[0] < 1e-6 and greatest[1] == pytest.approx(0.05, rel=0.05)


def test_the_panel_plays_recordings(bpy, opened, pulled):
    """Each recording has its button; the one in sight says how long it is and what was seen."""
    from tests.addon.test_panels import _draw_step

    drawn = _draw_step(bpy, "pulls")
    assert ("operator", "limber.replay_pull", "p") in drawn.calls
    assert "2.5 s, 1 points observed" in drawn.names("label")
    assert "frame_current" in drawn.names("prop")
    with pytest.raises(RuntimeError, match="no pull 'q'"):
        bpy.ops.limber.replay_pull(pull="q")


@pytest.mark.slow
def test_a_pull_of_the_example_is_replayed(bpy, worker_here, tmp_path):
    """By the worker: the branch moves as the gripper did, with its measured points over it, and
    the next plan or motion is shown instead."""
    shutil.copytree(EXAMPLE, tmp_path / "twig.branch")
    scene = bpy.context.scene
    scene.limber.branch_folder = str(tmp_path / "twig.branch")
    assert bpy.ops.limber.replay_pull(pull="pull-1") == {"FINISHED"}
    info = part("branch.branches").info_of(part("branch.branches").find_surface(scene))
    assert info["observation"] == {"pull": "pull-1", "is_shown": True}
    assert "residual" in info["frame_scalars"] and scene.limber.scene.motion == "pull-1"
    points = [thing for thing in scene.objects if thing.name.startswith("Measured point")]
    assert len(points) == 4
    high = info["frame_scalars"]["residual"]["high"]
    # The estimate was made of this very pull: some standard deviations (1 mm) of the markers.
    assert 0.0005 < high < 0.006
