"""`limber scene`: what stands in the file, that it moves rightly, and that it can be moved."""

import importlib
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from tests.addon.conftest import part
from tests.subjects.processes import left_alive

from limber.cell.cell_file import Cell
from limber.cell.obstacles import Box
from limber.cli.main import call
from limber.core.errors import MissingDependencyError
from limber.core.progress import SILENT
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.loads.loaded_branch import NamedTarget
from limber.results.scene.animation import scene_data
from limber.results.scene.blender_process import blender_command, make_scene
from limber.results.scene.still_objects import add_cell
from limber.store import Branch

ADDON = Path(__file__).parents[2] / "addon"


@pytest.fixture()
def positions(bpy):
    """A function that returns an object's vertices as evaluated at a frame, shape [v, 3]."""
    def at(name, frame, subframe=0.0):
        bpy.context.scene.frame_set(frame, subframe=subframe)
        thing = bpy.data.objects[name].evaluated_get(bpy.context.evaluated_depsgraph_get())
        values = np.empty(3 * len(thing.data.vertices), np.float32)
        thing.data.attributes["position"].data.foreach_get("vector", values)
        return values.reshape(-1, 3)
    return at


def _show(bpy, data, path):
    """Show what the worker found, by way of its file."""
    data.write(path)
    read = part("show.scene_data").read_scene_data(path)
    return part("show.scene").show_branch(bpy.context.scene, read)


def _scene_in_process(addon, branch, path, bpy, motion=None):
    """Build the scene here, as the process of `limber scene` does, without rendering."""
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    shown = _show(bpy, scene_data(Branch.open(branch), motion=motion), path.with_suffix(".npz"))
    bpy.ops.wm.save_as_mainfile(filepath=str(path))
    return shown


def test_frames_play_after_save_reopen_and_move(bpy, addon, beam, positions, tmp_path):
    """Every vertex is at its place at every frame, also when file and folder moved together."""
    shown = _scene_in_process(addon, beam.folder, tmp_path / "scene.blend", bpy)
    assert shown.surface.modifiers[0].filepath.replace("\\", "/") == (
        "//beam.branch/frames/to-goal.pc2")
    for number, frame in enumerate(beam.frames):
        np.testing.assert_allclose(positions("beam", 1 + number), frame, atol=1e-6)
    moved = tmp_path / "elsewhere"
    moved.mkdir()
    shutil.move(beam.folder, moved / beam.folder.name)
    shutil.move(tmp_path / "scene.blend", moved / "scene.blend")
    bpy.ops.wm.open_mainfile(filepath=str(moved / "scene.blend"))
    for number, frame in enumerate(beam.frames):
        np.testing.assert_allclose(positions("beam", 1 + number), frame, atol=1e-6)
    middle = (beam.frames[2] + beam.frames[3]) / 2
    np.testing.assert_allclose(positions("beam", 3, 0.5), middle, atol=1e-6)
    np.testing.assert_allclose(positions("beam", 99), beam.frames[-1], atol=1e-6)
    np.testing.assert_allclose(positions("Rest shape", 4), beam.surface, atol=4e-4)
    assert bpy.data.objects["Rest shape"].hide_viewport, "its lines would lie over the colours"


def test_content(bpy, addon, beam, tmp_path):
    """Surface with E, both paths, control points, goal, grasp and base are where they should."""
    meshes = part("bridge.meshes")
    shown = _scene_in_process(addon, beam.folder, tmp_path / "scene.blend", bpy)
    objects = bpy.data.objects
    mesh = objects["beam"].data
    np.testing.assert_allclose(meshes.positions(mesh), beam.surface, atol=1e-7)
    young = meshes.values_of(mesh, "young")
    # E falls by exp(-2.5) from the base to the tip; vertices see the mean of their tetrahedra.
    expected = 2.5e7 * np.exp(-2.5 * beam.surface[:, 2] / 0.6)
    np.testing.assert_allclose(young, expected, rtol=0.15)
    red = meshes.values_of(mesh, mesh.color_attributes.active_color.name)[:, 0]
    assert red[young.argmax()] > 0.8, "stiffest: yellow"
    assert red[young.argmin()] < 0.1, "softest: violet"
    tube = meshes.positions(objects["gentle path"].data)
    away = np.linalg.norm(tube[:, None] - beam.path, axis=2)
    radius = away.min()
    np.testing.assert_allclose(away.min(axis=0), radius, rtol=0.05)
    np.testing.assert_allclose(away.min(axis=1), radius, rtol=0.05)
    assert 0.001 < radius < 0.004
    assert objects["shortest path"].active_material != objects["gentle path"].active_material
    tree = objects["D-RRT* tree"].data
    np.testing.assert_allclose(meshes.positions(tree), beam.path, atol=1e-6)
    assert [tuple(edge.vertices) for edge in tree.edges] == [
        (k, k + 1) for k in range(len(beam.path) - 1)]
    assert len(shown.objects["control_points"]) == 4
    # Without a frame played they are at rest.
    places = np.array([thing.delta_location for thing in shown.objects["control_points"]])
    np.testing.assert_allclose(places[:, 2], [0.12, 0.24, 0.36, 0.48], atol=0.03)
    assert abs(places[:, 0]).max() < 1e-3
    np.testing.assert_allclose(objects["Grasp 1"].delta_location, beam.path[0], atol=1e-6)
    np.testing.assert_allclose(objects["Goal"].location, beam.path[-1], atol=1e-6)
    assert objects["Goal"].dimensions.x == pytest.approx(0.04, rel=0.02)
    bpy.context.scene.frame_set(6)
    for thing in shown.objects["control_points"]:
        # Bent towards x by the square of the height: the points go with the branch.
        assert thing.delta_location.x == pytest.approx(thing.delta_location.z ** 2, abs=0.01)
    np.testing.assert_allclose(objects["Grasp 1"].delta_location, beam.path[-1], atol=1e-6)
    assert objects["Fixed base"].delta_location.z < 0.01


@pytest.mark.slow
def test_a_motion_starts_and_runs_as_it_is_told(bpy, worker_here, beam, positions):
    """At half its speed from frame 11 on: the surface and what is keyed with it stay together."""
    bpy.ops.limber.open_result(directory=str(beam.folder))
    bpy.ops.limber.retime(frame_start=11, speed=0.5)
    scene = bpy.context.scene
    assert scene.frame_end == 11 + 2 * (len(beam.frames) - 1)
    for number, frame in enumerate(beam.frames):
        np.testing.assert_allclose(positions("beam", 11 + 2 * number), frame, atol=1e-6)
        place = scene.objects["Grasp 1"].delta_location
        np.testing.assert_allclose(place, beam.path[number], atol=1e-6)
    np.testing.assert_allclose(positions("beam", 5), beam.frames[0], atol=1e-6)
    bpy.ops.limber.retime()
    np.testing.assert_allclose(positions("beam", 3), beam.frames[2], atol=1e-6)
    np.testing.assert_allclose(scene.objects["Grasp 1"].delta_location, beam.path[2], atol=1e-5)


@pytest.mark.parametrize("fps", [24, 60, 25])
def test_a_motion_plays_in_its_own_time(bpy, addon, beam, write_pc2, positions, tmp_path, fps):
    """A simulation at 60 Hz in a scene of another frame rate, which stays as the user set it."""
    times = [number / 60 for number in range(len(beam.frames))]
    branch = Branch.open(beam.folder)
    with branch.stage("simulate", reads=["mesh.vtu"]) as stage:
        write_pc2(stage.path("frames/swing.pc2"), beam.frames)
        stage.path("frames/swing.json").write_text(json.dumps({"rate": 60.0, "times_s": times}))
    bpy.context.scene.render.fps = fps
    shown = _scene_in_process(addon, beam.folder, tmp_path / "scene.blend", bpy, motion="swing")
    scene = bpy.context.scene
    assert scene.render.fps == fps
    for number in (0, 1, 3, 5):
        frame = 1 + times[number] * fps
        whole = int(frame + 1e-9)
        found = positions("beam", whole, frame - whole)
        np.testing.assert_allclose(found, beam.frames[number], atol=1e-5)
        grasp = shown.objects["grasp"][0].delta_location
        assert grasp.x == pytest.approx(beam.path[number][0], abs=4e-3), "carried, and in step"
    assert scene.frame_end >= 1 + times[-1] * fps > scene.frame_end - 1


def test_targets_go_with_the_branch(bpy, addon, beam, tmp_path):
    """A named target is a ball of that name that follows its place on the branch."""
    flower = NamedTarget("flower", (0.0, 0.0, 0.5))
    shown = _show(bpy, scene_data(Branch.open(beam.folder), targets=[flower]), tmp_path / "d.npz")
    (thing,) = shown.objects["targets"]
    assert thing.name == "Target flower"
    np.testing.assert_allclose(thing.delta_location, flower.position, atol=1e-4)
    bpy.context.scene.frame_set(6)
    assert thing.delta_location.x == pytest.approx(0.25, abs=0.02), (
        "bent by the square of its height")


def test_skeleton_is_drawn_with_its_radii(bpy, addon, beam, tmp_path):
    """Lines from each node to its parent, radii as attribute, hidden until they are wanted."""
    meshes = part("bridge.meshes")
    nodes = np.array([[0, 0, 0], [0, 0, 0.3], [0, 0, 0.6], [0.1, 0, 0.4]])
    skeleton = Skeleton.from_edges(nodes, np.array([-1, 0, 1, 1]), np.array([.01, .01, .005, .004]))
    with Branch.open(beam.folder).stage("reconstruct") as stage:
        beam.mesh.write(stage.path("mesh.vtu"))
        skeleton.write_swc(stage.path("skeleton.swc"))
    shown = _scene_in_process(addon, beam.folder, tmp_path / "scene.blend", bpy)
    (thing,) = shown.objects["skeleton"]
    np.testing.assert_allclose(meshes.positions(thing.data), skeleton.nodes, atol=1e-6)
    np.testing.assert_allclose(meshes.values_of(thing.data, "radius"), skeleton.radius, rtol=1e-6)
    assert {tuple(sorted(edge.vertices)) for edge in thing.data.edges} == {
        tuple(sorted((child, parent))) for child, parent in enumerate(skeleton.parent)
        if parent >= 0}
    assert thing.hide_viewport and thing.hide_render


def test_strain_energy_along_the_path(bpy, addon, beam, tmp_path):
    """The surface carries the largest strain energy density of any frame, in J/m3."""
    meshes, scenes = part("bridge.meshes"), part("show.scene")
    shown = _scene_in_process(addon, beam.folder, tmp_path / "scene.blend", bpy)
    mesh = shown.surface.data
    np.testing.assert_allclose(meshes.values_of(mesh, "strain_energy"),
                               1000.0 * (0.61 - beam.surface[:, 2]), rtol=1e-5)
    assert mesh.color_attributes.active_color.name == "young_color"
    scenes.color_by(shown.surface, "strain_energy")
    assert mesh.color_attributes.active_color.name == "strain_energy_color"
    attributes = [node.attribute_name for node in mesh.materials[0].node_tree.nodes
                  if node.type == "ATTRIBUTE"]
    assert attributes == ["strain_energy"]


def test_a_branch_without_a_plan(bpy, addon, bare_beam, tmp_path):
    """Just reconstructed: the surface and its marks, no motion and no error."""
    shown = _scene_in_process(addon, bare_beam.folder, tmp_path / "scene.blend", bpy)
    assert shown.frame_count == 1
    assert not shown.surface.modifiers
    assert "goal" not in shown.objects


@pytest.mark.slow
def test_command_makes_scene_and_picture(bpy, beam, tmp_path, capsys):
    """`limber scene` writes a file that opens here and a picture that shows a coloured branch."""
    from PIL import Image

    scene, picture = tmp_path / "out" / "scene.blend", tmp_path / "out" / "scene.png"
    code = call(["scene", str(beam.folder), "-o", str(scene), "--render", str(picture),
                 "--width", "560", "--json"])
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert code == 0, result
    assert result["frame_count"] == len(beam.frames)
    bpy.ops.wm.open_mainfile(filepath=str(scene))
    names = set(bpy.data.objects.keys())
    assert {"beam", "gentle path", "shortest path", "Goal", "Camera", "Ground",
            "Fixed base"} <= names
    texts = [thing.data.body for thing in bpy.data.objects if thing.type == "FONT"]
    assert any(text.endswith("MPa") for text in texts)
    assert {"gentle path", "shortest path", "control points"} <= set(texts)
    assert bpy.context.scene.render.filepath.endswith("scene.png")
    pixels = np.asarray(Image.open(picture).convert("RGB"), float)
    assert pixels.shape == (420, 560, 3)
    # Right of the legend: yellow at the base to violet at the tip, red and blue paths.
    red, green, blue = np.moveaxis(pixels[:, 225:], 2, 0)
    yellow = (red > 180) & (green > 170) & (blue < 110)
    violet = (blue > red + 15) & (red > green + 10) & (blue < 170)
    crimson = (red > 170) & (green < 110) & (blue < 130)
    for mask in (yellow, violet, crimson):
        assert mask.sum() > 25
    assert np.nonzero(yellow)[0].mean() > np.nonzero(violet)[0].mean(), "the base is below"


def test_without_blender_the_scene_is_gltf(beam, tmp_path, monkeypatch, capsys):
    """It has the branch in its colours, and its paths, in metres with y up; the picture is the
    report's, and what brings Blender is said. Only a turntable is an error. No output: exit code 2.
    """
    import trimesh

    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec",
                        lambda name: None if name == "bpy" else find(name))
    monkeypatch.setenv("PATH", str(tmp_path))
    for name in ("LIMBER_BLENDER", "LIMBER_SCENE_BLENDER"):
        monkeypatch.delenv(name, raising=False)
    blend, picture = tmp_path / "scene.blend", tmp_path / "scene.png"
    words = ["scene", str(beam.folder), "-o", str(blend), "--json"]
    assert call([*words, "--turntable", str(tmp_path / "turn.gif")]) == 3
    capsys.readouterr()
    assert call([*words, "--render", str(picture)]) == 0
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert not blend.exists() and told["scene"] == str(tmp_path / "scene.glb")
    assert "scene.glb" in told["warnings"][0] and "LIMBER_BLENDER" in told["warnings"][0]
    assert picture.read_bytes().startswith(b"\x89PNG")
    made = trimesh.load(tmp_path / "scene.glb")
    assert {"Branch", "gentle", "shortest"} <= made.geometry.keys()
    np.testing.assert_allclose(made.geometry["Branch"].bounds, [
        beam.frames[0].min(axis=0), beam.frames[0].max(axis=0)], atol=1e-5)
    np.testing.assert_allclose(made.graph["Branch"][0][:3, :3], [[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    assert len(np.unique(made.geometry["Branch"].visual.vertex_colors, axis=0)) > 1
    assert call(["scene", str(beam.folder)]) == 2
    (tmp_path / "file").write_text("")
    assert call(["scene", str(beam.folder), "-o", str(tmp_path / "file" / "x.blend")]) == 2


@pytest.mark.slow
def test_scene_script_reports_its_failure(bpy, beam, write_pc2, tmp_path):
    """Frames of another mesh end the process with code 3 and a reason, not with a still branch."""
    scene_data(Branch.open(beam.folder)).write(tmp_path / "data.npz")
    write_pc2(beam.folder / "frames" / "to-goal.pc2", beam.frames[:, 1:])
    done = subprocess.run(
        [sys.executable, ADDON / "show/make_scene.py", "--", "--data", tmp_path / "data.npz",
         "--scene", tmp_path / "scene.blend"], check=False, capture_output=True, text=True)
    assert done.returncode == 3
    assert "another mesh" in json.loads(done.stdout.splitlines()[-1])["error"]


@pytest.mark.skipif(os.name == "nt", reason="a shell script stands for Blender")
@pytest.mark.parametrize(("told", "writes"), [
    ("Blender 4.3.2", True), ("Blender 99.0.0", False), ("Blender 3.6.1", False), ("?", False)])
def test_an_older_blender_writes_what_it_shall_open(tmp_path, monkeypatch, told, writes):
    """One that is too old for our scenes, or as new as bpy, does not."""
    program = tmp_path / "blender"
    program.write_text(f"#!/bin/sh\necho '{told}'\n")
    program.chmod(0o755)
    monkeypatch.delenv("LIMBER_SCENE_BLENDER", raising=False)
    monkeypatch.setenv("LIMBER_BLENDER", str(program))
    assert (blender_command()[0] == str(program)) == writes


def test_the_robots_links_go_with_the_frames(bpy, addon, beam, tmp_path):
    """A rod for each link reaches from end to end in every frame; too short ones are left out.
    Its ends are round, so that rods that meet have no gap.
    """
    from mathutils import Vector


    shown_data = scene_data(Branch.open(beam.folder))
    rng = np.random.default_rng(3)
    links = np.cumsum(rng.uniform(0.1, 0.2, (6, 8, 3)), axis=1)
    links[:, 4] = links[:, 3]
    # Links are stiff: the same lengths in every frame.
    steps = np.diff(links, axis=1)
    lengths = np.linalg.norm(steps[0], axis=1)
    norms = np.linalg.norm(steps, axis=2)
    steps *= np.divide(lengths, norms, out=np.zeros_like(norms), where=norms > 0)[..., None]
    links = np.concatenate([links[:, :1], links[:, :1] + np.cumsum(steps, axis=1)], axis=1)
    shown_data.arrays |= {"robot_starts": links[:, :-1], "robot_ends": links[:, 1:],
                          "robot_radii": np.full(7, 0.03)}
    shown_data.info["robot"] = {"name": "ur5e", "gripper_rods": 3}
    rods = _show(bpy, shown_data, tmp_path / "data.npz").objects["robot"]
    assert len(rods) == 6
    for frame in (1, 4, 6):
        bpy.context.scene.frame_set(frame)
        for rod, number in zip(rods, (0, 1, 2, 4, 5, 6), strict=True):
            half = np.linalg.norm(links[0, number + 1] - links[0, number]) / 2
            ends = [np.array(rod.matrix_world @ Vector((0, 0, side * half))) for side in (-1, 1)]
            np.testing.assert_allclose(ends, links[frame - 1, number:number + 2], atol=1e-5)
            top = max(vertex.co.z for vertex in rod.data.vertices)
            assert top == pytest.approx(half + 0.03, abs=1e-5)


def test_a_cell_is_shown_where_its_file_says(bpy, addon, beam, tmp_path):
    """Arm, gripper and an obstacle that lets one see through; shown again they are not doubled."""
    cell_data = scene_data(Branch.open(beam.folder))
    table = Box("table", np.array([0.4, 0.3, 0.02]), np.array([0.1, 0.0, -0.05]), np.eye(3))
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.6, 0, 0, 0, 0, 0)})
    add_cell(cell_data, cell, [table])
    for _ in range(2):
        shown = _show(bpy, cell_data, tmp_path / "data.npz")
    kinds = {kind for kind in shown.objects if kind.startswith("cell:")}
    assert kinds == {"cell:arm", "cell:tool", "cell:obstacle1"}
    [thing] = shown.objects["cell:obstacle1"]
    assert thing.name == "Obstacle table"
    places = np.array([vertex.co for vertex in thing.data.vertices])
    np.testing.assert_allclose(np.abs(places - table.centre), np.tile(table.half, (8, 1)),
                               atol=1e-6)
    assert thing.active_material.diffuse_color[3] < 1.0
    cell_data.arrays["solid_faces:arm"][-1, 0] = 10**6
    with pytest.raises(ValueError, match="solid_faces:arm contains indices"):
        _show(bpy, cell_data, tmp_path / "bad.npz")


def test_a_long_legend_keeps_to_its_margin_and_height(bpy, addon, beam, tmp_path):
    """Lines break where the margin ends; all is smaller where it would leave the picture below."""
    from mathutils import Vector


    shown_data = scene_data(Branch.open(beam.folder))
    shown_data.info["notes"] = ["one of many words that go on and on beyond the margin"] * 12
    shown_data.write(tmp_path / "data.npz")
    modules = {name: part(f"show.{name}")
               for name in ("scene", "scene_data", "studio", "picture_legend")}
    data = modules["scene_data"].read_scene_data(tmp_path / "data.npz")
    scene = bpy.context.scene
    shown = modules["scene"].show_branch(scene, data)
    camera = modules["studio"].set_up_studio(scene, data)
    legend = modules["picture_legend"].add_legend(scene, camera, data, shown)
    bpy.context.view_layer.update()
    frame = camera.data.view_frame(scene=scene)
    depth = 2.0 * camera.data.clip_start
    left, right = (pick(corner.x for corner in frame) for pick in (min, max))
    low = min(corner.y for corner in frame)
    scale = depth / -frame[0].z
    limit = left + modules["studio"].LEGEND_SHARE * (right - left)
    for thing in legend.objects:
        corner = thing.location + Vector(thing.dimensions) / 2
        assert thing.location.x + thing.dimensions.x <= limit * scale * (1 - 1e-3) + 1e-9, thing
        assert corner.y - thing.dimensions.y > low * scale, thing


@pytest.mark.parametrize("reason, remedy", [
    ("libX11.so.6: cannot open shared object file",
     "apt-get install libegl1 .*LIMBER_SCENE_BLENDER"),
    ("no such thing", "a Blender. Or set LIMBER_SCENE_BLENDER to a Blender")])
def test_a_bpy_that_does_not_load_is_named_with_its_remedy(tmp_path, monkeypatch, reason, remedy):
    """As on a server, where the package is installed and a desktop's libraries are not."""
    (tmp_path / "bpy.py").write_text(f"raise ImportError({reason!r})\n")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setattr("shutil.which", lambda _name: None)
    for name in ("LIMBER_BLENDER", "LIMBER_SCENE_BLENDER"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(MissingDependencyError, match=f"does not load .*{reason}.*{remedy}"):
        make_scene(["--data", tmp_path / "none.npz"], SILENT)


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="kill -9")
def test_a_killed_scene_leaves_no_blender(bpy, beam, tmp_path):
    """SIGKILL to `limber scene` while it renders: what it started ends within seconds."""
    import psutil

    program = subprocess.Popen(
        [sys.executable, "-m", "limber", "scene", str(beam.folder), "-o", str(tmp_path / "s.blend"),
         "--render", str(tmp_path / "s.png"), "--width", "4000", "--progress", "json"],
        stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    try:
        for line in program.stdout:
            if "rendering" in line:
                break
        started = psutil.Process(program.pid).children(recursive=True)
        assert started and all(each.is_running() for each in started)
    finally:
        program.kill()
        program.wait()
        program.stdout.close()
    assert not left_alive(started, 5)
