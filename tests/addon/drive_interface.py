"""Drives Limber's interface inside a Blender with a window; test_real_blender.py starts it.

FOLDER has slow_worker and beam.branch. Blender has just started: cube, camera and light are there.
"""

import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driving
from driving import FOLDER, KEY, drive, part, picture, seen, start, started, undo, view
from mouse import click, find

idle = {"since": 0.0}


def thing_of(name):
    return bpy.data.objects[name]


def begin():
    view()[1].spaces.active.show_region_ui = True
    return True


def open_tab():
    driving.is_tab_open()
    seen["category"] = view("UI")[2].active_panel_category
    return True


def start_slow_job():
    bpy.context.preferences.addons[KEY].preferences.python_path = str(FOLDER / "slow_worker")
    return start("check_worker")()


def slow_job_reports():
    seen["progress_seen"] = part("jobs.jobs").current().fraction
    return seen["progress_seen"] > 0


def job_cancelled():
    if part("jobs.jobs").is_running():
        return False
    seen["cancelled"] = part("jobs.jobs").current().state.value
    bpy.context.preferences.addons[KEY].preferences.python_path = ""
    return True


def slow_job_left_running():
    """Blender is closed while the worker works."""
    seen["left_running"] = part("jobs.jobs").current().pid
    return part("jobs.jobs").current().fraction > 0


def opened():
    seen["opened"] = [collection.name for collection in bpy.context.scene.collection.children
                      if "limber_folder" in collection]
    return "beam" in seen["opened"]


def is_idle():
    """Done for a while: a stage's job is followed by that which shows its result."""
    if part("jobs.jobs").is_running() or part("jobs.jobs").waiting():
        idle["since"] = time.monotonic()
    return time.monotonic() - max(idle["since"], started["step"]) > 0.5


def put_things():
    """Change what is ours, and add what is not; test_own_things.py has the whole table."""
    surface, scene = thing_of("beam"), bpy.context.scene
    seen["first_range"] = [scene.frame_start, scene.frame_end]
    surface.modifiers.new("Subsurf", "SUBSURF").levels = 1
    surface.name, surface.location.y = "my beam", 0.05
    scene.frame_start, scene.frame_end = 2, 90
    scene.frame_set(4)
    part("branch.branches").activate(scene, thing_of("Cube"))
    area = view()[1]
    area.spaces.active.shading.color_type = "MATERIAL"
    area.spaces.active.region_3d.view_distance = 1.5
    with driving.override():
        bpy.ops.ed.undo_push(message="my things")
    return True


def note(name):
    """Return the step that writes down what there is of it."""
    def step():
        scene, surface, space = bpy.context.scene, thing_of("my beam"), view()[1].spaces.active
        seen[name] = {
            "cube_seen": thing_of("Cube").visible_get(), "place": [*surface.location],
            "modifiers": [one.type for one in surface.modifiers],
            "range": [scene.frame_start, scene.frame_end, scene.frame_current],
            "active": bpy.context.view_layer.objects.active.name, "uid": surface.session_uid,
            "view": [space.shading.color_type, round(space.region_3d.view_distance, 3)]}
        seen[f"{name} cache"] = Path(surface.modifiers[0].filepath).name
        return True
    step.__name__ = f"note {name}"
    return step


def redo():
    with driving.override():
        bpy.ops.ed.redo()
    return True


def played():
    seen["playing"] = view()[0].screen.is_animation_playing
    seen["frame_after_play"] = bpy.context.scene.frame_current
    return bpy.context.scene.frame_current > 2


drive([begin, open_tab, picture("tab"),
       start_slow_job, slow_job_reports, picture("job"), find("cancel_job"), click, job_cancelled,
       start("open_result", directory=str(FOLDER / "beam.branch")), opened, is_idle,
       picture("opened"), put_things, note("before"),
       start("open_result", directory=str(FOLDER / "beam.branch")), is_idle, note("again"),
       start("simulate", name="mine", move=(0.06, 0.0, 0.0)), is_idle, note("simulated"),
       undo, note("undone"), redo, note("redone"),
       start("play"), played, picture("playing"),
       start_slow_job, slow_job_left_running], longest=200)
