"""Collect what a report of a bug needs in one file."""

import json
import os
import zipfile
from pathlib import Path
from typing import Any

from limber.core.errors import BranchFolderError, InputError
from limber.core.files.atomic import file_digest, replacing
from limber.core.files.safe_names import has_other_names, is_link
from limber.core.json_values import plain
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, Tool, argument, given, option
from limber.store.manifest import MANIFEST

_MOST_BYTES = 2 << 30
"""Size of a file that is read and packed; a larger one, perhaps full of holes, is named only."""


class BugReport(Tool):
    """Pack a list of what is installed, and data on a branch folder or a scan, into a ZIP.

    For a folder these are its manifest and the faults of its files; give a scan itself if no branch
    could be made of it. Check the ZIP before you send it: the manifest names your files.
    """

    about = About("bug-report", found=(
        "{file_count} files and what is installed. Look into it before you send it.",))

    source: Path = argument("The branch folder, or the scan.", metavar="FOLDER_OR_FILE")
    output: Path = given("File to write.", Path("limber-bug.zip"), group="output", short="-o")
    data: bool = option("Also include the files: scan, mesh, recordings. Otherwise only settings "
                        "and numbers of results are included.", False, switch=True)
    note: str = option("What you did, and what happened instead.", "")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.cli.commands.doctor import report

        source, output = self.source, self.output
        if not source.exists():
            raise InputError(f"There is no {source}.", "A branch folder or a scan was expected.",
                             "Name the branch folder or scan that the bug is about.")
        told: dict[str, Any] = {"note": self.note, "doctor": plain(report()), "damages": [],
                                "opens": True}
        if source.is_dir():
            told |= _of_folder(source)
            # A link may lead to a file outside the branch.
            files = sorted(path for folder, _, names in os.walk(source) for name in names
                           if (path := Path(folder, name)).is_file() and not is_link(path))
            names = {path: path.relative_to(source).as_posix() for path in files}
        else:
            files, names = [source], {source: source.name}
        told["files"] = {names[path]: {"bytes": path.stat().st_size, "sha256": _digest(path)}
                         for path in files}
        # A file with a second name elsewhere may not belong to the branch either.
        kept = {path for path in files if path.stat().st_size > _MOST_BYTES
                or (source.is_dir() and has_other_names(path))}
        told["not_packed"] = sorted(names[path] for path in kept)
        count = 0
        try:
            with replacing(output) as stream, zipfile.ZipFile(
                    stream, "w", zipfile.ZIP_DEFLATED) as archive:
                archive.writestr("report.json", json.dumps(plain(told), indent=1, default=str))
                for path, name in names.items():
                    if path not in kept and (name == MANIFEST or (
                            self.data and path.resolve() != output.resolve())):
                        progress(count / len(files), name)
                        archive.write(path, f"branch/{name}" if source.is_dir() else name)
                        count += 1
        except OSError as error:
            raise InputError(f"{output} cannot be written ({error.strerror}).",
                             "The report goes there.", "Choose another place with -o.") from error
        return {"output": output, "file_count": count, "byte_count": output.stat().st_size,
                "opens": told["opens"], "damaged_count": len(told["damages"])}


def _of_folder(folder: Path) -> dict[str, Any]:
    from limber.store import Branch

    try:
        branch = Branch.read(folder, unfinished=True)
        return {"damages": [vars(damage) for damage in branch.damages()],
                "is_unfinished": branch.is_unfinished}
    except BranchFolderError as error:
        # A folder that cannot be opened is all the more worth reporting.
        return {"opens": False, "error": str(error)}


def _digest(path: Path) -> str:
    try:
        return "too large" if path.stat().st_size > _MOST_BYTES else file_digest(path)
    except OSError as error:
        return f"not readable: {error.strerror}"
