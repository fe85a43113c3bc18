"""The grab in a Blender with a window, by mouse events; ``benchmarks.viewport`` starts it.

    blender --factory-startup --enable-event-simulate --python viewport_window.py -- SETTINGS.json

A frame counts as drawn when Blender's event loop comes round after it. The delay is from the
mouse's event to there.
"""

import json
import sys
import time
import traceback
from math import cos, sin, tau
from pathlib import Path

import bpy  # noqa: TID253 (a program of its own, for Blender)
from bpy_extras import view3d_utils
from mathutils import Vector

sys.path.insert(0, str(Path(__file__).parent))
from viewport_probe import load_addon, part, say, spread

_ROUND_SECONDS = 4.0
"""Time in which the mouse goes round once."""
_LONGEST_SECONDS = 300.0
state = {"since": time.monotonic(), "drawn": set(), "delays": [], "sent": {}, "shown": 0}


def view():
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    return window, area, next(region for region in area.regions if region.type == "WINDOW")


def event(kind, value="NOTHING", aside=(0.0, 0.0)):
    window, _, region = view()
    state["at"] = time.perf_counter()
    window.event_simulate(type=kind, value=value, x=int(region.x + state["x"] + aside[0]),
                          y=int(region.y + state["y"] + aside[1]))


def held():
    return part("bend.session")._open[0]


def begin(settings):
    window, area, region = view()
    with bpy.context.temp_override(window=window, area=area, region=region):
        bpy.ops.limber.open_result(directory=settings["branch"])
        bpy.ops.limber.grab("INVOKE_DEFAULT")
    return True


def is_loaded(_settings):
    if held().error:
        raise RuntimeError(held().error)
    if not held().hello:
        return False
    surface = part("branch.branches").find_surface(bpy.context.scene)
    _, area, region = view()
    place = view3d_utils.location_3d_to_region_2d(
        region, area.spaces.active.region_3d, surface.matrix_world @ Vector(
            surface[part("branch.branches").GRASP_KEY][:3]))
    state["x"], state["y"] = place
    move, frame = held().move, held().frame

    def moved(*given):
        number = move(*given)
        state["sent"][number] = state["at"]
        return number

    def framed(*given):
        found = frame(*given)
        if found is not None:
            state["shown"], state["who"] = found.answers, found.who
        return found
    held().move, held().frame = moved, framed
    bpy.types.SpaceView3D.draw_handler_add(
        lambda: state.update(on_screen=state["shown"]), (), "WINDOW", "POST_PIXEL")
    event("MOUSEMOVE")
    event("LEFTMOUSE", "PRESS")
    return True


def circle():
    """Move the mouse on; note the frames that have been drawn since."""
    number = state.get("on_screen", 0)
    if number in state["sent"] and number not in state["drawn"]:
        state["drawn"].add(number)
        state["delays"].append(time.perf_counter() - state["sent"][number])
    turn = tau * time.perf_counter() / _ROUND_SECONDS
    event("MOUSEMOVE", aside=(12.0 * sin(turn), 6.0 * cos(turn)))


def is_learnt(settings):
    """The full model answers slowly until then; it is measured if it takes too long."""
    circle()
    return state.get("who") == "reduced" or waited(settings["learn_seconds"])


def is_measured(settings):
    if "from" not in state:
        state["drawn"].clear()
        state["delays"].clear()
        state["from"] = time.perf_counter()
    circle()
    passed = time.perf_counter() - state["from"]
    if passed < settings["grab_seconds"]:
        return False
    say("window", frames=len(state["delays"]), per_second=len(state["delays"]) / passed,
        who=state.get("who", ""), **spread(state["delays"]))
    return True


def leave(_settings):
    event("LEFTMOUSE", "RELEASE")
    event("ESC", "PRESS")
    return True


def waited(seconds):
    return time.monotonic() - state["since"] > seconds


def main(settings):
    left = [begin, is_loaded, is_learnt, is_measured, leave]
    load_addon(Path(settings["addon"]))
    sys.modules["limber_addon"].register()
    say("blender", version=bpy.app.version_string)
    bpy.context.preferences.view.show_splash = False
    bpy.context.preferences.use_preferences_save = False

    def run():
        try:
            if left[0](settings):
                left.pop(0)
                state["since"] = time.monotonic()
            elif waited(_LONGEST_SECONDS):
                raise TimeoutError(left[0].__name__)
            if left:
                return 1 / 120
        except Exception:
            say("window", error=traceback.format_exc())
        bpy.ops.wm.quit_blender()
        return None
    bpy.app.timers.register(run, first_interval=0.5)


main(json.loads(Path(sys.argv[sys.argv.index("--") + 1]).read_text()))
