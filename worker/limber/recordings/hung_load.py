"""A steady load, such as a hung weight: the branch's rest position under it.

No robot is needed. Marker tracks show the branch without the load, then swinging, then at rest. The
rest position is detected and becomes a pull of a few frames, driven by a force.
"""

from dataclasses import dataclass

import numpy as np

from limber.core.errors import Command, InputError, Option
from limber.recordings.recording import Observations

FRAMES = 4
"""Number of frames into which the settled part is averaged."""
STILL_SHARE = 0.005
"""Fraction of the whole displacement within which the end counts as settled. Chosen, not measured.
"""
HIDDEN_SHARE = 0.1
"""Ratio of noise to displacement above which start and end of the motion are found from the mean of
all markers. Chosen, not measured."""
SURE = 4.0
"""Standard deviations by which a mean must differ to count as motion."""
STRAY = 5.5
"""Standard deviations per axis that no marker of a still recording exceeds, except in 1 of 1,000
recordings with 1,000 positions."""
MEAN_WIDTH = 5
"""Frames of the running mean."""
REGISTRATION_SHARE = 0.25
"""Displacement error of a marker, as a fraction of its position error on the body: the displacement
of a bent body changes along it by about its slope."""


@dataclass(frozen=True)
class Settled:
    """Markers without the load [m], shape [m, 3], and after the swinging: mean of each block at its
    middle [s], shape [f, m, 3], NaN where not seen. ``noise`` [m] is that of one reading per axis,
    ``moved`` [m] the farthest marker's displacement, ``duration`` [s] that of the settled part."""

    rest: np.ndarray
    times: np.ndarray
    positions: np.ndarray
    noise: float
    moved: float
    duration: float
    warnings: tuple[str, ...] = ()

    def sigma(self, registration: float) -> float:
        """Standard deviation [m] for each frame, as common errors do not average out;
        ``registration``: RMS distance of the markers at rest from their nominal positions [m]."""
        shared = REGISTRATION_SHARE * registration
        alone = self.noise * np.sqrt(2 / max(len(self.times), 1))
        return float(np.sqrt(len(self.times) * (shared**2 + alone**2 + 1e-10)))


def settled(seen: Observations, name: str) -> Settled:
    """Find the unloaded start and the settled end: the longest final part in which every marker's
    running mean stays in a band of 1 % of the whole displacement. A slow creep in the band is
    reported. InputError if nothing moved, or the branch still swings at the end."""
    times, positions = seen.times, seen.positions
    whole = seen.visible.mean(axis=0) > 0.5
    if not whole.any() or not np.isfinite(positions[0, whole]).all(axis=1).any():
        raise InputError(f"{name}: the first frame shows no marker that stays in view.",
                         "The first frame must show the branch without the load.",
                         "Trim the recording so that it starts before the load.")
    noise = _noise(positions[:, whole])
    last = max(len(times) // 20, 3)
    end = np.nanmean(positions[-last:], axis=0)
    count = _still_frames(positions, end, noise)
    rest = _mean(positions[:count])
    off = np.linalg.norm(end - rest, axis=1)
    moved = float(np.nanmax(off[whole]))
    if moved < 1.5 * SURE * noise * np.sqrt(1 / count + 1 / last):
        raise InputError(
            f"{name}: no marker moves by more than {moved * 1e3:.2g} mm between start and end.",
            f"The markers' noise is {noise * 1e3:.2g} mm, so the load has no visible effect.",
            "Hang a larger weight, or check that the recording starts without it.")
    away = np.linalg.norm(_running_mean(positions[:, whole]) - end[whole], axis=2)
    band = max(STILL_SHARE * moved, STRAY * noise * np.sqrt(1 / MEAN_WIDTH + 1 / last))
    outside = np.flatnonzero(np.nanmax(np.where(np.isfinite(away), away, 0.0), axis=1) > band)
    first = int(outside[-1]) + 1 if len(outside) else 0
    if band > HIDDEN_SHARE * moved:
        first = max(first, _settled_frame(positions, rest, end, noise, last))
    if len(times) - first < max(8, 0.03 * len(times)):
        swing = np.nanmax(np.ptp(positions[-last:, whole], axis=0))
        raise InputError(
            f"{name}: the recording ends before the branch is at rest (it still moves by "
            f"{swing * 1e3:.2g} mm).", "A static fit needs the branch at rest under the load.",
            "Record until the branch has settled, or import the recording with ",
            Option("motion", "swing"), " and fit the swing (", Command("swing"), ").")
    blocks = np.array_split(np.arange(first, len(times)), FRAMES)
    means = np.array([_mean(positions[block]) for block in blocks])
    middle = np.array([times[block].mean() for block in blocks])
    drift = float(np.nanmax(np.linalg.norm(means[-1] - means[0], axis=1)[whole]))
    warnings: tuple[str, ...] = ()
    if drift > 0.002 * moved + 2 * noise / np.sqrt(len(blocks[0])):
        warnings = (f"{name}: the branch still creeps at rest, by {100 * drift / moved:.1f} % of "
                    f"its displacement over {times[-1] - times[first]:.1f} s. Young's modulus "
                    "applies to this moment only.",)
    return Settled(rest, middle, means, noise, moved, float(times[-1] - times[first]), warnings)


def swung(seen: Observations, start: str, name: str) -> tuple[np.ndarray, float]:
    """Return the markers at rest [m], shape [m, 3], and their noise [m]; ``start``: "held", at rest
    before the release, or "loaded", at rest when the swing is over. InputError if no marker stays
    in view, or a loaded one still swings at the end."""
    whole = seen.visible.mean(axis=0) > 0.5
    if not whole.any():
        raise InputError(f"{name}: no marker stays in view.", "A swing is tracked over time.",
                         "Record again with the markers facing the cameras.")
    noise = _noise(seen.positions[:, whole])
    if start == "held":
        last = _mean(seen.positions[-max(len(seen.times) // 20, 3):])
        return _mean(seen.positions[:_still_frames(seen.positions, last, noise)]), noise
    last = seen.positions[-max(len(seen.times) // 10, 5):]
    travel = np.nanmax(np.ptp(seen.positions[:, whole], axis=0))
    if np.nanmax(np.ptp(last[:, whole], axis=0)) > 0.05 * travel + 6 * noise:
        raise InputError(f"{name}: the recording ends while the branch still swings.",
                         "Its rest position without the load is not known then.",
                         "Record until the branch has settled.")
    return _mean(last), noise


def _noise(positions: np.ndarray) -> float:
    """Noise of one coordinate from second differences, which are close to zero for a smooth motion.
    """
    second = np.diff(positions, n=2, axis=0)
    second = second[np.isfinite(second)]
    if not len(second):
        return 1e-5
    return max(1.4826 * float(np.median(np.abs(second))) / np.sqrt(6), 1e-6)


def _still_frames(positions: np.ndarray, end: np.ndarray, noise: float) -> int:
    """Return the number of initial frames before anything moves; at least one."""
    away = np.linalg.norm(positions - positions[0], axis=2)
    band = 6 * noise + 5e-5
    still = np.nanmax(np.where(np.isfinite(away), away, 0.0), axis=1) < band
    count = max(int(np.argmin(still)) if not still.all() else len(still), 1)
    if band < HIDDEN_SHARE * np.nanmax(np.linalg.norm(end - positions[0], axis=1)):
        return count
    for _ in range(3):
        course, deviation = _course(positions, _mean(positions[:count]), end, noise)
        # The motion is half complete at the frame that best separates values below one half from
        # those above.
        half = max(int(np.argmin(np.cumsum(course - 0.5))) + 1, 1)
        width = max(5, half // 4)
        moving = _smoothed(course, width) > SURE * deviation / np.sqrt(width) + 0.02
        begin = int(np.argmax(moving)) if moving.any() else half
        count = max(min(begin, half) - width // 2, 1)
    return count


def _settled_frame(positions: np.ndarray, rest: np.ndarray, end: np.ndarray, noise: float,
                   last: int) -> int:
    """Return the first frame of the settled end in the mean of all markers; the end is the mean of
    the ``last`` frames."""
    course, deviation = _course(positions, rest, end, noise)
    width = max(5, len(course) // 12)
    band = SURE * deviation * np.sqrt(1 / width + 1 / last) + STILL_SHARE
    away = np.abs(_smoothed(course, width) - 1) > band
    return int(np.flatnonzero(away)[-1]) + 1 + width // 2 if away.any() else 0


def _course(positions: np.ndarray, rest: np.ndarray, end: np.ndarray, noise: float,
            ) -> tuple[np.ndarray, float]:
    """Return the progress of all markers from rest, 0, to end, 1, shape [t], and its deviation."""
    vector = end - rest
    whole = np.isfinite(vector).all(axis=1)
    length = float(np.linalg.norm(vector[whole])) or noise
    off = np.where(np.isfinite(positions), positions - rest, 0.0)[:, whole]
    return np.einsum("tma,ma->t", off, vector[whole]) / length**2, noise / length


def _smoothed(course: np.ndarray, width: int) -> np.ndarray:
    return np.convolve(np.pad(course, (width // 2, (width - 1) // 2), mode="edge"),
                       np.full(width, 1 / width), mode="valid")


def _mean(positions: np.ndarray) -> np.ndarray:
    known = np.isfinite(positions).all(axis=2)
    total = np.where(known[..., None], positions, 0.0).sum(axis=0)
    count = known.sum(axis=0)[:, None]
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


def _running_mean(positions: np.ndarray, width: int = MEAN_WIDTH) -> np.ndarray:
    pad = np.pad(positions, ((width // 2, width // 2), (0, 0), (0, 0)), mode="edge")
    windows = np.lib.stride_tricks.sliding_window_view(pad, width, axis=0)
    return np.nanmean(np.where(np.isfinite(windows), windows, np.nan), axis=-1) \
        if np.isfinite(positions).all() else np.ma.masked_invalid(windows).mean(axis=-1).filled(
            np.nan)
