"""Takes the manual's pictures inside a Blender with a window; scripts/make_manual_pictures does it.

FOLDER gets NAME.png. The example that comes along is what they show.
"""

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from driving import FOLDER, KEY, clear, drive, is_tab_open, override, picture, view, waited

BENT, MOST_PULLED = 14, 73


def jobs():
    return sys.modules[f"{KEY}.jobs.jobs"]


def begin():
    clear()
    system = bpy.context.preferences.system
    system.viewport_aa, system.use_overlay_smooth_wire = "8", True
    return True


def open_example():
    with override():
        bpy.ops.limber.open_example("INVOKE_DEFAULT", directory=str(FOLDER))
    return True


def is_open():
    return "bending_branch" in bpy.data.collections and not jobs().is_running() and waited(1.5)


def save():
    """Beside the example: its folder is shown relative to the file, not where this machine has it.
    """
    with override():
        bpy.ops.wm.save_as_mainfile(filepath=str(FOLDER / "manual.blend"))
    return True


def see(graph, scalar, frame, *groups):
    """Return the step that shows a graph, colours of a frame, and groups of marks beside it."""
    def step():
        current = bpy.context.scene
        current.frame_set(frame)
        current.limber.graph = graph
        with override():
            bpy.ops.limber.color_by(scalar=scalar, each_frame=True)
            for group in groups:
                bpy.ops.limber.show(group=group)
            for thing in list(bpy.context.selected_objects):
                # No outline about what is coloured.
                thing.select_set(False)
        view()[1].tag_redraw()
        return True
    return step


def replay():
    with override():
        bpy.ops.limber.replay_pull("INVOKE_DEFAULT", pull="pull-1")
    return True


def render_wood():
    """The picture that Set Up Picture makes, in wood, at the end of the motion."""
    current = bpy.context.scene
    current.limber.scene.motion = ""
    with override():
        bpy.ops.limber.open_result()
        bpy.ops.limber.color_by(scalar="wood")
        bpy.ops.limber.show(group="energy", hide=True)
        bpy.ops.limber.set_up_picture()
    current.frame_set(BENT)
    current.render.resolution_percentage = 60
    current.render.filepath = str(FOLDER / "wood.png")
    bpy.ops.render.render(write_still=True)
    return True


def is_replayed():
    return bpy.data.objects.get("Measured point 1") is not None and not jobs().is_running() and (
        waited(1.5))


drive([begin, is_tab_open, open_example, is_open, save,
       see("energy", "stress_over_strength", BENT, "energy"), picture("stress"),
       see("young", "young", 1), picture("young"),
       replay, is_replayed, see("force", "residual", MOST_PULLED), picture("pull"),
       render_wood], longest=100)
