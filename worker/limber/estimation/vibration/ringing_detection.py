"""Detection of the ringing columns of a record, its plucks, and clipped readings."""

from dataclasses import dataclass, replace
from typing import TypeVar

import numpy as np

from limber.core.errors import InputError
from limber.recordings.time_series import Stream

_Record = TypeVar("_Record", bound=Stream)

_BAND = 0.15
"""Width of the band around a frequency, as a fraction: that of a tenth of critical damping."""
_PROMINENT, _SHARE = 6.0, 0.1
"""Density of power in that band over that beside it, and the band's fraction of all power."""
_BURST = 2.0
"""Maximum power over typical power: a plucked vibration decays."""
_JUMP, _LOUD, _ABOVE = 2.5, 0.2, 2.0
"""A pluck's amplitude over that before it, over the record's largest, over its quietest."""
_FLAT = 3
"""Equal readings in a row at a channel's limit."""

_LARGEST = 1e15  # largest reading, in any unit


@dataclass(frozen=True)
class _Spectrum:
    """Ringing of a column: its frequency [Hz], prominence, power fraction, and burst ratio.
    """

    frequency: float
    prominence: float
    share: float
    burst: float

    @property
    def rings(self) -> bool:
        return self.prominence > _PROMINENT and self.share > _SHARE and self.burst > _BURST


def ringing_columns(record: _Record) -> _Record:
    """Return the record with the columns that ring, and a sentence on those that do not.

    A logger's table may also contain accelerations of other directions, a temperature, a voltage or
    a counter. If no column rings clearly, all columns that change are kept.

    Raises:
        InputError: no column changes, all of them are counters, or a reading is impossible.
    """
    if not (np.abs(record.values[np.isfinite(record.values)]) < _LARGEST).all():
        raise InputError(f"The record has a reading over {_LARGEST:g}.",
                         "No sensor gives such a number.", "Check the file and its units.")
    changing = [k for k in range(record.values.shape[1])
                if not _is_counter(record.values[:, k]) and not _is_magnitude(record.values, k)]
    if not changing:
        raise InputError(f"No column of the record changes ({', '.join(record.columns)}), but for "
                         "those that only count.", "A vibration goes to and fro.",
                         "Check the file and the sensor.")
    spectra = {k: _spectrum(record.times, record.values[:, k]) for k in changing}
    ringing = [k for k, found in spectra.items() if found.rings]
    used = ringing or changing
    others = [title for k, title in enumerate(record.columns) if k not in used]
    if not others:
        return record
    taken = ", ".join(record.columns[k] for k in used)
    message = (f"Columns taken as readings, because they ring: {taken}. Not used, because they do "
               f"not: {', '.join(others)}." if ringing else
               f"No column rings clearly. Columns taken as readings, because they change: {taken}. "
               f"Not used: {', '.join(others)}.")
    return replace(record, values=record.values[:, used],
                   columns=tuple(record.columns[k] for k in used),
                   warnings=(*record.warnings, message))


def _is_counter(values: np.ndarray) -> bool:
    """Whether a column is constant, or increases from row to row as a clock does."""
    steps = np.diff(values)
    return not steps.any() or bool((steps > 0).all() or (steps < 0).all())


def _is_magnitude(values: np.ndarray, k: int) -> bool:
    """Whether column ``k`` is the magnitude of the others, as telephones add it.

    It tells nothing more, and rings at twice the frequency.
    """
    own, others = values[:, k], np.delete(values, k, axis=1)
    # Of two equal columns, neither is the magnitude of the other.
    return bool((others.shape[1] > 1 or (others < 0).any()) and (own >= 0).all() and own.any()
                and np.abs(own - np.linalg.norm(others, axis=1)).max() < 1e-3 * own.max())


def _spectrum(times: np.ndarray, values: np.ndarray) -> _Spectrum:
    step = float(np.median(np.diff(times)))
    even = np.arange(times[0], times[-1], step)
    flat = np.interp(even, times, values)
    flat = flat - np.polyval(np.polyfit(even - even[0], flat, 1), even - even[0])
    power = np.abs(np.fft.rfft(flat * np.hanning(len(flat))))**2
    frequencies = np.fft.rfftfreq(len(flat), step)
    # Fewer than three periods in the record are drift.
    inside = frequencies >= 3 / (times[-1] - times[0])
    tops = np.r_[False, (power[1:-1] > power[:-2]) & (power[1:-1] >= power[2:]), False] & inside
    if inside.sum() < 16 or not tops.any():
        return _Spectrum(0.0, 0.0, 0.0, 0.0)
    peak = float(frequencies[tops][np.argmax(power[tops])])
    width = max(_BAND * peak, 3 * frequencies[1])
    band = inside & (np.abs(frequencies - peak) <= width)
    beside = inside & ~band
    if not beside.any():
        return _Spectrum(peak, 0.0, 1.0, 0.0)
    density = power[band].mean() / max(float(power[beside].mean()), 1e-300)
    swing = np.fft.irfft(np.where(band, np.fft.rfft(flat), 0), len(flat))**2
    parts = np.array([part.mean() for part in np.array_split(swing, 20)])
    return _Spectrum(peak, float(density), float(power[band].sum() / power[inside].sum()),
                     float(parts.max() / max(float(np.median(parts)), 1e-300)))


def plucks(channels: np.ndarray, period: float) -> list[tuple[int, int]]:
    """Return the first reading of each pluck and the end of its decay.

    A pluck starts within half a period. The beat of two close vibrations grows more slowly.

    Args:
        channels: Shape [n, c].
        period: Period of the vibration, in readings.
    """
    width, half = max(round(period), 8), max(round(period / 2), 4)
    if len(channels) < 4 * width:
        return [(0, len(channels))]
    swing = _extent(channels, width)  # extent of the readings k .. k + width
    after = _extent(channels, half)[width:]
    before, after = swing[:len(after)], after[:len(swing)]
    least = max(_LOUD * float(swing.max()), _ABOVE * float(np.quantile(swing, 0.1)))
    found = np.flatnonzero((after > _JUMP * before) & (after > least)) + width
    # A start less than two periods after another belongs to it.
    starts = found[np.diff(found, prepend=-len(channels)) > 2 * width].tolist()
    if starts and starts[0] > 2 * width and swing[0] > least:
        # It rang from the beginning of the record.
        starts.insert(0, 0)
    if len(starts) < 2:
        return [(0, len(channels))]
    # The jump is seen as soon as the window reaches it.
    return [(start, end - width) for start, end in
            zip(starts, [*starts[1:], len(channels) + width], strict=True)]


def _extent(channels: np.ndarray, width: int) -> np.ndarray:
    """Range of each ``width`` readings in a row, the largest of all channels."""
    windows = np.lib.stride_tricks.sliding_window_view(channels, width, axis=0)
    return np.ptp(windows, axis=2).max(axis=1)


def cut_off(channels: np.ndarray, period: float) -> np.ndarray:
    """Whether each reading is one of several equal ones at a channel's limit, shape [n] of bool.

    A vibration rounded by a converter has equal readings at its extremes too, but only as many as
    are within one of its steps.

    Args:
        channels: Shape [n, c].
        period: Period of the vibration, in readings.
    """
    found = np.zeros(len(channels), bool)
    for values in channels.T:
        steps = np.abs(np.diff(np.unique(values)))
        if not len(steps):
            continue
        middle = float(np.median(values))
        for end in (values.min(), values.max()):
            at = np.flatnonzero(np.diff(np.r_[0, (values == end).astype(int), 0]))
            for first, last in at.reshape(-1, 2):
                turn = 2 * np.pi * (last - first - 1) / period
                drop = abs(end - middle) * (1 - np.cos(min(turn / 2, np.pi)))
                if last - first >= _FLAT and drop > 2 * steps.min():
                    found[first:last] = True
    return found
