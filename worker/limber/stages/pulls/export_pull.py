"""Export a recorded pull as an MCAP file, which Foxglove opens."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from limber.core.errors import InputError
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.stages.inputs import BranchInputs, NoOptions, NoSettings, by_name, required
from limber.stages.registry import StageDescription
from limber.store import Branch


class ExportPullInputs(BranchInputs):
    """A branch folder, one of its pulls, and the file to write."""

    groups: ClassVar[Groups] = {"input": ("name",), "output": ("mcap",)}

    name: str = required("Name of the pull.", "pull-1")
    mcap: Path = required("File to write: ROS 2 messages in an MCAP container.", "{stem}.mcap")


def export_pull(folder: Path, name: str, output: Path, *, progress: Progress = SILENT,
                ) -> dict[str, Any]:
    """Write a pull as an MCAP file; the folder stays as it is.

    Returns:
        ``output`` and ``messages``, the number per topic.

    Raises:
        InputError: there is no such pull, or the file cannot be written.
    """
    from limber.recordings.bag_pull import write_mcap
    from limber.recordings.recording import read_pull

    branch = Branch.read(folder)
    entry = branch.require(f"pulls/{name}/pull.toml", "import-pull")
    progress(0.1, "reading the pull")
    pull = read_pull(entry.parent)
    beside = output.with_name(f".{output.name}.part")
    try:
        counts = write_mcap(beside, entry.parent, pull)
        beside.replace(output)
    except OSError as error:
        raise InputError(f"{output} cannot be written ({error}).", "", "Choose another location."
                         ) from error
    finally:
        beside.unlink(missing_ok=True)
    return {"output": output, "messages": counts}


def _message_line(result: Mapping[str, Any]) -> str:
    counts = result["messages"]
    return f"{sum(counts.values()):,} messages on {len(counts)} topics."


STAGE = StageDescription(
    "export-pull", 58, by_name(export_pull, folder="branch_folder", output="mcap"),
    ExportPullInputs, NoSettings, NoOptions, reads=("pulls/{name}/",),
    found=(_message_line,), step="pulls", label="Export a Pull")
