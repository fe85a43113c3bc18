"""Scan a branch: of the virtual robot, or with a RealSense camera: `limber robot scan`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from limber.cli.cell_tool import views_in_turn
from limber.core.errors import InputError, Option, Text
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, Tool, given

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell


class Scan(Tool):
    """Scan the branch of `limber virtual-robot` from all around, or a branch with a RealSense.

    A RealSense on the flange is placed by the controller's own pose, while the arm stands. Nothing
    is moved from here: guide the arm, and press Enter at each view. Clouds of other cameras are
    recorded with their own program, or come from ROS (`limber ros scan`).
    """

    about = About("robot scan", found=("{point_count:,} points from {view_count} positions.",),
                  then="limber reconstruct {output} -o {output.stem}.branch")

    address: str = Field("127.0.0.1", description="Address of the virtual robot.")
    realsense: Path | None = given(
        "Take the clouds with the connected RealSense camera instead; its pose is that of "
        "[camera] in this cell file.", metavar="CELL")
    output: Path = given("PLY file to write.", Path("scan.ply"), group="output", short="-o")
    middle: tuple[float, float, float] | None = Field(None, description=(
        "Point that the virtual robot's cameras look at, in the branch's frame [m]."))
    distance: float = Field(0.6, description="Distance of the virtual cameras from it [m].")
    views: int | None = Field(None, ge=1, le=100, description=(
        "Number of views. Default: 8 virtual ones, or one of a real camera, which is moved "
        "between them."))

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.cell.cell_file import read_cell
        from limber.cli.virtual_camera import scanned, views_around
        from limber.geometry.cloud.cloud import Cloud

        count = self.views or (8 if self.realsense is None else 1)
        if self.realsense is not None:
            points = _seen(read_cell(self.realsense), count)
        elif self.middle is not None:
            points = scanned(self.address,
                             views_around(np.array(self.middle), self.distance, count))
        else:
            raise InputError(Text("Neither ", Option("middle"), " nor ", Option("realsense"),
                                  " is given."), "The virtual cameras look at a point; a real "
                             "one is described by a cell file.", "Give one.")
        Cloud(points, {}).write_ply(self.output)
        return {"cloud": str(self.output), "point_count": len(points), "view_count": count}


def _seen(cell: Cell, count: int) -> np.ndarray:
    """Points of ``count`` views with a RealSense camera [m], branch frame, shape [n, 3]."""
    from limber.cli.commands.robot.moves import stands
    from limber.core.numerics.rigid import inverted, matrices
    from limber.robot.depth_camera import RealSense, seen_points

    if cell.camera is None:
        raise InputError("The cell file has no [camera].", "The cloud would be in an unknown "
                         "frame.", "Add [camera] with pose and mount.")
    views, found = views_in_turn(count), []
    with RealSense() as camera:
        for _ in views:
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
