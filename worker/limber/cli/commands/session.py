"""Hold a branch in a process that other programs bend through JSON lines."""

import sys
from pathlib import Path

import click

from limber.session.protocol import SessionSettings
from limber.stages.command_line import settings_options


@click.command("session")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@settings_options(SessionSettings)
def command(branch_folder: Path, settings: SessionSettings) -> None:
    """A branch held in a process that other programs bend.

    Commands are JSON lines on standard input, events are JSON lines on standard output, and frames
    are in a memory-mapped file: `python -m limber.session.worker --help` lists them. The session
    ends at the end of its input.
    """
    from limber.session.worker import run_session

    sys.exit(run_session(branch_folder, settings))
