"""The line of each key in a TOML file, which the parser does not report."""

import re

KeyPath = tuple[str | int, ...]

_HEADER = re.compile(r"(\[\[?)([^\]]+)\]")
_PART = r"""(?:[\w-]+|"[^"]*"|'[^']*')"""
_KEY = re.compile(rf"({_PART}(?:\s*\.\s*{_PART})*)\s*=")


def toml_lines(text: str) -> dict[KeyPath, int]:
    """Return the line, from 1, of every table and key: ``("job", 0, "stage", 1, "run")``.

    Text in a multi-line string that looks like a key counts as one, which does no harm.
    """
    found: dict[KeyPath, int] = {(): 1}
    counts: dict[KeyPath, int] = {}
    table: KeyPath = ()
    for number, line in enumerate(map(str.strip, text.splitlines()), 1):
        if header := _HEADER.match(line):
            table = ()
            parts = _parts(header.group(2))
            for part in parts[:-1]:
                table = (*table, part)
                if table in counts:
                    table = (*table, counts[table] - 1)
            table = (*table, parts[-1])
            if header.group(1) == "[[":
                counts[table] = counts.get(table, 0) + 1
                table = (*table, counts[table] - 1)
            found[table] = number
        elif key := _KEY.match(line):
            key_path = table
            for part in _parts(key.group(1)):
                key_path = (*key_path, part)
                found.setdefault(key_path, number)
    return found


def line_of(lines: dict[KeyPath, int], key_path: KeyPath) -> int:
    """Return the line of ``key_path``, or of the nearest table that contains it."""
    while key_path not in lines:
        key_path = key_path[:-1]
    return lines[key_path]


def _parts(text: str) -> list[str]:
    return [part.strip("\"'") for part in re.findall(_PART, text)]
