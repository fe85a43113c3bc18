"""Scan a branch: of the virtual robot, or with a RealSense camera: `limber robot scan`."""

from __future__ import annotations

import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from limber.cli.main import Run, stage_command
from limber.core.errors import Option, Text

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell


@stage_command("scan")
@click.option("--address", default="127.0.0.1", show_default=True, help="Address of the virtual "
                                                                        "robot.")
@click.option("--realsense", "cell_file", type=click.Path(path_type=Path), metavar="CELL",
              help="Take the clouds with the connected RealSense camera instead; its pose is that "
              "of [camera] in this cell file.")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("scan.ply"),
              show_default=True, help="PLY file to write.")
@click.option("--middle", type=float, nargs=3, metavar="X Y Z",
              help="Point that the virtual robot's cameras look at, in the branch's frame [m].")
@click.option("--distance", default=0.6, show_default=True, help="Distance of the virtual cameras "
                                                                 "from it [m].")
@click.option("--views", type=click.IntRange(1, 100), help="Number of views. Default: 8 virtual "
              "ones, or one of a real camera, which is moved between them.")
def scan(run: Run, address: str, cell_file: Path | None, output: Path,
         middle: tuple[float, float, float] | None, distance: float, views: int | None,
         ) -> dict[str, Any]:
    """Scan the branch of `limber virtual-robot` from all around, or a branch with a RealSense.

    A RealSense on the flange is placed by the controller's own pose, while the arm stands. Nothing
    is moved from here: guide the arm, and press Enter at each view. Clouds of other cameras are
    recorded with their own program, or come from ROS (`limber ros scan`).
    """
    from limber.cell.cell_file import read_cell
    from limber.core.errors import InputError
    from limber.geometry.cloud.cloud import Cloud
    from limber.robot.virtual.launch import scanned, views_around

    count = views or (8 if cell_file is None else 1)
    if cell_file is not None:
        points = _seen(read_cell(cell_file), count)
    elif middle is not None:
        points = scanned(address, views_around(np.array(middle), distance, count))
    else:
        raise InputError(Text("Neither ", Option("middle"), " nor ", Option("realsense"), " is "
                              "given."), "The virtual cameras look "
                         "at a point; a real one is described by a cell file.", "Give one.")
    Cloud(points, {}).write_ply(output)
    run.close(f"{len(points):,} points from {count} positions.", where=output,
              then=f"limber reconstruct {shlex.quote(str(output))} -o "
              f"{shlex.quote(output.stem)}.branch")
    return {"cloud": str(output), "point_count": len(points), "view_count": count}


def _seen(cell: Cell, count: int) -> np.ndarray:
    """Points of ``count`` views with a RealSense camera [m], branch frame, shape [n, 3]."""
    from limber.cli.robot_commands.moves import stands
    from limber.core.errors import InputError
    from limber.core.numerics.rigid import inverted, matrices
    from limber.robot.depth_camera import RealSense, seen_points

    if cell.camera is None:
        raise InputError("The cell file has no [camera].", "The cloud would be in an unknown "
                         "frame.", "Add [camera] with pose and mount.")
    if count > 1 and not sys.stdin.isatty():
        raise InputError(Text(Option("views", count), " needs a terminal, and standard input is "
                              "none."), "",
                         "Run it in a terminal, or take one view at a time.")
    found = []
    with RealSense() as camera:
        for number in range(count):
            if number:
                input(f"View {number + 1} of {count}: move the camera, then press Enter ")
            flange = None
            if cell.camera.mount == "flange":
                _, pose = stands(cell)
                flange = matrices(pose) @ inverted(matrices(np.array(cell.tool.grasp_pose)))
            found.append(seen_points(cell, camera, flange))
    points = np.concatenate(found)
    if not len(points):
        raise InputError("The camera sees nothing within camera.range_m.", "",
                         "Check [camera] in the cell file, and what it looks at.")
    return points
