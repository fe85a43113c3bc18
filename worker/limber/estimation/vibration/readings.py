"""Which columns of a record ring, where it was plucked, and which readings a sensor cut off."""

from dataclasses import dataclass, replace

import numpy as np

from limber.core.errors import InputError
from limber.recordings.time_series import Stream

_BAND = 0.15
"""Around a frequency, as a fraction of it: as wide as a tenth of critical damping makes it."""
_PROMINENT, _SHARE = 6.0, 0.1
"""Density of power in that band over that beside it, and the band's share of all of it."""
_BURST = 2.0
"""Power where it is strongest over what it mostly is: what was plucked dies away."""
_JUMP, _LOUD, _ABOVE = 2.5, 0.2, 2.0
"""A pluck: its swing over that before it, over the record's largest, over the record's quietest."""
_FLAT = 3
"""Equal readings in a row at a channel's end."""


@dataclass(frozen=True)
class _Spectrum:
    """Where a column rings: its frequency [Hz], how far that stands out, whether it comes and goes.
    """

    frequency: float
    prominence: float
    share: float
    burst: float

    @property
    def rings(self) -> bool:
        return self.prominence > _PROMINENT and self.share > _SHARE and self.burst > _BURST


def ringing_columns(record: Stream) -> Stream:
    """Return the record with the columns that ring, and a sentence on those that do not.

    Accelerations of other directions, a temperature, a voltage, a counter stand beside the reading
    in a logger's table. Where no column rings clearly, all that change are kept.

    Raises:
        InputError: none changes, or they only count.
    """
    changing = [k for k in range(record.values.shape[1])
                if not _is_counter(record.values[:, k])]
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
    told = (f"Columns taken as readings, because they ring: {taken}. Not used, because they do "
            f"not: {', '.join(others)}." if ringing else
            f"No column rings clearly. Columns taken as readings, because they change: {taken}. "
            f"Not used: {', '.join(others)}.")
    return replace(record, values=record.values[:, used],
                   columns=tuple(record.columns[k] for k in used),
                   warnings=(*record.warnings, told))


def _is_counter(values: np.ndarray) -> bool:
    """Whether a column stays as it is, or grows from row to row as a clock does."""
    steps = np.diff(values)
    return not steps.any() or bool((steps > 0).all() or (steps < 0).all())


def _spectrum(times: np.ndarray, values: np.ndarray) -> _Spectrum:
    step = float(np.median(np.diff(times)))
    even = np.arange(times[0], times[-1], step)
    flat = np.interp(even, times, values)
    flat = flat - np.polyval(np.polyfit(even - even[0], flat, 1), even - even[0])
    power = np.abs(np.fft.rfft(flat * np.hanning(len(flat))))**2
    frequencies = np.fft.rfftfreq(len(flat), step)
    # Under three turns in the record is drift.
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
    """Return the first reading of each pluck and the end of what follows it.

    A pluck sets in within half a turn. Two close vibrations grow more slowly where they come to
    swing together again.

    Args:
        channels: Shape [n, c].
        period: Of the vibration, in readings.
    """
    width, half = max(round(period), 8), max(round(period / 2), 4)
    if len(channels) < 4 * width:
        return [(0, len(channels))]
    swing = _extent(channels, width)  # of the readings k .. k + width
    after = _extent(channels, half)[width:]
    before, after = swing[:len(after)], after[:len(swing)]
    least = max(_LOUD * float(swing.max()), _ABOVE * float(np.quantile(swing, 0.1)))
    found = np.flatnonzero((after > _JUMP * before) & (after > least)) + width
    # What sets in less than two turns after another belongs to it.
    starts = found[np.diff(found, prepend=-len(channels)) > 2 * width].tolist()
    if starts and starts[0] > 2 * width and swing[0] > least:
        # It rang from the beginning on.
        starts.insert(0, 0)
    if len(starts) < 2:
        return [(0, len(channels))]
    # The jump is seen as soon as the window touches it.
    return [(start, end - width) for start, end in
            zip(starts, [*starts[1:], len(channels) + width], strict=True)]


def _extent(channels: np.ndarray, width: int) -> np.ndarray:
    """How far each ``width`` readings in a row are apart, the largest of all channels."""
    windows = np.lib.stride_tricks.sliding_window_view(channels, width, axis=0)
    return np.ptp(windows, axis=2).max(axis=1)


def cut_off(channels: np.ndarray, period: float) -> np.ndarray:
    """Whether each reading is one of several equal ones at a channel's end, shape [n] of bool.

    A vibration that a converter rounds has equal readings at its turns too, but only as many as
    lie within one of its steps.

    Args:
        channels: Shape [n, c].
        period: Of the vibration, in readings.
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
