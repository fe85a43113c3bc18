"""``limber simulate``: pull a branch by a pose or a force."""

from pathlib import Path

import click
import numpy as np

from limber.cli import Run, settings_options, stage_command
from limber.mechanics.pose_table import PoseTable
from limber.mechanics.simulate import SimulateSettings
from limber.recordings.recording import POSE_COLUMNS
from limber.recordings.tables import read_table, robot_stream, time_column, with_columns
from limber.stages.simulate import simulate


@stage_command("simulate")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--force", is_flag=True, help="Run again even if nothing has changed.")
@click.option("--along", type=click.Path(path_type=Path), metavar="FILE",
              help="The grasp moves as the poses of a table do, from where it is: a recording's "
              "robot.csv, or a plan's plans/NAME.csv, which takes --duration.")
@settings_options(SimulateSettings)
def command(run: Run, branch_folder: Path, force: bool, along: Path | None,
            settings: SimulateSettings) -> dict:
    """Pull a branch by a pose or a force; writes motion, energy and forces."""
    return simulate(branch_folder, settings, force=force, progress=run.progress,
                    along=_poses(along, settings.duration, run) if along else None)


def _poses(path: Path, duration: float, run: Run) -> PoseTable:
    table = read_table(path)
    timed = time_column(table) is not None
    rate = None if timed else max(len(table.values) - 1, 1) / duration
    stream = robot_stream(path, rate_hz=rate)
    for message in stream.warnings:
        run.progress.warn(message)
    poses = with_columns(stream, POSE_COLUMNS).values
    if np.isnan(poses[:, 3:]).all():
        poses[:, 3:] = 0.0  # a table of positions alone
    known = np.isfinite(poses).all(axis=1)
    return PoseTable(stream.times[known], poses[known])
