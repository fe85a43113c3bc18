"""The streams of robot and observer on one clock: frames that an estimator compares.

The observer's time stamps define the frames. At each the gripper's pose is interpolated, and its
wrench is averaged over the time between two frames.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from limber.core.errors import InputError, Option
from limber.core.numerics.rigid import poses_at
from limber.recordings.recording import Pull
from limber.recordings.time_series import gaps, inside_gap

UNMEASURED_M = 1.0
"""Standard deviation of a position across the direction in which a ruler measures it."""

SEARCH_S = 10.0
"""Largest offset between the clocks that is searched for."""
DETERMINED_S = 0.02
"""Largest standard deviation of an offset that counts as found."""
_COARSE_S, _COARSE_ROWS = 0.1, 100
"""Step of the first search, and the frames that it uses."""
_SURE = 3.0
"""Standard deviations within which another offset fits as well."""


@dataclass(frozen=True)
class Frames:
    """Actions and observations at the same instants [s] of the robot's clock, shape [f]: poses [m,
    rad], shape [f, 6]; wrenches of the gripper on the branch [N, N m], means of ``wrench_counts``
    readings; points [m], shape [f, m, 3], with covariance [m^2]; NaN where not measured or seen."""

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
    seen = pull.observations
    if seen is None:
        times, positions = pull.times, np.full((len(pull.times), 0, 3), np.nan)
        covariance = np.zeros((len(times), 0, 3, 3))
    else:
        times, positions = seen.times + pull.entry.time_offset_s, seen.positions
        alike = np.broadcast_to(_reading_covariance(pull), (*positions.shape, 3))
        covariance = alike if seen.covariance is None else seen.covariance
    slack = 0.5 * np.median(np.diff(pull.times))
    usable = (times >= pull.times[0] - slack) & (times <= pull.times[-1] + slack)
    usable &= ~inside_gap(times, gaps(pull.times))
    if usable.sum() < 2:
        raise InputError(
            f"{pull.name}: the robot's recording covers {pull.times[0]:.2f} to "
            f"{pull.times[-1]:.2f} s, the observations {times[0]:.2f} to {times[-1]:.2f} s.",
            "Fewer than two observations lie within the robot's recording.",
            "Import it again with the right ", Option("time_offset"), ".")
    warnings = () if usable.all() else (
        f"{pull.name}: {np.sum(~usable)} of {len(times)} observed frames lie outside the robot's "
        "recording or in a gap in it. They are not used.",)
    times = np.clip(times[usable], pull.times[0], pull.times[-1])
    wrenches, counts = _mean_wrenches(pull, times)
    return Frames(times, poses_at(pull.times, pull.poses, times), wrenches, counts,
                  positions[usable], np.array(covariance[usable]), warnings)


def _reading_covariance(pull: Pull) -> np.ndarray:
    """Covariance of one reading of a position [m^2], shape [3, 3]."""
    sensor = pull.entry.sensor
    if sensor.measured_direction is None:
        return sensor.position_sigma_m**2 * np.eye(3)
    along = np.array(sensor.measured_direction) / np.linalg.norm(sensor.measured_direction)
    across = np.eye(3) - np.outer(along, along)
    return sensor.position_sigma_m**2 * np.outer(along, along) + UNMEASURED_M**2 * across


def estimate_offset(pull: Pull) -> tuple[float, float]:
    """Find the offset [s] to add to the observations' stamps, and its standard deviation. Without
    inertia the motion is a smooth function of the gripper's pose: the offset is the one for which a
    quadratic function of it fits best. At constant speed, started and ended out of view, or if
    others fit about as well, the deviation is infinite; it includes the rounding of poses and
    positions, whose error does not average out while a value stays. InputError if the best is at
    the end of the search, or several fit, but not the pull's own."""
    seen = pull.observations
    if seen is None or len(seen.times) < 12:
        return pull.entry.time_offset_s, np.inf
    whole = seen.visible.all(axis=0) if seen.visible.all(axis=0).any() else seen.visible.any(axis=0)
    positions = seen.positions[:, whole]
    rows = np.isfinite(positions).all(axis=(1, 2))
    observed = positions[rows].reshape(rows.sum(), -1)
    target = observed - observed.mean(axis=0)

    quanta = _quanta(pull.poses)
    smooth = np.column_stack([
        # A rotation vector jumps where the angle passes half a turn.
        _unrounded(pull.times, each) if quantum > 0 and np.ptp(np.diff(each)) < 1.0 else each
        for each, quantum in zip(pull.poses.T, quanta, strict=True)])

    def at(offset: float, poses: np.ndarray = smooth) -> np.ndarray:
        moments = np.clip(seen.times[rows] + offset, pull.times[0], pull.times[-1])
        return poses_at(pull.times, poses, moments)

    def unexplained(offset: float, every: int = 1) -> float:
        poses = at(offset)[::every]
        features = _Quadratic.of(poses).features(poses)
        solved = np.linalg.lstsq(features, target[::every], rcond=1e-9)[0]
        left = target[::every] - features @ solved
        # Per reading that is left over: many functions fit a few readings whatever the offset.
        return float(np.sum(left**2) / max(left.size - solved.size, 1))

    start = pull.entry.time_offset_s
    every = max(len(target) // _COARSE_ROWS, 1)
    coarse = start + np.arange(-SEARCH_S, SEARCH_S + _COARSE_S / 2, _COARSE_S)
    rough = np.array([unexplained(offset, every) for offset in coarse])
    near = coarse[int(np.argmin(rough))]
    grid = near + np.linspace(-_COARSE_S, _COARSE_S, 17)
    cost = np.array([unexplained(offset) for offset in grid])
    best = int(np.argmin(cost))
    low, high = grid[max(best - 1, 0)], grid[min(best + 1, len(grid) - 1)]
    found = scipy.optimize.minimize_scalar(unexplained, bounds=(low, high), method="bounded",
                                           options={"xatol": 1e-5})
    if np.ptp(rough) <= 0.2 * rough.min() + 1e-16:
        return start, np.inf
    if abs(near - start) > SEARCH_S - _COARSE_S / 2:
        raise _not_found(pull.name, start, near, near)
    # Others that fit as well, by a likelihood ratio (three standard deviations).
    allowed = 1 + _SURE**2 / max(target.size - 15 * target.shape[1], target.shape[1])
    others = np.r_[coarse[rough < 1.3 * rough.min() + 1e-16], grid]
    fits = others[[unexplained(other) < allowed * found.fun + 1e-16 for other in others]]
    if np.abs(fits - found.x).max(initial=0.0) > 2 * DETERMINED_S:
        if unexplained(start) < 1.2 * found.fun + 1e-16:
            return start, np.inf
        raise _not_found(pull.name, start, float(fits.min()), float(fits.max()))
    step = 2e-3
    beside = unexplained(found.x + step) + unexplained(found.x - step)
    curvature = (beside - 2 * found.fun) / step**2
    noise = max(found.fun, 1e-16)
    if not curvature > 0:
        return start, np.inf
    kept = np.searchsorted(pull.times, seen.times[rows] + found.x).clip(0, len(pull.times) - 1)
    rounded = _rounding(pull.poses[kept], quanta, observed,
                        [at(found.x + k * step) for k in (-1, 0, 1)], step)
    return float(found.x), float(np.hypot(np.sqrt(2 * noise / (curvature * target.size)), rounded))


def _not_found(name: str, start: float, low: float, high: float) -> InputError:
    several = f"Offsets of {low:.2f} to {high:.2f} s fit" if high > low else (
        f"An offset of {low:.2f} s fits best, at the end of that range")
    return InputError(
        f"{name}: the observed points do not follow the gripper with the clocks as they are. "
        f"Offsets of {start - SEARCH_S:.4g} to {start + SEARCH_S:.4g} s were tried.",
        f"{several}, so the pull does not determine the offset between the clocks.",
        "Check that both tables are of the same pull and that their times are in the stated unit; "
        "then state the offset with ", Option("time_offset", float(f"{(low + high) / 2:.3f}")), ".")


@dataclass(frozen=True)
class _Quadratic:
    """Quadratic functions of a pose along the directions in which it moves."""

    middle: np.ndarray
    axes: np.ndarray
    size: np.ndarray

    @classmethod
    def of(cls, poses: np.ndarray) -> "_Quadratic":
        centred = poses - poses.mean(axis=0)
        _, size, axes = np.linalg.svd(centred, full_matrices=False)
        axes = axes[size > 1e-3 * size[0] + 1e-12].T
        return cls(poses.mean(axis=0), axes, np.abs(centred @ axes).max(axis=0, initial=0.0))

    def features(self, poses: np.ndarray) -> np.ndarray:
        along = (poses - self.middle) @ self.axes / self.size
        pairs = [along[:, i] * along[:, j] for i in range(along.shape[1]) for j in range(i + 1)]
        return np.column_stack([np.ones(len(poses)), along, *pairs])


def _rounding(rounded: np.ndarray, quanta: np.ndarray, observed: np.ndarray,
              poses: list[np.ndarray], step: float) -> float:
    """Standard deviation of the offset [s] from poses [m, rad], shape [f, 6], rounded to ``quanta``
    [6], and rounded positions [m], shape [f, c]; ``poses``: at the found offset and ``step`` [s]
    before and after."""
    before, middle, after = poses
    target = observed - observed.mean(axis=0)
    basis = _Quadratic.of(middle)
    features = basis.features(middle)
    solved = np.linalg.lstsq(features, target, rcond=1e-9)[0]
    speed = (basis.features(after) - basis.features(before)) @ solved / (2 * step)
    spanned = np.linalg.qr(features)[0]
    weight = speed - spanned @ (spanned.T @ speed)
    variance = 0.0
    for column, quantum in enumerate(quanta):
        if quantum > 0:
            moved = middle + quantum / 12**0.5 * np.eye(6)[column]
            error = (basis.features(moved) - features) @ solved
            variance += _coherent((weight * error).sum(axis=1), rounded[:, column])
    for column, quantum in enumerate(_quanta(observed)):
        if quantum > 0:
            variance += _coherent(weight[:, column] * quantum / 12**0.5, observed[:, column])
    return float(np.sqrt(variance) / max(np.sum(weight**2), 1e-300))


def _coherent(effect: np.ndarray, values: np.ndarray) -> float:
    """Variance of a sum of errors that are the same as long as a value stays the same, [f] each;
    those of neighbouring values are related as well, so the deviations add up."""
    runs = np.r_[0, np.cumsum(np.diff(values) != 0)]
    return float(np.sum(np.abs(np.bincount(runs, effect))))**2


def _unrounded(times: np.ndarray, values: np.ndarray) -> np.ndarray:
    """A rounded course without its steps: halfway between two levels where it changes, [n]."""
    last = np.flatnonzero(np.diff(values) != 0)
    moments, levels = (0.5 * (each[last] + each[last + 1]) for each in (times, values))
    # Runs at both ends, and where the motion reverses, stay at their level in between.
    widths = np.diff(moments, prepend=moments[0], append=moments[-1])
    still = [(times[0], values[0]), (times[-1], values[-1])]
    if len(moments) > 1:
        still += [(max(times[0], moments[0] - widths[1] / 2), values[0]),
                  (min(times[-1], moments[-1] + widths[-2] / 2), values[-1])]
    turns = np.flatnonzero(np.diff(levels) == 0)
    still += [(0.5 * (moments[k] + moments[k + 1]), values[last[k] + 1]) for k in turns]
    knots = np.array(sorted([*zip(moments, levels, strict=True), *still]))
    return np.interp(times, *knots.T)


def _quanta(values: np.ndarray) -> np.ndarray:
    """Step to which each column was rounded; 0: not rounded, or constant. Shape [c]."""
    found = np.zeros(values.shape[1])
    for column, each in enumerate(values.T):
        steps = np.diff(np.unique(each))
        steps = steps[steps > 1e-9 * max(np.abs(each).max(), 1e-9)]
        counts = (each - each.min()) / steps.min(initial=np.inf)
        if len(steps) and np.abs(counts - np.round(counts)).max() < 0.02:
            found[column] = steps.min()
    return found


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
