"""Takes the manual's pictures inside a Blender with a window; scripts/make_manual_pictures does it.

FOLDER gets NAME.png. The example that comes along is what they show.
"""

import sys
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
import driving
from driving import FOLDER, clear, drive, override, picture, start, view

BENT, MOST_PULLED = 14, 73


def begin():
    clear()
    system = bpy.context.preferences.system
    system.viewport_aa, system.use_overlay_smooth_wire = "8", True
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
    return "Measured point 1" in bpy.data.objects and driving.is_example_open()


drive([begin, driving.is_tab_open, start("open_example", directory=str(FOLDER)),
       driving.is_example_open, driving.save(FOLDER / "manual.blend"),
       see("energy", "stress_over_strength", BENT, "energy"), picture("stress"),
       see("young", "young", 1), picture("young"),
       start("replay_pull", pull="pull-1"), is_replayed,
       see("force", "residual", MOST_PULLED), picture("pull"),
       render_wood], longest=100)
