"""The line of each key in a TOML file, which the parser does not report."""

import re

Place = tuple[str | int, ...]

_HEADER = re.compile(r"(\[\[?)([^\]]+)\]")
_PART = r"""(?:[\w-]+|"[^"]*"|'[^']*')"""
_KEY = re.compile(rf"({_PART}(?:\s*\.\s*{_PART})*)\s*=")


def toml_lines(text: str) -> dict[Place, int]:
    """Return the line, from 1, of every table and key: ``("job", 0, "stage", 1, "run")``.

    Text in a multi-line string that looks like a key counts as one, which does no harm.
    """
    found: dict[Place, int] = {(): 1}
    counts: dict[Place, int] = {}
    table: Place = ()
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
            place = table
            for part in _parts(key.group(1)):
                place = (*place, part)
                found.setdefault(place, number)
    return found


def line_of(lines: dict[Place, int], place: Place) -> int:
    """Return the line of ``place``, or of the nearest table that contains it."""
    while place not in lines:
        place = place[:-1]
    return lines[place]


def _parts(text: str) -> list[str]:
    return [part.strip("\"'") for part in re.findall(_PART, text)]
