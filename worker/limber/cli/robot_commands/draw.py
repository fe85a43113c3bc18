"""Draw a cell: `limber robot draw`."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import click
import numpy as np

from limber.cli.main import Run, stage_command
from limber.core.errors import Option, Text


@stage_command("draw")
@click.argument("cell_file", type=click.Path(path_type=Path))
@click.option("--branch", "folder", type=click.Path(path_type=Path), help="Branch folder to draw.")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("cell.png"),
              show_default=True, help="Picture to write; .svg and .pdf as well.")
@click.option("--joints", type=str, help="Angles of the arm [rad], A,B,C,D,E,F. Default: its home "
              "pose.")
def draw(run: Run, cell_file: Path, folder: Path | None, output: Path, joints: str | None,
         ) -> dict[str, Any]:
    """Draw arm, gripper, branch, camera and obstacles of a cell file from three sides.

    No robot is needed. Compare it with the bench: a base that is turned, a pose in millimetres or
    an obstacle on the wrong side are seen at once.
    """
    from limber.cell.cell_file import read_cell
    from limber.cell.obstacles import cell_obstacles
    from limber.core.errors import InputError
    from limber.core.files.atomic import replacing
    from limber.core.optional import require_extra
    from limber.store import Branch
    from limber.store.loading import load_skeleton

    require_extra("report", ("matplotlib",), "The drawing of a cell")
    from limber.results.cell_picture import cell_picture

    cell = read_cell(cell_file)
    angles = np.array(cell.arm.home, float)
    if joints is not None:
        try:
            angles = np.array([float(part) for part in joints.split(",")])
        except ValueError as error:
            raise InputError(Text(Option("joints", joints), " are no angles."), "",
                             "Give numbers in rad, separated by commas.") from error
    if angles.shape != (len(cell.arm.joint_names),) or not np.isfinite(angles).all():
        raise InputError(Text(Option("joints"), f" has {len(angles)} values."),
                         f"A {cell.arm.name} has {len(cell.arm.joint_names)} joints.",
                         "Give one finite angle per joint.")
    skeleton = None if folder is None else load_skeleton(Branch.read(folder))
    figure = cell_picture(cell, angles, cell_obstacles(cell, cell_file.parent), skeleton)
    try:
        with replacing(output) as stream:
            figure.savefig(stream, dpi=130, format=output.suffix.removeprefix(".") or "png")
    except ValueError as error:
        raise InputError(f"{output} cannot be drawn ({error}).", "", "Give a name that ends in "
                         ".png, .svg or .pdf.") from error
    return {"picture": str(output), "arm": cell.arm.name, "joints_rad": angles,
            "grasp_m": cell.grasp_frames(cell.arm.forward(angles))[:3, 3],
            "obstacles": len(cell.obstacles)}
