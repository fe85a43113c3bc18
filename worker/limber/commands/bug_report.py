"""Gather what a report of a bug needs in one file."""

import json
import zipfile
from pathlib import Path
from typing import Any

import click

from limber.cli import Run, stage_command


@stage_command("bug-report")
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("limber-bug.zip"),
              show_default=True, help="File to write.")
@click.option("--data", is_flag=True, help=(
    "Also the folder's files: scan, mesh, recordings. Without it nothing of what was measured "
    "leaves your computer but numbers of results and settings."))
@click.option("--note", default="", help="What you did, and what happened instead.")
def command(run: Run, branch_folder: Path, output: Path, data: bool, note: str) -> dict[str, Any]:
    """Pack what is installed, the folder's manifest and what is wrong with its files into a ZIP.

    Look into it before you send it: the manifest names your files.
    """
    from limber.commands.doctor import report
    from limber.errors import BranchFolderError, InputError
    from limber.plain import plain
    from limber.store import Branch
    from limber.store.manifest import MANIFEST

    folder = Path(branch_folder)
    if not folder.is_dir():
        raise InputError(f"There is no folder {folder}.", "A branch folder was expected.",
                         "Name the folder that the bug is about.")
    told: dict[str, Any] = {"note": note, "doctor": plain(report()), "damages": [], "opens": True}
    try:
        branch = Branch.open(folder)
        told["damages"] = [vars(damage) for damage in branch.damages()]
    except BranchFolderError as error:
        # A folder that cannot be opened is the more worth a report.
        told |= {"opens": False, "error": str(error)}
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    told["files"] = {path.relative_to(folder).as_posix(): path.stat().st_size for path in files}
    count = 0
    try:
        with zipfile.ZipFile(output, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("report.json", json.dumps(plain(told), indent=1, default=str))
            for path in files:
                name = path.relative_to(folder).as_posix()
                if name == MANIFEST or (data and path.resolve() != Path(output).resolve()):
                    run.progress(count / len(files), name)
                    archive.write(path, f"branch/{name}")
                    count += 1
    except OSError as error:
        raise InputError(f"{output} cannot be written ({error.strerror}).",
                         "The report goes there.", "Choose another place with -o.") from error
    return {"output": output, "file_count": count, "byte_count": Path(output).stat().st_size,
            "opens": told["opens"], "damaged_count": len(told["damages"])}
