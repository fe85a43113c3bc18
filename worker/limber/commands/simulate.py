"""``limber simulate``: a pull or a force on a branch over time."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.mechanics.simulate import SimulateSettings, simulate_branch


@stage_command("simulate")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--force", is_flag=True, help="Run again even if nothing has changed.")
@settings_options(SimulateSettings)
def command(run: Run, branch_folder: Path, force: bool, settings: SimulateSettings,
            ) -> dict[str, Any]:
    """Pull a branch by a pose or a force over time; write its motion, energy and forces."""
    return simulate_branch(branch_folder, settings, force=force, progress=run.progress,
                           warn=run.warn)
