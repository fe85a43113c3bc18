"""A picture of a branch in the colours of a quantity, without a window.

    blender -b --python colour_and_render.py -- FOLDER.branch PICTURE.png --colour strain

Quantities: young, strain_energy, strain, stress, stress_over_strength, det_f, residual.
"""

import argparse
import math
import sys
from pathlib import Path

import bpy
from mathutils import Vector


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="colour_and_render.py")
    parser.add_argument("folder", type=Path)
    parser.add_argument("picture", type=Path)
    parser.add_argument("--colour", default="young")
    parser.add_argument("--frame", type=int, help="of the motion; the worst of all without it")
    parser.add_argument("--width", type=int, default=800)
    given = parser.parse_args(arguments)

    bpy.ops.limber.open_result(directory=str(given.folder.resolve()))
    scene = bpy.context.scene
    if given.frame is not None:
        scene.frame_set(given.frame)
    bpy.ops.limber.color_by(scalar=given.colour, each_frame=given.frame is not None)
    # A camera that sees the branch whole, and a sun.
    bpy.ops.limber.turntable(frames=2)
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.rotation_euler = Vector((math.radians(50), 0.0, math.radians(-30)))
    scene.collection.objects.link(sun)
    sun.data.energy = 3.0
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 16, False
    scene.view_settings.view_transform = "Standard"
    scene.render.film_transparent = True
    scene.render.resolution_x = scene.render.resolution_y = given.width
    scene.render.filepath = str(given.picture.resolve())
    bpy.ops.render.render(write_still=True)


if __name__ == "__main__":
    main(sys.argv[sys.argv.index("--") + 1:])
