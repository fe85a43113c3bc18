"""``limber generate``: a generated branch with known truth, and its scan."""

from pathlib import Path
from typing import Any

import click

from limber.cli import Run, settings_options, stage_command
from limber.geometry.generated import BranchSpec
from limber.stages.generate import generate


@stage_command("generate")
@click.argument("folder", type=click.Path(path_type=Path))
@click.option("--seed", type=int, default=0, show_default=True, help="Seed of all that is random.")
@settings_options(BranchSpec)
def command(run: Run, folder: Path, seed: int, settings: BranchSpec) -> dict[str, Any]:
    """A generated branch with known truth, scanned as a scanner would.

    Writes cloud.ply, and the truth: truth_skeleton.swc, truth_surface.ply and truth.json.
    `limber reconstruct FOLDER/cloud.ply` takes the truth along.
    """
    return generate(folder, settings, seed=seed, progress=run.progress)
