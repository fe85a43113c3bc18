"""``limber scene``: a Blender scene of a branch, made by a process that has bpy."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, stage_command


@stage_command("scene")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), help="The .blend to write.")
@click.option("--render", "picture", type=click.Path(path_type=Path),
              help="Also render a picture (PNG) of the end of the path.")
@click.option("--width", type=click.IntRange(160, 8192), default=1120, show_default=True,
              help="Of the picture [pixels]; its height is three quarters of it.")
@click.option("--color", type=click.Choice(["young", "strain_energy"]), default="young",
              show_default=True, help="What the branch's colours mean.")
@click.option("--plan", help="Which path to show.  [default: the newest]")
@click.option("--data", "data_path", type=click.Path(path_type=Path),
              help="Write only what a scene shows, as arrays (.npz): what the add-on opens.")
def command(run: Run, branch_folder: Path, output: Path | None, picture: Path | None,
            width: int, color: str, plan: str | None, data_path: Path | None) -> dict[str, Any]:
    """A Blender scene with the branch, its motion and paths (needs bpy or Blender).

    Files made by the bpy package (5.0) open in Blender 4.5 and newer. To have one made by another
    Blender, 4.2 or newer, name that in LIMBER_SCENE_BLENDER.
    """
    from limber.stages.scene import scene

    return scene(branch_folder, output=output, picture=picture, width=width, color=color,
                 plan=plan, data_path=data_path, progress=run.progress)
