"""``limber predict``: where a branch rests under another load."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.estimation.predict import PredictSettings
from limber.stages.predict import predict


@stage_command("predict")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@settings_options(PredictSettings)
def command(run: Run, branch_folder: Path, settings: PredictSettings) -> dict[str, Any]:
    """Where the points of a pull come to rest under another load, with the estimated modulus."""
    return predict(branch_folder, settings, progress=run.progress)
