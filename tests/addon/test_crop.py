"""A scan is cropped by an object around a part of it, or by the points that are selected."""

import importlib

import pytest
from tests.addon.conftest import part

from limber.geometry.generated import generate_branch
from limber.geometry.io.clouds import read_points
from limber.geometry.io.skeletons import read_swc


@pytest.fixture()
def scan(bpy, registered, tmp_path):
    """Four points in millimetres, far from the file's origin."""
    path = tmp_path / "twig.xyz"
    path.write_text("500000 2000 0\n500000 2000 100\n500100 2000 500\n500300 2000 900\n")
    bpy.context.scene.limber.reconstruct.unit = "mm"
    bpy.ops.limber.import_cloud(filepath=str(path))
    return next(thing for thing in bpy.data.objects if "limber_scan_sha256" in thing)


def _cropped(bpy):
    settings = bpy.context.scene.limber.reconstruct
    assert settings.use_crop
    return list(settings.crop)


def test_a_box_around_a_part_is_kept_in_the_files_numbers(bpy, scan):
    """Metres in the view, millimetres and the file's origin in the setting."""
    bpy.context.view_layer.update()
    low, high = (scan.matrix_world @ scan.data.vertices[number].co for number in (1, 2))
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=(low + high) / 2, scale=(0.2, 0.1, 0.5))
    bpy.context.view_layer.update()
    assert bpy.ops.limber.crop_scan() == {"FINISHED"}
    assert _cropped(bpy) == pytest.approx([499950, 1950, 50, 500150, 2050, 550], abs=0.1)


def test_selected_points_give_the_box(bpy, scan):
    """As they were selected in Edit Mode; none selected is said."""
    bpy.context.view_layer.objects.active = scan
    for vertex in scan.data.vertices:
        vertex.select = False
    with pytest.raises(RuntimeError, match="No points are selected"):
        bpy.ops.limber.crop_scan()
    for number in (1, 2):
        scan.data.vertices[number].select = True
    assert bpy.ops.limber.crop_scan() == {"FINISHED"}
    assert _cropped(bpy) == pytest.approx([500000, 2000, 100, 500100, 2000, 500], abs=0.1)


def test_deleted_points_are_left_out(bpy, scan, tmp_path):
    """By their numbers in the file, in its own digits; restored, none is given any more."""
    bmesh = importlib.import_module("bmesh")
    deleted = part("scan.deleted_points")
    source = tmp_path / "twig.xyz"
    assert deleted.write(bpy.context.scene, source) is None
    bpy.context.view_layer.objects.active = scan
    bpy.ops.object.mode_set(mode="EDIT")
    shape = bmesh.from_edit_mesh(scan.data)
    shape.verts.ensure_lookup_table()
    bmesh.ops.delete(shape, geom=[shape.verts[1], shape.verts[3]], context="VERTS")
    bmesh.update_edit_mesh(scan.data)
    path = deleted.write(bpy.context.scene, source)
    assert read_points(path).points.tolist() == [[500000, 2000, 100], [500300, 2000, 900]]
    assert deleted.is_ours(str(path)) and not deleted.is_ours(str(source))
    bpy.ops.object.mode_set(mode="OBJECT")
    assert deleted.write(bpy.context.scene, source) == path


@pytest.mark.slow
def test_a_branch_is_made_without_the_deleted_points(bpy, registered, worker_here, tmp_path):
    """The upper half of a scan is deleted: its branch ends there."""
    bmesh = importlib.import_module("bmesh")
    cloud = generate_branch(5, length=0.4, fork_count=0, point_spacing=0.004).cloud
    middle = cloud.points[:, 2].min() + 0.2
    source = tmp_path / "rod.ply"
    cloud.write_ply(source)
    bpy.ops.limber.import_cloud(filepath=str(source))
    scan = next(thing for thing in bpy.data.objects if "limber_scan_sha256" in thing)
    shape = bmesh.new()
    shape.from_mesh(scan.data)
    bmesh.ops.delete(shape, geom=[vert for vert in shape.verts if vert.co.z > middle],
                     context="VERTS")
    shape.to_mesh(scan.data)
    shape.free()
    assert bpy.ops.limber.reconstruct(mesher="sweep") == {"FINISHED"}
    skeleton = read_swc(tmp_path / "rod.branch" / "scan_skeleton.swc")
    assert skeleton.nodes[:, 2].max() == pytest.approx(middle, abs=0.02)
    assert cloud.points[:, 2].max() > middle + 0.1


def test_without_a_scan_there_is_nothing_to_crop(bpy, registered):
    """The button is off, and says what to do."""
    assert not bpy.ops.limber.crop_scan.poll()
