"""Logs of the Arduino IDE's serial monitor: ``14:03:05.123 -> 0.25,1.5``."""

import re
from collections import Counter

from limber.recordings.table_parts.rows import fields_of, number_of, separator_of

_LINE = re.compile(r"\s*(\d{1,2}:\d{2}:\d{2}(?:[.,]\d+)?)\s*->\s?(.*)")
_PAIR = re.compile(r"([^\W\d][^:=]*)[:=]([-+.\d].*)")
"""A reading as the serial plotter takes it: ``force:2.5``."""


def without_arrows(lines: list[str]) -> list[str]:
    """Return the lines of such a log as a table with titles; other lines as they are.

    What the board prints before its first reading is left out, but for the titles right above.
    """
    found = [_LINE.fullmatch(line) for line in lines]
    if 2 * sum(one is not None for one in found) <= len(lines):
        return lines
    stamped = [(one[1], re.sub(r"\s*([:=])\s*", r"\1", one[2])) for one in found if one is not None]
    separator = separator_of([rest for _, rest in stamped])
    rows = [(stamp, fields_of(rest, separator)) for stamp, rest in stamped]
    pairs = [[_PAIR.fullmatch(part) for part in row] for _, row in rows]
    titles = next(([pair[1] for pair in row if pair] for row in pairs if row and all(row)), [])
    if titles:
        rows = [(stamp, [pair[2] if pair else part for pair, part in zip(row, own, strict=True)])
                for (stamp, own), row in zip(rows, pairs, strict=True)]
    widths = Counter(len(row) for _, row in rows if _are_numbers(row))
    # The first line of a log is often a part of one.
    width = widths.most_common(1)[0][0] if widths else 0
    first = next((k for k, (_, row) in enumerate(rows)
                  if len(row) == width and _are_numbers(row)), len(rows))
    above = rows[first - 1][1] if first else []
    if len(titles) != width:
        named = len(above) == width and not any(map(_is_number, above))
        titles = above if named else [f"reading_{k + 1}" for k in range(width)]
    return ["\t".join(("time", *titles)),
            *("\t".join((stamp, *row)) for stamp, row in rows[first:])]


def _are_numbers(row: list[str]) -> bool:
    return all(map(_is_number, row))


def _is_number(part: str) -> bool:
    return part != "" and number_of(part, True) is not None
