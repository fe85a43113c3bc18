"""What scripts share that drive a Blender with a window; they run in Blender's Python.

    blender --enable-event-simulate --python drive_NAME.py -- FOLDER

A step is a function that returns True when it is done; a timer calls the current one. What was seen
is written to FOLDER/log.json. A picture is asked for by a file NAME.request, and has been taken
when that file is gone.
"""

import json
import os
import sys
import time
import traceback
from pathlib import Path

import bpy

FOLDER = Path(sys.argv[sys.argv.index("--") + 1])
KEY = "bl_ext.user_default.limber"
seen = {"error": None}
started = {}


def view(kind="WINDOW"):
    """Return window, 3D view area and its region of a kind."""
    window = bpy.context.window_manager.windows[0]
    area = next(area for area in window.screen.areas if area.type == "VIEW_3D")
    return window, area, next(region for region in area.regions if region.type == kind)


def clear():
    """Empty the scene and open the sidebar."""
    view()[1].spaces.active.show_region_ui = True
    for thing in list(bpy.data.objects):
        bpy.data.objects.remove(thing)


def is_tab_open():
    """Show Limber's tab; the step for it."""
    # The tabs are known once the sidebar has been drawn.
    with override("UI"):
        bpy.ops.wm.redraw_timer(type="DRAW", iterations=1)
    view("UI")[2].active_panel_category = "Limber"
    return True


def part(name):
    """Return a module of the add-on."""
    return sys.modules[f"{KEY}.{name}"]


def start(operator, **keywords):
    """Return the step that presses the button of an operator."""
    def step():
        with override():
            getattr(bpy.ops.limber, operator)("INVOKE_DEFAULT", **keywords)
        return True
    step.__name__ = operator
    return step


def undo():
    with override():
        bpy.ops.ed.undo()
    return True


def is_example_open():
    return "bending_branch" in bpy.data.collections and not part("jobs.jobs").is_running() and (
        waited(1.0))


def save(path):
    """Return the step that saves: beside a branch its folder is shown relative to the file."""
    def step():
        with override():
            bpy.ops.wm.save_as_mainfile(filepath=str(path))
        return True
    return step


def override(kind="WINDOW"):
    window, area, region = view(kind)
    return bpy.context.temp_override(window=window, screen=window.screen, area=area, region=region)


def draw():
    """Have the whole window drawn now: what is placed and read in it is then as it is shown."""
    with override():
        bpy.ops.wm.redraw_timer(type="DRAW_WIN_SWAP", iterations=1)


def waited(seconds):
    """Whether the current step has lasted that long."""
    return time.monotonic() - started["step"] > seconds


def processor_seconds(pid):
    """Return the processor time of a process and those that it has started, on Linux [s]."""
    total, left = 0.0, [str(pid)]
    while left:
        place = Path("/proc", left.pop())
        fields = (place / "stat").read_text().rsplit(")", 1)[1].split()
        total += sum(map(int, fields[11:15])) / os.sysconf("SC_CLK_TCK")
        left += (place / "task" / place.name / "children").read_text().split()
    return total


def picture(name):
    """Return the step that has a picture taken."""
    def step():
        request = FOLDER / f"{name}.request"
        if "picture" not in started:
            # All is drawn before the next turn.
            for area in view()[0].screen.areas:
                area.tag_redraw()
            started["picture"] = "drawn"
            return False
        if started["picture"] == "drawn":
            request.touch()
            started["picture"] = "asked"
        if request.exists():
            return False
        del started["picture"]
        return True
    return step


def leave():
    """Quit Blender; drive_cases.py waits for its next case instead."""
    bpy.ops.wm.quit_blender()


def drive(steps, longest):
    """Do the steps one after the other, none longer than ``longest`` [s]; leave then."""
    left = list(steps)

    def run():
        try:
            if "step" not in started:
                started["step"] = time.monotonic()
                started["name"] = getattr(left[0], "__name__", "step")
            if left[0]():
                left.pop(0)
                del started["step"]
            elif waited(longest):
                raise TimeoutError(f"{started['name']}, {len(left)} steps from the end")
            if left:
                return 0.02
        except Exception:
            seen["error"] = traceback.format_exc()
        log = FOLDER / "log.new"
        log.write_text(json.dumps(seen))
        log.rename(FOLDER / "log.json")
        leave()
        return None

    bpy.context.preferences.view.show_splash = False
    # Blender keeps what was changed when it quits: the next test would start with it.
    bpy.context.preferences.use_preferences_save = False
    # A view is at once where it is turned to, and drawn once instead of eight times.
    bpy.context.preferences.view.smooth_view = 0
    system = bpy.context.preferences.system
    system.viewport_aa, system.use_overlay_smooth_wire = "OFF", False
    bpy.app.timers.register(run, first_interval=0.1, persistent=True)
