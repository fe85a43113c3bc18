"""Drives Limber's interface inside a Blender with a window; test_real_blender.py starts it.

FOLDER has slow_worker and beam.branch.
"""

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from driving import FOLDER, KEY, drive, is_tab_open, override, picture, seen, view
from mouse import click, find


def jobs():
    return sys.modules[f"{KEY}.jobs.jobs"]


def open_sidebar():
    view()[1].spaces.active.show_region_ui = True
    return True


def open_tab():
    is_tab_open()
    seen["category"] = view("UI")[2].active_panel_category
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    return True


def start_slow_job():
    bpy.context.preferences.addons[KEY].preferences.python_path = str(FOLDER / "slow_worker")
    with override():
        bpy.ops.limber.check_worker("INVOKE_DEFAULT")
    return True


def slow_job_reports():
    seen["progress_seen"] = jobs().current().fraction
    return seen["progress_seen"] > 0


def job_cancelled():
    if jobs().is_running():
        return False
    seen["cancelled"] = jobs().current().state.value
    bpy.context.preferences.addons[KEY].preferences.python_path = ""
    return True


def slow_job_left_running():
    """Blender is closed while the worker works."""
    seen["left_running"] = jobs().current().pid
    return jobs().current().fraction > 0


def open_result():
    with override():
        bpy.ops.limber.open_result("INVOKE_DEFAULT", directory=str(FOLDER / "beam.branch"))
    return True


def opened():
    seen["opened"] = [collection.name for collection in bpy.context.scene.collection.children
                      if "limber_folder" in collection]
    return "beam" in seen["opened"]


def play():
    with override():
        bpy.ops.limber.play("INVOKE_DEFAULT")
    return True


def played():
    seen["playing"] = view()[0].screen.is_animation_playing
    seen["frame_after_play"] = bpy.context.scene.frame_current
    return bpy.context.scene.frame_current > 1


drive([open_sidebar, open_tab, picture("tab"),
       start_slow_job, slow_job_reports, picture("job"), find("cancel_job"), click, job_cancelled,
       open_result, opened, picture("opened"), play, played, picture("playing"),
       start_slow_job, slow_job_left_running], longest=200)
