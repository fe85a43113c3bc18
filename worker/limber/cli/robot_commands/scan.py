"""Scan the branch of the virtual robot: `limber robot scan`."""

import shlex
from pathlib import Path
from typing import Any

import click
import numpy as np

from limber.cli.main import Run, stage_command


@stage_command("scan")
@click.option("--address", default="127.0.0.1", show_default=True, help="Address of the virtual "
                                                                        "robot.")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("scan.ply"),
              show_default=True, help="PLY file to write.")
@click.option("--middle", type=float, nargs=3, required=True, metavar="X Y Z",
              help="Point that the cameras look at, in the branch's frame [m].")
@click.option("--distance", default=0.6, show_default=True, help="Distance of the cameras from it "
                                                                 "[m].")
@click.option("--views", default=8, show_default=True, help="Number of camera positions around "
                                                            "it.")
def scan(run: Run, address: str, output: Path, middle: tuple[float, float, float],
         distance: float, views: int) -> dict[str, Any]:
    """Scan the branch of `limber virtual-robot` with its depth camera, from all around.

    Real cameras are not controlled from here: record a cloud with their own program.
    """
    from limber.geometry.cloud.cloud import Cloud
    from limber.robot.virtual.depth_camera import scanned, views_around

    points = scanned(address, views_around(np.array(middle), distance, views))
    Cloud(points, {}).write_ply(output)
    run.close(f"{len(points):,} points from {views} positions.", where=output,
              then=f"limber reconstruct {shlex.quote(str(output))} -o "
              f"{shlex.quote(output.stem)}.branch")
    return {"cloud": str(output), "point_count": len(points), "view_count": views}
