"""Makes a scene file and its picture; `limber scene` runs this in a process that has bpy.

    blender -b --factory-startup --python make_scene.py -- \
        --data DATA.npz --scene SCENE.blend [--picture PICTURE.png] [--round FOLDER --sides 48]

Standard output carries JSON lines as every stage's does; the last one has ``status``.
"""

import argparse
import importlib
import importlib.util
import json
import math
import os
import shutil
import sys
import threading
import traceback
from pathlib import Path

import bpy

_PLAY_SECONDS = 4.0


def _load_addon():
    """Import the folder of this file as a package, whatever its name there."""
    folder = Path(__file__).resolve().parents[1]
    if "limber_addon" in sys.modules:
        return
    spec = importlib.util.spec_from_file_location(
        "limber_addon", folder / "__init__.py", submodule_search_locations=[str(folder)])
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)


def _end_with_parent() -> None:
    """End when the parent does: `limber` then closes this process's standard input.

    The core requests it by LIMBER_PARENT_PIPE; see limber.core.processes.end_with_parent, which
    Blender's Python lacks.
    """
    if os.environ.pop("LIMBER_PARENT_PIPE", None) != "stdin":
        return

    def watch() -> None:
        while os.read(0, 1024):
            continue
        # Rendering receives no exception: the scene file is written whole or not at all.
        os._exit(1)

    threading.Thread(target=watch, name="parent watch", daemon=True).start()


def _say(**content) -> None:
    # The new line first: Blender leaves half-written lines of its own on standard output.
    print("\n" + json.dumps(content), flush=True)


def make_scene(data_path: Path, scene_path: Path, picture_path: Path | None = None,
               width: int = 1120, color: str | None = None, round_path: Path | None = None,
               sides: int = 48) -> dict:
    """Build the scene of ``data_path``, save it and render its last frame; returns a summary.

    Args:
        data_path: File written by the worker.
        scene_path: The .blend to write.
        picture_path: The PNG to render, if any.
        width: Width of the picture [pixels].
        color: Meaning of the colours: a scalar of the data, the first by default.
        round_path: A folder for pictures from all sides, if any; ``sides`` of them.
    """
    _load_addon()
    animation = importlib.import_module("limber_addon.bridge.animation")
    scenes = importlib.import_module("limber_addon.show.scene")
    studio = importlib.import_module("limber_addon.show.studio")
    legend = importlib.import_module("limber_addon.show.picture_legend")
    scene_data = importlib.import_module("limber_addon.show.scene_data")
    data = scene_data.read_scene_data(data_path)
    bpy.ops.wm.read_factory_settings(use_empty=True)
    bpy.context.preferences.filepaths.save_version = 0
    # Saved before it is filled: from then on paths are kept relative to it.
    bpy.ops.wm.save_as_mainfile(filepath=str(scene_path), compress=True)
    scene = bpy.context.scene
    scene.name = data.info["name"]
    scene.unit_settings.system = "METRIC"
    scene.render.fps = _frame_rate(data.info.get("frames"))
    shown = scenes.show_branch(scene, data, color)
    camera = studio.set_up_studio(scene, data, studio.Picture(width))
    legend.add_legend(scene, camera, data, shown)
    _look_through_camera()
    _say(progress=0.2, message="scene built")
    target = picture_path or scene_path.with_suffix(".png")
    scene.render.filepath = animation.shown_path(target)
    scene.frame_set(scene.frame_end if shown.frame_count > 1 else 1)
    bpy.ops.wm.save_as_mainfile(filepath=str(scene_path), compress=True)
    _say(progress=0.3, message="scene saved")
    if picture_path is not None:
        _say(progress=0.3, message="rendering")
        bpy.ops.render.render(write_still=True)
    summary = {"object_count": len(scene.objects), "frame_count": shown.frame_count,
               "blender": bpy.app.version_string}
    if round_path is not None:
        _render_round(scene, round_path, sides)
    return summary


def _render_round(scene: bpy.types.Scene, folder: Path, sides: int) -> None:
    """Render the branch in its present display from all sides; the saved file stays."""
    sharing = importlib.import_module("limber_addon.show.sharing")
    for each in sharing.CLASSES:
        bpy.utils.register_class(each)
    bpy.ops.limber.turntable(frames=sides)
    pivot = bpy.data.objects[f"{sharing.RIG} pivot"]
    # The branch is at rest meanwhile: the camera turns by hand, not by the scene's frames.
    pivot.animation_data_clear()
    for collection in bpy.data.collections:
        # It is in front of the other camera.
        collection.hide_render |= collection.name == "Legend"
    for number in range(sides):
        _say(progress=0.3 + 0.7 * number / sides, message="turntable")
        pivot.rotation_euler[2] = 2 * math.pi * number / sides
        scene.render.filepath = str(folder / f"{number:04d}.png")
        bpy.ops.render.render(write_still=True)


def _look_through_camera() -> None:
    """Set every 3D view of the file to the branch, in its colours."""
    layout = bpy.data.workspaces.get("Layout")
    if layout is not None:
        layout.name = "Limber"
    for screen in bpy.data.screens:
        for area in screen.areas:
            if area.type == "VIEW_3D":
                space = area.spaces.active
                space.show_region_ui = True
                space.region_3d.view_perspective = "CAMERA"
                space.shading.color_type = "VERTEX"


def _frame_rate(frames: dict | None) -> int:
    """Return frames per second: a motion's own, up to 60; for a path a rate that can be followed.
    """
    if not frames:
        return 24
    if frames["is_timed"]:
        return min(max(round(frames["rate_hz"]), 1), 60)
    return min(max(round(frames["count"] / _PLAY_SECONDS), 5), 24)


def main(arguments: list[str]) -> int:
    """Run with the arguments after ``--``; returns the exit code."""
    parser = argparse.ArgumentParser(prog="make_scene.py")
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--scene", type=Path, required=True)
    parser.add_argument("--picture", type=Path)
    parser.add_argument("--width", type=int, default=1120)
    parser.add_argument("--color")
    parser.add_argument("--round", type=Path)
    parser.add_argument("--sides", type=int, default=48)
    given = parser.parse_args(arguments)
    _end_with_parent()
    try:
        summary = make_scene(given.data, given.scene, given.picture, given.width, given.color,
                             given.round, given.sides)
    except (ValueError, RuntimeError, OSError) as error:
        _say(status="failed", error=str(error))
        return 3
    _say(status="done", error=None, **summary)
    return 0


def _end(code: int) -> None:
    """End the process, without Blender's own exit if that is a package of this Python.

    There it hangs (4.5) or crashes (4.2) on exit, after everything has been written.
    """
    _load_addon()
    if importlib.import_module("limber_addon.compat").IS_MODULE:
        shutil.rmtree(bpy.app.tempdir, ignore_errors=True)
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    if code:
        sys.exit(code)


if __name__ == "__main__":
    try:
        exit_code = main(sys.argv[sys.argv.index("--") + 1:])
    except Exception:
        # Reported here: left to Python it would lead to Blender's own exit.
        traceback.print_exc()
        exit_code = 3
    _end(exit_code)
