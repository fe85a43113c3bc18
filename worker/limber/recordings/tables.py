"""Tables of other programs: where header, columns, units and time are, whatever they are called.

A recorder's own CSV has what :mod:`limber.recordings.time_series` reads. Others separate by
semicolons or tabs, write a preamble above the header, put units in brackets, call time "Time
Stamp" and count it in milliseconds; here they become streams in SI units, at the door.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from limber.core.constants import FORCE_UNITS_N
from limber.core.errors import InputError
from limber.recordings.time_series import Stream, in_order

LENGTH_UNITS_M = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "um": 1e-6, "in": 0.0254, "metres": 1.0,
                  "meters": 1.0, "millimetres": 1e-3, "millimeters": 1e-3, "inch": 0.0254}
FORCE_NAMES_N = FORCE_UNITS_N | {
    "newton": 1.0, "newtons": 1.0, "lb": FORCE_UNITS_N["lbf"], "kg": FORCE_UNITS_N["kgf"],
    **dict.fromkeys(("g", "gram", "grams"), FORCE_UNITS_N["gf"])}
"""Also what titles call them."""
TIME_UNITS_S = {"s": 1.0, "sec": 1.0, "secs": 1.0, "second": 1.0, "seconds": 1.0, "ms": 1e-3,
                "msec": 1e-3, "milliseconds": 1e-3, "us": 1e-6, "ns": 1e-9, "min": 60.0}
ANGLE_UNITS_RAD = {"rad": 1.0, "deg": np.pi / 180}
TORQUE_UNITS_NM = {"Nm": 1.0, "Nmm": 1e-3, "mNm": 1e-3}

_UNITS = {unit.lower() for unit in (*LENGTH_UNITS_M, *FORCE_NAMES_N, *TIME_UNITS_S,
                                    *ANGLE_UNITS_RAD, *TORQUE_UNITS_NM)}
_TIME_NAME = r"t|time|times|timestamp|timestamps|elapsed|elapsedtime|clock"
_EMPTY = ("", "nan", "na", "n/a", "null", "none", "-")


@dataclass
class Table:
    """A table as read from a file.

    Attributes:
        path: The file.
        titles: Of the columns, as written (a row of units below them is joined in brackets).
        values: Shape [n, columns]; NaN in cells without a number.
        warnings: What was wrong.
    """

    path: Path
    titles: list[str]
    values: np.ndarray
    warnings: list[str] = field(default_factory=list)


@dataclass(frozen=True)
class Title:
    """A column's name without its unit, and the unit if it names one."""

    name: str
    unit: str | None

    @property
    def plain(self) -> str:
        """Lower-case letters and digits alone."""
        return re.sub(r"[^a-z0-9]", "", self.name.lower())


def read_table(path: str | Path) -> Table:
    """Read a text table of numbers.

    Raises:
        InputError: it cannot be read, has no row of numbers, or no header above them.
    """
    path = Path(path)
    text = _text(path)
    lines = [line for line in text.splitlines() if line.strip()]
    bare = [line for line in lines if not line.lstrip().startswith(("#", "%"))]
    comments = [line.lstrip()[1:].strip() for line in lines if line not in bare]
    separator = _separator(bare)
    rows = [_fields(line, separator) for line in bare]
    first, width = _first_numbers(path, rows)
    titles = _titles(rows[:first], comments, width, separator)
    if titles is None:
        raise InputError(f"{path} has no header line with {width} column names.",
                         "The columns cannot be identified without names.",
                         "Add a first line such as t_s,x_m,y_m,z_m.")
    table = Table(path, titles, np.empty((0, width)))
    table.values = _numbers(table, bare[first:], rows[first:], text.endswith(("\n", "\r")))
    return table


def split_title(title: str) -> Title:
    """Take the unit off a column's name: ``Force (N)``, ``x [mm]``, ``tip1_x_m``, ``Time_ms``."""
    bracket = re.search(r"[(\[]\s*([^)\]]*)\s*[)\]]\s*$", title)
    if bracket:
        return Title(title[:bracket.start()].strip(), bracket.group(1).strip() or None)
    head, _, tail = title.strip().rpartition("_")
    if head and tail.lower() in _UNITS:
        return Title(head, tail)
    return Title(title.strip(), None)


def scale_of(title: Title, units: dict[str, float], default: str, where: Path) -> float:
    """Return the factor to SI of a column.

    Raises:
        InputError: it names a unit that is none of ``units``.
    """
    unit = title.unit or default
    known = dict(units)
    known |= {key.lower(): value for key, value in units.items() if key.lower() not in known}
    for spelt in (unit, unit.lower()):
        if spelt in known:
            return known[spelt]
    raise InputError(f"{where}: the column {title.name!r} has the unit {unit!r}.",
                     f"Known units: {', '.join(units)}.",
                     "Convert the column, or correct its name.")


def time_column(table: Table) -> int | None:
    """Return which column holds times, if any."""
    return next((k for k, title in enumerate(table.titles)
                 if re.fullmatch(_TIME_NAME, split_title(title).plain)), None)


def time_stream(table: Table, rate_hz: float | None = None) -> Stream:
    """Return the table with its time stamps [s] in order; other columns keep their titles.

    Raises:
        InputError: no column of times (and no ``rate_hz``), or too few or too disordered rows.
    """
    titles = [split_title(title) for title in table.titles]
    at = time_column(table)
    warnings = list(table.warnings)
    if at is not None:
        times = table.values[:, at] * scale_of(titles[at], TIME_UNITS_S, "s", table.path)
        if titles[at].unit is None:
            warnings += _suspicious_clock(table.path, times)
    elif rate_hz is not None:
        at = next((k for k, title in enumerate(titles)
                   if re.fullmatch(r"frames?|samples?|index|framenumber", title.plain)), None)
        count = np.arange(len(table.values)) if at is None else table.values[:, at]
        times = (count - np.nanmin(count)) / rate_hz
    else:
        raise InputError(
            f"{table.path} has the columns {', '.join(table.titles)}.",
            "No column is named time (t_s, Time (ms), timestamp, ...).",
            "Rename the column of time stamps, or give --rate-hz.")
    kept = [k for k in range(len(titles)) if k != at]
    times, values = in_order(table.path, times, table.values[:, kept], warnings)
    if len(times) < 2:
        raise InputError(f"{table.path} has {len(times)} complete rows.",
                         "A pull needs at least two samples.", "Record it again.")
    return Stream(times, values, tuple(table.titles[k] for k in kept), tuple(warnings))


def marker_stream(path: str | Path, unit: str | None = None, rate_hz: float | None = None,
                  ) -> tuple[Stream, list[str]]:
    """Read marker tracks: three columns per marker, named LABEL and x, y or z in any usual form.

    Args:
        path: The file.
        unit: Of the positions; None takes the titles' own, metres where they have none.
        rate_hz: Frames per second, if there is no time column.

    Returns:
        Columns ``m0_x_m, m0_y_m, m0_z_m, ...`` [m], and the markers' labels.

    Raises:
        InputError: no marker has all three coordinates.
    """
    stream = time_stream(read_table(path), rate_hz)
    places = _places(stream.columns)
    whole = {label: at for label, at in places.items() if set(at) == set("xyz")}
    if not whole:
        raise InputError(f"{path} has the columns {', '.join(stream.columns)}.",
                         "No marker has x, y and z columns.",
                         "Name them LABEL_x_m, LABEL_y_m, LABEL_z_m.")
    used = [at[letter] for at in whole.values() for letter in "xyz"]
    scales = [LENGTH_UNITS_M[unit] if unit else
              scale_of(split_title(stream.columns[k]), LENGTH_UNITS_M, "m", Path(path))
              for k in used]
    halves = [k for label, at in places.items() if label not in whole for k in at.values()]
    named = {k for at in places.values() for k in at.values()}
    ignored = [title for k, title in enumerate(stream.columns) if k not in named]
    ignored += [stream.columns[k] for k in halves]
    warnings = list(stream.warnings)
    if ignored:
        warnings.append(f"{Path(path).name}: columns not used: {', '.join(ignored)}.")
    # In C order: sums over what chosen columns give would differ in their last digits.
    values = np.ascontiguousarray(stream.values[:, used]) * scales
    positions = values.reshape(len(stream), -1, 3)
    return marker_tracks(stream.times, positions, warnings), list(whole)


def _places(titles: Sequence[str]) -> dict[str, dict[str, int]]:
    """The columns of each marker's coordinates, by its label and by x, y and z."""
    places: dict[str, dict[str, int]] = {}
    for column, title in enumerate(titles):
        name = split_title(title).name
        match = re.fullmatch(r"(.*?)[\s_.:\-]*([xyz])", name, re.IGNORECASE)
        if match and not re.search(r"rot|quat|angle", name, re.IGNORECASE):
            places.setdefault(match.group(1).strip() or "m0", {})[match.group(2).lower()] = column
    return places


def marker_tracks(times: np.ndarray, positions: np.ndarray, warnings: Sequence[str] = (),
                  ) -> Stream:
    """Return tracks of markers as a stream: ``m0_x_m``, ``m0_y_m``, ``m0_z_m``, ``m1_x_m``, ...

    Args:
        times: [s], shape [n].
        positions: [m], shape [n, m, 3]. Motion capture writes (0, 0, 0) for a marker that it does
            not see, or NaN.
        warnings: What was wrong with the file.
    """
    seen = positions.copy(order="K")
    seen[np.all(positions == 0.0, axis=2)] = np.nan
    columns = tuple(f"m{k}_{axis}_m" for k in range(positions.shape[1]) for axis in "xyz")
    return Stream(times, seen.reshape(len(times), -1), columns, tuple(warnings))


def same_label(one: str, other: str) -> bool:
    """Whether two names mean one marker: ``Tip - 1`` and ``tip1``."""
    return _bare(one) == _bare(other)


def _bare(label: str) -> str:
    # A subject's name before a colon, as Vicon writes it, is not the marker's.
    return re.sub(r"[^a-z0-9]", "", label.rsplit(":", 1)[-1].lower())


def _text(path: Path) -> str:
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error}).", "A CSV file was expected.",
                         "Check the path and the file.") from error
    if raw[:2] in (b"\xff\xfe", b"\xfe\xff"):
        return raw.decode("utf-16", errors="replace")
    try:
        text = raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        text = raw.decode("latin-1")
    if "\x00" in text:
        raise InputError(f"{path} is not a text file.", "A table of numbers was expected.",
                         "Export it as CSV.")
    return text


def _separator(lines: list[str]) -> str | None:
    """The sign between fields; None is white space."""
    sample = lines[-20:]
    for sign in ("\t", ";", ","):
        counts = [line.count(sign) for line in sample]
        # The last line may be cut short.
        if counts and np.median(counts) >= 1 and (
                np.mean(np.array(counts[:-1] or counts) == np.median(counts)) > 0.6):
            return sign
    return None


def _fields(line: str, separator: str | None) -> list[str]:
    parts = line.split(separator) if separator else line.split()
    return [part.strip().strip('"').strip() for part in parts]


def _number(text: str, comma: bool) -> float | None:
    if text.lower() in _EMPTY:
        return np.nan
    try:
        number = float(text.replace(",", ".") if comma else text)
    except ValueError:
        return None
    return None if np.isinf(number) else number


def _first_numbers(path: Path, rows: list[list[str]]) -> tuple[int, int]:
    """Index of the first row of numbers, and how many fields the rows have."""
    for index, row in enumerate(rows):
        parsed = [_number(part, True) for part in row]
        known = [value for value in parsed if value is not None and np.isfinite(value)]
        follows = rows[index + 1] if index + 1 < len(rows) else row
        # A preamble (NO_OF_FRAMES 600) has numbers too, but never two rows of several alike.
        if len(row) > 1 and None not in parsed and len(known) > len(row) // 2 and (
                len(follows) == len(row) or index + 2 >= len(rows)):
            return index, len(row)
    raise InputError(f"{path} has no row of numbers." if rows else f"{path} is empty.",
                     "A header and rows of numbers were expected.",
                     "Check the file, or export it again.")


def _titles(above: list[list[str]], comments: list[str], width: int, separator: str | None,
            ) -> list[str] | None:
    """The lowest line above the numbers with as many names; a line of units below it joins in."""
    fitting = [row for row in above if len(row) == width and _is_named(row)]
    if not fitting:
        fitting = [row for comment in comments
                   if len(row := _fields(comment, separator)) == width and _is_named(row)]
    if not fitting:
        return None
    units = _units(fitting[-1]) if len(fitting) > 1 else None
    if units is None:
        return fitting[-1]
    return [f"{name} ({unit})" if unit else name
            for name, unit in zip(fitting[-2], units, strict=True)]


def _is_named(row: list[str]) -> bool:
    words = [part for part in row if part and _number(part, True) is None]
    return len(words) >= max(1, (len(row) + 1) // 2)


def _units(row: list[str]) -> list[str] | None:
    bare = [part.strip("()[] ") for part in row]
    return bare if all(not part or part.lower() in _UNITS for part in bare) else None


def _numbers(table: Table, lines: list[str], rows: list[list[str]], complete: bool) -> np.ndarray:
    name, width = table.path.name, len(table.titles)
    comma = any(re.fullmatch(r"-?\d+,\d+", part) for row in rows[:50] for part in row)
    kept, bad = [], []
    for index, row in enumerate(rows):
        numbers = [_number(part, comma) for part in row]
        # A separator at the line's end makes an empty field.
        if len(numbers) == width + 1 and row[-1] == "":
            numbers = numbers[:-1]
        is_last = index == len(rows) - 1
        whole = len(numbers) == width and None not in numbers
        if is_last and (not whole or not complete):
            # Without an end of line even a last line of full length may have lost digits.
            table.warnings.append(f"{name}: the last line is incomplete and was discarded.")
        elif whole:
            kept.append(numbers)
        else:
            bad.append(index)
    if len(bad) > 0.05 * len(rows):
        raise InputError(f"{table.path}: {len(bad)} of {len(rows)} rows do not have {width} "
                         f"numbers. The first is {lines[bad[0]][:60]!r}.",
                         "The table is not reliable.", "Correct or delete those lines.")
    if bad:
        table.warnings.append(f"{name}: {len(bad)} row(s) without {width} numbers were discarded. "
                              f"The first is {lines[bad[0]][:40]!r}.")
    return np.array(kept, float).reshape(-1, width)


def _suspicious_clock(path: Path, times: np.ndarray) -> list[str]:
    step = float(np.median(np.diff(times[np.isfinite(times)]))) if len(times) > 2 else 0.0
    if step < 1.0 or np.any(times != np.round(times)):
        return []
    return [f"{path.name}: the time column does not state a unit and has steps of {step:g}. "
            "Seconds are assumed. If it is in milliseconds, rename the column to t_ms."]
