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

import numpy as np
import scipy

from limber.core.errors import InputError
from limber.core.not_none import present
from limber.estimation.vibration.packets import Packets, packets_of
from limber.estimation.vibration.ringing_detection import cut_off, plucks, ringing_columns
from limber.recordings.importing.import_request import ImportRequest
from limber.recordings.importing.recording_formats import RECORDINGS
from limber.recordings.tables import at_rate, read_table, split_title, time_stream
from limber.recordings.time_series import Stream, in_order

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
    """Vibrations of a record, by frequency.

    Attributes:
        frequencies: [Hz], shape [k], ascending.
        frequency_deviations: Standard deviations [Hz], shape [k].
        damping: Damping ratios, shape [k].
        damping_deviations: Shape [k].
        shares: Fractions of the record's power, shape [k].
        left_over: RMS of the unexplained part over that of the record.
        start: Start of the decay that was used [s]; of several the first.
        duration: Total duration of all decays that were used [s].
        pluck_frequencies: The first frequency of each decay, if there are several [Hz].
        warnings: Parts of the record that were not used.
    """

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
    """Readings over time.

    Attributes:
        rate_deviation: Relative standard deviation of the rate at which they were taken.
    """

    rate_deviation: float = 0.0


def read_record(path: Path, rate_hz: float | None = None) -> Record:
    """Read a record: a table of times and readings in any unit, or a C3D file's marker tracks.

    Columns with gaps, such as those of a hidden marker, are discarded, and those that do not ring
    (:func:`.ringing_detection.ringing_columns`). Readings that come in packets are taken at even
    steps, where they ring better so. ``rate_hz``, if given, is the rate of all readings, whatever
    their stamps.

    Raises:
        InputError: it cannot be read, has no times or no readings, or its times do not ascend in
            even steps.
    """
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
    """The record by its stamps, with the columns that ring.

    Raises:
        InputError: they do not ascend in even steps.
    """
    doubled = int(np.sum(np.diff(record.times) == 0))
    if 2 * doubled >= len(record):
        raise InputError(f"{path}: {doubled} of {len(record)} readings have the time of another.",
                         "The clock is too coarse to tell how often the sensor reads.",
                         "State the sensor's readings per second with --rate-hz.")
    warnings = list(record.warnings)
    times, values = in_order(path, record.times, record.values, warnings)
    steps = (times[-1] - times[0]) / np.median(np.diff(times))
    if not steps < min(_MOST_STEPS, _MOST_GAPS * len(times)):
        raise InputError(f"{path} has gaps that are far longer than its time steps.",
                         "The analysis needs uniform time steps.",
                         "Give a part of the record without gaps, or the sensor's readings per "
                         "second with --rate-hz.")
    return ringing_columns(replace(record, times=times, values=values, warnings=tuple(warnings)))


def _of_packets(path: Path, record: Record, packets: Packets) -> Record:
    """The record by its stamps or by the count of its readings, whichever rings better.

    Raises:
        InputError: both ring about as well, with different frequencies.
    """
    gone = "".join(f" Readings are missing before {time:.4g} s." for time in packets.missing[:3])
    seen = (f"{path.name}: {packets.shared} of {len(record)} readings have the time of another, or "
            f"nearly so. They came in packets.{gone}")
    counted = ringing_columns(replace(
        record, times=packets.times, rate_deviation=packets.deviation, warnings=(
            *record.warnings,
            f"{seen} Their times are counted: {packets.rate_hz:.5g} readings per second. If the "
            "sensor has another rate, state it with --rate-hz.")))
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
            "State the sensor's readings per second with --rate-hz.")
    return counted if ratio < 1 else stamped


def _first_of(record: Record) -> Ringing | None:
    try:
        return identify(record.times, record.values)
    except InputError:
        return None


def identify(times: np.ndarray, channels: np.ndarray, start: float | None = None, *,
             rate_deviation: float = 0.0) -> Ringing:
    """Return the vibrations of a free decay.

    Args:
        times: [s], ascending, shape [n].
        channels: Displacements, accelerations or strains, shape [n, c].
        start: Start of the free decay [s]. Default: the time of the largest motion. If the branch
            is plucked again, each decay is used.
        rate_deviation: Relative standard deviation of the rate of the times.

    Raises:
        InputError: the record is too short, shows no free vibration, or is sampled too slowly.
    """
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
                      "Record longer, or state the start of the decay with --start.")


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
        raise InputError("The record shows no free vibration.",
                         f"Decaying vibrations explain only {100 * (1 - found.left_over**2):.0f} "
                         "% of it.",
                         "Release the branch abruptly, and state the time of release with --start.")
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
    variance = float((left**2).sum()) / spare * _stretch(left)
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
    """The vibrations from the first one on, by frequency, and what makes that one doubtful.

    A branch that is plucked vibrates most in its first modes. A line far below the strongest one
    is the wind, the support, or drift.
    """
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


def _stretch(left: np.ndarray) -> float:
    """Number of readings that count as one, from the autocorrelation of the residual."""
    power, total = float((left**2).sum()), 1.0
    for lag in range(1, len(left) // 4):
        value = float((left[lag:] * left[:-lag]).sum()) / max(power, 1e-300)
        if value < 0.05:
            break
        total += 2 * value
    return total
