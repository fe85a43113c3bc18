"""Renders a branch in the colours of a quantity, without a window.

    blender -b --python colour_and_render.py -- FOLDER.branch PICTURE.png --colour strain

Quantities: young, strain_energy, strain, stress, stress_over_strength, det_f, residual; or wood.
"""

import argparse
import math
import sys
from pathlib import Path

import bpy
import numpy as np
from mathutils import Vector


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="colour_and_render.py")
    parser.add_argument("folder", type=Path)
    parser.add_argument("picture", type=Path, help="a PNG")
    parser.add_argument("--colour", default="young")
    parser.add_argument("--frame", type=int, help="frame of the motion; without it, the worst "
                                                  "value over all frames")
    parser.add_argument("--width", type=int, default=800)
    given = parser.parse_args(arguments)

    bpy.ops.limber.open_result(directory=str(given.folder.resolve()))
    scene = bpy.context.scene
    if given.frame is not None:
        scene.frame_set(given.frame)
    bpy.ops.limber.color_by(scalar=given.colour, each_frame=given.frame is not None)
    # The opened branch is active. The picture has nothing else: no startup cube and no lamp.
    branch = bpy.context.view_layer.objects.active.users_collection[0]
    for thing in scene.objects:
        thing.hide_render |= thing.name not in branch.all_objects
    # A camera that shows the whole branch in a picture of this shape, and a sun.
    scene.render.resolution_x = scene.render.resolution_y = given.width
    bpy.ops.limber.turntable(frames=2)
    sun = bpy.data.objects.new("Sun", bpy.data.lights.new("Sun", "SUN"))
    sun.rotation_euler = Vector((math.radians(50), 0.0, math.radians(-30)))
    scene.collection.objects.link(sun)
    sun.data.energy = 3.0
    scene.render.engine = "CYCLES"
    scene.cycles.samples, scene.cycles.use_denoising = 16, False
    scene.view_settings.view_transform = "Standard"
    scene.render.film_transparent = True
    picture = given.picture.resolve()
    rendered = picture.with_name(f".{picture.stem}.part.png")
    scene.render.image_settings.file_format = "PNG"
    scene.render.filepath = str(rendered)
    bpy.ops.render.render(write_still=True)
    try:
        check(rendered)
        rendered.replace(picture)
    finally:
        rendered.unlink(missing_ok=True)


def check(picture: Path) -> None:
    """Raise RuntimeError unless the picture shows a branch: opaque, on an empty background."""
    if not picture.is_file():
        raise RuntimeError(f"Blender rendered no {picture}.")
    image = bpy.data.images.load(str(picture))
    pixels = np.empty(4 * image.size[0] * image.size[1], np.float32)
    image.pixels.foreach_get(pixels)
    share = (pixels[3::4] > 0.5).mean()
    if not 0.0 < share < 1.0:
        raise RuntimeError("The branch is not in the picture." if share == 0.0 else
                           "Something in the scene fills the picture and covers the branch.")


if __name__ == "__main__":
    try:
        main(sys.argv[sys.argv.index("--") + 1:])
    except Exception as error:
        # Blender itself would end with 0, whatever the error.
        sys.exit(f"{Path(__file__).name}: {error}")
