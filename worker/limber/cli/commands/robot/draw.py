"""Draw a cell: `limber robot draw`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from pydantic import Field

from limber.cli.cell_tool import CellTool
from limber.core.errors import InputError, Option, Text
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, given


class Draw(CellTool):
    """Draw arm, gripper, branch, camera and obstacles of a cell file from three sides.

    No robot is needed. Compare it with the bench: a base that is turned, a pose in millimetres or
    an obstacle on the wrong side are seen at once.
    """

    about = About("robot draw")

    branch: Path | None = given("Branch folder to draw.")
    output: Path = given("Picture to write; .svg and .pdf as well.", Path("cell.png"),
                         group="output", short="-o")
    joints: tuple[float, ...] | None = Field(
        None, description="Angles of the arm [rad]. Default: its home pose.",
        json_schema_extra={"metavar": "A,B,C,D,E,F"})

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.cell.obstacles import cell_obstacles
        from limber.core.files.atomic import replacing
        from limber.core.optional import require_extra
        from limber.store import Branch
        from limber.store.loading import load_skeleton

        require_extra("report", ("matplotlib",), "The drawing of a cell")
        from limber.results.cell_picture import cell_picture

        cell, output = self.cell(), self.output
        angles = np.array(cell.arm.home if self.joints is None else self.joints, float)
        if angles.shape != (len(cell.arm.joint_names),):
            raise InputError(Text(Option("joints"), f" has {len(angles)} values."),
                             f"A {cell.arm.name} has {len(cell.arm.joint_names)} joints.",
                             "Give one finite angle per joint.")
        skeleton = None if self.branch is None else load_skeleton(Branch.read(self.branch))
        figure = cell_picture(cell, angles, cell_obstacles(cell, self.cell_file.parent), skeleton)
        try:
            with replacing(output) as stream:
                figure.savefig(stream, dpi=130, format=output.suffix.removeprefix(".") or "png")
        except ValueError as error:
            raise InputError(f"{output} cannot be drawn ({error}).", "", "Give a name that ends "
                             "in .png, .svg or .pdf.") from error
        return {"picture": str(output), "arm": cell.arm.name, "joints_rad": angles,
                "grasp_m": cell.grasp_frames(cell.arm.forward(angles))[:3, 3],
                "obstacles": len(cell.obstacles)}
