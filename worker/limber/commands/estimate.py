"""``limber estimate``: Young's modulus along the branch."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.estimation.settings import EstimateSettings
from limber.plain import plain
from limber.report.tables import held_out_rows, modulus_rows
from limber.stages.estimate import estimate, follow


@stage_command("estimate")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--force", is_flag=True, help="Estimate again even if nothing has changed.")
@click.option("--follow", "is_online", is_flag=True,
              help="Estimate frame by frame while a pull is recorded, or replay one.")
@click.option("--pace", type=click.FloatRange(min=0), default=1.0, show_default=True,
              help="Speed of a replay; 0: as fast as it goes.")
@settings_options(EstimateSettings)
def command(run: Run, branch_folder: Path, force: bool, is_online: bool, pace: float,
            settings: EstimateSettings) -> dict[str, Any]:
    """Young's modulus along the branch with its uncertainty, from recorded or virtual pulls."""
    if is_online:
        result = plain(follow(branch_folder, settings, pace=pace, progress=run.progress))
    else:
        result = plain(estimate(branch_folder, settings, force=force, progress=run.progress))
    run.show("Young's modulus", modulus_rows(result, None))
    if held_out := held_out_rows(result):
        run.show("Pulls foretold by a fit that did not see them: RMS errors", held_out)
    return result
