"""Motion capture titles in several rows: Motive, Vicon Nexus, Qualisys, OpenSim's TRC.

One row has the letters of the axes, a row above it the markers' names, and in some formats a row
below it the units. The quantity and the rate are in a preamble.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass

_RATES = ("exportframerate", "framerate", "captureframerate", "frequency", "datarate",
          "camerarate", "samplerate", "samplingrate", "samplefrequency", "samplingfrequency")
_UNITS = ("lengthunits", "units")
_KINDS = ("position", "rotation", "markerquality", "meanmarkererror", "quality", "error")
_TYPES = ("marker", "rigid body marker", "bone marker", "rigid body", "bone")
"""Motive's types that count as markers; the first one present is used."""


@dataclass(frozen=True)
class Preamble:
    """Content of the rows above the numbers of a capture.

    Attributes:
        titles: Titles of the columns; those of markers are ``NAME:X``, with a unit if rows have it.
            None if they do not span several rows.
        rate_hz: Frames per second, if stated.
        unit: Unit of length, if the preamble states one, as spelled in the file.
    """

    titles: list[str] | None
    rate_hz: float | None
    unit: str | None


def capture_preamble(above: Sequence[Sequence[str]], width: int,
                     comments: Sequence[str] = ()) -> Preamble:
    """Return what the rows above the numbers state about a capture.

    Args:
        above: Cells of these rows.
        width: Number of columns of numbers.
        comments: Lines of comments, without their marks.
    """
    rows = [[*row[:width], *[""] * (width - len(row))] for row in above]
    at = next((k for k in reversed(range(len(rows))) if len(above[k]) <= width + 1
               and sum(_axis(cell) is not None for cell in rows[k]) >= 3), None)
    titles = _without_axes(above, width) if at is None or at == 0 else _titled(rows, at)
    is_qualisys = any(row and _letters(row[0]) == "markernames" for row in above)
    rate = _stated(above, _RATES) or _stated(
        [_pair(line) for line in (*comments, *map(" ".join, above))], _RATES)
    if rate is None and titles is not None:
        # Vicon writes the rate alone in a row.
        rate = next((row[0] for row in above if row and _is_number(row[0])
                     and not any(row[1:])), None)
    unit = _stated(above, _UNITS)
    return Preamble(titles, float(rate) if rate and _is_number(rate) and float(rate) else None,
                    unit or ("mm" if is_qualisys else None))


def _titled(rows: list[list[str]], at: int) -> list[str] | None:
    axes = [_axis(cell) for cell in rows[at]]
    columns = [k for k, axis in enumerate(axes) if axis]
    named = next((row for row in rows[:at] if "name" in (_letters(row[0]), _letters(row[1]))),
                 None) or next((row for row in reversed(rows[:at]) if row[columns[0]]
                                and not _is_kind(row)), None)
    if named is None:
        return None
    labels = _filled(named, columns)
    kinds = _filled(next((row for row in rows[:at] if _is_kind(row)), []), columns)
    types = _filled(next((row for row in rows[:at] if "type" in (_letters(row[0]),
                                                               _letters(row[1]))), []), columns)
    present = {kind.lower() for kind in types.values()}
    chosen = next((kind for kind in _TYPES if kind in present), None)
    units = rows[at + 1] if at + 1 < len(rows) else []
    titles = []
    for k, axis in enumerate(axes):
        if axis is None:
            own = rows[at][k] or (named[k] if k < min(columns) else "")
            titles.append(own or f"column {k + 1}")
        elif kinds.get(k, "position").lower() != "position" or (
                chosen is not None and types.get(k, "").lower() != chosen):
            titles.append(f"{labels.get(k, '')} {axis} of {types.get(k, '')} {kinds.get(k, '')} "
                          "rotation, not used")
        else:
            unit = f" ({units[k].strip('()[] ')})" if k < len(units) and units[k] else ""
            titles.append(f"{labels.get(k, 'm0')}:{axis}{unit}")
    return titles


def _without_axes(above: Sequence[Sequence[str]], width: int) -> list[str] | None:
    """Qualisys names its markers only in the preamble."""
    names = next(([cell for cell in row[1:] if cell] for row in above
                  if row and _letters(row[0]) == "markernames"), None)
    if names is None or width - 3 * len(names) not in (0, 1, 2):
        return None
    if any(len(row) == width and _letters(row[0]) in ("frame", "time") for row in above):
        return None
    return [*("Frame", "Time (s)")[:width - 3 * len(names)],
            *(f"{name}:{axis}" for name in names for axis in "XYZ")]


def _filled(row: Sequence[str], columns: Sequence[int]) -> dict[int, str]:
    """A row's cells at columns; an empty one takes the value to its left."""
    found, last = {}, ""
    for k in columns:
        last = (row[k] if k < len(row) else "") or last
        if last:
            found[k] = last
    return found


def _is_kind(row: Sequence[str]) -> bool:
    words = {_letters(cell) for cell in row if cell}
    return "position" in words and words <= set(_KINDS)


def _stated(above: Sequence[Sequence[str]], keys: Sequence[str]) -> str | None:
    """The value after one of the keys, or below it."""
    for key in keys:
        for row, below in zip(above, [*above[1:], []], strict=False):
            at = next((k for k, cell in enumerate(row) if _letters(cell) == key), None)
            if at is None:
                continue
            for value in (row[at + 1:at + 2], below[at:at + 1]):
                if value and value[0] and not (keys is _RATES and not _is_number(value[0])) and (
                        _letters(value[0]) not in (*_RATES, *_UNITS, "origdatarate")):
                    return value[0]
    return None


def _pair(line: str) -> list[str]:
    """``Sampling rate [Hz]: 200`` or ``Sample Rate = 200 Hz``, as cells of a row."""
    found = re.fullmatch(r"\W*([a-z ]+?)\s*[(\[]?(?:hz)?[)\]]?\s*[:=\s]\s*([\d.]+)\s*(?:hz)?\W*",
                         line.lower())
    return list(found.groups()) if found else []


def _axis(cell: str) -> str | None:
    found = re.fullmatch(r"([XYZxyz])\d*", cell)
    return found.group(1).upper() if found else None


def _letters(cell: str) -> str:
    return re.sub(r"[^a-z]", "", cell.lower())


def _is_number(text: str) -> bool:
    return re.fullmatch(r"\d+(\.\d*)?", text) is not None
