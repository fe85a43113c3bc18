"""``limber plan``: RRT* and D-RRT* to a goal, compared on the full model."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.plain import plain
from limber.planning.compare import PlanSettings
from limber.report.tables import comparison_rows
from limber.stages.plan import plan


@stage_command("plan")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--name", default="path", show_default=True, help="Name of the plan's files.")
@click.option("--force", is_flag=True, help="Run again even if nothing has changed.")
@settings_options(PlanSettings)
def command(run: Run, branch_folder: Path, name: str, force: bool, settings: PlanSettings,
            ) -> dict[str, Any]:
    """Paths to a goal: RRT* and deformation-aware D-RRT*, compared on the full model."""
    result = plan(branch_folder, settings, name=name, force=force, progress=run.progress)
    run.show("Both paths, on the full model", comparison_rows(plain(result)))
    return result
