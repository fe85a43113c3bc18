"""Stage ``export-pull``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from limber.core.errors import InputError
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, BranchStage, required
from limber.store import Branch


def _message_line(result: Mapping[str, Any]) -> str:
    counts = result["messages"]
    return f"{sum(counts.values()):,} messages on {len(counts)} topics."


class ExportPull(BranchStage):
    """Export a recorded pull as an MCAP file, which Foxglove opens."""

    about = About("export-pull", 58, reads=("pulls/{name}/",), found=(_message_line,), step="pulls",
                  label="Export a Pull")

    name: str = required("Name of the pull.", "pull-1")
    mcap: Path = required("File to write: ROS 2 messages in an MCAP container.", "{stem}.mcap",
                          group="output")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Write a pull as an MCAP file; the folder stays as it is.

        Returns:
            ``output`` and ``messages``, the number per topic.

        Raises:
            InputError: there is no such pull, or the file cannot be written.
        """
        from limber.recordings.bag_pull import write_mcap
        from limber.recordings.recording import read_pull

        branch = Branch.read(self.branch_folder)
        entry = branch.require(f"pulls/{self.name}/pull.toml", "import-pull")
        progress(0.1, "reading the pull")
        pull = read_pull(entry.parent)
        beside = self.mcap.with_name(f".{self.mcap.name}.part")
        try:
            counts = write_mcap(beside, entry.parent, pull)
            beside.replace(self.mcap)
        except OSError as error:
            raise InputError(f"{self.mcap} cannot be written ({error}).", "",
                             "Choose another location.") from error
        finally:
            beside.unlink(missing_ok=True)
        return {"output": self.mcap, "messages": counts}
