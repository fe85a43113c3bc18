"""From Blender's factory start-up to a bent branch and a moved goal, by the mouse alone;
test_clicks.py starts it.
"""

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import mouse
from driving import drive, part, picture, processor_seconds, seen, started, view, waited


def is_open():
    return "bending_branch" in bpy.data.objects and waited(1.0) and (
        not part("jobs.jobs").is_running())


def places():
    values = [0.0] * (3 * len(bpy.data.objects["bending_branch"].data.vertices))
    bpy.data.objects["bending_branch"].data.attributes["position"].data.foreach_get(
        "vector", values)
    return values


def is_held():
    """The session answers, and its first frame is drawn: then the branch can be pressed."""
    sessions = part("bend.session")._open
    if not (sessions and sessions[0].hello):
        return False
    mouse.at["before"] = places()
    return waited(0.5)


def front_place():
    """A vertex in sight, two thirds up."""
    thing = bpy.data.objects["bending_branch"]
    low, high = (pick(vertex.co.z for vertex in thing.data.vertices) for pick in (min, max))
    origin = view()[1].spaces.active.region_3d.view_matrix.inverted().translation
    front = [vertex for vertex in thing.data.vertices
             if abs(vertex.co.z - low - 0.66 * (high - low)) < 0.05 * (high - low)]
    nearest = min(front, key=lambda vertex: (vertex.co - origin).length)
    return thing.matrix_world @ nearest.co


def drag():
    mouse.at["x"] += 3
    mouse.event("MOUSEMOVE")
    seen["clicks_to_bent"] = seen["clicks"]
    seen["bent_m"] = max(abs(a - b) for a, b in zip(places(), mouse.at["before"], strict=True))
    if seen["bent_m"] > 0.0 and "answer_s" not in seen:
        seen["answer_s"] = processor_seconds(part("bend.session")._open[0].pid)
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
    return part("plan.goal_ball").of(bpy.data.collections["bending_branch"])


def goal_place():
    mouse.at["goal"] = goal().location.copy()
    return goal().matrix_world.translation


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
       mouse.find("grab"), mouse.click, is_held, mouse.point_at(front_place), mouse.press, drag,
       picture("bent"), mouse.let_go, leave,
       mouse.point_at(goal_place), mouse.press, drag_goal, picture("goal"), mouse.let_go,
       is_goal_planned], longest=120)
