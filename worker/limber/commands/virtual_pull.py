"""``limber virtual-pull``: a simulated recording with known truth."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.estimation.virtual_pull import VirtualPullSettings
from limber.stages.virtual_pull import virtual_pull


@stage_command("virtual-pull")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--name", default="pull-1", show_default=True, help="Name of the pull.")
@click.option("--force", is_flag=True, help="Simulate again even if nothing has changed.")
@settings_options(VirtualPullSettings)
def command(run: Run, branch_folder: Path, name: str, force: bool,
            settings: VirtualPullSettings) -> dict[str, Any]:
    """Simulate a pull with a known Young's modulus and sensor noise, on a finer mesh."""
    return virtual_pull(branch_folder, name, settings, force=force, progress=run.progress)
