"""Tables of points as text: names of columns, units and numbers.

Imports numpy but not Limber: ``addon/text_columns.py`` is a copy, so that worker and add-on read
alike. ``scripts/make_addon_schema`` makes the copy; a test compares the two.
"""

import codecs
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

# Relative, since the add-on has copies of both files.
from .column_titles import LENGTHS, OTHER_LENGTHS, plain, split_title, stated_unit, three_of

_COUNTERS = ("id", "index", "idx", "nr", "no", "number", "row", "point", "pointid", "pointnumber")
_MISSING = ("", "nan", "na", "n/a", "null", "none", "-")
_COLMAP, _HEAD = "POINT3D_ID", 1000  # in the first characters of COLMAP's points3D.txt
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")
_LINES = 20_000
"""Lines read at a time: numpy holds the interpreter lock meanwhile."""
_MOST_HEAD = 60
"""Most lines above the numbers that are examined."""


class ColumnsError(ValueError):
    """A table cannot be read: what was ``seen``, ``why`` it is wrong, how to ``fix`` it."""

    def __init__(self, seen: str, why: str, fix: str):
        self.seen, self.why, self.fix = seen, why, fix
        super().__init__(f"{seen} {why} {fix}")


@dataclass(frozen=True)
class Columns:
    """A table of points.

    Attributes:
        names: In lower case, without units; coordinates are x, y, z.
        titles: Titles as in the file.
        values: Shape [n, columns].
        unit: Unit of the coordinates, one of the values of :data:`LENGTHS`, if the file states it.
        notes: Parts of the file that were not used.
    """

    names: list[str]
    titles: list[str]
    values: np.ndarray
    unit: str | None = None
    notes: tuple[str, ...] = ()


def decoded(raw: bytes) -> str:
    """Return the text of a file in UTF-8, UTF-16 or, as spreadsheets write it, a Windows code page.
    """
    for mark, coding in ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"),
                         (codecs.BOM_UTF16_BE, "utf-16")):
        if raw.startswith(mark):
            return raw.decode(coding, errors="replace")
    try:
        return raw.decode("utf-8")
    except UnicodeDecodeError:
        return raw.decode("cp1252", errors="replace")


def read_columns(path: Path) -> Columns:
    """Read the columns of a text file.

    Numbers are separated by blanks, tabs, commas or semicolons. Lines above them may name the
    columns and state a unit. The number of points may precede the points of each scan. Decimals may
    be commas if commas are not separators.

    Raises:
        ColumnsError: there are no numbers, too few columns, coordinates of several or unknown
            units, or a line that does not fit; the message names it.
    """
    text = decoded(path.read_bytes()).replace('"', "")
    if _COLMAP in text[:_HEAD] or _has_tracks(text):
        return _colmap(path, text)
    every = [line for line in text.splitlines() if line.strip()]
    lines = [line for line in every if not _is_comment(line)]
    if not lines:
        raise ColumnsError(f"{path} has no lines with numbers.", "A point cloud was expected.",
                           "Export it again.")
    comments = [line.lstrip(" #/") for line in every[:_MOST_HEAD] if _is_comment(line)]
    lines = _without_counts(lines)
    # The lines above do not show how numbers are written.
    separator = _separator(lines[len(lines) // 2])
    first = _first_row(lines, separator)
    head, lines = lines[:first], lines[first:]
    if not lines:
        raise ColumnsError(f"{path} has a header but no points.", "A point cloud was expected.",
                           "Export it again.")
    titles = _titles(path, head, lines, separator)
    used, values, notes = _numbers(path, lines, separator, text, titles)
    if values.shape[1] < 3:
        raise ColumnsError(f"{path} has {values.shape[1]} columns.",
                           "Coordinates need three columns.", "Export it again.")
    if (len(titles) == values.shape[1] - 1 and _counts_up(values[:, 0])) or (
            0 not in used and len(titles) == max(used)):
        # R's write.table writes no title for its row names.
        titles = ["", *titles]
    titles = [titles[k] for k in used] if len(titles) > max(used) else []
    titles = titles or _commented(comments, separator, values)
    if len(titles) != values.shape[1]:
        titles = ["x", "y", "z", *_guessed(values[:, 3:], path.suffix.lower() == ".pts")]
    names, unit = _named(path, titles)
    return Columns(names, titles, values, unit or stated_unit("\n".join([*comments, *head])),
                   notes)


def _colmap(path: Path, text: str) -> Columns:
    """COLMAP's points3D.txt without the images of each point; their number varies."""
    names = ["point3d_id", "x", "y", "z", "red", "green", "blue", "error"]
    cut = [" ".join(line.split()[:len(names)]) for line in text.splitlines()]
    lines = [line for line in cut if line and not _is_comment(line)]
    if not lines:
        raise ColumnsError(f"{path} has no points.", "A COLMAP reconstruction was expected.",
                           "Export it again.")
    values = _numbers(path, lines, None, "\n".join(cut), names)[1]
    if values.shape[1] < len(names):
        raise ColumnsError(f"{path}, line {_place(text, lines[0])} has {values.shape[1]} values.",
                           f"A point of COLMAP has at least {len(names)}: {', '.join(names)}.",
                           "Export it again.")
    return Columns(names, names, values)


def _has_tracks(text: str) -> bool:
    """Whether these are COLMAP's points without its comments: rows end with pairs of numbers."""
    rows = [line.split() for line in text[:_HEAD].splitlines()[:-1]]
    widths = {len(row) for row in rows}
    return len(widths) > 1 and min(widths) >= 8 and not any(width % 2 for width in widths) and all(
        row[0].isdigit() and all(part.isdigit() and int(part) < 256 for part in row[4:7])
        for row in rows)


def _without_counts(lines: list[str]) -> list[str]:
    """Lines without counts of the points that follow: first, below titles, at each scan."""
    start = next((k for k, line in enumerate(lines[:2]) if line.strip().isdigit()), None)
    if start is None or start + 1 == len(lines):
        return lines
    kept = lines[:start]
    while start < len(lines) and lines[start].strip().isdigit():
        stop = start + 1 + int(lines[start])
        kept += lines[start + 1:stop]
        start = stop
    return kept + lines[start:]


def _counts_up(column: np.ndarray) -> bool:
    return column[0] in (0, 1) and bool((np.diff(column) == 1).all())


def _is_comment(line: str) -> bool:
    start = line.lstrip()
    return start.startswith(("#", "%")) or (start.startswith("//") and not start[2:3].isalpha())


def _separator(line: str) -> str | None:
    for mark in (";", "\t"):
        if mark in line:
            return mark
    blanks = line.split()
    if len(blanks) > 2 and all(_DECIMAL_COMMA.fullmatch(part) for part in blanks):
        return None
    return "," if "," in line else None


def _parts(line: str, separator: str | None) -> list[str]:
    if separator is None:
        # A unit in brackets belongs to the title before it.
        line = re.sub(r"\s+(?=[\[(])", "", line)
    parts = [part.strip() for part in line.split(separator)]
    # Some programs end each line with a separator.
    return parts[:-1] if len(parts) > 3 and parts[-1] == "" else parts


def _number(part: str, commas: bool) -> float | None:
    """A number of a table; NaN for a missing-value word, None for any other word."""
    if part.lower() in _MISSING:
        return float("nan")
    try:
        return float(part.replace(",", ".") if commas else part)
    except ValueError:
        return None


def _first_row(lines: list[str], separator: str | None) -> int:
    """Index of the first line of numbers."""
    for index, line in enumerate(lines[:_MOST_HEAD]):
        parts = _parts(line, separator)
        numbers = [_number(part, separator != ",") for part in parts]
        known = [number for number in numbers if number is not None]
        # A row of a table may contain words besides numbers, but they are never the majority.
        if len(known) >= max(3, (len(parts) + 1) // 2) and not all(np.isnan(known)):
            return index
    return int(any(part[:1].isalpha() for part in _parts(lines[0], separator)))


def _titles(path: Path, head: list[str], lines: list[str], separator: str | None) -> list[str]:
    """Titles of the columns; none if no line above the numbers names coordinates."""
    for index in reversed(range(len(head))):
        line = head[index]
        other = separator if separator is None or separator in line else _separator(line)
        titles = _parts(line, other)
        if three_of("position", _bare(titles)) is None:
            continue
        units = [part.strip("()[] ") for part in _parts(head[index + 1], other)] if (
            index + 1 < len(head)) else []
        if len(units) == len(titles) and any(unit.lower() in LENGTHS for unit in units):
            return [f"{title} ({unit})" if unit else title
                    for title, unit in zip(titles, units, strict=True)]
        return titles
    last = _parts(head[-1], separator) if head else []
    if last and len(last) == len(_parts(lines[0], separator)):
        raise ColumnsError(f"{path} has the columns {', '.join(_bare(last))[:200]}.",
                           "x, y and z are missing.", "Name the coordinates x, y, z.")
    return []


def _commented(comments: list[str], separator: str | None, values: np.ndarray) -> list[str]:
    """Titles in a comment that names coordinates and the right number of columns."""
    for comment in reversed(comments):
        for mark in (separator, _separator(comment)):
            titles = _parts(comment, mark)
            counts = [k for k, title in enumerate(titles) if plain(title) in _COUNTERS]
            if len(titles) == values.shape[1] and three_of("position", _bare(titles)) and (
                    (values[:, counts] % 1 == 0).all()):
                return titles
    return []


def _bare(titles: Iterable[str]) -> list[str]:
    """Titles without units of length, in lower case."""
    found = []
    for title in titles:
        name, unit = split_title(title.lower().lstrip("/#").strip(), LENGTHS)
        is_length = unit is not None and unit in (*LENGTHS, *OTHER_LENGTHS)
        found.append(name if is_length else title.lower().lstrip("/#").strip())
    return found


def _named(path: Path, titles: list[str]) -> tuple[list[str], str | None]:
    """Names of columns, and the unit of the coordinates if their titles state it."""
    names = _bare(titles)
    axes = three_of("position", names)
    if axes is None:
        return names, None
    units = {split_title(titles[k].lower(), LENGTHS)[1] for k in axes}
    for k, axis in zip(axes, "xyz", strict=True):
        names[k] = axis
    if units == {None}:
        return names, None
    found = {LENGTHS.get(unit or "") for unit in units}
    if len(found) > 1 or None in found:
        raise ColumnsError(f"{path}: the coordinates are called "
                           f"{', '.join(titles[k] for k in axes)}.",
                           "They must have one unit, out of m, cm, mm, um and in.",
                           "Convert the columns, or correct their titles.")
    return names, found.pop()


def _numbers(path: Path, lines: list[str], separator: str | None, text: str,
             titles: Sequence[str]) -> tuple[list[int], np.ndarray, tuple[str, ...]]:
    """Which columns are numeric, their values, and what the others are."""
    commas = separator != ","
    ending = separator is not None and lines[0].rstrip().endswith(separator)
    parts = []
    try:
        # In chunks: a copy of all would take several times the file's size.
        for start in range(0, len(lines), _LINES):
            rows = lines[start:start + _LINES]
            clean = (line.replace(",", ".") for line in rows) if commas else iter(rows)
            if ending:
                clean = (line.rstrip().removesuffix(separator or "") for line in clean)
            parts.append(np.loadtxt(clean, delimiter=separator, ndmin=2))
        values = np.concatenate(parts)
        return list(range(values.shape[1])), values, ()
    except ValueError:
        pass
    return _with_words(path, lines, separator, text, titles)


def _with_words(path: Path, lines: list[str], separator: str | None, text: str,
                titles: Sequence[str]) -> tuple[list[int], np.ndarray, tuple[str, ...]]:
    """The numbers of a table with missing values, or with columns of words beside named ones."""
    width = len(_parts(lines[0], separator))
    rows = [[_number(part, separator != ",") for part in _parts(line, separator)]
            for line in lines]
    if len(titles) == width - 1:
        titles = ["", *titles]
    sample = [row for row in rows[:_MOST_HEAD] if len(row) == width]
    axes = three_of("position", _bare(titles)) if len(titles) == width else None
    words = [k for k in range(width) if axes is not None and k not in axes
             and all(row[k] is None for row in sample)]
    for line, row in zip(lines, rows, strict=True):
        parts = _parts(line, separator)
        if len(row) != width:
            raise ColumnsError(f"{path}, line {_place(text, line)} has {len(row)} values, but the "
                               f"first line has {width}.", "The file may be truncated.",
                               "Export it again, or correct that line.")
        bad = next((k for k in range(width) if k not in words and row[k] is None), None)
        if bad is not None:
            raise ColumnsError(f"{path}, line {_place(text, line)}: {parts[bad].strip()[:30]!r} is "
                               "not a number.",
                               "Each line of a cloud holds the numbers of one point.",
                               "Correct that line.")
    used = [k for k in range(width) if k not in words]
    notes = tuple(f"Column {titles[k]!r} holds words and was not read." for k in words)
    return used, np.array([[row[k] for k in used] for row in rows], float), notes


def _place(text: str, line: str) -> int:
    return next((k for k, other in enumerate(text.splitlines(), start=1)
                 if other.startswith(line)), 1)


def _guessed(extra: np.ndarray, intensity_first: bool) -> list[str]:
    """Names of unnamed columns [n, k] after x, y, z, in the order of scanners and CloudCompare.

    Of four columns, a scanner writes intensity and colour, CloudCompare colour and a scalar. If
    their values are ambiguous, ``intensity_first`` decides.
    """
    count = extra.shape[1]
    if count == 3:
        return ["red", "green", "blue"]
    if count == 4:
        before, after = _are_bytes(extra[:, :3]), _are_bytes(extra[:, 1:])
        if after and (intensity_first or not before):
            return ["intensity", "red", "green", "blue"]
        if before:
            return ["red", "green", "blue", "scalar_0"]
    if count == 6:
        return ["red", "green", "blue", "nx", "ny", "nz"]
    return [f"scalar_{k}" for k in range(count)]


def _are_bytes(columns: np.ndarray) -> bool:
    return bool(((columns >= 0) & (columns <= 255) & (columns % 1 == 0)).all())
