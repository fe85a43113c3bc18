"""Files that a command line names otherwise than by a path: ``-`` and quoted patterns."""

import glob
import shutil
import sys
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import click

from limber.core.errors import Command, InputError

_MARKS = (b"ply", b"# .PCD", b"LASF", b"ASTM-E57", b"glTF", b"solid", b"VERSION")
"""Content that is recognised without a suffix begins so, or has zero bytes."""


@contextmanager
def input_files(arguments: list[click.Parameter], typed: Mapping[str, Any],
                ) -> Iterator[dict[str, Any]]:
    """Return what was typed, with a file that holds standard input for ``-``, and for a pattern the
    file that matches it. InputError if several match."""
    found = dict(typed)
    with ExitStack() as held:
        for name in (each.name for each in arguments if isinstance(each, click.Argument)):
            path = found.get(name)
            if path == Path("-") and not sys.stdin.isatty():
                folder = held.enter_context(tempfile.TemporaryDirectory(prefix="limber-stdin-"))
                found[name] = _held(sys.stdin.buffer, Path(folder))
            elif isinstance(path, Path) and glob.has_magic(str(path)) and not path.exists():
                found[name] = _match(path)
        yield found


def _held(stream: Any, folder: Path) -> Path:
    head = stream.read(1 << 12)
    path = folder / ("stdin" if b"\0" in head or head.startswith(_MARKS) else "stdin.txt")
    with open(path, "wb") as file:
        file.write(head)
        shutil.copyfileobj(stream, file)
    return path


def _match(pattern: Path) -> Path:
    matches = sorted(glob.glob(str(pattern)))
    if len(matches) > 1:
        raise InputError(f"{len(matches)} files match {pattern}: {', '.join(matches[:5])}"
                         f"{', ...' if len(matches) > 5 else '.'}", "This command takes one.",
                         "Name one of them. ", Command("batch"), " runs many.")
    return Path(matches[0]) if matches else pattern
