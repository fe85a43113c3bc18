"""The extension as a user has it: the built zip, installed and enabled in a real Blender.

A Blender is found by LIMBER_BLENDER or on the PATH; scripts/provision_blender brings one. With
LIMBER_TEST_ZIP=limber-X-linux-x64-pyXY.zip (scripts/build_extension --wheels) all run on that zip,
its wheels the only worker.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from tests.addon.window import SharedBlender, colour_count, driven, require_screen

from limber.cli.main import call
from limber.geometry.generated import generate_branch
from limber.geometry.skeleton.skeleton import Skeleton
from limber.store import Branch

pytestmark = [pytest.mark.real_blender, pytest.mark.slow]

FOLDER = Path(__file__).parent


@pytest.fixture(scope="module")
def shared_blender(run, blender, environment, tmp_path_factory):
    """A window for what is not about Blender's own start or end."""
    require_screen()
    with SharedBlender(blender, environment, tmp_path_factory.mktemp("window")) as shared:
        yield shared


def test_it_is_enabled(run):
    """The installed extension is on: its operators and its preferences are there."""
    done = run("-b", "--python-exit-code", "9", "--python-expr", (
        "import bpy; key = 'bl_ext.user_default.limber';"
        "assert key in bpy.context.preferences.addons;"
        "assert bpy.context.preferences.addons[key].preferences.python_path == '';"
        "assert bpy.types.LIMBER_PT_play.bl_category == 'Limber'"))
    assert done.returncode == 0, done.stdout + done.stderr
    assert "Traceback" not in done.stderr


def test_command_is_the_workers(run, beam):
    """`blender -b --command limber ...`: a result as the last line, exit codes."""
    out = beam.folder.parent / "data.npz"
    done = run("-b", "--command", "limber", "scene", beam.folder, "--data", out, "--json")
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout.splitlines()[-1])["status"] == "done"
    assert out.is_file()
    done = run("-b", "--command", "limber", "scene", "nowhere", "-o", "x.blend", "--json")
    assert done.returncode == 2
    assert "There is no folder" in json.loads(done.stdout.splitlines()[-1])["error"]


def test_the_worker_comes_along(blender, tmp_path):
    """The zip with wheels is the whole installation: a scan is reconstructed with no other
    Python. It fetches 150 MB, so only where LIMBER_TEST_WHEELS is set."""
    if not os.environ.get("LIMBER_TEST_WHEELS"):
        pytest.skip("a large download: set LIMBER_TEST_WHEELS=1")
    environment = {name: value for name, value in os.environ.items() if name != "LIMBER_PYTHON"}
    environment |= {"BLENDER_USER_RESOURCES": str(tmp_path / "resources"),
                    "PATH": "/usr/sbin:/usr/bin:/sbin:/bin"}

    def run(*arguments):
        done = subprocess.run([blender, "-b", *map(str, arguments)], check=False, text=True,
                              capture_output=True, env=environment, timeout=400)
        assert done.returncode == 0, done.stdout + done.stderr
        return done.stdout
    version = run("--python-expr", "import sys; print('Python', *sys.version_info[:2])")
    version = next(line for line in version.splitlines() if line.startswith("Python"))
    subprocess.run([sys.executable, FOLDER.parents[1] / "scripts" / "build_extension",
                    "--wheels", "linux-x64", "--python", ".".join(version.split()[1:]),
                    "--output-dir", tmp_path], check=True)
    run("--command", "extension", "install-file", "-r", "user_default", "--enable",
        next(tmp_path.glob("*.zip")))
    generate_branch(5, length=0.4, fork_count=0, point_spacing=0.004).cloud.write_ply(
        tmp_path / "scan.ply")
    run("--command", "limber", "reconstruct", tmp_path / "scan.ply", "-o", tmp_path / "scan.branch")
    assert (tmp_path / "scan.branch" / "mesh.vtu").is_file()


def test_scene_is_made_and_opens(blender, run, beam, monkeypatch, capsys):
    """`limber scene` by this Blender; the file opens in it and its frames are right."""
    monkeypatch.setenv("LIMBER_SCENE_BLENDER", blender)
    scene = beam.folder.parent / "scene.blend"
    picture = scene.with_suffix(".png")
    code = call(["scene", str(beam.folder), "-o", str(scene), "--render", str(picture),
                 "--width", "240", "--color", "strain_energy", "--json"])
    result = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert code == 0, result
    assert picture.stat().st_size > 5000
    script = scene.with_name("look.py")
    script.write_text(
        "import bpy, json\n"
        "found = []\n"
        "for frame in (1, 6):\n"
        "    bpy.context.scene.frame_set(frame)\n"
        "    depsgraph = bpy.context.evaluated_depsgraph_get()\n"
        "    mesh = bpy.data.objects['beam'].evaluated_get(depsgraph).data\n"
        "    found.append([list(v.co) for v in mesh.vertices])\n"
        f"json.dump(found, open({str(scene.with_name('found.json'))!r}, 'w'))\n")
    done = run("-b", scene, "--python-exit-code", "9", "--python", script)
    assert done.returncode == 0, done.stderr
    found = json.loads(scene.with_name("found.json").read_text())
    for index, frame in ((0, 0), (1, 5)):
        difference = abs(beam.frames[frame] - found[index]).max()
        assert difference < 1e-6


def test_interface(run, blender, environment, beam, tmp_path):
    """In a window: the tab opens, a job is cancelled by a click, a result opened by the worker
    beside the interface, and played. What is the user's stays meanwhile, after a stage, its undo
    and its redo."""
    require_screen()
    slow = tmp_path / "slow_worker"
    slow.write_text("#!/bin/sh\necho '{\"progress\": 0.4, \"message\": \"slowly\"}'\n"
                    "exec sleep 100\n")
    slow.chmod(0o755)
    seen = driven("drive_interface.py", blender, environment, tmp_path)
    assert seen["category"] == "Limber"
    assert seen["progress_seen"] == 0.4
    assert seen["cancelled"] == "cancelled"
    assert seen["opened"] == ["beam"]
    assert seen["playing"] is True and 2 < seen["frame_after_play"] <= 90
    assert seen["first_range"] == [1, len(beam.frames)]
    assert seen["before"]["modifiers"] == ["MESH_CACHE", "SUBSURF"]
    assert seen["before"]["range"] == [2, 90, 4]
    for name in ("again", "simulated", "redone"):
        assert seen[name] == seen["before"], name
    assert (seen["simulated cache"], seen["undone cache"]) == ("mine.pc2", "to-goal.pc2")
    assert not Path(f"/proc/{seen['left_running']}").exists(), "closing Blender ends the worker"
    for name in ("tab", "job", "opened", "playing"):
        assert colour_count(tmp_path / f"{name}.png") > 50, "a window, not a blank screen"


def test_the_first_view(shared_blender, tmp_path):
    """Beside Blender's startup cube: example and scan are in sight, whole; undo shows the cube."""
    generate_branch(5, length=0.4, fork_count=0, point_spacing=0.004).cloud.write_ply(
        tmp_path / "scan.ply")
    seen = shared_blender.driven("drive_factory_start.py", tmp_path)
    assert seen["at_start"] == ["Camera", "Cube", "Light"], "a Blender that has just started"
    for name in ("bending_branch", "scan scan"):
        found = seen[name]
        assert found["inside"] == 1.0 and found["height"] > 0.4, "framed"
        assert found["beside"], "not behind the sidebar"
        assert not found["cube"] and not found["cube_in_picture"]
    assert seen["undone"] == [True, False, False]
    assert _coloured_count(tmp_path / "branch.png") > 1000


def test_a_picture_by_an_example(run, beam, tmp_path):
    """At factory start, beside the cube: the branch is in the picture; a failure has a code."""
    example = FOLDER.parents[1] / "addon" / "examples" / "colour_and_render.py"
    picture = tmp_path / "beam.png"
    done = run("-b", "--python", example, "--", beam.folder, picture, "--colour", "strain_energy",
               "--width", "300")
    assert done.returncode == 0, done.stderr
    assert _coloured_count(picture, None) > 300
    done = run("-b", "--python", example, "--", tmp_path / "nowhere", tmp_path / "none.png")
    assert done.returncode == 1 and "nowhere" in done.stderr
    assert not (tmp_path / "none.png").exists()


def _coloured_count(path: Path, part: tuple[int, ...] | None = (200, 200, 800, 690)) -> int:
    """Return how many pixels are in a strong colour: of the 3D view, left of the sidebar."""
    pixels = np.asarray(Image.open(path).convert("RGB").crop(part)).astype(int)
    return int((np.ptp(pixels, axis=2) > 90).sum())


def test_grab(shared_blender, beam, tmp_path):
    """By mouse events: pressed and dragged the beam follows; kept, left, undone; Esc restores.

    A fruit, a cut and wind act while it is held; left by Esc, the branch is whole again."""
    with Branch.open(beam.folder).stage("axes") as stage:
        height = np.linspace(0.0, 0.6, 31)
        Skeleton.from_edges(np.column_stack([0 * height, 0 * height, height]), np.arange(-1, 30),
                            0.012 - height / 0.6 * 0.007).write_swc(stage.path("skeleton.swc"))
    seen = shared_blender.driven("drive_grab.py", tmp_path)
    assert seen["began"] == ["RUNNING_MODAL"]
    is_given, move, place, mode = seen["kept"]
    assert is_given and mode == "point"
    assert abs(move[0]) > 0.02 and abs(move[1]) < 0.005
    assert abs(place[2] - 0.57) < 0.06, "where it was pressed"
    assert seen["restored"] < 1e-6 and seen["motion_shown"]
    assert (seen["colour_over"], seen["colour_after"]) == ("limber_limit", seen["colour"])
    assert not seen["after_undo"]
    assert seen["carried_m"] > 0.005 and seen["marks_after"] < 1e-6
    assert seen["refused"], "S where no plan moves the branch"
    for name in ("start", "goal"):
        is_given, place = seen[name]
        assert is_given and place[0] > 0.02 and abs(place[2] - 0.4) < 0.06
    assert seen["ball"] == pytest.approx(seen["goal"][1], abs=1e-6), "the goal is shown there"
    assert seen["sessions_left"] == 0 and not Path(f"/proc/{seen['session']}").exists()
    live = seen["live"]
    assert live["hidden"] > 5 and live["bent_m"] > 1e-3
    assert live["fruit"].endswith(" 0.02") and float(live["cut"].split()[2]) == pytest.approx(
        0.45, abs=0.04)
    assert live["lines"][0].startswith("Sag") and "added 0.02 kg" in live["lines"][2]
    assert seen["after_live"] == ["", "", False]
    for name in ("grab", "goal", "loads"):
        assert colour_count(tmp_path / f"{name}.png") > 50


def test_manual_pictures(run, blender, environment, tmp_path):
    """The manual's pictures can be taken: a window each, with what it shows. Kept where
    LIMBER_MANUAL_PICTURES says, which alone has them taken."""
    kept = os.environ.get("LIMBER_MANUAL_PICTURES")
    if not kept:
        pytest.skip("for the manual: scripts/make_manual_pictures")
    require_screen()
    driven("drive_manual.py", blender, environment, tmp_path)
    Path(kept).mkdir(parents=True, exist_ok=True)
    for name in ("stress", "young", "pull"):
        assert colour_count(tmp_path / f"{name}.png") > 50
        _cropped(tmp_path / f"{name}.png").save(Path(kept) / f"{name}.png", optimize=True)
    with Image.open(tmp_path / "wood.png") as made:
        made.convert("RGB").save(Path(kept) / "wood.webp", quality=92)


def _cropped(path: Path):
    """Return the picture of the 3D view and its sidebar; in all its colours, which mean numbers."""
    return Image.open(path).convert("RGB").crop((0, 28, 1056, 718))


def test_skeleton(shared_blender, tmp_path):
    """In Edit Mode: a node moved, a twig cut, one hung over; undone; applied by the worker."""
    shutil.copytree(FOLDER.parents[1] / "blend_files" / "bending_branch", tmp_path / "twig.branch")
    seen = shared_blender.driven("drive_skeleton.py", tmp_path)
    assert (seen["moved"], seen["deleted"], seen["split"]) == (1, 2, 3)
    assert (seen["after_undo"], seen["still_editing"]) == (2, "EDIT")
    assert seen["node_count_after"] < seen["node_count"] and seen["edited"] >= 1
    for name in ("edited", "applied"):
        assert colour_count(tmp_path / f"{name}.png") > 50
