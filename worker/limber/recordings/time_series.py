"""Time-stamped tables of a recording, read from CSV and cleaned of sensor faults.

No repair is silent: each adds a sentence to ``warnings``.
"""

import datetime
import re
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from limber.core.errors import Command, InputError, Option
from limber.core.files.reading import read_text
from limber.core.files.tables import write_table
from limber.core.files.text_columns import plain

MAD_TO_SIGMA = 1.4826
"""Ratio of standard deviation to median absolute deviation of a normal variable."""
_SHORTEST_STEP, _LONGEST_STEP = 1e-8, 1e8
"""Between two samples of a recorder, whatever it records [s]."""


@dataclass(frozen=True)
class Stream:
    """Samples at increasing times [s], shape [n]: values [n, columns], NaN if not measured, names
    of the columns, and the file's faults and their repairs."""

    times: np.ndarray
    values: np.ndarray
    columns: tuple[str, ...]
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.times)


def read_stream(path: str | Path) -> Stream:
    """Read a CSV file with a header and a column ``t_s`` [s]. An unfinished last line is dropped,
    rows are sorted, of rows with one stamp the first is kept, each with a warning; empty and
    ``nan`` mean "not measured". InputError without file, times or two rows, for a field that is no
    number, or if a tenth of the rows are out of order (the clock is then unusable)."""
    path = Path(path)
    warnings: list[str] = []
    header, table = _read_rows(path, warnings)
    if "t_s" not in header:
        raise InputError(f"{path} has the columns {', '.join(header)}.",
                         "A column t_s with time stamps in seconds was expected.",
                         "Rename the column, or import the file with ", Command("import-pull"), ".")
    at = header.index("t_s")
    times, values = in_order(path, table[:, at], np.delete(table, at, axis=1), warnings)
    if len(times) < 2:
        raise InputError(f"{path} has too few complete rows ({len(times)}).",
                         "A pull needs at least two samples.", "Record it again.")
    return Stream(times, values, tuple(name for name in header if name != "t_s"), tuple(warnings))


def write_stream(path: str | Path, stream: Stream) -> None:
    """Write a CSV file that :func:`read_stream` reads; NaN becomes an empty field."""
    write_table(path, ("t_s", *stream.columns), (
        (f"{time:.6f}", *row) for time, row in zip(stream.times, stream.values, strict=True)))


def gaps(times: np.ndarray, factor: float = 5.0) -> np.ndarray:
    """Return the intervals (start, end) [s] longer than ``factor`` median steps, shape [g, 2]."""
    steps = np.diff(times)
    wide = steps > factor * np.median(steps)
    return np.column_stack([times[:-1][wide], times[1:][wide]])


def inside_gap(times: np.ndarray, intervals: np.ndarray) -> np.ndarray:
    """Whether each time is strictly within one of the intervals, shape [n] of bool."""
    inside = np.zeros(len(times), bool)
    for start, end in intervals:
        inside |= (times > start) & (times < end)
    return inside


def spikes(values: np.ndarray, half_window: int = 3, threshold: float = 8.0) -> np.ndarray:
    """Find readings, shape [n] of bool, more than ``threshold`` robust deviations off a robust line
    (Theil and Sen) through their window: a fast pull is no spike then, and up to three in a row are
    found."""
    width = 2 * half_window + 1
    if len(values) < width:
        return np.zeros(len(values), bool)
    padded = np.pad(values, ((half_window, half_window), (0, 0)), mode="reflect",
                    reflect_type="odd")
    windows = np.lib.stride_tricks.sliding_window_view(padded, width, axis=0)
    offset = np.arange(width) - half_window
    first, second = np.triu_indices(width, 1)
    slope = np.median((windows[..., second] - windows[..., first])
                      / (offset[second] - offset[first]), axis=2)
    expected = np.median(windows - slope[..., None] * offset, axis=2)
    residual = np.abs(values - expected)
    # One scale for all axes: a sensor's noise is similar in all of them, and an axis that hardly
    # moves does not show it, less one that is not measured.
    varied = residual[np.ix_(residual.any(axis=1), residual.any(axis=0))]
    typical = MAD_TO_SIGMA * np.median(varied) if varied.size else 0.0
    far = residual > threshold * typical + 1e-3 * np.abs(values).max()
    # A spike distorts the line of its neighbours, whose deviations then look large too, but
    # smaller.
    around = np.pad(residual, ((half_window, half_window), (0, 0)))
    largest = np.lib.stride_tricks.sliding_window_view(around, width, axis=0).max(axis=2)
    return np.any(far & (residual > 0.5 * largest), axis=1)


def saturated(values: np.ndarray, run_length: int = 4) -> np.ndarray:
    """Find runs of ``run_length`` or more equal readings at a column's extreme, [n] of bool."""
    flagged = np.zeros(len(values), bool)
    for column in values.T:
        magnitude = np.abs(column)
        peak = np.nanmax(magnitude, initial=0.0)
        at_peak = (magnitude >= peak * (1 - 1e-9)) & (peak > 0)
        flagged |= _long_runs(at_peak, run_length)
    return flagged


def _long_runs(flags: np.ndarray, run_length: int) -> np.ndarray:
    edges = np.flatnonzero(np.diff(np.r_[0, flags.astype(int), 0]))
    kept = np.zeros(len(flags), bool)
    for start, end in edges.reshape(-1, 2):
        kept[start:end] = end - start >= run_length
    return kept


def _read_rows(path: Path, warnings: list[str]) -> tuple[list[str], np.ndarray]:
    """The titles and numbers of a CSV file, shape [n, columns]."""
    text = read_text(path, "a CSV file of a recording")
    lines = [line for line in text.splitlines() if line.strip() and not line.startswith("#")]
    if not lines:
        raise InputError(f"{path} is empty.", "A header and rows of numbers were expected.",
                         "Record it again.")
    header = [name.strip() for name in lines[0].split(",")]
    rows: list[list[float]] = []
    for number, line in enumerate(lines[1:], start=2):
        try:
            numbers = [float(part) if part.strip() else np.nan for part in line.split(",")]
        except ValueError:
            numbers = []
        is_last = number == len(lines)
        # Without an end of line even a last line of full length may have lost digits.
        if (len(numbers) == len(header) and not np.isinf(numbers).any()
                and (not is_last or text.endswith(("\n", "\r")))):
            rows.append(numbers)
        elif is_last:
            warnings.append(f"{path.name}: the last line is incomplete and was discarded.")
        else:
            raise InputError(f"{path}, line {number} is {line[:60]!r}.",
                             f"{len(header)} numbers were expected.",
                             "Correct or delete the line.")
    return header, np.array(rows, float).reshape(-1, len(header))


def in_order(path: Path, times: np.ndarray, values: np.ndarray, warnings: list[str], *,
             keep_repeated: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Sort rows by time and drop those without a stamp, or with another's unless ``keep_repeated``;
    each repair adds to ``warnings``. InputError if a tenth of the stamps run backwards, half are
    not unique, or their steps are no recorder's."""
    finite = np.isfinite(times)
    if not finite.all():
        warnings.append(f"{path.name}: {np.sum(~finite)} rows without a time stamp were "
                        "discarded.")
        times, values = times[finite], values[finite]
    backward = int(np.sum(np.diff(times) < 0))
    if backward and backward >= 0.1 * len(times):
        raise InputError(f"{path}: {backward} of {len(times)} time stamps run backwards.",
                         "The order of the rows is not reliable.",
                         "Check the recorder's clock and the column used as time",
                         *((", or state the readings per second with ", Option("rate_hz"), ".")
                           if keep_repeated else (".",)))
    if backward:
        warnings.append(f"{path.name}: {backward} time stamps are out of order. The rows were "
                        "sorted.")
    order = np.argsort(times, kind="stable")
    times, values = times[order], values[order]
    first = np.flatnonzero(np.diff(times, prepend=-np.inf) > 0)
    step = float(np.median(np.diff(times[first]))) if len(first) > 1 else 1.0
    if not _SHORTEST_STEP <= step <= _LONGEST_STEP:
        raise InputError(f"{path}: the time stamps are {step:.3g} s apart.",
                         f"Recorders take {_SHORTEST_STEP:g} s to {_LONGEST_STEP:g} s.",
                         "Check the column used as time, and its unit.")
    doubled = 0 if keep_repeated else len(values) - len(first)
    if 2 * doubled >= len(values) > 1:
        raise InputError(f"{path}: {doubled} of {len(values)} rows have the time of another row.",
                         "The clock is too coarse, or several rows belong together.",
                         "Give times with more digits; of several markers, one row for each time, "
                         "with columns for each marker.")
    if doubled:
        warnings.append(f"{path.name}: there are {doubled} duplicate time stamps. The first row "
                        "of each was kept.")
        times, values = times[first], values[first]
    return times, values


# Time stamps of other programs: counts in any unit, clocks since 1970, dates as text.

TIME_UNITS_S = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sekunden"), 1.0),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "usecs", "micros", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecond", "nanoseconds"),
                    1e-9), "min": 60.0}
"""Units of time in seconds, by their names in files."""

_WORDS = (r"t|times?|timestamps?|stamp|elapsed|elapsedtime|elapsedsince\w*|clock|clocktime|zeit"
          r"|zeitstempel|uhrzeit|xvalue|temps|tiempo|tempo|pruf?zeit|datetime|date|datum|rostime|systime|systemtime|unixtime|epoch"
          r"|(?:\w*header)?stamp")
_NAME = re.compile(rf"(?:{_WORDS})?(?P<unit>{'|'.join(sorted(TIME_UNITS_S, key=len)[::-1])})?"
                   rf"|(?:{_WORDS})")
_STAMP = re.compile(
    r"(?:(?P<year>\d{4})[-/.](?P<month>\d{1,2})[-/.](?P<day>\d{1,2})"
    r"|(?P<one>\d{1,2})(?P<mark>[./-])(?P<two>\d{1,2})[./-](?P<last>\d{4}))?[ T]*"
    r"(?:(?P<hour>\d{1,3}):(?P<minute>\d{2})(?::(?P<second>\d{2}(?:[.,]\d*)?))?"
    r"\s*(?P<half>[AaPp][Mm])?)?\s*(?:Z|UTC|[+-]\d{2}:?\d{2})?")
_DAY = 86400.0
_LATEST, _EARLIEST = 4e9, 1e9  # [s] since 1970: 2001 to 2096
_FASTEST, _SLOWEST = 2e-4, 0.2  # [s] between samples that are assumed without a unit
_LEAST = 5
"""Fewest stamps from which a clock can be recognised."""


def unit_in_name(name: str) -> str | None:
    """Return the unit that a name such as ``millis`` or ``timestampMs`` states."""
    letters = plain(name)
    found = _NAME.fullmatch(letters)
    return found.group("unit") if found and letters != "ts" else None


def is_time(name: str) -> bool:
    """Whether a column of this name, without its unit, holds time stamps."""
    letters = plain(name)
    return letters not in ("", "s", "min") and _NAME.fullmatch(letters) is not None


def clock_seconds(text: str) -> float | None:
    """Return a date, a time of day, or both in seconds; None for any other text."""
    found = _STAMP.fullmatch(text.strip())
    if not found or not (found["hour"] or found["year"] or found["last"]):
        return None
    seconds = 0.0
    if found["hour"]:
        hour = int(found["hour"])
        if found["half"]:
            hour = hour % 12 + 12 * (found["half"].lower() == "pm")
        seconds = (hour * 3600.0 + 60.0 * int(found["minute"])
                   + float((found["second"] or "0").replace(",", ".")))
    if not (found["year"] or found["last"]):
        return seconds
    if found["year"]:
        year, month, day = (int(found[part]) for part in ("year", "month", "day"))
    else:
        year, month, day = int(found["last"]), int(found["two"]), int(found["one"])
        if month > 12 or (found["mark"] == "/" and day <= 12):
            month, day = day, month
    try:
        date = datetime.datetime(year, month, day, tzinfo=datetime.UTC)
    except ValueError:
        return None
    return date.timestamp() + seconds


def in_seconds(where: str, stamps: np.ndarray, unit: str | None, is_clock: bool,
               ) -> tuple[np.ndarray, list[str]]:
    """Return stamps [n], NaN if missing, in seconds, and the assumptions made; dates and times of
    day are seconds. Counters of 32 bits and clocks of a day are continued over their wrap; 0 among
    dates is invalid. InputError if the unit is neither stated nor determined by the steps."""
    if is_clock:
        return _unwrapped(stamps, _DAY), []
    known = stamps[np.isfinite(stamps)]
    whole = bool((known == np.round(known)).all())
    times = _unwrapped(stamps, 2.0**32) if whole else stamps
    others = known[known != 0]
    if len(others) > 2 and others.min() > max(_EARLIEST, 100 * np.median(np.diff(others))):
        times = np.where(times == 0, np.nan, times)
    scale, notes = (TIME_UNITS_S[unit], []) if unit else _recognised(where, times)
    return times * scale, notes


def _unwrapped(stamps: np.ndarray, period: float) -> np.ndarray:
    """Stamps of a counter that wraps after ``period``, without the jumps."""
    steps = np.diff(np.nan_to_num(stamps))
    if np.nanmax(np.abs(stamps), initial=0.0) > period:
        return stamps
    return stamps + period * np.r_[0, np.cumsum(steps < -0.5 * period)]


def _recognised(where: str, stamps: np.ndarray) -> tuple[float, list[str]]:
    """Seconds per count of stamps without a unit, and the assumption to report."""
    known = stamps[np.isfinite(stamps)]
    if len(known) < 3:
        return 1.0, []
    size, step = float(np.median(np.abs(known))), float(np.median(np.diff(known)))
    for unit in ("ms", "us", "ns"):
        if _EARLIEST < size * TIME_UNITS_S[unit] < _LATEST:
            return TIME_UNITS_S[unit], []
    if step < 1.0:
        return 1.0, []
    fix = "If it has another unit, name it in the title of the column, such as t_s or t_ms."
    if step < 5.0:
        if len(known) < _LEAST:
            return 1.0, [f"{where} does not state a unit and has steps of {step:g}. Seconds are "
                         f"assumed. {fix}"]
        raise InputError(f"{where} does not state a unit and has steps of {step:g}.",
                         "They can be seconds or milliseconds.",
                         "Name the unit in the title of the column: t_s or t_ms.")
    for unit in ("ms", "us", "ns"):
        if _FASTEST < step * TIME_UNITS_S[unit] <= _SLOWEST:
            rate = 1 / (step * TIME_UNITS_S[unit])
            return TIME_UNITS_S[unit], [f"{where} does not state a unit. Its steps of {step:g} are "
                                        f"read as {unit} ({rate:.4g} samples per second). {fix}"]
    raise InputError(f"{where} does not state a unit and has steps of {step:g}.",
                     "No usual unit makes a recording's rate of that.",
                     "Name the unit in the title of the column, such as t_s or t_us.")
