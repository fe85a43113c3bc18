"""Tables of other programs: header, columns, units and time, whatever their names.

A recorder's own CSV has the format of :mod:`limber.recordings.time_series`. Others separate by
semicolons or tabs, write a preamble above the header, put units in brackets, call time "Time Stamp"
and count it in milliseconds. Here they are converted to streams in SI units on input.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from limber.core.constants import FORCE_UNITS_N, UNIT_METRES
from limber.core.errors import InputError
from limber.core.files import text_columns
from limber.core.files.text_columns import LENGTHS, plain
from limber.recordings.table_parts.capture_titles import capture_preamble
from limber.recordings.table_parts.clocks import (
    TIME_UNITS_S,
    in_seconds,
    is_time,
    unit_in_name,
)
from limber.recordings.table_parts.rows import (
    fields_of,
    first_numbers,
    is_clock,
    number_of,
    section_of,
    separator_of,
    text_of,
    words_in,
)
from limber.recordings.table_parts.serial_log import without_arrows
from limber.recordings.time_series import Stream, in_order

LENGTH_UNITS_M = {spelt: UNIT_METRES[unit] for spelt, unit in LENGTHS.items()}
FORCE_NAMES_N = FORCE_UNITS_N | {
    "newton": 1.0, "newtons": 1.0, "lb": FORCE_UNITS_N["lbf"], "kg": FORCE_UNITS_N["kgf"],
    **dict.fromkeys(("g", "gram", "grams"), FORCE_UNITS_N["gf"])}
"""Force units in newtons, including their names in titles."""
ANGLE_UNITS_RAD = {"rad": 1.0, "deg": np.pi / 180}
TORQUE_UNITS_NM = {"Nm": 1.0, "Nmm": 1e-3, "mNm": 1e-3}

_UNITS = {unit.lower() for unit in (*LENGTH_UNITS_M, *FORCE_NAMES_N, *TIME_UNITS_S,
                                    *ANGLE_UNITS_RAD, *TORQUE_UNITS_NM)}
_DECIMAL_COMMA = re.compile(r"[-+]?\d+,\d+(?:[eE][-+]?\d+)?")
_RATE_OFF = 0.02
"""Relative difference of a stated rate from that of the stamps that is reported."""
_COUNTERS = r"frames?|samples?|index|framenumber"


@dataclass
class Table:
    """A table as read from a file.

    Attributes:
        path: The file.
        titles: Titles of the columns, as written (a row of units below them is appended in
        brackets).
        values: Shape [n, columns]; NaN in cells without a number. Dates and times of day are
            seconds.
        warnings: Faults that were found.
        clocks: Columns that were dates or times of day.
        rate_hz: Frames per second, if the file states it.
        unit: Unit of lengths without one in their titles, if the file states it.
    """

    path: Path
    titles: list[str]
    values: np.ndarray
    warnings: list[str] = field(default_factory=list)
    clocks: tuple[int, ...] = ()
    rate_hz: float | None = None
    unit: str | None = None


@dataclass(frozen=True)
class Title:
    """A column's name without its unit, and the unit if it names one."""

    name: str
    unit: str | None

    @property
    def plain(self) -> str:
        """Lower-case letters and digits alone."""
        return plain(self.name)


def read_table(path: str | Path) -> Table:
    """Read a text table of numbers.

    Raises:
        InputError: it cannot be read, has no row of numbers, or no header above them.
    """
    path = Path(path)
    text = text_of(path)
    lines = without_arrows(section_of(text.splitlines()))
    bare = [line for line in lines if not line.lstrip().startswith(("#", "%"))]
    comments = [line.lstrip()[1:].strip() for line in lines if line not in bare]
    separator = separator_of(bare)
    rows = [fields_of(line, separator) for line in bare]
    first, width = first_numbers(path, rows)
    capture = capture_preamble(rows[:first], width, comments)
    titles = capture.titles or _titles(rows[:first], comments, width, separator)
    if titles is None:
        raise InputError(f"{path} has no header line with {width} column names.",
                         "The columns cannot be identified without names.",
                         "Add a first line such as t_s,x_m,y_m,z_m.")
    table = Table(path, titles, np.empty((0, width)), rate_hz=capture.rate_hz,
                  unit=capture.unit or text_columns.stated_unit("\n".join(comments)))
    words = words_in(rows[first])
    table.clocks = tuple(k for k, part in enumerate(rows[first]) if is_clock(part))
    table.values = _numbers(table, bare[first:], rows[first:], text.endswith(("\n", "\r")), words)
    return _without_words(table, words)


def _without_words(table: Table, words: list[int]) -> Table:
    """The table without its text columns."""
    if not words:
        return table
    kept = [k for k in range(len(table.titles)) if k not in words]
    table.warnings.append(f"{table.path.name}: columns of words are not used: "
                          f"{', '.join(table.titles[k] for k in words)}.")
    return replace(table, titles=[table.titles[k] for k in kept], values=table.values[:, kept],
                   clocks=tuple(kept.index(k) for k in table.clocks))


def split_title(title: str) -> Title:
    """Split the unit from a column's name: :func:`limber.core.files.text_columns.split_title`."""
    return Title(*text_columns.split_title(title, _UNITS))


def scale_of(title: Title, units: dict[str, float], default: str, where: Path) -> float:
    """Return the factor to SI of a column.

    Raises:
        InputError: its unit is none of ``units``.
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
    return next((k for k, title in enumerate(table.titles) if is_time(split_title(title).name)),
                None)


def time_stream(table: Table, rate_hz: float | None = None, *, keep_repeated: bool = False,
                ) -> Stream:
    """Return the table with its time stamps [s] in order; other columns keep their titles.

    Args:
        table: The table.
        rate_hz: Rows per second, if it has no stamps.
        keep_repeated: Keep all rows of the same stamp.

    Raises:
        InputError: there is no column of times (and no ``rate_hz``), or the rows are too few or too
        disordered.
    """
    titles = [split_title(title) for title in table.titles]
    at = time_column(table)
    warnings = list(table.warnings)
    rate_hz = rate_hz or table.rate_hz
    used: tuple[int, ...] = ()
    if (parts := _split_stamps(titles)) and (at is None or at in parts):
        used = parts
        times = table.values[:, parts[0]] + 1e-9 * table.values[:, parts[1]]
    elif at is not None:
        times, notes, used = _stamps(table, titles, at)
        warnings += notes
    elif rate_hz is not None:
        at = next((k for k, title in enumerate(titles) if re.fullmatch(_COUNTERS, title.plain)),
                  None)
        used = () if at is None else (at,)
        count = np.arange(float(len(table.values))) if at is None else table.values[:, at]
        times = (count - np.nanmin(count, initial=np.inf)) / rate_hz
    else:
        raise InputError(
            f"{table.path} has the columns {', '.join(table.titles)}.",
            "No column is named time (t_s, Time (ms), timestamp, ...).",
            "Rename the column of time stamps, or give --rate-hz.")
    kept = [k for k in range(len(titles)) if k not in used]
    times, values = in_order(table.path, times, table.values[:, kept], warnings,
                             keep_repeated=keep_repeated)
    if len(times) < 2:
        raise InputError(f"{table.path} has {len(times)} complete rows.",
                         "A pull needs at least two samples.", "Record it again.")
    return Stream(times, values, tuple(table.titles[k] for k in kept), tuple(warnings))


def at_rate(table: Table, rate_hz: float) -> Stream:
    """Return the table with a stated number of rows per second, whatever its stamps.

    The first row keeps its stamp [s], if that is known. A column that counts the rows shows missing
    ones.

    Raises:
        InputError: the rows are too few.
    """
    titles = [split_title(title) for title in table.titles]
    stamps = {k for k, title in enumerate(titles) if is_time(title.name)} | set(
        _split_stamps(titles) or ())
    kept = [k for k in range(len(titles)) if k not in stamps]
    bare = time_stream(replace(table, titles=[table.titles[k] for k in kept], clocks=(),
                               values=table.values[:, kept]), rate_hz)
    try:
        stamped = time_stream(table, keep_repeated=True)
    except InputError:
        # There are no stamps, or they cannot be used.
        return bare
    length, stated = (float(np.ptp(each.times)) for each in (stamped, bare))
    warnings = bare.warnings if abs(stated / length - 1) < _RATE_OFF else (
        *bare.warnings,
        f"{table.path.name}: {len(bare)} rows at {rate_hz:g} per second last {stated:.4g} s, but "
        f"their stamps span {length:.4g} s. The stated rate is used.")
    return replace(bare, times=stamped.times[0] + bare.times, warnings=warnings)


def _stamps(table: Table, titles: list[Title], at: int,
            ) -> tuple[np.ndarray, list[str], tuple[int, ...]]:
    """Times [s] of a column of stamps, the assumptions made, and the columns used."""
    title, values = titles[at], table.values[:, at]
    other = next((k for k in table.clocks if k != at and is_time(titles[k].name)), None)
    if at in table.clocks and other is not None:
        # A date and the time of that day.
        return values + table.values[:, other], [], (at, other)
    unit = title.unit or unit_in_name(title.name)
    if unit is not None and at not in table.clocks:
        scale_of(title, TIME_UNITS_S, unit, table.path)
    times, notes = in_seconds(f"{table.path}: the column {title.name!r}", values,
                              unit.lower() if unit else None, at in table.clocks)
    return times, notes, (at,)


def _split_stamps(titles: list[Title]) -> tuple[int, int] | None:
    """The columns of a ROS stamp: seconds, and nanoseconds beside them."""
    names = [title.plain for title in titles]
    whole = next((k for k, name in enumerate(names) if re.search(r"stampsecs?$", name)), None)
    part = next((k for k, name in enumerate(names) if re.search(r"stampn(ano)?secs?$", name)), None)
    return None if whole is None or part is None else (whole, part)


def marker_stream(path: str | Path, unit: str | None = None, rate_hz: float | None = None,
                  ) -> tuple[Stream, list[str]]:
    """Read marker tracks: three columns per marker, named LABEL and x, y or z in any usual form.

    Args:
        path: The file.
        unit: Unit of the positions; None uses the titles' own, or metres if they have none.
        rate_hz: Frames per second, if there is no time column.

    Returns:
        Columns ``m0_x_m, m0_y_m, m0_z_m, ...`` [m], and the markers' labels.

    Raises:
        InputError: no marker has all three coordinates.
    """
    table = read_table(path)
    stream = time_stream(table, rate_hz)
    columns = _column_indices(stream.columns)
    whole = {label: at for label, at in columns.items() if set(at) == set("xyz")}
    if not whole:
        raise InputError(f"{path} has the columns {', '.join(stream.columns)}.",
                         "No marker has x, y and z columns.",
                         "Name them LABEL_x_m, LABEL_y_m, LABEL_z_m.")
    used = [at[letter] for at in whole.values() for letter in "xyz"]
    scales = [LENGTH_UNITS_M[unit] if unit else
              scale_of(split_title(stream.columns[k]), LENGTH_UNITS_M, table.unit or "m",
                       Path(path)) for k in used]
    halves = [k for label, at in columns.items() if label not in whole for k in at.values()]
    named = {k for at in columns.values() for k in at.values()}
    ignored = [title for k, title in enumerate(stream.columns) if k not in named]
    ignored += [stream.columns[k] for k in halves]
    warnings = list(stream.warnings)
    if ignored:
        warnings.append(f"{Path(path).name}: columns not used: {', '.join(ignored)}.")
    # In C order: otherwise sums over selected columns would differ in their last digits.
    values = np.ascontiguousarray(stream.values[:, used]) * scales
    positions = values.reshape(len(stream), -1, 3)
    return marker_tracks(stream.times, positions, warnings), list(whole)


def _column_indices(titles: Sequence[str]) -> dict[str, dict[str, int]]:
    """The columns of each marker's coordinates, by its label and by x, y and z."""
    indices: dict[str, dict[str, int]] = {}
    for column, title in enumerate(titles):
        name = split_title(title).name
        match = re.fullmatch(r"(.*?)[\s_.:\-]*([xyz])", name, re.IGNORECASE)
        if match and not re.search(r"rot|quat|angle", name, re.IGNORECASE):
            indices.setdefault(match.group(1).strip() or "m0", {})[match.group(2).lower()] = column
    return indices


def marker_tracks(times: np.ndarray, positions: np.ndarray, warnings: Sequence[str] = (),
                  ) -> Stream:
    """Return marker tracks as a stream: ``m0_x_m``, ``m0_y_m``, ``m0_z_m``, ``m1_x_m``, ...

    Args:
        times: [s], shape [n].
        positions: [m], shape [n, m, 3]. Motion capture writes (0, 0, 0) or NaN for an invisible
            marker.
        warnings: Faults of the file.
    """
    seen = positions.copy(order="K")
    seen[np.all(positions == 0.0, axis=2)] = np.nan
    columns = tuple(f"m{k}_{axis}_m" for k in range(positions.shape[1]) for axis in "xyz")
    return Stream(times, seen.reshape(len(times), -1), columns, tuple(warnings))


def same_label(one: str, other: str) -> bool:
    """Whether two names denote the same marker: ``Tip - 1`` and ``tip1``."""
    return _bare(one) == _bare(other)


def _bare(label: str) -> str:
    # A subject's name before a colon, as Vicon writes it, is not the marker's.
    return re.sub(r"[^a-z0-9]", "", label.rsplit(":", 1)[-1].lower())


def _titles(above: list[list[str]], comments: list[str], width: int, separator: str | None,
            ) -> list[str] | None:
    """The lowest title line with as many names; units in the next line are appended."""
    fitting = [row for row in above if len(row) == width and _is_named(row)]
    if not fitting:
        fitting = [row for comment in comments
                   if len(row := fields_of(comment, separator)) == width and _is_named(row)]
    if not fitting:
        # LabVIEW's comment column is mostly empty.
        fitting = [row[:width] for row in above[-1:] if len(row) > width and _is_named(row[:width])]
    if not fitting:
        return None
    units = _units(fitting[-1]) if len(fitting) > 1 else None
    if units is None:
        return fitting[-1]
    return [f"{name} ({unit})" if unit else name
            for name, unit in zip(fitting[-2], units, strict=True)]


def _is_named(row: list[str]) -> bool:
    words = [part for part in row if part and number_of(part, True) is None]
    return len(words) >= max(1, (len(row) + 1) // 2)


def _units(row: list[str]) -> list[str] | None:
    bare = [part.strip("()[] ") for part in row]
    return bare if all(not part or part.lower() in _UNITS for part in bare) else None


def _numbers(table: Table, lines: list[str], rows: list[list[str]], complete: bool,
             words: list[int]) -> np.ndarray:
    name, width = table.path.name, len(table.titles)
    comma = any(_DECIMAL_COMMA.fullmatch(part) for row in rows[:50] for part in row)
    kept, bad = [], []
    for index, row in enumerate(rows):
        numbers = [np.nan if k in words else number_of(part, comma) for k, part in enumerate(row)]
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
