"""From Blender's factory start-up to a planned path of an own scan, by mouse and keys alone;
test_clicks.py starts it.

The home folder has scan.ply and nothing else.
"""

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import mouse
from driving import FOLDER, drive, part, picture, seen, waited


def browser(kind):
    """Return the window of the file browser, its area and its region of a kind; None without."""
    return next(((window, area, next(region for region in area.regions if region.type == kind))
                 for window in bpy.context.window_manager.windows for area in window.screen.areas
                 if area.type == "FILE_BROWSER"), None)


def is_browser_open():
    return browser("WINDOW") is not None and waited(1.0)


def point_at_file():
    """At the first row of the list."""
    window, _, region = browser("WINDOW")
    mouse.at.update(x=region.x + 120, y=region.y + region.height - 35, window=window)
    mouse.event("MOUSEMOVE")
    return waited(0.3)


def is_chosen():
    seen["file"] = browser("WINDOW")[1].spaces.active.params.filename
    return seen["file"] == "scan.ply"


def point_at_import():
    """At the button in the lower right corner."""
    window, _, region = browser("EXECUTE")
    mouse.at.update(x=region.x + region.width - 70, y=region.y + region.height // 2, window=window)
    mouse.event("MOUSEMOVE")
    return waited(0.3)


def is_imported():
    mouse.at.pop("window", None)
    return "scan scan" in bpy.data.objects and waited(0.5)


def is_made():
    """The worker has made a branch folder of the scan, and its result was opened by itself."""
    if "scan" not in bpy.data.collections or part("jobs.jobs").is_running() or not waited(1.0):
        return False
    cloud, surface = bpy.data.objects["scan scan"], bpy.data.collections["scan"].objects["scan"]
    seen["points"] = len(cloud.data.vertices)
    seen["scan_beside_branch_m"] = max(
        (surface.closest_point_on_mesh(place)[1] - place).length
        for place in (cloud.matrix_world @ vertex.co for vertex in cloud.data.vertices))
    return True


def grasp_place():
    return next(thing for thing in bpy.data.collections["scan"].objects
                if thing.name.startswith("Grasp")).matrix_world.translation


def goal():
    return part("plan.goal_ball").of(bpy.data.collections["scan"])


def drag():
    mouse.at["x"] += 4
    mouse.event("MOUSEMOVE")
    if goal() is None:
        return False
    grasp = part("branch.branches").find_surface(bpy.context.scene)["limber_grasp_m"][:3]
    seen["goal_from_grasp_m"] = sum(
        (a - b) ** 2 for a, b in zip(goal().location, grasp, strict=True)) ** 0.5
    return seen["goal_from_grasp_m"] > 0.03


def is_goal_set():
    plan = bpy.context.scene.limber.plan
    seen["goal"], seen["ball"] = [*plan.goal], [*goal().location]
    return plan.use_goal


def is_planned():
    jobs = part("jobs.jobs")
    if jobs.is_running() or not waited(1.0):
        return False
    if error := jobs.current().error:
        raise RuntimeError(error)
    scene = bpy.context.scene
    seen["state"] = part("panels.steps").state_of(scene, "plan")[0].name
    seen["goal"], seen["ball"] = [*scene.limber.plan.goal], [*goal().location]
    seen["paths"] = sorted(thing.name for thing in bpy.data.collections["scan"].objects
                           if thing.name.endswith("path"))
    return seen["state"] == "DONE" and bool(seen["paths"])


steps = [
    mouse.open_sidebar, mouse.is_sidebar_open, mouse.point_at_tab, mouse.click, mouse.is_ours,
    mouse.find("import_cloud"), mouse.click, is_browser_open, picture("browser"), point_at_file,
    mouse.click, is_chosen, point_at_import, picture("chosen"), mouse.click, is_imported,
    picture("scan"),
    mouse.find("reconstruct"), mouse.click, is_made, picture("branch"),
    mouse.point_at(grasp_place), mouse.press, drag, picture("goal"), mouse.let_go, is_goal_set,
    mouse.find("plan")]
if (FOLDER / "plan").exists():
    # It takes minutes.
    steps += [mouse.click, is_planned, picture("path")]
drive(steps, longest=400)
