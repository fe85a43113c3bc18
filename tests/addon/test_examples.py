"""The example scripts that come with the add-on do what they say."""

import csv
import runpy
import shutil
import sys

import numpy as np
import pytest
from tests.addon.conftest import ADDON

from limber.geometry.generated import generate_branch


@pytest.fixture()
def run(bpy, worker_here, monkeypatch):
    def run(name, *arguments):
        monkeypatch.setattr(sys, "argv", ["blender", "--", *map(str, arguments)])
        runpy.run_path(str(ADDON / "examples" / f"{name}.py"), run_name="__main__")
    return run


@pytest.mark.slow
def test_scan_to_branch(bpy, run, tmp_path):
    """A scan in millimetres becomes a branch that a fruit bends down, in a file."""
    scan = generate_branch(5, length=0.4, fork_count=0, point_spacing=0.006).cloud
    np.savetxt(tmp_path / "twig.xyz", 1000 * scan.points)
    run("scan_to_branch", tmp_path / "twig.xyz", tmp_path / "twig.blend", "--unit", "mm")
    bpy.ops.wm.open_mainfile(filepath=str(tmp_path / "twig.blend"))
    scene = bpy.context.scene
    twig = scene.objects["twig"]

    def top():
        depsgraph = bpy.context.evaluated_depsgraph_get()
        return max(vertex.co.z for vertex in twig.evaluated_get(depsgraph).data.vertices)
    scene.frame_set(scene.frame_start)
    before = top()
    scene.frame_set(scene.frame_end)
    assert 1e-4 < before - top() < 0.3


@pytest.mark.slow
def test_colour_and_render(bpy, run, beam, tmp_path):
    """The bent beam in the colours of its energy: transparent around it, and not of one colour."""
    from PIL import Image

    # Blender has just started: its cube is there, 2 m wide about the branch.
    bpy.ops.wm.read_factory_settings()
    run("colour_and_render", beam.folder, tmp_path / "beam.png", "--colour", "strain_energy",
        "--frame", 6, "--width", 256)
    pixels = np.asarray(Image.open(tmp_path / "beam.png"))
    branch = pixels[pixels[..., 3] > 200]
    assert 100 < len(branch) < 0.5 * pixels[..., 3].size
    assert np.ptp(branch[:, 0].astype(int)) > 60, "bent: much energy at its foot, none at its tip"


@pytest.mark.parametrize("name", ["colour_and_render", "scan_to_branch", "compare_branches"])
def test_an_example_that_fails_says_so(bpy, run, name, tmp_path):
    """Blender would end with 0: the script ends with another code, and leaves no result."""
    out = tmp_path / "out.png"
    arguments = [tmp_path / "nowhere", *(["-o"] if name == "compare_branches" else []), out]
    with pytest.raises(SystemExit, match="nowhere") as ended:
        run(name, *arguments)
    assert ended.value.code not in (0, None) and not out.exists()


@pytest.mark.parametrize("shown", ["a wall", "nothing"])
def test_a_picture_without_a_branch_is_refused(bpy, tmp_path, shown):
    """Filled by something else, or empty: no picture for a success."""
    script = runpy.run_path(str(ADDON / "examples" / "colour_and_render.py"))
    image = bpy.data.images.new("shown", 8, 8, alpha=True)
    image.pixels = [0.5, 0.5, 0.5, float(shown == "a wall")] * 64
    image.filepath_raw, image.file_format = str(tmp_path / "a.png"), "PNG"
    image.save()
    with pytest.raises(RuntimeError, match="covers" if shown == "a wall" else "not in the"):
        script["check"](tmp_path / "a.png")
    with pytest.raises(RuntimeError, match="rendered no"):
        script["check"](tmp_path / "b.png")


@pytest.mark.slow
def test_compare_branches(bpy, run, beam, tmp_path):
    """Two branches stand apart, each with its row in the table."""
    other = tmp_path / "other.branch"
    shutil.copytree(beam.folder, other)
    run("compare_branches", beam.folder, other, "-o", tmp_path / "both.blend")
    with open(tmp_path / "both.csv", newline="") as stream:
        rows = list(csv.DictReader(stream))
    assert [float(row["length_m"]) for row in rows] == [0.6, 0.6]
    places = [bpy.data.objects[name].delta_location.x for name in ("beam", "beam.001")]
    assert places[0] == 0.0 and places[1] > 0.02
