"""Check whether a branch folder's files are as they were written."""

from collections.abc import Mapping
from typing import Any

from limber.core.errors import Option
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, BranchStage, Tool, option
from limber.store import Branch, damage_error, unlisted


def _unlisted(values: Mapping[str, Any]) -> str:
    beside = values["unlisted"]
    return f"Written by no stage: {', '.join(map(str, beside))}." if beside else ""


class Verify(BranchStage, Tool):
    """Compare every file of a branch folder with its checksum; exit code 2 if one is damaged.

    Files that no stage wrote and truncated recordings are listed too; they do not count as damage.
    The folder is not changed unless --finish is given.
    """

    about = About("verify", found=("All {file_count} files are as they were written.", _unlisted))

    finish: bool = option("First put the results of an interrupted command (.commit) in place. "
                          "Otherwise nothing is changed.", False, switch=True)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        branch = (Branch.open(self.branch_folder) if self.finish
                  else Branch.read(self.branch_folder, unfinished=True))
        if branch.is_unfinished:
            progress.warn("An interrupted command left results that are not in place yet. They "
                          "are compared as they will be. ", Option("finish", True), ", or the "
                          "next command that writes to the folder, puts them in place.")
        progress(0.0, "comparing with checksums")
        damages = branch.damages()
        if damages:
            raise damage_error(branch.folder, damages, shown_count=100)
        found = branch.manifest.files
        return {"uuid": branch.uuid, "file_count": len(found),
                "byte_count": sum(entry.bytes for entry in found.values()),
                "unlisted": unlisted(branch.folder, branch.manifest),
                "is_unfinished": branch.is_unfinished,
                "unfinished_streams": branch.streams()}
