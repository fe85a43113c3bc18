"""Bends a branch with the mouse inside a Blender with a window; test_real_blender.py starts it.

FOLDER has beam.branch.
"""

import sys
from pathlib import Path

import bpy
from bpy_extras import view3d_utils
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).parent))
from driving import FOLDER, clear, draw, drive, override, part, picture, seen, view, waited

state = {}


def surface():
    return bpy.data.collections["beam"].objects["beam"]


def tip():
    """Return the highest vertex as the mesh has it now, in the world."""
    values = [0.0] * (3 * len(surface().data.vertices))
    surface().data.attributes["position"].data.foreach_get("vector", values)
    points = [Vector(values[k:k + 3]) for k in range(0, len(values), 3)]
    return max(points, key=lambda point: point.z), points


def marks():
    """Return where the highest control point and the grasp are in the world."""
    bpy.context.view_layer.update()
    things = [thing for thing in bpy.data.collections["beam"].objects
              if thing.get("limber_shows") in ("control_points", "grasp")]
    return {thing.name: thing.matrix_world.translation.copy() for thing in things}


def pixels(place):
    _, area, region = view()
    return view3d_utils.location_3d_to_region_2d(region, area.spaces.active.region_3d, place)


def event(kind, value="NOTHING", move=(0, 0)):
    """Simulate an event at the place that is pressed, ``move`` pixels on."""
    window, _, region = view()
    x, y = state["place"]
    window.event_simulate(type=kind, value=value, x=int(region.x + x + move[0]),
                          y=int(region.y + y + move[1]))
    return True


def send(*given):
    """Return the step that simulates an event."""
    return lambda: event(*given)


HELD = (60, -4)
hover, press = send("MOUSEMOVE"), send("LEFTMOUSE", "PRESS")
let_go, keep = send("LEFTMOUSE", "RELEASE", HELD), send("RET", "PRESS", HELD)
press_s, press_g = send("S", "PRESS", HELD), send("G", "PRESS", HELD)


def sessions():
    return part("bend.session")._open


def open_result():
    clear()
    with override():
        bpy.ops.limber.open_result(directory=str(FOLDER / "beam.branch"))
    view()[1].spaces.active.region_3d.view_perspective = "ORTHO"
    return True


def begin():
    with override():
        bpy.ops.view3d.view_axis(type="FRONT")
        bpy.ops.view3d.view_all()
        if "before" not in state:
            bpy.ops.wm.tool_set_by_id(name="limber.grab_tool")
    draw()
    state["before"], state["marks"] = tip()[1], marks()
    with override():
        seen["began"] = list(bpy.ops.limber.grab("INVOKE_DEFAULT"))
    return True


def is_loaded(height=0.57):
    """Point at the middle of the beam; without a height, a little below the tip."""
    if not sessions()[0].hello:
        return False
    seen["session"] = sessions()[0].pid
    state["place"] = pixels(Vector((0.0, 0.0, height)))
    return True


def is_loaded_at_grasp():
    return is_loaded(0.4)


def drag():
    return waited(0.1) and event("MOUSEMOVE", move=HELD)


def is_bent():
    """The tip has come along by most of the way that the mouse has gone."""
    bent = max((now - then).length for now, then in zip(tip()[1], state["before"], strict=True))
    seen["bent_m"] = bent
    seen["carried_m"] = max((now - state["marks"][name]).length for name, now in marks().items())
    return bent > 0.02


def colour():
    return surface().data.color_attributes.active_color.name


def limit():
    """A force that is passed by now: the branch is red from the next frame on."""
    seen["colour"] = colour()
    plan = bpy.context.scene.limber.plan
    plan.use_max_force, plan.max_force = True, 1e-3
    return event("MOUSEMOVE", move=(61, -4))


def is_over():
    seen["colour_over"] = colour()
    return colour() == "limber_limit"


def is_kept():
    if sessions():
        return False
    group = bpy.context.scene.limber.simulate
    seen["kept"] = [group.use_move, list(group.move), list(group.grasp_point), group.grasp_mode]
    seen["restored"] = max((now - then).length for now, then in zip(
        tip()[1], state["before"], strict=True))
    seen["marks_after"] = max((now - state["marks"][name]).length for name, now in marks().items())
    seen["colour_after"] = colour()
    seen["motion_shown"] = surface().modifiers["Limber motion"].show_viewport
    return True


def is_refused():
    """A plan moves the marked grasp, which is not where the beam is held: it stays held."""
    seen["refused"] = bool(sessions()) and not bpy.context.scene.limber.plan.use_start
    return waited(0.3)


def is_kept_as(name):
    """Return the step that waits until the grab is the plan's start or goal."""
    def step():
        if sessions():
            return False
        plan = bpy.context.scene.limber.plan
        seen[name] = [getattr(plan, f"use_{name}"), list(getattr(plan, name))]
        ball = part("plan.goal_ball").of(bpy.data.collections["beam"])
        seen["ball"] = list(ball.location)
        return True
    return step


def undo():
    with override():
        bpy.ops.ed.undo()
    seen["after_undo"] = bpy.context.scene.limber.simulate.use_move
    return True


def is_left():
    seen["sessions_left"] = len(sessions())
    return not sessions()


def key(kind, height):
    """Point at the beam at a height and press a key."""
    def step():
        state["place"] = pixels(Vector((0.0, 0.0, height)))
        event("MOUSEMOVE")
        return event(kind, "PRESS")
    return step


def blow():
    load = bpy.context.scene.limber.load
    load.use_wind, load.wind = True, (3.0, 0.0, 0.0)
    bpy.context.scene.limber.fruit_mass = 0.02
    return True


def is_loaded_down():
    """Cut at the top, with a fruit in the wind: it is bent, what is cut off is hidden."""
    lines = part("bend.live_loads").lines
    if len(lines) < 3 or "Limber cut" not in surface().modifiers:
        return False
    bent = max((now - then).length for now, then in zip(tip()[1], state["before"], strict=True))
    shown = surface().evaluated_get(bpy.context.evaluated_depsgraph_get()).data
    load = bpy.context.scene.limber.load
    seen["live"] = {"lines": list(lines), "bent_m": bent, "fruit": load.fruit, "cut": load.cut,
                    "hidden": len(surface().data.vertices) - len(shown.vertices)}
    return bent > 1e-3 and waited(0.3)


def is_whole():
    if sessions():
        return False
    load = bpy.context.scene.limber.load
    seen["after_live"] = [load.fruit, load.cut, "Limber cut" in surface().modifiers]
    return True


drive([open_result, begin, is_loaded, hover, press, drag, is_bent, limit, is_over, picture("grab"),
       let_go, press_s, is_refused, keep, is_kept, undo,
       begin, is_loaded_at_grasp, hover, press, drag, is_bent, let_go, press_s, is_kept_as("start"),
       begin, is_loaded_at_grasp, hover, press, drag, is_bent, let_go, press_g, is_kept_as("goal"),
       picture("goal"), begin, is_loaded, key("F", 0.3), key("C", 0.45), blow,
       is_loaded_down, picture("loads"), send("ESC", "PRESS"), is_whole, is_left], longest=180)
