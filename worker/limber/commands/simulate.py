"""``limber simulate``: pull a branch by a pose or a force."""

from pathlib import Path

import click

from limber.cli import Run, settings_options, stage_command
from limber.mechanics.simulate import SimulateSettings, simulate


@stage_command("simulate")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--force", is_flag=True, help="Run again even if nothing has changed.")
@settings_options(SimulateSettings)
def command(run: Run, branch_folder: Path, force: bool, settings: SimulateSettings) -> dict:
    """Pull a branch by a pose or a force; writes motion, energy and forces."""
    return simulate(branch_folder, settings, force=force, progress=run.progress,
                    warn=run.warn)
