"""Hold a branch in a process that other programs bend through JSON lines."""

import sys
from typing import Any

from limber.core.progress import SILENT, Progress
from limber.session.protocol import SessionSettings
from limber.stages.stage import About, BranchStage, Tool


class Session(SessionSettings, BranchStage, Tool):
    """A branch held in a process that other programs bend.

    Commands are JSON lines on standard input, events are JSON lines on standard output, and frames
    are in a memory-mapped file: `python -m limber.session.worker --help` lists them. The session
    ends at the end of its input.
    """

    about = About("session", prints=True)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.session.worker import run_session

        sys.exit(run_session(self.branch_folder, SessionSettings.of(self)))
