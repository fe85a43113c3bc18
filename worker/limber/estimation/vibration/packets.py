"""Time stamps of readings that arrive in packets.

A sensor reads at even steps, but a radio or a serial line delivers several readings together. They
get the time of arrival: the same, or steps far shorter than the sensor's.
"""

from dataclasses import dataclass

import numpy as np

from limber.recordings.time_series import MAD_TO_SIGMA

_FEWEST = 8
"""Packets from which a rate can be counted."""
_BESIDE = 4
"""Packets on each side of a place where readings may be missing."""
_SURE = 6.0
"""Standard deviations by which the stamps must jump there."""


@dataclass(frozen=True)
class Packets:
    """A record in packets, and the times of its readings by their count.

    Attributes:
        shared: Number of readings that come with, or right after, another one.
        times: [s], even steps, shape [n].
        rate_hz: Readings per second.
        deviation: Relative standard deviation of the rate.
        missing: Times before which readings are missing [s].
    """

    shared: int
    times: np.ndarray
    rate_hz: float
    deviation: float
    missing: tuple[float, ...] = ()


def packets_of(times: np.ndarray, number: np.ndarray) -> Packets | None:
    """Return the packets of a record; None if its readings do not come in packets.

    Args:
        times: Ascending stamps, also equal ones [s], shape [n].
        number: Ascending numbers of the readings, shape [n].
    """
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
    """Return the packets before which readings are missing: they come too late for their number.

    Args:
        arrival: [s], shape [p].
        last: Number of the last reading in each packet, shape [p].
    """
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
