"""Collect what a report of a bug needs in one file."""

import json
import os
import zipfile
from pathlib import Path
from typing import Any

import click

from limber.cli.main import Run, stage_command


@stage_command("bug-report")
@click.argument("source", type=click.Path(path_type=Path), metavar="FOLDER_OR_FILE")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("limber-bug.zip"),
              show_default=True, help="File to write.")
@click.option("--data", is_flag=True, help=(
    "Also include the files: scan, mesh, recordings. Otherwise only settings and numbers of "
    "results are included."))
@click.option("--note", default="", help="What you did, and what happened instead.")
def command(run: Run, source: Path, output: Path, data: bool, note: str) -> dict[str, Any]:
    """Pack a list of what is installed, and data on a branch folder or a scan, into a ZIP.

    For a folder these are its manifest and the faults of its files; give a scan itself if no branch
    could be made of it. Check the ZIP before you send it: the manifest names your files.
    """
    from limber.cli.commands.doctor import report
    from limber.core.errors import InputError
    from limber.core.files.atomic import replacing
    from limber.core.files.safe_names import has_other_names, is_link
    from limber.core.json_values import plain
    from limber.store.manifest import MANIFEST

    source = Path(source)
    if not source.exists():
        raise InputError(f"There is no {source}.", "A branch folder or a scan was expected.",
                         "Name the branch folder or scan that the bug is about.")
    report_content: dict[str, Any] = {"note": note, "doctor": plain(report()), "damages": [],
                                      "opens": True}
    if source.is_dir():
        report_content |= _of_folder(source)
        # A link may lead to a file outside the branch.
        files = sorted(Path(folder, name) for folder, _, names in os.walk(source) for name in names
                       if Path(folder, name).is_file() and not is_link(Path(folder, name)))
        names = {path: path.relative_to(source).as_posix() for path in files}
    else:
        files, names = [source], {source: source.name}
    report_content["files"] = {names[path]: {"bytes": path.stat().st_size, "sha256": _digest(path)}
                               for path in files}
    # A file with a second name elsewhere may not belong to the branch either.
    kept = {path for path in files if source.is_dir() and has_other_names(path)}
    report_content["not_packed"] = sorted(names[path] for path in kept)
    count = 0
    try:
        with replacing(output) as stream, zipfile.ZipFile(
                stream, "w", zipfile.ZIP_DEFLATED) as archive:
            archive.writestr("report.json",
                             json.dumps(plain(report_content), indent=1, default=str))
            for path, name in names.items():
                if path not in kept and (name == MANIFEST or (
                        data and path.resolve() != Path(output).resolve())):
                    run.progress(count / len(files), name)
                    archive.write(path, f"branch/{name}" if source.is_dir() else name)
                    count += 1
    except OSError as error:
        raise InputError(f"{output} cannot be written ({error.strerror}).",
                         "The report goes there.", "Choose another place with -o.") from error
    run.close(f"{count} files and what is installed. Look into it before you send it.",
              where=output)
    return {"output": output, "file_count": count, "byte_count": Path(output).stat().st_size,
            "opens": report_content["opens"], "damaged_count": len(report_content["damages"])}


def _of_folder(folder: Path) -> dict[str, Any]:
    from limber.core.errors import BranchFolderError
    from limber.store import Branch

    try:
        branch = Branch.read(folder, unfinished=True)
        return {"damages": [vars(damage) for damage in branch.damages()],
                "is_unfinished": branch.is_unfinished}
    except BranchFolderError as error:
        # A folder that cannot be opened is all the more worth reporting.
        return {"opens": False, "error": str(error)}


def _digest(path: Path) -> str:
    from limber.core.files.atomic import file_digest

    try:
        return file_digest(path)
    except OSError as error:
        return f"not readable: {error.strerror}"
