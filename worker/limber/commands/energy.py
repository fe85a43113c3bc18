"""``limber energy``: the energy field over grasp poses."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.stages.energy import EnergySettings, sample_energy_field


@stage_command("energy")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--force", is_flag=True, help="Run again even if nothing has changed.")
@settings_options(EnergySettings)
def command(run: Run, branch_folder: Path, force: bool, settings: EnergySettings,
            ) -> dict[str, Any]:
    """Energy field over grasp poses: solve sampled poses, fit radial basis functions."""
    return sample_energy_field(branch_folder, settings, force=force, progress=run.progress)
