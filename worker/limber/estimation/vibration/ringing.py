"""Frequencies and damping of free vibration from tracks, accelerometers or strain gauges.

A free decay is a few vibrations, each a frequency and a damping that all channels share, with an
amplitude and a phase in each channel. They are fitted together by least squares, the linear part
eliminated (variable projection: G. Golub, V. Pereyra, 1973); one more is taken in as long as the
Bayesian information criterion falls. What the vibrations leave over is correlated in time and
counts as so many fewer readings.
"""

import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import scipy

from limber.core.errors import InputError
from limber.core.present import present
from limber.recordings.importing.import_request import ImportRequest
from limber.recordings.importing.recording_formats import RECORDINGS
from limber.recordings.tables import read_table, split_title, time_stream
from limber.recordings.time_series import Stream

_COUNTS = r"frames?|samples?|index|framenumber|subframes?"
"""Columns that count the rows."""
_MOST_MODES = 4
_LEAST_READINGS = 32
_MOST_STEPS = 2e6
_LEAST_TURNS = 3.0
_PERIODS = 60
"""So many of the first are used: what comes later is noise, or somebody at the branch."""
_LEAST_SHARE = 0.005
"""Of the record's power; a vibration below it is not taken for the first one."""
_DAMPING = (1e-4, 0.5)


@dataclass(frozen=True)
class Ringing:
    """Vibrations of a record, by frequency.

    Attributes:
        frequencies: [Hz], shape [k], ascending.
        frequency_deviations: Standard deviations [Hz], shape [k].
        damping: Shares of critical damping, shape [k].
        damping_deviations: Shape [k].
        shares: Of the record's power, shape [k].
        left_over: RMS of what they do not explain over that of the record.
        start: When the decay that was used begins [s].
        duration: [s].
    """

    frequencies: np.ndarray
    frequency_deviations: np.ndarray
    damping: np.ndarray
    damping_deviations: np.ndarray
    shares: np.ndarray
    left_over: float
    start: float
    duration: float


def read_record(path: Path) -> Stream:
    """Read a record: a table of times and readings in any unit, or a C3D file's marker tracks.

    Columns with gaps, such as those of a hidden marker, are discarded.

    Raises:
        InputError: it cannot be read, has no times or no readings, or its times do not ascend in
            even steps.
    """
    tracks = [one for one in RECORDINGS.readers() if path.suffix.lower() in one.suffixes
              and one.holds == "markers" and one.name != "markers"]
    if tracks:
        stream = RECORDINGS.read_as(tracks[0], path, request=ImportRequest(path))[0]
    else:
        stream = time_stream(read_table(path))
    used = [number for number, title in enumerate(stream.columns)
            if np.isfinite(stream.values[:, number]).all()
            and not re.fullmatch(_COUNTS, split_title(title).plain)]
    times = stream.times
    if not used:
        raise InputError(f"{path} has no complete column of readings beside its times.",
                         "A record needs at least one.", "Correct the file.")
    if not (times[-1] - times[0]) / np.median(np.diff(times)) < _MOST_STEPS:
        raise InputError(f"{path} has gaps that are far longer than its time steps.",
                         "The analysis needs uniform time steps.",
                         "Give a part of the record without gaps.")
    return replace(stream, values=stream.values[:, used],
                   columns=tuple(stream.columns[number] for number in used))


def identify(times: np.ndarray, channels: np.ndarray, start: float | None = None) -> Ringing:
    """Return the vibrations of a free decay.

    Args:
        times: [s], ascending, shape [n].
        channels: Displacements, accelerations or strains, shape [n, c].
        start: Start of the free decay [s]. Default: the time of the largest motion.

    Raises:
        InputError: the record is too short, shows no free vibration, or is sampled too slowly.
    """
    step = float(np.median(np.diff(times)))
    channels = channels / np.maximum(channels.std(axis=0), 1e-300)
    away = np.abs(channels - np.median(channels, axis=0)).max(axis=1)
    first = int(np.argmax(away)) if start is None else int(np.searchsorted(times, start))
    times, channels = times[first:], channels[first:] - channels[first:].mean(axis=0)
    if len(times) < _LEAST_READINGS:
        raise InputError(f"The record has {len(times)} readings of a free decay.",
                         f"At least {_LEAST_READINGS} are needed.",
                         "Record longer, or state the start of the decay with --start.")
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
    return Ringing(**{**vars(found), "start": float(times[0]),
                      "duration": float(times[-1] - times[0])})


def _fitted(times: np.ndarray, channels: np.ndarray, step: float) -> Ringing:
    """Take vibrations in, the strongest first, as long as each is worth its numbers."""
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
    """Cosines and sines that die away, and one for what stays, shape [n, 2k + 1]."""
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
    frequencies, damping = np.exp(free[::2])[order], np.exp(free[1::2])[order]
    return Ringing(frequencies, frequencies * deviation[::2][order], damping,
                   damping * deviation[1::2][order], shares[order],
                   float(np.sqrt((left**2).sum() / power)), 0.0, float(times[-1]))


def _peak(times: np.ndarray, channels: np.ndarray, step: float) -> float:
    """The strongest frequency [Hz] of a record, from a padded spectrum on even steps."""
    even = np.arange(times[0], times[-1], step)
    size = 4 * 2 ** int(np.ceil(np.log2(len(even))))
    flat = np.stack([np.interp(even, times, one) for one in channels.T], axis=1)
    window = np.hanning(2 * len(even))[len(even):, None]
    power = (np.abs(np.fft.rfft((flat - flat.mean(axis=0)) * window, size, axis=0))**2).sum(axis=1)
    frequencies = np.fft.rfftfreq(size, step)
    # Under one turn in the record is drift.
    inside = frequencies >= 1 / (times[-1] - times[0])
    return float(frequencies[inside][np.argmax(power[inside])])


def _stretch(left: np.ndarray) -> float:
    """How many readings count as one, by the autocorrelation of what is left over."""
    power, total = float((left**2).sum()), 1.0
    for lag in range(1, len(left) // 4):
        value = float((left[lag:] * left[:-lag]).sum()) / max(power, 1e-300)
        if value < 0.05:
            break
        total += 2 * value
    return total
