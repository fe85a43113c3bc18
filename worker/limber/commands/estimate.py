"""``limber estimate``: Young's modulus along the branch."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.estimation.estimate import estimate
from limber.estimation.settings import EstimateSettings


@stage_command("estimate")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--force", is_flag=True, help="Estimate again even if nothing has changed.")
@settings_options(EstimateSettings)
def command(run: Run, branch_folder: Path, force: bool,
            settings: EstimateSettings) -> dict[str, Any]:
    """Young's modulus along the branch with its uncertainty, from recorded or virtual pulls."""
    return estimate(branch_folder, settings, force=force, progress=run.progress, warn=run.warn)
