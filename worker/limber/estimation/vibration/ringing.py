"""Frequencies and damping of free vibration from tracks, accelerometers or strain gauges.

A free decay consists of a few vibrations, each with a frequency and a damping that all channels
share, and an amplitude and a phase in each channel. They are fitted together by least squares, with
the linear part eliminated (variable projection: G. Golub, V. Pereyra, 1973); one more is added as
long as the Bayesian information criterion falls. The residual of the fit is correlated in time, and
counts as correspondingly fewer readings.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TypeVar

import numpy as np
import scipy

from limber.core.errors import InputError, Option, Text
from limber.core.not_none import present
from limber.recordings.import_request import ImportRequest
from limber.recordings.recording_formats import RECORDINGS
from limber.recordings.tables import at_rate, read_table, split_title, time_stream
from limber.recordings.time_series import MAD_TO_SIGMA, Stream, in_order

# Detection of the ringing columns of a record, its plucks, and clipped readings.

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
    """Ringing of a column: frequency [Hz], prominence, power fraction, and burst ratio."""

    frequency: float
    prominence: float
    share: float
    burst: float

    @property
    def rings(self) -> bool:
        return self.prominence > _PROMINENT and self.share > _SHARE and self.burst > _BURST


def ringing_columns(record: _Record) -> _Record:
    """Return the columns that ring, and a sentence on the others, as a logger adds directions,
    temperatures and counters. If none rings clearly, all that change stay. InputError if none
    changes, all are counters, or a reading is impossible."""
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
    """Whether column ``k`` is the magnitude of the others, as telephones add it. It tells nothing
    more, and rings at twice the frequency."""
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
    """Return the first reading of each pluck and the end of its decay. A pluck starts within half a
    period [readings]; the beat of two close vibrations grows more slowly."""
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
    """Return which readings are among several equal ones at a channel's limit, bool [n]; at a
    rounded vibration's extremes only as many are equal as are within a converter's step."""
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


# Time stamps of readings that arrive in packets.
#
# A sensor reads at even steps, but a radio or a serial line delivers several readings together.
# They get the time of arrival: the same, or steps far shorter than the sensor's.

_FEWEST = 8
"""Packets from which a rate can be counted."""
_BESIDE = 4
"""Packets on each side of a place where readings may be missing."""
_SURE = 6.0
"""Standard deviations by which the stamps must jump there."""


@dataclass(frozen=True)
class Packets:
    """A record's readings by their count: times [n] [s] in even steps, rate with relative
    deviation, times before which some are missing; ``shared`` come with or right after another."""

    shared: int
    times: np.ndarray
    rate_hz: float
    deviation: float
    missing: tuple[float, ...] = ()


def packets_of(times: np.ndarray, number: np.ndarray) -> Packets | None:
    """Return the packets of a record by stamps [n] [s] ascending, also equal, and readings'
    numbers; None if not in packets."""
    mean = (times[-1] - times[0]) / max(number[-1] - number[0], 1)
    starts = np.flatnonzero(np.diff(times, prepend=-np.inf) > mean / 2)
    if not _FEWEST <= len(starts) < len(times):
        return None
    # A packet is sent when its last reading is taken. The last packet may be cut off.
    arrival, last = times[starts[:-1]], number[starts[1:] - 1]
    jumps = _jumps(arrival, last)
    parts = np.searchsorted(jumps, np.arange(len(arrival)), side="right")
    basis = np.column_stack([last, parts[:, None] == np.arange(len(jumps) + 1)]).astype(float)
    solved = np.linalg.lstsq(basis, arrival, rcond=None)[0]
    off = arrival - basis @ solved
    variance = float(off @ off) / max(len(off) - basis.shape[1], 1)
    step, shifts = float(solved[0]), solved[1:]
    deviation = np.sqrt(variance * np.linalg.pinv(basis.T @ basis)[0, 0]) / step
    packet = np.cumsum(np.isin(np.arange(len(times)), starts)) - 1
    shift = shifts[np.append(parts, parts[-1])[packet]]
    return Packets(len(times) - len(starts), shift + step * number, 1 / step, float(deviation),
                   tuple(arrival[jumps].tolist()))


def _jumps(arrival: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Return the packets before which readings are missing, as they come too late [s] for the
    number of their last reading."""
    steps, counts = np.diff(arrival), np.diff(last)
    late = arrival - float(np.median(steps / counts)) * last
    if len(late) < 2 * _BESIDE:
        return np.zeros(0, int)
    windows = np.median(np.lib.stride_tricks.sliding_window_view(late, _BESIDE), axis=1)
    jump = windows[_BESIDE:] - windows[:-_BESIDE]
    noise = MAD_TO_SIGMA * float(np.median(np.abs(np.diff(late)))) / np.sqrt(_BESIDE)
    is_jump = jump > max(_SURE * noise, 0.5 * float(np.median(steps)))
    found: list[int] = []
    # Beside the place the medians differ too, but not two packets in a row.
    for k in np.argsort(-np.diff(late)[_BESIDE - 1:1 - _BESIDE], kind="stable"):
        if is_jump[k] and all(abs(k + _BESIDE - other) >= _BESIDE for other in found):
            found.append(int(k) + _BESIDE)
    return np.sort(np.array(found, int))


_COUNTS = r"frames?|samples?|index|framenumber|subframes?"
"""Columns that count the rows."""
_MOST_MODES = 4
_LEAST_READINGS = 32
_MOST_STEPS, _MOST_GAPS = 2e6, 10
"""Most steps of a record; most steps over its readings."""
_LEAST_TURNS = 3.0
_PERIODS = 60
"""Number of first periods that are used: later ones are noise, or disturbances."""
_LEAST_SHARE = 0.005
"""Fraction of the record's power below which a vibration is not taken as the first one."""
_FIRST_SHARE = 0.1
"""Least power of the branch's first vibration over that of the strongest one."""
_PLANES = 0.15
"""Relative difference within which two frequencies are those of two bending planes."""
_DAMPING = (1e-4, 0.5)
_AGREED = 0.01
"""Frequencies by stamps and by count that differ by less are the same."""
_SAME, _CHANGED = 0.05, 0.03
"""Plucks whose frequencies differ by less are of one vibration; by more, of a changed branch."""


@dataclass(frozen=True)
class Ringing:
    """Vibrations of a record by ascending frequency [k] [Hz], with damping ratios, deviations and
    shares of power. ``left_over`` is the unexplained RMS over the record's; ``start`` [s] of the
    first decay used, ``duration`` [s] of all; ``warnings`` name parts that were not used."""

    frequencies: np.ndarray
    frequency_deviations: np.ndarray
    damping: np.ndarray
    damping_deviations: np.ndarray
    shares: np.ndarray
    left_over: float
    start: float
    duration: float
    pluck_frequencies: tuple[float, ...] = ()
    warnings: tuple[str, ...] = ()

    @property
    def damping_intervals(self) -> np.ndarray:
        """95 % intervals of the damping, which is positive, shape [k, 2]."""
        wide = 1.96 * self.damping_deviations / np.maximum(self.damping, 1e-12)
        return self.damping[:, None] * np.exp(np.clip(wide, 0, 30)[:, None] * np.array([-1, 1]))


@dataclass(frozen=True)
class Record(Stream):
    """Readings over time, with the relative standard deviation of their rate."""

    rate_deviation: float = 0.0


def read_record(path: Path, rate_hz: float | None = None) -> Record:
    """Read times and readings in any unit, or a C3D file's tracks, without columns that have gaps
    or do not ring. Packets count as even where that rings better; ``rate_hz`` overrides stamps.
    InputError if it is unreadable, without times or readings, or its steps are not even."""
    tracks = [one for one in RECORDINGS.readers() if path.suffix.lower() in one.suffixes
              and one.holds == "markers" and one.name != "markers"]
    if tracks:
        stream = RECORDINGS.read_as(tracks[0], path, request=ImportRequest(path))[0]
    else:
        table = read_table(path)
        stream = (time_stream(table, keep_repeated=True) if rate_hz is None else
                  at_rate(table, rate_hz))
    used = [number for number, title in enumerate(stream.columns)
            if np.isfinite(stream.values[:, number]).all()
            and not re.fullmatch(_COUNTS, split_title(title).plain)]
    if not used:
        raise InputError(f"{path} has no complete column of readings beside its times.",
                         "A record needs at least one.", "Correct the file.")
    record = Record(stream.times, stream.values[:, used],
                    tuple(stream.columns[number] for number in used), stream.warnings)
    counters = [values for title, values in zip(stream.columns, stream.values.T, strict=True)
                if re.fullmatch(_COUNTS, split_title(title).plain) and (np.diff(values) > 0).all()]
    packets = None if rate_hz is not None else packets_of(
        stream.times, counters[0] if counters else np.arange(float(len(stream))))
    return _stamped(path, record) if packets is None else _of_packets(path, record, packets)


def _stamped(path: Path, record: Record) -> Record:
    """The record by its stamps, with the columns that ring. InputError if they do not ascend in
    even steps."""
    doubled = int(np.sum(np.diff(record.times) == 0))
    if 2 * doubled >= len(record):
        raise InputError(f"{path}: {doubled} of {len(record)} readings have the time of another.",
                         "The clock is too coarse to tell how often the sensor reads.",
                         "State the sensor's readings per second with ", Option("rate_hz"), ".")
    warnings = list(record.warnings)
    times, values = in_order(path, record.times, record.values, warnings)
    steps = (times[-1] - times[0]) / np.median(np.diff(times))
    if not steps < min(_MOST_STEPS, _MOST_GAPS * len(times)):
        raise InputError(f"{path} has gaps that are far longer than its time steps.", "The "
                         "analysis needs uniform time steps.", "Give a part of the record without "
                         "gaps, or the sensor's readings per second with ", Option("rate_hz"), ".")
    return ringing_columns(replace(record, times=times, values=values, warnings=tuple(warnings)))


def _of_packets(path: Path, record: Record, packets: Packets) -> Record:
    """The record by its stamps or by the count of its readings, whichever rings better. InputError
    if both ring about as well, with different frequencies."""
    gone = "".join(f" Readings are missing before {time:.4g} s." for time in packets.missing[:3])
    seen = (f"{path.name}: {packets.shared} of {len(record)} readings have the time of another, or "
            f"nearly so. They came in packets.{gone}")
    counted = ringing_columns(replace(
        record, times=packets.times, rate_deviation=packets.deviation, warnings=(
            *record.warnings,
            Text(f"{seen} Their times are counted: {packets.rate_hz:.5g} readings per second. If "
                 "the sensor has another rate, state it with ", Option("rate_hz"), "."))))
    try:
        stamped = _stamped(path, record)
    except InputError:
        return counted
    by_count, by_stamps = _first_of(counted), _first_of(stamped)
    if by_count is None or by_stamps is None:
        return stamped if by_count is None and by_stamps is not None else counted
    ratio = (by_count.left_over / by_stamps.left_over)**2
    is_same = abs(by_count.frequencies[0] / by_stamps.frequencies[0] - 1) < _AGREED
    if not is_same and 0.5 < ratio < 2:
        raise InputError(
            f"{seen} They ring at {by_stamps.frequencies[0]:.4g} Hz by their stamps, and at "
            f"{by_count.frequencies[0]:.4g} Hz if they are {packets.rate_hz:.5g} a second.",
            "The record does not show which is right.",
            "State the sensor's readings per second with ", Option("rate_hz"), ".")
    return counted if ratio < 1 else stamped


def _first_of(record: Record) -> Ringing | None:
    try:
        return identify(record.times, record.values)
    except InputError:
        return None


def identify(times: np.ndarray, channels: np.ndarray, start: float | None = None, *,
             rate_deviation: float = 0.0) -> Ringing:
    """Return a free decay's vibrations from ``start`` [s] (None: the largest motion; each decay if
    plucked again). InputError if too short, without vibration, or sampled too slowly."""
    channels = channels / np.maximum(channels.std(axis=0), 1e-300)
    begin = 0 if start is None else int(np.searchsorted(times, start))
    if len(times) - begin < _LEAST_READINGS:
        raise _too_short(len(times) - begin)
    step = float(np.median(np.diff(times)))
    period = 1 / (_peak(times[begin:], channels[begin:], step) * step)
    cut = cut_off(channels, period)
    away = np.abs(channels - np.median(channels, axis=0)).max(axis=1)
    parts = plucks(channels[begin:], period)
    found, failed = [], []
    for number, (first, stop) in enumerate(parts):
        first, stop = first + begin, min(stop + begin, len(times))
        # From the largest motion, or from the time of release that the user states.
        if start is None or number or first > begin:
            first += int(np.argmax(away[first:stop]))
        if cut[first:stop].any():
            first += int(np.flatnonzero(cut[first:stop])[-1]) + 1
        try:
            found.append(_decay(times[first:stop], channels[first:stop], step))
        except InputError as error:
            failed.append(error)
    if not found:
        raise failed[0]
    best = min(found, key=lambda one: float(one.frequency_deviations[0] / one.frequencies[0]))
    alike = [one for one in found
             if abs(one.frequencies[0] / best.frequencies[0] - 1) < _SAME]
    united = _united(best, alike)
    united = replace(united, frequency_deviations=np.hypot(
        united.frequency_deviations, rate_deviation * united.frequencies))
    return _cut_record(united, len(parts), len(alike), int(cut.sum()))


def _too_short(count: int) -> InputError:
    return InputError(f"The record has {count} readings of a free decay.",
                      f"At least {_LEAST_READINGS} are needed.",
                      "Record longer, or state the start of the decay with ", Option("start"), ".")


def _cut_record(found: Ringing, count: int, used: int, cut: int) -> Ringing:
    """The vibrations, and warnings on the record for the user."""
    warnings = list(found.warnings)
    if count > 1:
        others = "" if used == count else (
            f" {count - used} of them are too short, too weak or of another frequency.")
        warnings.append(f"The branch was plucked {count} times. {used} decays were used, each from "
                        f"its largest motion, and their means taken.{others}")
    if cut:
        warnings.append(f"The sensor's range was too small for {cut} readings, which all have its "
                        "largest value. Each decay was used from where its readings are whole.")
    first = found.pluck_frequencies
    if len(first) > 1 and np.ptp(first) > _CHANGED * found.frequencies[0]:
        warnings.append("The plucks have different first frequencies: "
                        f"{', '.join(f'{value:.4g}' for value in first)} Hz. The branch, or what "
                        "holds it, changed between them.")
    return replace(found, warnings=tuple(warnings))


def _united(best: Ringing, found: list[Ringing]) -> Ringing:
    """The weighted mean of several decays of one branch; a single decay is unchanged."""
    if len(found) == 1:
        return best
    columns = []
    for frequency in best.frequencies:
        near = [(one, int(np.argmin(np.abs(one.frequencies - frequency)))) for one in found]
        same = [(one, k) for one, k in near
                if abs(one.frequencies[k] - frequency) < _SAME * frequency]
        columns.append((*_mean([(one.frequencies[k], one.frequency_deviations[k])
                                for one, k in same]),
                        *_mean([(one.damping[k], one.damping_deviations[k]) for one, k in same])))
    frequencies, frequency_deviations, damping, damping_deviations = np.array(columns).T
    return replace(
        best, frequencies=frequencies, frequency_deviations=frequency_deviations, damping=damping,
        damping_deviations=damping_deviations, start=found[0].start,
        left_over=float(np.sqrt(np.mean([one.left_over**2 for one in found]))),
        duration=float(sum(one.duration for one in found)),
        pluck_frequencies=tuple(float(one.frequencies[0]) for one in found))


def _mean(values: list[tuple[float, float]]) -> tuple[float, float]:
    """The weighted mean of values with deviations, and its own: from those, or the scatter."""
    value, deviation = np.array(values).T
    weight = 1 / np.maximum(deviation, 1e-9 * np.abs(value))**2
    mean = float(weight @ value / weight.sum())
    scatter = float(np.std(value, ddof=1) / np.sqrt(len(value))) if len(value) > 1 else 0.0
    return mean, max(float(1 / np.sqrt(weight.sum())), scatter)


def _decay(times: np.ndarray, channels: np.ndarray, step: float) -> Ringing:
    """The vibrations of one decay, which starts with the first reading."""
    if len(times) < _LEAST_READINGS:
        raise _too_short(len(times))
    channels = channels - channels.mean(axis=0)
    guess = _peak(times, channels, step)
    used = times <= times[0] + _PERIODS / guess
    times, channels = times[used], channels[used] - channels[used].mean(axis=0)
    found = _fitted(times - times[0], channels, step)
    if (times[-1] - times[0]) * found.frequencies[0] < _LEAST_TURNS:
        raise InputError("The branch oscillates only "
                         f"{(times[-1] - times[0]) * found.frequencies[0]:.1f} times in the "
                         "record.",
                         "A frequency needs several oscillations.", "Record longer.")
    if found.left_over > 0.9:
        raise InputError("The record shows no free vibration.", "Decaying vibrations explain only "
                         f"{100 * (1 - found.left_over**2):.0f} % of it.", "Release the branch "
                         "abruptly, and state the time of release with ", Option("start"), ".")
    return replace(found, start=float(times[0]), duration=float(times[-1] - times[0]))


def _fitted(times: np.ndarray, channels: np.ndarray, step: float) -> Ringing:
    """Add vibrations, the strongest first, as long as each improves the information criterion."""
    best: tuple[float, np.ndarray] | None = None
    free, left = np.zeros(0), channels
    power = float((channels**2).sum())
    for _ in range(_MOST_MODES):
        frequency = _peak(times, left, step)
        trial = np.concatenate([free, [np.log(frequency), np.log(0.02)]])
        low, high = np.log(0.2 / times[-1]), np.log(0.5 / step)
        bounds = (np.tile([low, np.log(_DAMPING[0])], len(trial) // 2),
                  np.tile([high, np.log(_DAMPING[1])], len(trial) // 2))
        result = scipy.optimize.least_squares(
            lambda x: _left(x, times, channels).ravel(),
            np.clip(trial, bounds[0] + 1e-6, bounds[1] - 1e-6), bounds=bounds,
            x_scale=np.tile([0.02, 0.5], len(trial) // 2), max_nfev=60)
        free, left = result.x, _left(result.x, times, channels)
        numbers = len(free) * (1 + channels.shape[1])
        score = channels.size * np.log(max(2 * result.cost / channels.size, 1e-30)) + (
            numbers * np.log(channels.size))
        if best is not None and score > best[0] - 10:
            break
        best = score, free
    return _judged(present(best, "vibration")[1], times, channels, power)


def _basis(free: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Decaying cosines and sines, and a constant, shape [n, 2k + 1]."""
    omega = 2 * np.pi * np.exp(free[::2])
    ratio = np.exp(free[1::2])
    fade = np.exp(-(ratio * omega) * times[:, None])
    phase = omega * np.sqrt(1 - ratio**2) * times[:, None]
    return np.hstack([fade * np.cos(phase), fade * np.sin(phase), np.ones((len(times), 1))])


def _left(free: np.ndarray, times: np.ndarray, channels: np.ndarray) -> np.ndarray:
    basis = _basis(free, times)
    return channels - basis @ np.linalg.lstsq(basis, channels, rcond=None)[0]


def _judged(free: np.ndarray, times: np.ndarray, channels: np.ndarray, power: float) -> Ringing:
    left, step = _left(free, times, channels), 1e-5
    slopes = np.stack([(_left(free + step * one, times, channels)
                        - _left(free - step * one, times, channels)).ravel() / (2 * step)
                       for one in np.eye(len(free))], axis=1)
    spare = max(left.size - len(free) * (1 + channels.shape[1]), 1)
    variance = float((left**2).sum()) / spare * repetition(left, len(left) // 4)
    deviation = np.sqrt(np.diag(variance * np.linalg.pinv(slopes.T @ slopes)))
    basis, count = _basis(free, times), len(free) // 2
    amplitude = np.linalg.lstsq(basis, channels, rcond=None)[0]
    shares = np.array([float(((basis[:, [k, count + k]] @ amplitude[[k, count + k]])**2).sum())
                       for k in range(count)]) / power
    order = [k for k in np.argsort(free[::2]) if shares[k] >= _LEAST_SHARE] or [
        int(np.argmax(shares))]
    order, warnings = _first_line(np.exp(free[::2]), shares, order)
    frequencies, damping = np.exp(free[::2])[order], np.exp(free[1::2])[order]
    return Ringing(frequencies, frequencies * deviation[::2][order], damping,
                   damping * deviation[1::2][order], shares[order],
                   float(np.sqrt((left**2).sum() / power)), 0.0, float(times[-1]),
                   warnings=warnings)


def _first_line(frequencies: np.ndarray, shares: np.ndarray, order: list[int],
                ) -> tuple[list[int], tuple[str, ...]]:
    """Return the vibrations from the first one on, and what makes it doubtful: plucked branches
    vibrate in their first modes, so a line far below the strongest is wind, support or drift."""
    largest = order[int(np.argmax(shares[order]))]
    at = next(n for n, k in enumerate(order) if shares[k] >= _FIRST_SHARE * shares[largest])
    first, warnings = order[at], []
    if at:
        warnings.append(
            f"The record also vibrates at {', '.join(f'{frequencies[k]:.4g}' for k in order[:at])} "
            f"Hz, with less than {100 * _FIRST_SHARE:.0f} % of the power at "
            f"{frequencies[largest]:.4g} Hz. This is not taken for the branch.")
    if frequencies[largest] > (1 + _PLANES) * frequencies[first]:
        warnings.append(
            f"The record vibrates most at {frequencies[largest]:.4g} Hz. The lower frequency, "
            f"{frequencies[first]:.4g} Hz, with {100 * shares[first] / shares[largest]:.0f} % of "
            "that power, is taken for the branch's first. If it is not the branch's, record with "
            "the branch sheltered and its support held.")
    return order[at:], tuple(warnings)


def _peak(times: np.ndarray, channels: np.ndarray, step: float) -> float:
    """The strongest frequency [Hz] of a record, from a padded spectrum on even steps."""
    even = np.arange(times[0], times[-1], step)
    size = 4 * 2 ** int(np.ceil(np.log2(len(even))))
    flat = np.stack([np.interp(even, times, one) for one in channels.T], axis=1)
    window = np.hanning(2 * len(even))[len(even):, None]
    power = (np.abs(np.fft.rfft((flat - flat.mean(axis=0)) * window, size, axis=0))**2).sum(axis=1)
    frequencies = np.fft.rfftfreq(size, step)
    # Less than one period in the record is drift.
    inside = frequencies >= 1 / (times[-1] - times[0])
    return float(frequencies[inside][np.argmax(power[inside])])


def repetition(left: np.ndarray, most: int) -> float:
    """Number of readings in a row [n, c] that count as one, from their autocorrelation over lags
    below ``most``."""
    power, total = float((left**2).sum()), 1.0
    for lag in range(1, most):
        value = float((left[lag:] * left[:-lag]).sum()) / max(power, 1e-300)
        if value < 0.05:
            break
        total += 2 * value
    return total
