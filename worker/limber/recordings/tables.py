"""Tables of other programs: header, columns, units and time, whatever their names.

A recorder's own CSV has the format of :mod:`limber.recordings.time_series`. Others separate by
semicolons or tabs, write a preamble above the header, put units in brackets, call time "Time Stamp"
and count it in milliseconds. Here they are converted to streams in SI units on input.
"""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.constants import FORCE_UNITS_N, UNIT_METRES
from limber.core.errors import InputError, Option, Text
from limber.core.files import text_columns
from limber.recordings.recording import POSE_COLUMNS, WRENCH_COLUMNS
from limber.recordings.time_series import (
    TIME_UNITS_S,
    Stream,
    clock_seconds,
    in_order,
    in_seconds,
    is_time,
    unit_in_name,
)

# The lines of a table as text, split into fields, and the start of its numbers.

_COLUMN = _SAMPLE = 20
"""Rows that make single numbers a column; last lines from which the separator is taken."""


def section_of(lines: list[str]) -> list[str]:
    """Return the lines that are not empty; of a Vicon file only its trajectories, of a LabVIEW file
    those below its headers."""
    ends = [k for k, line in enumerate(lines) if line.startswith("***End_of_Header***")]
    if ends:
        return [line for line in lines[ends[-1] + 1:] if line.strip()]
    begin = next((k for k, line in enumerate(lines)
                  if line.strip('",;\t \ufeff').lower() == "trajectories"), None)
    if begin is None:
        return [line for line in lines if line.strip()]
    end = next((k for k in range(begin, len(lines)) if not lines[k].strip(",;\t ")), len(lines))
    return lines[begin:end]


def is_clock(part: str) -> bool:
    """Return whether a field is a date or a time of day."""
    return text_columns.number_of(part, True) is None and clock_seconds(part) is not None


def text_of(path: Path) -> str:
    """Return the text of a file; InputError if it cannot be read, or is not text."""
    try:
        return path.read_text(encoding=text_columns.coding_of(path), errors="replace")
    except text_columns.ColumnsError as error:
        raise InputError(error.seen, error.why, error.fix) from error
    except OSError as error:
        raise InputError(f"{path} cannot be read ({error}).", "A CSV file was expected.",
                         "Check the path and the file.") from error


def number_of(text: str, comma: bool) -> float | None:
    """Return a number, a date or time of day in seconds, NaN for an empty field, None for a word;
    ``comma``: whether decimals may be commas."""
    number = text_columns.number_of(text, comma)
    if number is None:
        return clock_seconds(text)
    return None if np.isinf(number) else number


def first_numbers(path: Path, rows: list[list[str]]) -> tuple[int, int]:
    """Return the index of the first row of the longest table of numbers, and the number of its
    fields; InputError if there is none. A testing machine writes a table of results above."""
    best = longest = index = 0
    while index < len(rows):
        length = _length(rows, index)
        if length > longest:
            best, longest = index, length
        index += max(length, 1)
    if longest:
        return best, len(rows[best])
    raise InputError(f"{path} has no row of numbers." if rows else f"{path} is empty.",
                     "A header and rows of numbers were expected.",
                     "Check the file, or export it again.")


def _length(rows: list[list[str]], index: int) -> int:
    """Rows of a table of numbers that begins here; 0 if none does."""
    row, words = rows[index], words_in(rows[index])
    known = [part for part in row if part.lower() not in text_columns.MISSING]
    follows = rows[index + 1] if index + 1 < len(rows) else row
    # A preamble (NO_OF_FRAMES 600) also has numbers, but never two consecutive rows of several
    # numbers, nor words at the same positions twice.
    if not ((len(row) > 1 or _is_column(rows[index:index + _COLUMN])) and (
            len(known) - len(words) > len(row) // 2) and (
            not words or (words == words_in(follows) and len(words) <= len(row) // 3)) and (
            len(follows) == len(row) or index + 2 >= len(rows))):
        return 0
    return next((k - index for k in range(index + 1, len(rows))
                 if len(rows[k]) > 1 and len(words_in(rows[k])) == len(rows[k])), len(rows) - index)


def _is_column(rows: list[list[str]]) -> bool:
    """Whether these are readings alone: a preamble has fewer single numbers below each other."""
    return len(rows) == _COLUMN and all(len(row) == 1 and not words_in(row) for row in rows)


def words_in(row: list[str]) -> list[int]:
    """Return which fields are neither numbers nor empty."""
    return [k for k, part in enumerate(row) if number_of(part, True) is None]


# Motion capture titles in several rows: Motive, Vicon Nexus, Qualisys, OpenSim's TRC.
#
# One row has the letters of the axes, a row above it the markers' names, and in some formats a row
# below it the units. The quantity and the rate are in a preamble.

_RATES = ("exportframerate", "framerate", "captureframerate", "frequency", "datarate",
          "camerarate", "samplerate", "samplingrate", "samplefrequency", "samplingfrequency")
_UNIT_KEYS = ("lengthunits", "units")
_KINDS = ("position", "rotation", "markerquality", "meanmarkererror", "quality", "error")
_TYPES = ("marker", "rigid body marker", "bone marker", "rigid body", "bone")
"""Motive's types that count as markers; the first one present is used."""


@dataclass(frozen=True)
class Preamble:
    """Content of the rows above a capture's numbers: titles, those of markers ``NAME:X`` with a
    unit if rows have it (None if they do not span several rows), frames per second, and the unit of
    length as spelled in the file."""

    titles: list[str] | None
    rate_hz: float | None
    unit: str | None


def capture_preamble(above: Sequence[Sequence[str]], width: int,
                     comments: Sequence[str] = ()) -> Preamble:
    """Return what the cells above ``width`` columns of numbers, and comments without their marks,
    state about a capture."""
    rows = [[*row[:width], *[""] * (width - len(row))] for row in above]
    at = next((k for k in reversed(range(len(rows))) if len(above[k]) <= width + 1
               and sum(_axis(cell) is not None for cell in rows[k]) >= 3), None)
    titles = _without_axes(above, width) if at is None or at == 0 else _titled(rows, at)
    is_qualisys = any(row and _letters(row[0]) == "markernames" for row in above)
    rate = _stated(above, _RATES) or _stated(
        [_pair(line) for line in (*comments, *map(" ".join, above))], _RATES)
    if rate is None and titles is not None:
        # Vicon writes the rate alone in a row.
        rate = next((row[0] for row in above if row and _is_plain_number(row[0])
                     and not any(row[1:])), None)
    unit = _stated(above, _UNIT_KEYS)
    has_rate = rate and _is_plain_number(rate) and float(rate)
    return Preamble(titles, float(rate) if rate and has_rate else None,
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
                if value and value[0] and (keys is not _RATES or _is_plain_number(value[0])) and (
                        _letters(value[0]) not in (*_RATES, *_UNIT_KEYS, "origdatarate")):
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


def _is_plain_number(text: str) -> bool:
    return re.fullmatch(r"\d+(\.\d*)?", text) is not None


# Logs of the Arduino IDE's serial monitor: ``14:03:05.123 -> 0.25,1.5``.

_LINE = re.compile(r"\s*(\d{1,2}:\d{2}:\d{2}(?:[.,]\d+)?)\s*->\s?(.*)")
_PAIR = re.compile(r"([^\W\d][^:=]*)[:=]([-+.\d].*)")
"""A reading as the serial plotter takes it: ``force:2.5``."""


def without_arrows(lines: list[str]) -> list[str]:
    """Return the lines of such a log as a table with titles, other lines as they are; what the
    board prints before its first reading goes, but for the titles right above."""
    found = [_LINE.fullmatch(line) for line in lines]
    if 2 * sum(one is not None for one in found) <= len(lines):
        return lines
    stamped = [(one[1], re.sub(r"\s*([:=])\s*", r"\1", one[2])) for one in found if one is not None]
    separator = text_columns.separator_of([rest for _, rest in stamped[-_SAMPLE:]])
    rows = [(stamp, text_columns.fields_of(rest, separator)) for stamp, rest in stamped]
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
        named = len(above) == width and not any(map(_is_reading, above))
        titles = above if named else [f"reading_{k + 1}" for k in range(width)]
    return ["\t".join(("time", *titles)),
            *("\t".join((stamp, *row)) for stamp, row in rows[first:])]


def _are_numbers(row: list[str]) -> bool:
    return all(map(_is_reading, row))


def _is_reading(part: str) -> bool:
    return part != "" and number_of(part, True) is not None


LENGTH_UNITS_M = {spelt: UNIT_METRES[unit] for spelt, unit in text_columns.LENGTHS.items()}
FORCE_NAMES_N = FORCE_UNITS_N | {
    "newton": 1.0, "newtons": 1.0, "lb": FORCE_UNITS_N["lbf"], "kg": FORCE_UNITS_N["kgf"],
    **dict.fromkeys(("g", "gram", "grams"), FORCE_UNITS_N["gf"])}
"""Force units in newtons, including their names in titles."""
ANGLE_UNITS_RAD = {"rad": 1.0, "deg": np.pi / 180}
TORQUE_UNITS_NM = {"Nm": 1.0, "Nmm": 1e-3, "mNm": 1e-3}

_UNITS = {unit.lower() for unit in (*LENGTH_UNITS_M, *FORCE_NAMES_N, *TIME_UNITS_S,
                                    *ANGLE_UNITS_RAD, *TORQUE_UNITS_NM)}
_RATE_OFF = 0.02
"""Relative difference of a stated rate from that of the stamps that is reported."""
_COUNTERS = r"frames?|samples?|index|framenumber"


@dataclass
class Table:
    """A table as read: titles as written (with a row of units below them in brackets), values [n,
    columns] with NaN for no number and dates and times of day (columns ``clocks``) in seconds;
    frames per second and the unit of untitled lengths, if the file states them."""

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
        return text_columns.plain(self.name)


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
    separator = text_columns.separator_of(bare[-_SAMPLE:])
    rows = [text_columns.fields_of(line, separator) for line in bare]
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
    end = first + _length(rows, first)
    table.values = _numbers(table, bare[first:end], rows[first:end],
                            end < len(rows) or text.endswith(("\n", "\r")), words)
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
    """Return the factor to SI of a column; InputError if its unit is none of ``units``."""
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
    """Return the table with its time stamps [s] in order, or from its rows per second; rows of the
    same stamp may be kept, other columns keep their titles. InputError without times and rate, or
    if the rows are too few or too disordered."""
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
        raise InputError(f"{table.path} has the columns {', '.join(table.titles)}.", "No column is "
                         "named time (t_s, Time (ms), timestamp, ...).", "Rename the column of "
                         "time stamps, or give ", Option("rate_hz"), ".")
    kept = [k for k in range(len(titles)) if k not in used]
    times, values = in_order(table.path, times, table.values[:, kept], warnings,
                             keep_repeated=keep_repeated)
    if len(times) < 2:
        raise InputError(f"{table.path} has too few complete rows ({len(times)}).",
                         "A pull needs at least two samples.", "Record it again.")
    return Stream(times, values, tuple(table.titles[k] for k in kept), tuple(warnings))


def at_rate(table: Table, rate_hz: float) -> Stream:
    """Return the table with a stated number of rows per second, whatever its stamps. The first row
    keeps its stamp [s], if known; a column that counts the rows shows missing ones. InputError if
    the rows are too few."""
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
    """Read marker tracks, three columns per marker named LABEL and x, y or z in any usual form:
    columns ``m0_x_m, m0_y_m, m0_z_m, ...`` [m], and labels. ``unit`` overrides the titles',
    ``rate_hz`` stands for a missing time column. InputError if no marker has all three."""
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
    """Return marker tracks [m], shape [n, m, 3], as a stream ``m0_x_m``, ``m0_y_m``, ...; motion
    capture writes (0, 0, 0) or NaN for an invisible marker."""
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
        fitting = [row for row in (text_columns.fields_of(each, separator) for each in comments)
                   if len(row) == width and _is_named(row)]
    if not fitting:
        # LabVIEW's comment column is mostly empty.
        fitting = [row[:width] for row in above[-1:] if len(row) > width and _is_named(row[:width])]
    if not fitting:
        return None
    units = _units(fitting[-1]) if len(fitting) > 1 else None
    if units is None:
        return fitting[-1]
    return text_columns.with_units(fitting[-2], units)


def _is_named(row: list[str]) -> bool:
    words = [part for part in row if part and number_of(part, True) is None]
    return len(words) >= max(1, (len(row) + 1) // 2)


def _units(row: list[str]) -> list[str] | None:
    bare = [part.strip("()[] ") for part in row]
    return bare if all(not part or part.lower() in _UNITS for part in bare) else None


def _numbers(table: Table, lines: list[str], rows: list[list[str]], complete: bool,
             words: list[int]) -> np.ndarray:
    name, width = table.path.name, len(table.titles)
    comma = any(text_columns.DECIMAL_COMMA.fullmatch(part) for row in rows[:50] for part in row)
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


# Robot tables: the gripper's pose and wrench, whatever the names of the columns.

_ALIASES = {
    **{f"{a}_m": (a, f"p{a}", f"pos{a}", f"position{a}", f"tcp{a}", f"actualtcppose{k}",
                  f"otee{12 + k}") for k, a in enumerate("xyz")},
    **{f"r{a}_rad": (f"r{a}", f"rot{a}", f"rotvec{a}", f"tcpr{a}", f"actualtcppose{k}")
       for k, a in enumerate("xyz", 3)},
    **{f"f{a}_n": (f"f{a}", f"force{a}", f"tcpf{a}", f"actualtcpforce{k}", f"ofexthatk{k}")
       for k, a in enumerate("xyz")},
    **{f"t{a}_nm": (f"t{a}", f"m{a}", f"torque{a}", f"actualtcpforce{k}", f"ofexthatk{k}")
       for k, a in enumerate("xyz", 3)}}
_QUATERNION = {f"q{a}": f"orientation{a}" for a in "xyzw"}
_IN_TOPICS = {**{f"{a}_m": f"position{a}" for a in "xyz"},
              **{f"f{a}_n": f"force{a}" for a in "xyz"},
              **{f"t{a}_nm": f"torque{a}" for a in "xyz"}}
"""Last parts of the names in ROS messages, whatever topic precedes them."""
_ANGLES = (("roll", "pitch", "yaw"), ("c", "b", "a"))
"""About the fixed axes x, y, z in turn: of most programs, and of KUKA's A, B, C."""
_TRANSFORM = "otee"
"""Franka's ``O_T_EE``, by columns."""
_ROBOT_UNITS = {"m": (LENGTH_UNITS_M, "m"), "rad": (ANGLE_UNITS_RAD, "rad"),
          "n": (FORCE_NAMES_N, "N"), "nm": (TORQUE_UNITS_NM, "Nm")}


def robot_stream(path: str | Path, force_unit: str | None = None,
                 rate_hz: float | None = None) -> Stream:
    """Read a robot's table: the columns x_m .. rz_rad, fx_n .. tz_nm; NaN if not measured. Known
    names are our own, those of UR's RTDE (``actual_TCP_pose_0``) and Franka's libfranka
    (``O_T_EE_0``, ``O_F_ext_hat_K_0``), and short ones with a unit; a rotation may be a quaternion
    qx .. qw, or angles roll, pitch, yaw or KUKA's A, B, C. ``force_unit`` overrides the titles',
    ``rate_hz`` stands for a missing time column. InputError if the gripper's position is
    missing."""
    table = read_table(path)
    stream = time_stream(table, rate_hz)
    titles = _known([split_title(title) for title in stream.columns])
    values, warnings = {}, list(stream.warnings)
    for name, aliases in _ALIASES.items():
        at = next((k for k, title in enumerate(titles) if title.plain in aliases), None)
        if at is not None:
            values[name] = stream.values[:, at] * _scale(name, titles[at], force_unit, Path(path))
    missing = [name for name in POSE_COLUMNS[:3] if name not in values]
    if missing:
        raise InputError(f"{path} lacks {', '.join(missing)}.",
                         "The gripper's pose in the branch's frame is needed.",
                         f"Columns: t_s, {', '.join(POSE_COLUMNS + WRENCH_COLUMNS)}.")
    if force_unit is None and any(title.plain == "fx" and not title.unit for title in titles):
        warnings.append(Text(f"{Path(path).name}: the columns of the force state no unit. Newtons "
                             "are assumed; state another with ", Option("force_unit", "kgf"), "."))
    _add_rotation(values, titles, stream, warnings, Path(path))
    unmeasured = np.full(len(stream), np.nan)
    found = np.column_stack([values.get(name, unmeasured) for name in _ALIASES])
    return Stream(stream.times, found, tuple(_ALIASES), tuple(warnings))


def is_robot_table(titles: list[Title]) -> bool:
    """Return whether the columns hold a gripper's position and force, as a robot's log does."""
    plain = {title.plain for title in _known(titles)}
    return all(plain & set(_ALIASES[name]) for name in (*POSE_COLUMNS[:3], *WRENCH_COLUMNS[:3]))


def _known(titles: list[Title]) -> list[Title]:
    """Titles of ROS topics and of TUM's trajectories, renamed to our names."""
    plain = [title.plain for title in titles]
    if {"tx", "ty", "tz", "qx", "qy", "qz", "qw"} <= set(plain) and not (
            set(_ALIASES["x_m"]) & set(plain)):
        # TUM's translation; without a quaternion it is a torque.
        positions = {f"t{a}": f"p{a}" for a in "xyz"}
        return [Title(positions.get(title.plain, title.name), title.unit) for title in titles]
    renamed = list(titles)
    for name, aliases in _ALIASES.items():
        end = _IN_TOPICS.get(name)
        if end and not set(aliases) & set(plain):
            at = next((k for k, letters in enumerate(plain) if letters.endswith(end)), None)
            if at is not None:
                renamed[at] = Title(aliases[0], titles[at].unit)
    for part, end in _QUATERNION.items():
        at = next((k for k, letters in enumerate(plain) if letters.endswith(end)), None)
        if at is not None and part not in plain:
            renamed[at] = Title(part, None)
    return renamed


def _scale(name: str, title: Title, force_unit: str | None, path: Path) -> float:
    kind = name.rpartition("_")[2]
    if force_unit and kind in ("n", "nm"):
        return FORCE_UNITS_N[force_unit]
    return scale_of(title, *_ROBOT_UNITS[kind], path)


def _add_rotation(values: dict[str, np.ndarray], titles: list[Title], stream: Stream,
                  warnings: list[str], path: Path) -> None:
    if all(name in values for name in POSE_COLUMNS[3:]):
        vectors = np.column_stack([values[name] for name in POSE_COLUMNS[3:]])
        longest = float(np.nanmax(np.linalg.norm(vectors, axis=1), initial=0.0))
        if longest > 2 * np.pi:
            raise InputError(f"{path.name}: the gripper's rotation vector is {longest:.3g} rad.",
                             "A rotation has at most 6.28 rad. These are likely degrees.",
                             "Name the unit in the titles: rx_deg, ry_deg, rz_deg.")
        return
    at = {title.plain: k for k, title in enumerate(titles)}
    angles = next((names for names in _ANGLES if set(names) <= set(at)), None)
    if all(name in at for name in ("qx", "qy", "qz", "qw")):
        turns = _of_quaternions(stream.values[:, [at["qx"], at["qy"], at["qz"], at["qw"]]])
    elif f"{_TRANSFORM}0" in at:
        columns = [at[f"{_TRANSFORM}{k}"] for k in (0, 4, 8, 1, 5, 9, 2, 6, 10)]
        turns = Rotation.from_matrix(stream.values[:, columns].reshape(-1, 3, 3)).as_rotvec()
    elif angles is not None:
        turns = _of_angles({name: stream.values[:, at[name]] * scale_of(
            titles[at[name]], ANGLE_UNITS_RAD, "rad", path) for name in angles}, path)
    else:
        warnings.append(Text("The robot's table has no rotation, so the gripper is assumed not to "
                             "rotate. With a point grasp (", Option("grasp_mode", "point"),
                             ") that changes nothing."))
        turns = np.zeros((len(stream), 3))
    values |= dict(zip(POSE_COLUMNS[3:], turns.T, strict=True))


def _of_quaternions(quaternions: np.ndarray) -> np.ndarray:
    """Rotation vectors [n, 3]; a quaternion of length 0 is no rotation."""
    length = np.linalg.norm(quaternions, axis=1)
    known = np.isfinite(length) & (length > 1e-6)
    turns = np.full((len(quaternions), 3), np.nan)
    turns[known] = Rotation.from_quat(quaternions[known]).as_rotvec()
    return turns


def _of_angles(angles: dict[str, np.ndarray], path: Path) -> np.ndarray:
    """Rotation vectors [n, 3] of angles [rad] about the fixed axes x, y, z in turn."""
    largest = max(np.nanmax(np.abs(values), initial=0) for values in angles.values())
    if largest > 2 * np.pi + 1e-3:
        raise InputError(f"{path}: the angles {', '.join(angles)} reach {largest:.4g}, in radians.",
                         "They seem to be degrees.",
                         f"Name the unit in their titles, such as {next(iter(angles))} [deg].")
    known = np.isfinite(list(angles.values())).all(axis=0)
    turns = np.full((len(known), 3), np.nan)
    turns[known] = Rotation.from_euler("xyz", np.column_stack(list(angles.values()))[known]
                                       ).as_rotvec()
    return turns
