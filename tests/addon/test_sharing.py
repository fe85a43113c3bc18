"""The motion in other programs' files, the turntable, and the legend of the view."""

import math

import numpy as np
import pytest
from tests.addon.conftest import part


@pytest.fixture()
def opened(bpy, worker_here, beam):
    bpy.ops.limber.open_result(directory=str(beam.folder))
    return part("branch.branches").find_surface(bpy.context.scene)


@pytest.mark.slow
@pytest.mark.parametrize("kind", [".abc", ".usdc"])
def test_the_motion_is_in_the_file(bpy, opened, beam, tmp_path, kind):
    """Read back, the branch is at each frame where it was; what was selected still is."""
    path = tmp_path / f"motion{kind}"
    other = bpy.data.objects["Grasp 1"]
    for thing in bpy.context.view_layer.objects:
        thing.select_set(thing is other)
    assert bpy.ops.limber.export_motion(filepath=str(path)) == {"FINISHED"}
    assert list(bpy.context.selected_objects) == [other]
    bpy.ops.wm.read_factory_settings(use_empty=True)
    if kind == ".abc":
        bpy.ops.wm.alembic_import(filepath=str(path), as_background_job=False)
    else:
        bpy.ops.wm.usd_import(filepath=str(path))
    (thing,) = [thing for thing in bpy.data.objects if thing.type == "MESH"]
    for number in (0, len(beam.frames) - 1):
        bpy.context.scene.frame_set(1 + number)
        mesh = thing.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        places = np.array([thing.matrix_world @ vertex.co for vertex in mesh.vertices])
        np.testing.assert_allclose(places, beam.frames[number], atol=1e-5)


@pytest.mark.slow
def test_a_kind_that_is_none_is_refused(bpy, opened, tmp_path):
    with pytest.raises(RuntimeError, match=r"Use \.abc"):
        bpy.ops.limber.export_motion(filepath=str(tmp_path / "motion.fbx"))


@pytest.mark.slow
def test_the_turntable_goes_round_and_sees_the_branch(bpy, opened):
    """Once round in its frames, at an even speed; each corner of the branch is in the picture."""
    from bpy_extras.object_utils import world_to_camera_view

    scene = bpy.context.scene
    end = scene.frame_end
    # As it is shown now: later frames bend it.
    corners = [opened.matrix_world @ type(opened.location)(corner) for corner in opened.bound_box]
    assert bpy.ops.limber.turntable(frames=40) == {"FINISHED"}
    assert bpy.ops.limber.turntable(frames=40) == {"FINISHED"}
    assert len(bpy.data.collections["Turntable"].objects) == 2
    assert scene.frame_end == end, "the scene's frames are the user's"
    pivot = bpy.data.objects["Turntable pivot"]
    for frame in (1, 11, 26, 41):
        scene.frame_set(frame)
        bpy.context.view_layer.update()
        assert pivot.rotation_euler[2] == pytest.approx(2 * math.pi * (frame - 1) / 40, abs=1e-3)
        for corner in corners:
            seen = world_to_camera_view(scene, scene.camera, corner)
            assert 0 < seen.x < 1 and 0 < seen.y < 1 and seen.z > 0


@pytest.mark.slow
def test_the_legend_is_that_of_the_colours_shown(bpy, opened):
    """Its scale follows the button; the bar has a row a stop, in the colours of the screen."""
    legend = part("show.legend")
    assert legend.shown_scales(opened)[0]["title"] == "Young's modulus (assumed)"
    bpy.ops.limber.color_by(scalar="strain_energy")
    scale = legend.shown_scales(opened)[0]
    assert "peak" in scale["title"] and "energy" in scale["title"]
    places, colours, triangles = legend.bar([[0, 0, 0, 0], [0.5, 1, 0, 0], [1, 0.2, 0.2, 0.2]],
                                            10, 20, 5, 100)
    assert places[0] == (10, 20) and places[-1] == (15, 120) and len(triangles) == 4
    assert colours[2] == pytest.approx((1, 0, 0, 1))
    assert colours[4][0] == pytest.approx(0.4845, abs=1e-3)


def test_a_scan_keeps_its_colours_and_gives_way_to_its_branch(bpy, registered, tmp_path):
    """Red, green and blue of a PLY file, as a screen has them; the switch hides the scan."""
    overlay = part("scan.cloud_overlay")
    colours = np.random.default_rng(3).integers(0, 256, (50, 3)).astype("u1")
    rows = np.zeros(50, [(axis, "<f4") for axis in "xyz"] + [
        (name, "u1") for name in ("red", "green", "blue")])
    for number, name in enumerate(("red", "green", "blue")):
        rows[name] = colours[:, number]
    rows["x"] = np.arange(50)
    head = "ply\nformat binary_little_endian 1.0\nelement vertex 50\n" + "".join(
        f"property {kind} {name}\n" for kind, names in (("float", "xyz"), ("uchar", (
            "red", "green", "blue"))) for name in names) + "end_header\n"
    (tmp_path / "c.ply").write_bytes(head.encode() + rows.tobytes())
    bpy.ops.limber.import_cloud(filepath=str(tmp_path / "c.ply"))
    cloud = bpy.data.objects["c scan"]
    np.testing.assert_allclose(overlay.colours_of(cloud.data)[:, :3], colours / 255, atol=2e-3)
    bpy.context.scene.limber.show_scan = False
    assert cloud.hide_viewport
    bpy.context.scene.limber.show_scan = True
    assert not cloud.hide_viewport


@pytest.mark.slow
def test_folder_and_file_move_together(bpy, opened, beam, tmp_path):
    """Saved, moved with its branch, opened there; saved again elsewhere: the folder is found."""
    from pathlib import Path

    def folder():
        return Path(bpy.path.abspath(bpy.context.scene.limber.branch_folder)).resolve()
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    assert bpy.context.scene.limber.branch_folder.startswith("//")
    moved = tmp_path / "moved"
    moved.mkdir()
    beam.folder.rename(moved / beam.folder.name)
    (tmp_path / "a.blend").rename(moved / "a.blend")
    bpy.ops.wm.open_mainfile(filepath=str(moved / "a.blend"))
    assert folder() == (moved / beam.folder.name).resolve()
    (tmp_path / "deep" / "er").mkdir(parents=True)
    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "deep" / "er" / "b.blend"))
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "deep" / "er" / "b.blend"))
    assert folder() == (moved / beam.folder.name).resolve()
    assert bpy.ops.limber.open_result() == {"FINISHED"}
    assert len([c for c in bpy.context.scene.collection.children if "limber_folder" in c]) == 1


@pytest.mark.slow
def test_a_branch_is_appended_to_another_file(bpy, opened, beam, tmp_path):
    """Its folder is named as the other file sees it, saved or not; before 4.3 by one button."""
    from pathlib import Path

    bpy.ops.wm.save_as_mainfile(filepath=str(tmp_path / "a.blend"))
    for there in (tmp_path / "deep" / "er" / "b.blend", None):
        bpy.ops.wm.read_homefile(use_empty=True)
        if there is not None:
            there.parent.mkdir(parents=True)
            bpy.ops.wm.save_as_mainfile(filepath=str(there))
        bpy.ops.wm.append(directory=str(tmp_path / "a.blend" / "Collection"), filename="beam")
        branch = next(c for c in bpy.data.collections if "limber_folder" in c)
        if not hasattr(bpy.app.handlers, "blend_import_post"):
            assert bpy.ops.limber.relink(directory=str(beam.folder)) == {"FINISHED"}
        assert branch["limber_folder"].startswith("//") == (there is not None)
        assert Path(bpy.path.abspath(branch["limber_folder"])).resolve() == beam.folder.resolve()
        assert bpy.ops.limber.choose_branch(branch=branch.name) == {"FINISHED"}
        assert bpy.ops.limber.play() == {"FINISHED"}
        assert bpy.ops.limber.color_by(scalar="strain_energy", each_frame=True) == {"FINISHED"}
