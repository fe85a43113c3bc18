"""The example scenes that come with the project open, and show what their files hold."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest

from limber.results.scene.animation import scene_data
from limber.store import Branch

FOLDER = Path(__file__).parents[2] / "blend_files"
SCENES = sorted(FOLDER.glob("*.blend"))


def test_there_are_small_examples():
    """That of the add-on and more, each under 1 MB with the folder that it plays."""
    assert {"bending_branch", "young", "mature", "artificial"} <= {path.stem for path in SCENES}
    for scene in SCENES:
        parts = [scene, *(path for path in scene.with_suffix("").rglob("*") if path.is_file())]
        assert sum(path.stat().st_size for path in parts) < 1 << 20, scene.stem


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_example_plays(bpy, addon, path):
    """Opened here, every frame is that of the branch folder beside it."""
    bpy.ops.wm.open_mainfile(filepath=str(path))
    assert bpy.data.version < (5, 0, 0), "Blender 4.2 opens it too"
    scene = bpy.context.scene
    surface = scene.objects[path.stem]
    content = (FOLDER / path.stem / "frames" / "to-goal.pc2").read_bytes()
    _, _, points, _, _, count = struct.unpack_from("<12siiffi", content)
    frames = np.frombuffer(content, "<f4", offset=32).reshape(count, points, 3)
    assert len(surface.data.vertices) == points
    assert (scene.frame_start, scene.frame_end) == (1, count)
    for number in (0, count // 2, count - 1):
        scene.frame_set(1 + number)
        mesh = surface.evaluated_get(bpy.context.evaluated_depsgraph_get()).data
        found = np.empty(3 * points, np.float32)
        mesh.attributes["position"].data.foreach_get("vector", found)
        np.testing.assert_allclose(found.reshape(-1, 3), frames[number], atol=1e-6)
    assert np.ptp(frames, axis=0).max() > 0.03, "it moves by centimetres"
    names = set(scene.objects.keys())
    assert {"gentle path", "shortest path", "Goal", "Grasp 1", "Fixed base", "Camera"} <= names


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_example_is_what_a_scene_holds_today(bpy, addon, path):
    """If a scene holds something else now, scripts/make_blend_files has to be run again."""
    branch = Branch.open(FOLDER / path.stem)
    data = scene_data(branch)
    bpy.ops.wm.open_mainfile(filepath=str(path))
    info = json.loads(bpy.context.scene.objects[path.stem]["limber_info"])
    assert info["format"] == data.info["format"]
    assert set(info) == set(data.info)
    assert set(info["scalars"]) == set(data.info["scalars"])
    assert info["frames"] == data.info["frames"]
