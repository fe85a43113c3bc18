"""What is in sight and what its colours mean: each frame, rods, graphs, several branches."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from tests.addon.conftest import part

from limber.results.scene.animation import scene_data
from limber.store import Branch


@pytest.fixture()
def show(bpy, registered, tmp_path):
    """A function that shows a branch folder as `limber.open_result` does, without its process."""
    def show(folder):
        scene_data(Branch.open(folder)).write(tmp_path / "scene.npz")
        data = part("show.scene_data").read_scene_data(tmp_path / "scene.npz")
        shown = part("show.scene").show_branch(bpy.context.scene, data)
        bpy.context.scene.limber.branch_folder = str(folder)
        assert not part("show.frame_colours").keep(data)
        return shown.surface
    return show


@pytest.fixture()
def opened(show, beam):
    return show(beam.folder)


def _density(beam, frame):
    """The strain energy density that conftest gives the beam [J/m^3], at each vertex."""
    return 1000.0 * frame / 5 * (0.61 - beam.surface[:, 2])


def test_colours_follow_the_motion(bpy, opened, beam):
    """At each frame the values are that frame's, and so are the colours; the worst of all stays."""
    meshes, scene = part("bridge.meshes"), bpy.context.scene
    bpy.ops.limber.color_by(scalar="strain_energy", each_frame=True)
    colours = []
    for frame in (0, 2, 5):
        scene.frame_set(1 + frame)
        np.testing.assert_allclose(meshes.values_of(opened.data, "now"), _density(beam, frame),
                                   rtol=1e-5, atol=1e-5)
        shown = opened.data.color_attributes.active_color
        assert shown.name == "now_color"
        colours.append(meshes.values_of(opened.data, "now_color")[0, 0])
    assert colours[0] < colours[1] < colours[2], "the base: from dark to bright as it is bent"
    bpy.ops.limber.color_by(scalar="strain_energy")
    assert opened.data.color_attributes.active_color.name == "strain_energy_color"
    np.testing.assert_allclose(meshes.values_of(opened.data, "strain_energy"), _density(beam, 5),
                               rtol=1e-5)


def test_the_switch_changes_what_is_shown(bpy, opened):
    """From the worst of all frames to the frame in sight and back; E, which stays, stays."""
    settings, attributes = bpy.context.scene.limber, opened.data.color_attributes
    bpy.ops.limber.color_by(scalar="strain_energy", each_frame=True)
    settings.each_frame = False
    assert attributes.active_color.name == "strain_energy_color"
    settings.each_frame = True
    assert attributes.active_color.name == "now_color"
    bpy.ops.limber.color_by(scalar="young", each_frame=True)
    assert attributes.active_color.name == "young_color"
    settings.each_frame = False
    assert attributes.active_color.name == "young_color"


def test_colours_of_each_frame_survive_closing_and_moving(bpy, opened, beam, tmp_path):
    """File and folder moved together: the colours go on; without the folder the last ones stay."""
    bpy.ops.limber.color_by(scalar="strain_energy", each_frame=True)
    home = tmp_path / "elsewhere"
    home.mkdir()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    shutil.move(beam.folder, home / beam.folder.name)
    shutil.move(tmp_path / "scene.blend", home / "scene.blend")
    bpy.ops.wm.open_mainfile(filepath=str(home / "scene.blend"))
    meshes, scene = part("bridge.meshes"), bpy.context.scene
    data = scene.objects["beam"].data
    scene.frame_set(6)
    np.testing.assert_allclose(meshes.values_of(data, "now"), _density(beam, 5), rtol=1e-5)
    (home / beam.folder.name / ".viewport" / "to-goal.npz").write_bytes(b"rubbish")
    bpy.ops.wm.save_mainfile()
    bpy.ops.wm.open_mainfile(filepath=str(home / "scene.blend"))
    scene = bpy.context.scene
    scene.frame_set(3)
    np.testing.assert_allclose(meshes.values_of(scene.objects["beam"].data, "now"),
                               _density(beam, 5), rtol=1e-5)
    assert bpy.ops.limber.color_by(scalar="strain_energy", each_frame=True) == {"FINISHED"}
    active = scene.objects["beam"].data.color_attributes.active_color
    assert active.name == "strain_energy_color", "the worst of all, and a warning"


def test_a_motion_of_another_size_is_not_shown(addon, tmp_path):
    """Values of fewer frames, or of fewer vertices, are no values of this motion."""
    frame_values = part("show.frame_values")
    shape = (3, 4)
    values = frame_values.FrameValues({"strain": np.ones(shape, np.float32)},
                                      {"strain": np.ones(shape, np.uint8)},
                                      {"inferno": np.ones((256, 4))})
    frame_values.keep(tmp_path, "swing", values)
    read = frame_values.read(tmp_path, "swing")
    assert read.names(3, 4) == {"strain"}
    assert read.names(3, 5) == read.names(2, 4) == set()
    assert frame_values.read(tmp_path, "another") is None
    (tmp_path / "frames").mkdir()
    (tmp_path / "frames" / "swing.pc2").write_bytes(b"made anew")
    assert frame_values.read(tmp_path, "swing") is None, "of the motion before"
    values.scalars["strain"][0, 0] = np.nan
    frame_values.keep(tmp_path, "swing", values)
    assert frame_values.read(tmp_path, "swing") is None
    assert [path.name for path in (tmp_path / ".viewport").iterdir()] == ["swing.npz"]


def test_values_of_a_motion_stay_in_their_folder(addon, tmp_path):
    """A name that leads out of it, or a link in the place of its folder, is refused."""
    frame_values = part("show.frame_values")
    values = frame_values.FrameValues({}, {}, {})
    branch, elsewhere = tmp_path / "a.branch", tmp_path / "elsewhere"
    branch.mkdir()
    elsewhere.mkdir()
    for name in ("../../out", "sub/out", str(tmp_path / "out")):
        with pytest.raises(OSError, match="points outside"):
            frame_values.keep(branch, name, values)
    (branch / ".viewport").symlink_to(elsewhere)
    with pytest.raises(OSError, match="points outside"):
        frame_values.keep(branch, "swing", values)
    assert sorted(path.name for path in tmp_path.rglob("*")) == [".viewport", "a.branch",
                                                                 "elsewhere"]


def test_what_can_be_shown_and_hidden(bpy, opened):
    """Trees are hidden at first, paths are not; what is not there is said."""
    seeing, branch = part("show.seeing"), part("branch.branches").branch_of(opened)

    def hidden(group):
        return {thing.hide_viewport for thing in seeing.things_of(branch, group)}
    assert (hidden("trees"), hidden("paths"), hidden("hemisphere")) == ({True}, {False}, set())
    bpy.ops.limber.show(group="trees")
    bpy.ops.limber.show(group="paths", hide=True)
    assert (hidden("trees"), hidden("paths")) == ({False}, {True})
    with pytest.raises(RuntimeError, match="no grasps in reach"):
        bpy.ops.limber.show(group="hemisphere")


def test_paths_by_energy_have_a_legend_and_a_graph(bpy, opened):
    """Rods in the colours of the energy; their scale joins the legend once they are in sight."""
    legend, graph = part("show.legend"), part("show.graph")
    rods = bpy.data.objects["gentle path by energy"]
    assert rods.hide_viewport and len(legend.shown_scales(opened)) == 1
    bpy.ops.limber.show(group="energy")
    assert [scale["unit"] for scale in legend.shown_scales(opened)] == ["Pa", "J"]
    assert list(graph.graphs_of(opened)) == ["energy"]
    assert bpy.ops.limber.graph(graph="energy") == {"FINISHED"}
    assert bpy.context.scene.limber.graph == "energy"
    bpy.ops.limber.graph(graph="energy")
    assert bpy.context.scene.limber.graph == "none"
    with pytest.raises(RuntimeError, match="no such graph"):
        bpy.ops.limber.graph(graph="young")
    corners, triangles = graph.strip([[0, 0, 1], [1, 0.5, 1]])
    assert len(corners) == 4 and triangles == [(0, 1, 2), (1, 3, 2)]


def test_several_branches(bpy, show, beam, tmp_path):
    """Side by side without touching, back in place, each chosen by its button; grabs know which."""
    copied = tmp_path / "second.branch"
    shutil.copytree(beam.folder, copied)
    first, second = show(beam.folder), show(copied)
    find, scene = part("branch.branches").find_surface, bpy.context.scene
    assert find(scene) == second
    bpy.ops.limber.choose_branch(branch=first.users_collection[0].name)
    assert find(scene) == first
    assert Path(scene.limber.branch_folder) == beam.folder
    bpy.ops.limber.side_by_side()
    bpy.context.view_layer.update()
    spans = [[(thing.matrix_world @ type(thing.location)(corner)).x for corner in thing.bound_box]
             for thing in (first, second)]
    assert max(spans[0]) < min(spans[1])
    # Shown anew it stays where it was put.
    place = second.delta_location.x
    assert show(copied) == second and second.delta_location.x == place > 0
    marks = [thing for thing in bpy.data.objects if thing.name.startswith("Grasp 1")]
    scene.frame_set(4)
    assert abs(marks[1].matrix_world.translation.x - marks[0].matrix_world.translation.x) == (
        pytest.approx(place, abs=1e-5))
    bpy.ops.limber.side_by_side(back=True)
    assert second.delta_location.x == 0
    with pytest.raises(RuntimeError, match="no branch 'third'"):
        bpy.ops.limber.choose_branch(branch="third")


def test_a_folder_is_found_again(bpy, opened, beam, tmp_path):
    """Renamed beside the file: by its number. Elsewhere: where the user says; never another's."""
    several, scene = part("branch.several"), bpy.context.scene
    branch = part("branch.branches").branch_of(opened)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "scene.blend"))
    shutil.copytree(beam.folder, tmp_path / "other.branch")
    manifest = tmp_path / "other.branch" / "branch.json"
    content = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(content | {"uuid": "another"}))
    beam.folder.rename(tmp_path / "renamed.branch")
    assert several.is_lost(branch)
    with pytest.raises(RuntimeError, match="the folder of another branch, beam"):
        bpy.ops.limber.relink(directory=str(tmp_path / "other.branch"))
    assert bpy.ops.limber.relink() == {"FINISHED"}
    assert not several.is_lost(branch)
    assert bpy.path.abspath(scene.limber.branch_folder).endswith("renamed.branch")
    assert bpy.ops.limber.play() == {"FINISHED"}
    away = tmp_path / "a" / "b" / "c"
    away.mkdir(parents=True)
    (tmp_path / "renamed.branch").rename(away / "beam.branch")
    with pytest.raises(RuntimeError, match=r"no folder of .* beside this file"):
        bpy.ops.limber.relink()
    assert bpy.ops.limber.relink(directory=str(away / "beam.branch")) == {"FINISHED"}
    assert bpy.ops.limber.play() == {"FINISHED"}


@pytest.mark.slow
def test_the_example_opens(bpy, worker_here, tmp_path):
    """The branch that comes along, in a copy: with all its results."""
    assert bpy.ops.limber.open_example(directory=str(tmp_path / "mine")) == {"FINISHED"}
    surface = part("branch.branches").find_surface(bpy.context.scene)
    assert surface.name == "bending_branch"
    assert (tmp_path / "mine" / "bending_branch.blend").is_file()
    info = part("branch.branches").info_of(surface)
    assert {"young", "energy", "force"} <= set(info["graphs"])
    assert {"young", "strain_energy", "stress_over_strength", "residual"} <= set(info["scalars"])


def test_regions_come_from_objects_in_the_branchs_frame(bpy, opened):
    """A cube about a place: as a ball, as a box; also where the branch was put aside."""
    plan = bpy.context.scene.limber.plan
    opened.delta_location = (2.0, 0.0, 0.0)
    bpy.ops.mesh.primitive_cube_add(size=0.1, location=(2.1, 0.2, 0.3))
    bpy.context.view_layer.update()
    assert bpy.ops.limber.from_object(region="goal") == {"FINISHED"}
    assert list(plan.goal) == pytest.approx([0.1, 0.2, 0.3], abs=1e-5)
    assert plan.use_goal and plan.goal_tolerance == pytest.approx(0.05, abs=1e-5)
    bpy.ops.limber.from_object(region="target_box")
    assert list(plan.target_box) == pytest.approx([.05, .15, .25, .15, .25, .35], abs=1e-5)
    bpy.ops.limber.from_object(region="workspace")
    assert list(plan.workspace)[3:] == pytest.approx([.15, .25, .35], abs=1e-5)
    bpy.context.scene.cursor.location = (2.0, 0.0, 0.4)
    bpy.ops.limber.from_cursor(stage="plan", field="goal")
    assert list(plan.goal) == pytest.approx([0.0, 0.0, 0.4], abs=1e-5)
    bpy.context.view_layer.objects.active = opened
    assert not bpy.ops.limber.from_object.poll()


def test_a_known_material(bpy, registered):
    """Its modulus and density are what the scan is reconstructed with."""
    settings = bpy.context.scene.limber
    bpy.ops.limber.material(material="oak")
    assert settings.reconstruct.young == pytest.approx(9.3e9)
    assert settings.scene.use_strength and settings.scene.strength == pytest.approx(57e6)
