"""Check whether a branch folder's files are as they were written."""

from pathlib import Path
from typing import Any

import click

from limber.cli.main import Run, stage_command
from limber.core.errors import Option
from limber.store import Branch, damage_error, unlisted


@stage_command("verify")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--finish", is_flag=True, help=(
    "First put the results of an interrupted command (.commit) in place. Otherwise nothing is "
    "changed."))
def command(run: Run, branch_folder: Path, finish: bool) -> dict[str, Any]:
    """Compare every file of a branch folder with its checksum; exit code 2 if one is damaged.

    Files that no stage wrote and truncated recordings are listed too; they do not count as damage.
    The folder is not changed unless --finish is given.
    """
    branch = (Branch.open(branch_folder) if finish
              else Branch.read(branch_folder, unfinished=True))
    if branch.is_unfinished:
        run.progress.warn("An interrupted command left results that are not in place yet. They are "
                          "compared as they will be. ", Option("finish", True), ", or the next "
                          "command that writes to the folder, puts them in place.")
    run.progress(0.0, "comparing with checksums")
    damages = branch.damages()
    if damages:
        raise damage_error(branch.folder, damages, shown_count=len(damages))
    found = branch.manifest.files
    beside = unlisted(branch.folder, branch.manifest)
    run.close(f"All {len(found)} files are as they were written.",
              *([f"Written by no stage: {', '.join(map(str, beside))}."] if beside else []),
              where=branch.folder)
    return {"uuid": branch.uuid, "file_count": len(found),
            "byte_count": sum(entry.bytes for entry in found.values()),
            "unlisted": beside,
            "is_unfinished": branch.is_unfinished,
            "unfinished_streams": branch.streams()}
