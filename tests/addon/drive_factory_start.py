"""Opens the example and a scan beside Blender's startup cube; test_real_blender.py starts it.

FOLDER has scan.ply. Blender has just started: cube, camera and light are there.
"""

import sys
from pathlib import Path

import bpy
from bpy_extras.view3d_utils import location_3d_to_region_2d

sys.path.insert(0, str(Path(__file__).parent))
from driving import FOLDER, drive, is_tab_open, part, picture, seen, start, undo, view


def begin():
    view()[1].spaces.active.show_region_ui = True
    seen["at_start"] = sorted(thing.name for thing in bpy.context.scene.objects)
    return True


def shown(name):
    """Return the step that waits for an object."""
    def step():
        return name in bpy.data.objects and not part("jobs.jobs").is_running()
    step.__name__ = f"{name} shown"
    return step


def look(name):
    """Return the step that writes down where an object is in the view as it was drawn, and what
    became of the cube."""
    def step():
        thing = bpy.data.objects[name]
        _, area, region = view()
        places = [location_3d_to_region_2d(region, area.spaces.active.region_3d,
                                           thing.matrix_world @ vertex.co)
                  for vertex in thing.data.vertices]
        seen[name] = {
            "inside": sum(at is not None and 0 <= at[0] < region.width
                          and 0 <= at[1] < region.height for at in places) / len(places),
            # The sidebar covers the view's right edge.
            "beside": max(at[0] for at in places) < region.width - view("UI")[2].width,
            "height": max(at[1] for at in places if at is not None) / region.height
                      - min(at[1] for at in places if at is not None) / region.height,
            "cube": bpy.data.objects["Cube"].visible_get(),
            "cube_in_picture": not bpy.data.objects["Cube"].hide_render}
        return True
    step.__name__ = f"look at {name}"
    return step


def is_undone():
    cube = bpy.data.objects["Cube"]
    seen["undone"] = [cube.visible_get(), cube.hide_render, "bending_branch" in bpy.data.objects]
    return True


drive([begin, is_tab_open, picture("start"),
       start("open_example", directory=str(FOLDER / "copy")), shown("bending_branch"),
       picture("branch"), look("bending_branch"), undo, is_undone,
       start("import_cloud", filepath=str(FOLDER / "scan.ply")), shown("scan scan"),
       picture("scan"), look("scan scan")], longest=60)
