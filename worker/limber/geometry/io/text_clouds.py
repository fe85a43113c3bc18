"""Clouds as text: XYZ, TXT, CSV and their kin, as scanners, spreadsheets and programs write them.
"""

import codecs
import re
from pathlib import Path

import numpy as np

from limber.core.errors import InputError

_AXES = (("x", "y", "z"), ("points:0", "points:1", "points:2"), ("pos_x", "pos_y", "pos_z"),
         ("easting", "northing", "height"), ("easting", "northing", "elevation"),
         ("easting", "northing", "altitude"), ("easting", "northing", "z"))
_COLMAP, _COLMAP_HEAD = "POINT3D_ID", 1000  # in the first characters of COLMAP's points3D.txt
_UNIT = re.compile(r"[\s_]*[\[(](m|cm|mm|in)[\])]$|_(m|cm|mm)$")
_DECIMAL_COMMA = re.compile(r"[-+]?\d*,\d+([eE][-+]?\d+)?")


def read_table(path: Path) -> tuple[list[str], list[str], np.ndarray]:
    """Read the columns of a text file.

    Returns:
        Names in lower case, without units, coordinates as x, y, z; the same as the file has them;
        and the numbers, shape [n, columns].

    Numbers stand between blanks, tabs, commas or semicolons; a header may name the columns, the
    number of points may come before the points of each scan, and decimals may be commas where
    commas do not separate.

    Raises:
        InputError: no numbers, too few columns, or a line that does not fit, which is named.
    """
    text = _decoded(path.read_bytes()).replace('"', "")
    if _COLMAP in text[:_COLMAP_HEAD]:
        return _colmap(path, text)
    lines = [line for line in text.splitlines() if line.strip() and not _is_comment(line)]
    if not lines:
        raise InputError(f"{path} has no lines with numbers.", "A point cloud was expected.",
                         "Export it again.")
    lines = _without_counts(lines)
    # A header says little of how numbers are written.
    separator = _separator(lines[min(1, len(lines) - 1)])
    names, titles = _header(path, lines, separator)
    if names:
        lines = lines[1:]
    if not lines:
        raise InputError(f"{path} has a header but no points.", "A point cloud was expected.",
                         "Export it again.")
    table = _numbers(path, lines, separator, text)
    if table.shape[1] < 3:
        raise InputError(f"{path} has {table.shape[1]} columns.", "Coordinates need three columns.",
                         "Export it again.")
    if len(names) == table.shape[1] - 1 and _counts_up(table[:, 0]):
        # R's write.table gives no title to its row names.
        names, titles = ["", *names], ["", *titles]
    if len(names) != table.shape[1]:
        names = titles = ["x", "y", "z", *_guessed(table[:, 3:], path.suffix.lower() == ".pts")]
    return names, titles, table


def _colmap(path: Path, text: str) -> tuple[list[str], list[str], np.ndarray]:
    """Columns of COLMAP's points3D.txt, without the images that saw each point: as many as did."""
    names = ["point3d_id", "x", "y", "z", "red", "green", "blue", "error"]
    cut = [" ".join(line.split()[:len(names)]) for line in text.splitlines()]
    lines = [line for line in cut if line and not _is_comment(line)]
    if not lines:
        raise InputError(f"{path} has no points.", "A COLMAP reconstruction was expected.",
                         "Export it again.")
    return names, names, _numbers(path, lines, None, "\n".join(cut))


def _without_counts(lines: list[str]) -> list[str]:
    """Lines without those that say how many points follow: first, below titles, at each scan."""
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


def _decoded(raw: bytes) -> str:
    for mark, coding in ((codecs.BOM_UTF8, "utf-8-sig"), (codecs.BOM_UTF16_LE, "utf-16"),
                         (codecs.BOM_UTF16_BE, "utf-16")):
        if raw.startswith(mark):
            return raw.decode(coding, errors="replace")
    return raw.decode("utf-8", errors="replace")


def _is_comment(line: str) -> bool:
    start = line.lstrip()
    return start.startswith("#") or (start.startswith("//") and not start[2:3].isalpha())


def _separator(line: str) -> str | None:
    for mark in (";", "\t"):
        if mark in line:
            return mark
    blanks = line.split()
    if len(blanks) > 2 and all(_DECIMAL_COMMA.fullmatch(part) for part in blanks):
        return None
    return "," if "," in line else None


def _parts(line: str, separator: str | None) -> list[str]:
    parts = [part.strip() for part in line.split(separator)]
    # Some programs end each line with a separator.
    return parts[:-1] if len(parts) > 3 and parts[-1] == "" else parts


def _header(path: Path, lines: list[str], separator: str | None) -> tuple[list[str], list[str]]:
    """Names and titles of the columns; both are empty if the first line holds numbers."""
    other = separator if separator is None or separator in lines[0] else _separator(lines[0])
    titles = _parts(lines[0], other)
    names = [_UNIT.sub("", title.lower().lstrip("/#").strip()) for title in titles]
    if not any(name[:1].isalpha() and name not in ("nan", "inf") for name in names):
        return [], []
    for axes in _AXES:
        if set(axes) <= set(names):
            known = dict(zip(axes, "xyz", strict=True))
            return [known.get(name, name) for name in names], titles
    if len(names) == len(_parts(lines[min(1, len(lines) - 1)], separator)):
        raise InputError(f"{path} has the columns {', '.join(names)[:200]}.",
                         "x, y and z are missing.", "Name the coordinates x, y, z.")
    return [], []


def _numbers(path: Path, lines: list[str], separator: str | None, text: str) -> np.ndarray:
    commas = separator != ","
    try:
        # One line at a time: copies of all would take several times the file's size.
        clean = (line.replace(",", ".") for line in lines) if commas else iter(lines)
        if separator is not None and lines[0].rstrip().endswith(separator):
            clean = (line.rstrip().removesuffix(separator) for line in clean)
        return np.loadtxt(clean, delimiter=separator, ndmin=2)
    except ValueError:
        pass
    width = len(_parts(lines[0], separator))
    all_lines = text.splitlines()
    for line in lines:
        parts = _parts(line, separator)
        number = all_lines.index(line) + 1
        if len(parts) != width:
            raise InputError(f"{path}, line {number} has {len(parts)} values, but the first line "
                             f"has {width}.", "The file may be truncated.",
                             "Export it again, or correct that line.")
        for part in parts:
            try:
                float(part.replace(",", ".") if commas else part)
            except ValueError:
                raise InputError(f"{path}, line {number}: {part.strip()[:30]!r} is not a number.",
                                 "Each line of a cloud holds the numbers of one point.",
                                 "Correct that line.") from None
    raise InputError(f"{path} cannot be read as a table of numbers.",
                     "Its lines have different formats.", "Export it again.")


def _guessed(extra: np.ndarray, intensity_first: bool) -> list[str]:
    """Names of unnamed columns [n, k] after x, y, z, as scanners and CloudCompare order them.

    Of four, a scanner writes intensity and colour, CloudCompare colour and a scalar: where their
    values do not tell, ``intensity_first`` does.
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
