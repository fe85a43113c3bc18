"""Drives Limber's interface inside a Blender with a window; test_real_blender.py starts it.

FOLDER has scan.ply, slow_worker and beam.branch.
"""

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from driving import FOLDER, KEY, drive, is_tab_open, override, picture, seen, started, view


def jobs():
    return sys.modules[f"{KEY}.jobs"]


def open_sidebar():
    view()[1].spaces.active.show_region_ui = True
    return True


def open_tab():
    is_tab_open()
    seen["category"] = view("UI")[2].active_panel_category
    bpy.context.scene.limber.reconstruct.cloud = str(FOLDER / "scan.ply")
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)
    return True


def button_place(offset):
    """Return window coordinates of the middle of the sidebar, ``offset`` pixels below its top."""
    sidebar = view("UI")[2]
    return sidebar.x + sidebar.width // 2 - 10, sidebar.y + sidebar.height - offset


def click(offset):
    """Point at a button, press it in the next step of the timer, let it go in the one after."""
    def step():
        window = view()[0]
        x, y = button_place(offset)
        phase = started.setdefault("click", 0)
        kind, value = (("MOUSEMOVE", "NOTHING"), ("LEFTMOUSE", "PRESS"),
                       ("LEFTMOUSE", "RELEASE"))[phase]
        window.event_simulate(type=kind, value=value, x=x, y=y)
        started["click"] += 1
        if started["click"] == 3:
            del started["click"]
            return True
        return False
    return step


def imported():
    cloud = bpy.data.objects.get("scan scan")
    if cloud is None:
        return False
    seen["imported_points"] = len(cloud.data.vertices)
    return True


def reconstructed():
    """The worker has made a branch folder of the scan, and its result was opened by itself."""
    if "scan" not in bpy.data.collections:
        return False
    cloud, surface = bpy.data.objects["scan scan"], bpy.data.collections["scan"].objects["scan"]
    seen["scan_beside_branch"] = max(
        (surface.closest_point_on_mesh(at)[1] - at).length
        for at in (cloud.matrix_world @ vertex.co for vertex in cloud.data.vertices))
    seen["reconstructed_faces"] = len(bpy.data.collections["scan"].objects["scan"].data.polygons)
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


drive([open_sidebar, open_tab, picture("tab"), click(399), imported, picture("imported"),
       click(365), reconstructed,
       start_slow_job, slow_job_reports, picture("job"), click(145), job_cancelled,
       open_result, opened, picture("opened"), play, played, picture("playing"),
       start_slow_job, slow_job_left_running], longest=200)
