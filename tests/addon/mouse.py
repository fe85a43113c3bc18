"""A user's hands in a driven Blender: mouse and keys alone, as events of its windows.

Buttons are found as an eye finds them: the mouse goes down the sidebar until the button under it is
the one that is wanted. Clicks are counted; moves, the wheel, and a key that Blender itself has, are
not.
"""

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d
from driving import draw, seen, started, view, waited

STEP_PIXELS = 9
TAB_DOWN = 180 if bpy.app.version < (5, 0, 0) else 244
"""How far down the sidebar our tab is [pixels]: newer Blenders have the tab Animation above it."""
seen["clicks"] = 0
at = {}


def event(kind, value="NOTHING"):
    """Simulate an event where the mouse is, in the window ``at["window"]`` or the main one."""
    at.get("window", view()[0]).event_simulate(
        type=kind, value=value, x=int(at["x"]), y=int(at["y"]))


def open_sidebar():
    """N, over the view: Blender's own key."""
    _, _, region = view()
    at.update(x=region.x + region.width // 3, y=region.y + region.height // 2)
    event("N", "PRESS")
    event("N", "RELEASE")
    return True


def is_sidebar_open():
    draw()
    return view()[1].spaces.active.show_region_ui and waited(0.3)


def click():
    """The step that clicks where the mouse is: pressed in one turn, let go in the next."""
    if "pressed" not in started:
        event("LEFTMOUSE", "PRESS")
        started["pressed"] = True
        return False
    event("LEFTMOUSE", "RELEASE")
    del started["pressed"]
    seen["clicks"] += 1
    return True


def point_at_tab():
    """Our tab is the last one: at the sidebar's right edge, at the lower end of the tabs."""
    sidebar = view("UI")[2]
    at.update(x=sidebar.x + sidebar.width - 9, y=sidebar.y + sidebar.height - TAB_DOWN)
    event("MOUSEMOVE")
    return True


def is_ours():
    seen["category"] = view("UI")[2].active_panel_category
    return seen["category"] == "Limber"


def under_mouse():
    """Return the call of the button under the mouse, as Blender itself tells it."""
    window, area, region = view("UI")
    with bpy.context.temp_override(window=window, screen=window.screen, area=area, region=region):
        if not bpy.ops.ui.copy_python_command_button.poll():
            return ""
        bpy.ops.ui.copy_python_command_button()
    return bpy.context.window_manager.clipboard


def find(operator):
    """Return the step that moves the mouse down the sidebar until it is over a button."""
    def step():
        sidebar = view("UI")[2]
        if "down" not in started:
            started["down"] = 20
        elif f"limber.{operator}(" in under_mouse():
            del started["down"]
            return True
        started["down"] += STEP_PIXELS
        if started["down"] > sidebar.height:
            raise RuntimeError(f"{operator} is not in sight")
        at.update(x=sidebar.x + 100, y=sidebar.y + sidebar.height - started["down"])
        event("MOUSEMOVE")
        return False
    step.__name__ = f"find {operator}"
    return step


def point_at(find_place):
    """Return the step that moves the mouse to a place of the world in the view."""
    def step():
        _, area, region = view()
        place = location_3d_to_region_2d(region, area.spaces.active.region_3d, find_place())
        at.update(x=region.x + place.x, y=region.y + place.y)
        event("MOUSEMOVE")
        return waited(0.3)
    return step


def press():
    event("LEFTMOUSE", "PRESS")
    seen["clicks"] += 1
    return True


def let_go():
    event("LEFTMOUSE", "RELEASE")
    return True
