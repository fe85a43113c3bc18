"""Time stamps of other programs: counts in any unit, clocks since 1970, dates as text."""

import datetime
import re

import numpy as np

from limber.core.errors import InputError
from limber.core.files.text_columns import plain

TIME_UNITS_S = {
    **dict.fromkeys(("s", "sec", "secs", "second", "seconds", "sekunden"), 1.0),
    **dict.fromkeys(("ms", "msec", "msecs", "millis", "millisecond", "milliseconds"), 1e-3),
    **dict.fromkeys(("us", "usec", "usecs", "micros", "microsecond", "microseconds"), 1e-6),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanos", "nanosec", "nanosecond", "nanoseconds"),
                    1e-9), "min": 60.0}
"""Units of time in seconds, by their names in files."""

_WORDS = (r"t|times?|timestamps?|stamp|elapsed|elapsedtime|elapsedsince\w*|clock|clocktime|zeit"
          r"|zeitstempel|uhrzeit|xvalue|datetime|date|datum|rostime|systime|systemtime|unixtime|epoch"
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
    """Return time stamps in seconds, and the assumptions made.

    Wrapped counters of 32 bits are continued, clocks of a day too; stamps of 0 among dates are
    invalid.

    Args:
        where: The file and its column, for messages.
        stamps: Shape [n], NaN if missing.
        unit: One of :data:`TIME_UNITS_S`, if the column states it.
        is_clock: Whether they were dates or times of day, which are seconds.

    Raises:
        InputError: the unit is not stated, and their steps do not determine it.
    """
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
