"""A scan is cropped by an object around a part of it, or by the points that are selected."""

import pytest


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
    assert settings.use_crop_low and settings.use_crop_high
    return [*settings.crop_low, *settings.crop_high]


def test_a_box_around_a_part_is_kept_in_the_files_numbers(bpy, scan):
    """Metres in the view, millimetres and the file's origin in the setting."""
    bpy.context.view_layer.update()
    low, high = (scan.matrix_world @ scan.data.vertices[number].co for number in (1, 2))
    bpy.ops.mesh.primitive_cube_add(size=1.0, location=(low + high) / 2, scale=(0.2, 0.1, 0.5))
    bpy.context.view_layer.update()
    assert bpy.ops.limber.crop_scan() == {"FINISHED"}
    assert _cropped(bpy) == pytest.approx(
        [499950, 1950, 50, 500150, 2050, 550], abs=0.1)


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


def test_without_a_scan_there_is_nothing_to_crop(bpy, registered):
    """The button is off, and says what to do."""
    assert not bpy.ops.limber.crop_scan.poll()
