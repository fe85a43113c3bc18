"""Makes a branch that bends from a scan, without a window.

    blender -b --python scan_to_branch.py -- SCAN.ply SCENE.blend

Reconstructs the scan into a branch folder beside it, adds a fruit and saves the scene.
"""

import argparse
import sys
from pathlib import Path

import bpy


def main(arguments: list[str]) -> None:
    parser = argparse.ArgumentParser(prog="scan_to_branch.py")
    parser.add_argument("scan", type=Path)
    parser.add_argument("scene", type=Path)
    parser.add_argument("--unit", default="m", choices=("m", "cm", "mm", "in"))
    parser.add_argument("--young", type=float, default=1e8, help="Young's modulus [Pa]")
    parser.add_argument("--fruit", type=float, default=0.05, help="its mass [kg]")
    given = parser.parse_args(arguments)

    settings = bpy.context.scene.limber
    settings.reconstruct.unit = given.unit
    # Operators take the panels' settings as keyword arguments; an error raises RuntimeError.
    bpy.ops.limber.import_cloud(filepath=str(given.scan.resolve()))
    bpy.ops.limber.reconstruct(use_young=True, young=given.young)
    bpy.ops.limber.open_result()
    branch = bpy.context.scene.objects[Path(settings.branch_folder).stem]
    x, y, z = max((vertex.co for vertex in branch.data.vertices), key=lambda place: place[2])
    bpy.ops.limber.load(name="fruit", fruit=f"{x} {y} {z} {given.fruit}")
    bpy.ops.limber.open_result()
    bpy.ops.wm.save_as_mainfile(filepath=str(given.scene.resolve()))


if __name__ == "__main__":
    try:
        main(sys.argv[sys.argv.index("--") + 1:])
    except Exception as error:
        # Blender itself would end with 0, whatever the error.
        sys.exit(f"{Path(__file__).name}: {error}")
