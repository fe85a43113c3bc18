"""Names in files that are used as paths: they must not lead out of their folder.

A branch folder or a recording may come from an untrusted source. Each name in it that is used as a
path goes through :func:`inside`, and a folder with links is refused before it is written to. A user
who made the links allows them with ``limber --follow-links``; names must stay inside even then.
"""

import os
import re
import stat
import unicodedata
from collections.abc import Sequence
from pathlib import Path, PurePosixPath, PureWindowsPath

from limber.core.errors import InputError

_DEVICE = re.compile(r"(?:^|/)(?:con|prn|aux|nul|conin\$|conout\$|(?:com|lpt)[0-9\xb9\xb2\xb3])"
                     r"\s*(?:\.[^/]*)?(?:/|$)", re.IGNORECASE)
"""Names that Windows takes for a device in every folder, whatever follows the dot."""
_PLAIN = re.compile(r"(?:[A-Za-z0-9_-](?:[A-Za-z0-9_. +-]*[A-Za-z0-9_+-])?(?:/(?!$)|$))+")
"""Names that need no further check: manifests list thousands of them."""
_MOST_LEVELS = 32
FOLLOW_LINKS = "LIMBER_FOLLOW_LINKS"
"""Set to 1 if links may be followed; child processes of a command inherit it."""


def relative_name(name: str) -> str:
    """Return ``name``, relative and with ``/``, in its shortest form; the rule is the same on every
    system, so that a folder valid on one is valid on all. InputError if it is absolute, leads
    upwards, names a drive, or is no valid file name."""
    is_device = _DEVICE.search(name) is not None
    if _PLAIN.fullmatch(name) and not is_device:
        return name
    pure = PurePosixPath(name)
    if pure.is_absolute() or PureWindowsPath(name).anchor or "\\" in name:
        why = "It is absolute, or has a backslash or a drive."
    elif any(not part.strip(". ") for part in pure.parts) or not pure.parts:
        why = "It leads to a parent folder, or does not name a file."
    elif any(PureWindowsPath(part).drive for part in pure.parts):
        why = "Part of it is the name of a drive."
    elif is_device or ":$" in name:
        why = "Windows takes a part of it for a device or a hidden stream."
    elif any(part[-1] in ". " for part in pure.parts):
        # It would name the file without them.
        why = "Windows drops dots and spaces at the end of a name."
    elif any(unicodedata.category(character) in ("Cc", "Cs") for character in name):
        why = "It contains control characters, or is not valid Unicode."
    else:
        return pure.as_posix()
    raise InputError(f"{name[:200]!r} cannot be used as a file name in a folder.", why,
                     "Use a relative name with / that stays inside the folder.")


def same_named(names: Sequence[str]) -> list[list[int]]:
    """Return the indices of names that are one on some system: equal but for case, or the coding of
    accents."""
    groups: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        groups.setdefault(unicodedata.normalize(
            "NFC", unicodedata.normalize("NFD", name).casefold()), []).append(index)
    return [group for group in groups.values() if len(group) > 1]


def inside(folder: Path, name: str) -> Path:
    """Return the path of ``name`` in ``folder``, whether or not it exists; InputError if it points
    outside, or its path contains a link."""
    path = Path(folder)
    for part in PurePosixPath(relative_name(name)).parts:
        path = path / part
        if is_link(path) and not _may_follow():
            raise _link_error(path)
    return path


def refuse_links(folder: Path) -> None:
    """Refuse a folder that contains a link; it may be one itself. InputError, which names the link,
    also if it is nested too deeply to be checked."""
    top = len(Path(folder).parts)
    for parent, folders, files in os.walk(folder):
        if folders and len(Path(parent).parts) - top >= _MOST_LEVELS:
            raise InputError(f"{folder} has folders that are nested more than {_MOST_LEVELS} deep, "
                             f"as {Path(parent).relative_to(folder).as_posix()[:100]}.",
                             "Limber writes no such folder.", "Remove it.")
        for name in folders + files:
            if is_link(path := Path(parent, name)) and not _may_follow():
                raise _link_error(path)


def _may_follow() -> bool:
    return os.environ.get(FOLLOW_LINKS) == "1"


def is_link(path: Path) -> bool:
    """Whether ``path`` is a symbolic link, or a junction of Windows; False if it does not exist."""
    try:
        about = os.lstat(path)
    except (FileNotFoundError, NotADirectoryError):
        return False
    junction = getattr(stat, "IO_REPARSE_TAG_MOUNT_POINT", None)
    return stat.S_ISLNK(about.st_mode) or (
        junction is not None and getattr(about, "st_reparse_tag", 0) == junction)


def has_other_names(path: Path) -> bool:
    """Whether a file has a second name (a hard link), perhaps outside its folder: to be checked
    before it is changed in place or passed on; replacing does not affect the other name."""
    about = os.lstat(path)
    return stat.S_ISREG(about.st_mode) and about.st_nlink > 1


def _link_error(path: Path) -> InputError:
    return InputError(f"{path} is a link.",
                      "It may point outside its folder, where Limber must not read or write.",
                      "Replace it with a copy of its target, or remove it. If you made it "
                      "yourself, use `limber --follow-links COMMAND ...`.")
