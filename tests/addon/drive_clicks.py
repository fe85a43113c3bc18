"""From Blender's factory start-up to a bent branch and a moved goal, by the mouse alone;
test_clicks.py starts it.
"""

import sys
from pathlib import Path

import bpy
from bpy_extras import view3d_utils

sys.path.insert(0, str(Path(__file__).parent))
import mouse
from driving import KEY, drive, picture, processor_seconds, seen, started, view, waited


def is_open():
    return "bending_branch" in bpy.data.objects and waited(1.0) and (
        not sys.modules[f"{KEY}.jobs.jobs"].is_running())


def places():
    values = [0.0] * (3 * len(bpy.data.objects["bending_branch"].data.vertices))
    bpy.data.objects["bending_branch"].data.attributes["position"].data.foreach_get(
        "vector", values)
    return values


def is_held():
    """The session answers, and its first frame is drawn: then the branch can be pressed."""
    sessions = sys.modules[f"{KEY}.bend.session"]._open
    if not (sessions and sessions[0].hello):
        return False
    mouse.at["before"] = places()
    return waited(0.5)


def point_at_branch():
    """At a vertex in sight, two thirds up."""
    thing = bpy.data.objects["bending_branch"]
    _, area, region = view()
    low, high = (pick(vertex.co.z for vertex in thing.data.vertices) for pick in (min, max))
    origin = area.spaces.active.region_3d.view_matrix.inverted().translation
    front = [vertex for vertex in thing.data.vertices
             if abs(vertex.co.z - low - 0.66 * (high - low)) < 0.05 * (high - low)]
    nearest = min(front, key=lambda vertex: (vertex.co - origin).length)
    place = view3d_utils.location_3d_to_region_2d(
        region, area.spaces.active.region_3d, thing.matrix_world @ nearest.co)
    mouse.at.update(x=region.x + place.x, y=region.y + place.y)
    mouse.event("MOUSEMOVE")
    return True


def drag():
    mouse.at["x"] += 3
    mouse.event("MOUSEMOVE")
    seen["clicks_to_bent"] = seen["clicks"]
    seen["bent_m"] = max(abs(a - b) for a, b in zip(places(), mouse.at["before"], strict=True))
    if seen["bent_m"] > 0.0 and "answer_s" not in seen:
        seen["answer_s"] = processor_seconds(sys.modules[f"{KEY}.bend.session"]._open[0].pid)
    return seen["bent_m"] > 0.01


def leave():
    if "left" not in started:
        mouse.event("ESC", "PRESS")
        started["left"] = True
    if not waited(0.5):
        return False
    del started["left"]
    return True


def goal():
    branch = bpy.data.collections["bending_branch"]
    return sys.modules[f"{KEY}.plan.goal_ball"].of(branch)


def point_at_goal():
    _, area, region = view()
    place = view3d_utils.location_3d_to_region_2d(
        region, area.spaces.active.region_3d, goal().matrix_world.translation)
    mouse.at.update(x=region.x + place.x, y=region.y + place.y, goal=goal().location.copy())
    mouse.event("MOUSEMOVE")
    return waited(0.3)


def drag_goal():
    mouse.at["x"] += 3
    mouse.event("MOUSEMOVE")
    seen["goal_moved_m"] = (goal().location - mouse.at["goal"]).length
    return seen["goal_moved_m"] > 0.01


def is_goal_planned():
    plan = bpy.context.scene.limber.plan
    seen["goal"] = [*plan.goal] if plan.use_goal else None
    seen["ball"] = [*goal().location]
    return waited(0.3)


drive([mouse.open_sidebar, mouse.is_sidebar_open, mouse.point_at_tab, mouse.click, mouse.is_ours,
       picture("tab"),
       mouse.find("open_example"), mouse.click, is_open, picture("example"),
       mouse.find("grab"), mouse.click, is_held, point_at_branch, mouse.press, drag,
       picture("bent"), mouse.let_go, leave,
       point_at_goal, mouse.press, drag_goal, picture("goal"), mouse.let_go, is_goal_planned],
      longest=120)
