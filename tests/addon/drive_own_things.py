"""Runs stages beside things of the user's in a window; test_real_blender.py starts it.

FOLDER has beam.branch. Blender has just started: cube, camera and light are there.
"""

import sys
import time
from pathlib import Path

import bpy

sys.path.insert(0, str(Path(__file__).parent))
from driving import FOLDER, drive, is_tab_open, override, part, picture, seen, start, started, view

idle = {"since": 0.0}


def thing_of(name):
    return bpy.data.objects[name]


def is_idle():
    """Done for a while: a stage's job is followed by that which shows its result."""
    if part("jobs.jobs").is_running() or part("jobs.jobs").waiting():
        idle["since"] = time.monotonic()
    return time.monotonic() - max(idle["since"], started["step"]) > 0.5


def begin():
    view()[1].spaces.active.show_region_ui = True
    thing_of("Cube").location = (0.3, 0.1, 0.2)
    thing_of("Cube").scale = (0.05,) * 3
    return True


def put_things():
    """Change what is ours, and add what is not."""
    seen["first_range"] = [bpy.context.scene.frame_start, bpy.context.scene.frame_end]
    surface, scene = thing_of("beam"), bpy.context.scene
    mine = bpy.data.materials.new("mine")
    mine.diffuse_color = (0.9, 0.05, 0.5, 1.0)
    surface.data.materials[0] = mine
    surface.modifiers.new("Subsurf", "SUBSURF").levels = 1
    surface.name, surface["species"] = "my beam", "oak"
    surface.location.y = 0.05
    thing_of("Grasp 1").location.z = 0.1
    thing_of("Grasp 1").keyframe_insert("location", frame=3)
    own = bpy.data.objects.new("own", bpy.data.meshes.new("own"))
    bpy.data.collections["beam"].objects.link(own)
    own.parent = surface
    box = bpy.data.collections.new("box")
    scene.collection.children.link(box)
    scene.collection.children.unlink(bpy.data.collections["beam"])
    box.children.link(bpy.data.collections["beam"])
    bpy.data.scenes.new("other").collection.children.link(bpy.data.collections["beam"])
    scene.frame_start, scene.frame_end = 2, 90
    scene.frame_set(4)
    part("branch.branches").activate(scene, thing_of("Cube"))
    area = view()[1]
    area.spaces.active.shading.color_type = "MATERIAL"
    area.spaces.active.region_3d.view_distance = 1.5
    with override():
        bpy.ops.ed.undo_push(message="my things")
    return True


def note(name):
    """Return the step that writes down what there is of it."""
    def step():
        scene, surface = bpy.context.scene, thing_of("my beam")
        space = view()[1].spaces.active
        seen[name] = {
            "cube": [*thing_of("Cube").location, *thing_of("Cube").scale],
            "cube_seen": thing_of("Cube").visible_get(),
            "materials": [one.name for one in surface.data.materials],
            "modifiers": [one.type for one in surface.modifiers],
            "species": surface["species"], "place": [*surface.location],
            "grasp": [*thing_of("Grasp 1").location],
            "own": [thing_of("own").parent.name, thing_of("own").users_collection[0].name],
            "nested": [one.name for one in bpy.data.collections["box"].children],
            "collections": sorted(bpy.data.collections.keys()),
            "other": "my beam" in bpy.data.scenes["other"].objects,
            "range": [scene.frame_start, scene.frame_end, scene.frame_current],
            "active": bpy.context.view_layer.objects.active.name,
            "view": [space.shading.color_type, round(space.region_3d.view_distance, 3)],
            "uid": surface.session_uid, "meshes": len(bpy.data.meshes)}
        seen[f"{name} cache"] = Path(surface.modifiers[0].filepath).name
        seen[f"{name} target"] = "Target bud" in bpy.data.objects
        return True
    step.__name__ = f"note {name}"
    return step


def with_override(operator):
    def step():
        with override():
            operator()
        return True
    return step


drive([begin, is_tab_open, start("open_result", directory=str(FOLDER / "beam.branch")), is_idle,
       put_things, note("before"), picture("own_before"),
       start("open_result", directory=str(FOLDER / "beam.branch")), is_idle, note("opened"),
       start("target", name="bud", at=(0.0, 0.0, 0.3)), is_idle, note("target"),
       start("simulate", name="mine", move=(0.06, 0.0, 0.0)), is_idle, note("simulated"),
       picture("own_after"), with_override(bpy.ops.ed.undo), note("undone"),
       with_override(bpy.ops.ed.redo), note("redone"),
       start("open_result", directory=str(FOLDER / "beam.branch")), is_idle, note("again"),
       with_override(bpy.ops.limber.play), with_override(bpy.ops.limber.play),
       note("played")], longest=100)
