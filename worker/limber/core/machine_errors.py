"""Machine errors in plain words: a full disk, a lost folder, no memory, packages that do not load.
"""

import errno
import re
import sys
from pathlib import Path

from limber.core.errors import (
    Command,
    InputError,
    LimberError,
    MissingDependencyError,
    Option,
    WorkError,
)


def _codes(*names: str) -> frozenset[int]:
    # Windows lacks some of them.
    return frozenset(getattr(errno, name) for name in names if hasattr(errno, name))


_FULL = _codes("ENOSPC", "EDQUOT")
_LOST = _codes("ESTALE", "EIO", "ENODEV", "ENXIO")
_UNREACHABLE = _codes("ENOTCONN", "ESHUTDOWN", "EHOSTDOWN", "EHOSTUNREACH", "ENETDOWN",
                      "ENETUNREACH", "ETIMEDOUT")
"""Errors of a file; without a file name they may be those of a robot's connection."""
_LOST_ON_WINDOWS = frozenset((53, 55, 59, 64, 67, 121, 1231))
"""ERROR_BAD_NETPATH and related errors, which Python reports as a missing file."""
_FULL_IN_WORDS = re.compile(r"no space left|not enough free space|requested and \d+ written", re.I)
"""The wording of numpy and HDF5, which give no error number."""
_FORBIDDEN = _codes("EROFS", "EACCES", "EPERM")
_NO_SUCH_NAME = _codes("ENAMETOOLONG", "ELOOP", "ENOTDIR", "EISDIR", "EILSEQ")
_TOO_LARGE = _codes("EFBIG", "EOVERFLOW")
_TOO_MANY = _codes("EMFILE", "ENFILE")


def machine_error(error: BaseException, path: Path | None = None) -> LimberError | None:
    """Return a readable text for an error of the machine about ``path``, unless it names another;
    None for any other error."""
    if isinstance(error, MemoryError):
        return WorkError("Out of memory.", "", "Use a coarser mesh or a thinner cloud.")
    if isinstance(error, ImportError):
        return _not_loaded(error)
    if not isinstance(error, OSError):
        return None
    name = error.filename2 or error.filename or path or "A file"
    seen = error.strerror or str(error) or type(error).__name__
    if error.errno in _FULL or (error.errno is None and _FULL_IN_WORDS.search(seen)):
        return WorkError(f"{name} cannot be written ({seen}).",
                         "The disk is full, or your quota is used up.",
                         "Free some space (", Command("cache", Option("clear", True)), " helps), "
                         "and run this again. Earlier results are kept.")
    if (error.errno in _LOST or (error.filename and error.errno in _UNREACHABLE)
            or getattr(error, "winerror", None) in _LOST_ON_WINDOWS):
        return WorkError(f"{name} does not answer ({seen}).",
                         "The connection to its disk or network folder was lost.",
                         "Restore the connection, and run this again. Earlier results are kept.")
    if error.errno in _NO_SUCH_NAME:
        return InputError(f"{str(name)[:300]} cannot be used ({seen}).",
                          "No file can have this name or be in this place.",
                          "Give a shorter name, or another place.")
    if error.errno in _TOO_LARGE:
        return WorkError(f"{name} cannot be written ({seen}).",
                         "The disk, or a limit of your account (ulimit -f), allows no file of this "
                         "size.", "Raise the limit, or use another disk.")
    if error.errno in _TOO_MANY:
        return WorkError(f"{name} cannot be opened ({seen}).",
                         "Too many files are open on this computer or in this program.",
                         "Close other programs, or raise the limit (ulimit -n).")
    if error.errno in _FORBIDDEN:
        return InputError(f"{name} cannot be used ({seen}).",
                          "It is read-only, or belongs to another user.",
                          "Change its permissions, or work on a copy.")
    return None


def _not_loaded(error: ImportError) -> LimberError:
    python = f"Python {sys.version_info.major}.{sys.version_info.minor}"
    return MissingDependencyError(
        f"{error.name or 'A package'} does not load ({error}).",
        f"The installed packages are incomplete, or do not fit each other or {python}.",
        f"In Blender, install the extension's zip for this system and {python} again. In a "
        "checkout, remove .venv and run scripts/setup. Elsewhere, install Limber's wheel anew.")
