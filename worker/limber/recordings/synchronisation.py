"""The streams of robot and observer on one clock: frames that an estimator compares.

The observer's time stamps define the frames. At each the gripper's pose is interpolated, and its
wrench is averaged over the time between two frames.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from limber.core.errors import InputError
from limber.core.numerics.rigid import poses_at
from limber.recordings.recording import Pull
from limber.recordings.time_series import gaps, inside_gap


@dataclass(frozen=True)
class Frames:
    """Actions and observations at the same instants.

    Attributes:
        times: [s] on the robot's clock, shape [f].
        poses: [m, rad], shape [f, 6].
        wrenches: Gripper on branch [N, N m], shape [f, 6]; NaN where not measured.
        wrench_counts: Readings averaged in each wrench, shape [f].
        positions: Observed points [m], shape [f, m, 3]; NaN where not seen.
        covariance: [m^2], shape [f, m, 3, 3].
        warnings: Data that could not be used.
    """

    times: np.ndarray
    poses: np.ndarray
    wrenches: np.ndarray
    wrench_counts: np.ndarray
    positions: np.ndarray
    covariance: np.ndarray
    warnings: tuple[str, ...] = ()

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, chosen: np.ndarray | slice) -> "Frames":
        return Frames(self.times[chosen], self.poses[chosen], self.wrenches[chosen],
                      self.wrench_counts[chosen], self.positions[chosen],
                      self.covariance[chosen], self.warnings)


def frames_of(pull: Pull) -> Frames:
    """Synchronise a pull's streams at the observer's time stamps.

    Raises:
        InputError: the clocks do not overlap, or there is nothing to compare.
    """
    sigma = pull.entry.sensor.position_sigma_m
    seen = pull.observations
    if seen is None:
        times, positions = pull.times, np.full((len(pull.times), 0, 3), np.nan)
        covariance = np.zeros((len(times), 0, 3, 3))
    else:
        times, positions = seen.times + pull.entry.time_offset_s, seen.positions
        isotropic = np.broadcast_to(sigma**2 * np.eye(3), (*positions.shape, 3))
        covariance = isotropic if seen.covariance is None else seen.covariance
    slack = 0.5 * np.median(np.diff(pull.times))
    usable = (times >= pull.times[0] - slack) & (times <= pull.times[-1] + slack)
    usable &= ~inside_gap(times, gaps(pull.times))
    if usable.sum() < 2:
        raise InputError(
            f"{pull.name}: the robot's recording covers {pull.times[0]:.2f} to "
            f"{pull.times[-1]:.2f} s, the observations {times[0]:.2f} to {times[-1]:.2f} s.",
            "Fewer than two observations lie within the robot's recording.",
            "Import it again with the right --time-offset.")
    warnings = () if usable.all() else (
        f"{pull.name}: {np.sum(~usable)} of {len(times)} observed frames lie outside the robot's "
        "recording or in a gap in it. They are not used.",)
    times = np.clip(times[usable], pull.times[0], pull.times[-1])
    wrenches, counts = _mean_wrenches(pull, times)
    return Frames(times, poses_at(pull.times, pull.poses, times), wrenches, counts,
                  positions[usable], np.array(covariance[usable]), warnings)


def estimate_offset(pull: Pull, *, limit_s: float = 1.0) -> tuple[float, float]:
    """Find the offset [s] to add to the observations' stamps, and its standard deviation.

    Without inertia the observed motion is a smooth function of the gripper's pose. The offset
    returned is the one for which a quadratic function of the pose best fits the observed points.
    A pull at constant speed, started and ended out of view, does not determine it: the standard
    deviation is then infinite.
    """
    seen = pull.observations
    if seen is None or len(seen.times) < 12:
        return pull.entry.time_offset_s, np.inf
    whole = seen.visible.all(axis=0) if seen.visible.all(axis=0).any() else seen.visible.any(axis=0)
    positions = seen.positions[:, whole]
    rows = np.isfinite(positions).all(axis=(1, 2))
    target = positions[rows].reshape(rows.sum(), -1)
    target = target - target.mean(axis=0)

    def unexplained(offset: float) -> float:
        moments = np.clip(seen.times[rows] + offset, pull.times[0], pull.times[-1])
        features = _quadratic_features(poses_at(pull.times, pull.poses, moments))
        solved = np.linalg.lstsq(features, target, rcond=1e-9)[0]
        return float(np.mean((target - features @ solved)**2))

    start = pull.entry.time_offset_s
    grid = start + np.linspace(-limit_s, limit_s, 81)
    cost = np.array([unexplained(offset) for offset in grid])
    best = int(np.argmin(cost))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, 80)]
    found = scipy.optimize.minimize_scalar(unexplained, bounds=(low, high), method="bounded",
                                           options={"xatol": 1e-5})
    step = 2e-3
    beside = unexplained(found.x + step) + unexplained(found.x - step)
    curvature = (beside - 2 * found.fun) / step**2
    noise = max(found.fun, 1e-16)
    informative = curvature > 0 and np.ptp(cost) > 0.2 * noise + 1e-16
    sigma = float(np.sqrt(2 * noise / (curvature * target.size))) if informative else np.inf
    return (float(found.x), sigma) if np.isfinite(sigma) else (start, sigma)


def _quadratic_features(poses: np.ndarray) -> np.ndarray:
    centred = poses - poses.mean(axis=0)
    _, size, axes = np.linalg.svd(centred, full_matrices=False)
    along = centred @ axes[size > 1e-3 * size[0] + 1e-12].T
    if along.shape[1]:
        along = along / np.abs(along).max(axis=0)
    pairs = [along[:, i] * along[:, j] for i in range(along.shape[1]) for j in range(i + 1)]
    return np.column_stack([np.ones(len(poses)), along, *pairs])


def _mean_wrenches(pull: Pull, at_times: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    measured = np.isfinite(pull.wrenches[:, :3]).all(axis=1)
    wrenches = np.full((len(at_times), 6), np.nan)
    counts = np.zeros(len(at_times), int)
    if not measured.any():
        return wrenches, counts
    times, values = pull.times[measured], pull.wrenches[measured]
    unknown = ~np.isfinite(values).all(axis=0)
    values = np.nan_to_num(values)
    half = 0.5 * np.median(np.diff(at_times)) if len(at_times) > 1 else 0.0
    step = np.median(np.diff(pull.times))
    for row, moment in enumerate(at_times):
        near = np.flatnonzero(np.abs(times - moment) <= half)
        if half > 2 * step and len(near) > 2:
            # A mean over a window about the instant is unbiased for values that vary linearly in
            # it.
            slope = np.polynomial.polynomial.polyfit(times[near] - moment, values[near], 1)
            wrenches[row], counts[row] = slope[0], len(near)
        elif np.abs(times - moment).min() <= step:
            wrenches[row] = [np.interp(moment, times, column) for column in values.T]
            counts[row] = 1
    wrenches[:, unknown] = np.nan
    return wrenches, counts
