"""Messages for stages that meet a full disk or a lost folder."""

import gc
import shutil
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from limber.core.errors import BranchFolderError, Command, Option, WorkError
from limber.core.machine_errors import machine_error
from limber.store import journal
from limber.store.manifest import MANIFEST

NAME_ROOM = 100
"""Longest name of a file that a stage writes: in a work folder (50), such as
executions/NAME/report.json (50)."""
_LONGEST_PATH = 259
"""Of Windows' MAX_PATH, the last character is a zero."""
LEAST_FREE_BYTES = 200e6
"""A stage does not start with less free space on the disk: it would lose its results at the end."""


@contextmanager
def in_words(folder: Path) -> Iterator[None]:
    """Report a full disk or a lost folder to the user of a stage."""
    try:
        yield
    except OSError as error:
        if _is_gone(folder):
            raise gone(folder) from error
        translated = machine_error(error, folder)
        if translated is None:
            raise
        # A file still open in the failed writer keeps its space, removed or not; the next stage of
        # this process would find the disk full as well.
        traceback.clear_frames(error.__traceback__)
        gc.collect()
        raise translated from error


def require_there(folder: Path) -> None:
    """Refuse a folder that has disappeared: locks would create an empty one."""
    if _is_gone(folder):
        raise gone(folder)


def _is_gone(folder: Path) -> bool:
    try:
        return not (folder / MANIFEST).is_file() and not journal.is_pending(folder)
    except OSError:
        # The file system does not answer; another error reports that better.
        return False


def gone(folder: Path) -> WorkError:
    return WorkError(f"{folder} no longer exists.",
                     "It was moved or removed, or its disk or network folder was "
                     "lost.", "Restore it, and run this again. Earlier results are kept.")


def require_short(folder: Path, room: int) -> None:
    """Refuse a folder with paths too long for Windows to open: ``room`` is the longest name of a
    file to be written; those that are there are counted."""
    if not limits_paths():
        return
    place = str(folder.absolute())
    length = len(place) + 1 + max([room, *(
        len(str(path.relative_to(folder))) for path in folder.rglob("*"))])
    if length > _LONGEST_PATH and not place.startswith("\\\\?\\"):
        raise BranchFolderError(
            f"Paths of files in {folder} would have {length} characters.",
            f"Windows opens paths of at most {_LONGEST_PATH} characters.",
            "Move the folder to one with a shorter path, such as C:\\branches, or switch on long "
            "paths in Windows (LongPathsEnabled) and start the program again.")


def limits_paths() -> bool:
    """Whether this is a Windows on which long paths are not switched on."""
    if sys.platform != "win32":
        return False
    import ctypes

    libraries: Any = ctypes  # WinDLL is on Windows alone
    try:
        return not libraries.WinDLL("ntdll").RtlAreLongPathsEnabled()
    except (AttributeError, OSError):
        # Before Windows 10 of 2016.
        return True


def require_room(folder: Path, purpose: str) -> None:
    free = shutil.disk_usage(folder).free
    if free < LEAST_FREE_BYTES:
        raise WorkError(f"The disk of {folder} has {free / 1e6:.0f} MB left.", f"{purpose} needs "
                        f"{LEAST_FREE_BYTES / 1e6:.0f} MB; otherwise its results would be lost.",
                        "Make room (", Command("cache", Option("clear", True)), " frees some), or "
                        "move the folder.")
