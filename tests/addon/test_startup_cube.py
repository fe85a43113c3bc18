"""Blender's startup cube makes way for a branch or a scan; a cube that a user changed stays."""

import pytest


@pytest.fixture()
def cube(bpy, worker_here):
    """The cube of a Blender that has just started."""
    bpy.ops.wm.read_factory_settings()
    return bpy.data.objects["Cube"]


def _is_in_sight(cube):
    return not cube.hide_get() and not cube.hide_render


@pytest.mark.slow
def test_it_makes_way_for_a_branch(bpy, cube, beam, capfd):
    """Hidden in view and picture, and named; camera and light stay. Shown again, it stays."""
    assert bpy.ops.limber.open_result(directory=str(beam.folder)) == {"FINISHED"}
    assert cube.hide_get() and cube.hide_render
    assert "startup cube (Cube) was hidden" in capfd.readouterr().out
    assert all(_is_in_sight(bpy.data.objects[name]) for name in ("Camera", "Light", "beam"))
    cube.hide_set(False)
    cube.hide_render = False
    bpy.ops.limber.open_result(directory=str(beam.folder))
    assert _is_in_sight(cube), "the user wants it there"
    assert "Cube" not in capfd.readouterr().out


def test_it_makes_way_for_a_scan(bpy, cube, tmp_path, capfd):
    """The same before there is a branch."""
    (tmp_path / "twig.xyz").write_text("0 0 0\n0 0 0.1\n0 0 0.2\n")
    assert bpy.ops.limber.import_cloud(filepath=str(tmp_path / "twig.xyz")) == {"FINISHED"}
    assert cube.hide_get() and cube.hide_render
    assert "startup cube (Cube) was hidden" in capfd.readouterr().out


CHANGES = {
    "bevel": lambda cube: cube.modifiers.new("Bevel", "BEVEL"),
    "move": lambda cube: setattr(cube.location, "x", 3.0),
    "scale": lambda cube: setattr(cube, "scale", (0.1, 0.1, 0.1)),
    "rename": lambda cube: setattr(cube, "name", "Table"),
    "shape": lambda cube: setattr(cube.data.vertices[0].co, "z", 0.5),
    "paint": lambda cube: cube.data.materials.clear()}


@pytest.mark.parametrize("change", CHANGES.values(), ids=CHANGES)
def test_a_cube_of_the_users_stays(bpy, cube, tmp_path, change):
    """Whatever it was changed into, it is theirs."""
    change(cube)
    (tmp_path / "twig.xyz").write_text("0 0 0\n0 0 0.1\n0 0 0.2\n")
    bpy.ops.limber.import_cloud(filepath=str(tmp_path / "twig.xyz"))
    assert _is_in_sight(cube)
