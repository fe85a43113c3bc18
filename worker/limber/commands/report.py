"""``limber report``: the page of all results."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, stage_command


@stage_command("report")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--picture", type=click.Path(path_type=Path),
              help="A PNG to open the page with, such as the render of `limber scene`.")
def command(run: Run, branch_folder: Path, picture: Path | None) -> dict[str, Any]:
    """One self-contained HTML page with figures and tables of all results."""
    from limber.stages.report import write_report

    return write_report(branch_folder, picture=picture, progress=run.progress)
