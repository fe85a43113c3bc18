"""``limber import-pull``: a recording into the branch folder."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.recordings.importing import ImportSettings
from limber.stages.import_pull import import_pull


@stage_command("import-pull")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.argument("source", type=click.Path(path_type=Path))
@click.option("--name", required=True, help="Name of the pull.")
@click.option("--force", is_flag=True, help="Import again even if nothing has changed.")
@settings_options(ImportSettings)
def command(run: Run, branch_folder: Path, source: Path, name: str, force: bool,
            settings: ImportSettings) -> dict[str, Any]:
    """Bring SOURCE (marker CSV, C3D, folder of PLY or RGB-D, force table) into the branch folder.
    """
    return import_pull(branch_folder, source, name, settings, force=force,
                       progress=run.progress)
