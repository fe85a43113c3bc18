"""Detection of faults of force sensors and marker systems, before a fit uses their data.

Each check returns the pull with the fault removed and a sentence about it in ``warnings``.
"""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import scipy

from limber.core.constants import FORCE_UNITS_N
from limber.core.errors import InputError, Option, Text
from limber.core.files.reading import read_toml
from limber.recordings.recording import Observations, Pull
from limber.recordings.time_series import gaps, saturated, spikes

_FARTHEST, _MOST_TURN, _MOST_FORCE = 1e4, 1e3, 1e6  # m of the branch, rad, N or N m
PLAUSIBLE_YOUNG_PA = (2e4, 4e10)
"""From soft silicone to the stiffest dry wood; outside, the force's scale is wrong."""


def clean(pull: Pull) -> Pull:
    """Apply every check that needs no model.

    Raises:
        InputError: a position, force or torque is beyond any plausible value.
    """
    _require_possible(pull)
    for check in (_without_bad_readings, _tared, _with_right_sign, _with_gaps_named):
        pull = check(pull)
    if pull.observations is not None:
        observations, swaps = unswapped(pull.observations)
        pull = replace(pull, observations=observations)
        if swaps:
            frames = ", ".join(str(frame) for frame in swaps[:8])
            pull = pull.warned(f"{pull.name}: markers swapped names at frame "
                               f"{frames}{' ...' if len(swaps) > 8 else ''}. The names were "
                               "corrected.")
    return pull


def _require_possible(pull: Pull) -> None:
    seen = None if pull.observations is None else pull.observations.positions
    for what, values, most, unit in (
            ("The gripper's position", pull.poses[:, :3], _FARTHEST, "m"),
            ("The gripper's rotation", pull.poses[:, 3:], _MOST_TURN, "rad"),
            ("The force", pull.wrenches[:, :3], _MOST_FORCE, "N"),
            ("The torque", pull.wrenches[:, 3:], _MOST_FORCE, "N m"),
            ("A marker's position", seen, _FARTHEST, "m")):
        if values is None or not np.isfinite(values).any():
            continue
        if (largest := float(np.nanmax(np.abs(values)))) > most:
            raise InputError(f"{pull.name}: {what[0].lower()}{what[1:]} reaches {largest:.3g} "
                             f"{unit}.", f"No recording of a branch has more than {most:g} {unit}.",
                             "Check the units of the recording, and whether its columns are what "
                             "their titles say. Then import it again.")


def work_done(pull: Pull) -> np.ndarray:
    """Return the cumulative work [J] of the gripper on the branch, shape [n]; samples without a
    wrench are given the previous one."""
    wrench = pull.wrenches.copy()
    for column in range(6):
        measured = np.isfinite(wrench[:, column])
        wrench[:, column] = np.interp(pull.times, pull.times[measured], wrench[measured, column]
                                      ) if measured.any() else 0.0
    mean = (wrench[1:] + wrench[:-1]) / 2
    # Rotation vectors add up only for small steps; those between two samples are small.
    return np.r_[0.0, np.cumsum(np.sum(mean * np.diff(pull.poses, axis=0), axis=1))]


def force_unit_suspicion(young_pa: float) -> str | None:
    """Return the likely unit of the force if the Young's modulus [Pa] that the measured work
    implies, with forces in newtons, is implausible."""
    low, high = PLAUSIBLE_YOUNG_PA
    if low <= young_pa <= high:
        return None
    fitting = [name for name, newtons in FORCE_UNITS_N.items()
               if name != "N" and low <= young_pa * newtons <= high]
    hint = f"It may be in {' or '.join(fitting)}. " if fitting else ""
    return Text(f"The measured force implies a Young's modulus of {young_pa:.2g} Pa, outside the "
                f"range of plants, {low:.0e}-{high:.0e} Pa. The force may be in another unit than "
                f"newtons. {hint}Import the recording with ", Option("force_unit"), ".")


def unswapped(observations: Observations) -> tuple[Observations, list[int]]:
    """Restore the names of markers that exchanged them: another assignment is used if it at least
    halves the distance from a constant-velocity prediction from the two frames before. Returns the
    observations and the frames at which names changed."""
    positions = observations.positions.copy()
    swaps: list[int] = []
    if observations.point_count < 2:
        return observations, swaps
    order = np.arange(observations.point_count)
    last, before = positions[0].copy(), positions[0].copy()
    for frame in range(1, len(positions)):
        now = observations.positions[frame][order]
        predicted = 2 * last - before
        change = _better_order(predicted, now)
        if change is not None:
            order = order[change]
            now = now[change]
            swaps.append(frame)
        positions[frame] = now
        seen = np.isfinite(now).all(axis=1)
        before = np.where(seen[:, None], last, before)
        last = np.where(seen[:, None], now, last)
    return replace(observations, positions=positions), swaps


def _better_order(predicted: np.ndarray, now: np.ndarray) -> np.ndarray | None:
    seen = np.flatnonzero(np.isfinite(now).all(axis=1) & np.isfinite(predicted).all(axis=1))
    if len(seen) < 2:
        return None
    cost = np.linalg.norm(predicted[seen, None] - now[None, seen], axis=2)
    rows, columns = scipy.optimize.linear_sum_assignment(cost**2)
    kept, best = np.trace(cost**2), np.sum(cost[rows, columns]**2)
    separation = np.min(np.linalg.norm(
        predicted[seen, None] - predicted[None, seen], axis=2) + np.diag(np.full(len(seen), 1e9)))
    if best < 0.25 * kept and kept > (0.3 * separation)**2:
        change = np.arange(len(now))
        change[seen[rows]] = seen[columns]
        return change
    return None


def _without_bad_readings(pull: Pull) -> Pull:
    wrench = pull.wrenches.copy()
    rows = np.flatnonzero(np.isfinite(wrench[:, :3]).all(axis=1))
    if len(rows) < 5:
        return pull
    messages = []
    limited = rows[saturated(wrench[rows, :3])]
    if pull.entry.sensor.force_range_n is not None:
        beyond = np.any(np.abs(wrench[:, :3]) >= pull.entry.sensor.force_range_n, axis=1)
        limited = np.union1d(limited, np.flatnonzero(beyond))
    if len(limited):
        messages.append(f"{pull.name}: the force sensor is saturated in {len(limited)} samples "
                        f"(at {np.nanmax(np.abs(wrench[limited, :3])):.3g} N). The force of these "
                        "samples is not used. Pull less far, or use a sensor with a wider range.")
    kept = np.setdiff1d(rows, limited)
    jumps = kept[spikes(wrench[kept, :3])] if len(kept) else kept
    if len(jumps):
        times = ", ".join(f"{pull.times[row]:.2f}" for row in jumps[:5])
        messages.append(f"{pull.name}: {len(jumps)} force spike(s) at {times} s were discarded.")
    wrench[np.union1d(limited, jumps).astype(int)] = np.nan
    return replace(pull, wrenches=wrench).warned(*messages)


def _tared(pull: Pull) -> Pull:
    travel = np.linalg.norm(pull.poses[:, :3] - pull.poses[0, :3], axis=1)
    travel += pull.entry.grasp.radius_m * np.linalg.norm(
        pull.poses[:, 3:] - pull.poses[0, 3:], axis=1)
    if pull.entry.gravity_m_s2 is not None or travel.max() <= 0:
        # The hand carries weight at rest, or never moves: the zero of the force is undetermined.
        return pull
    at_rest = np.cumprod(travel <= 0.01 * travel.max()).astype(bool)
    # A gauge measures no torque.
    quiet = pull.wrenches[at_rest & np.isfinite(pull.wrenches[:, :3]).all(axis=1)]
    if not len(quiet) or np.linalg.norm(pull.poses[0, :3] - pull.entry.grasp.point_m) > 2e-3:
        return pull
    offset, sigma = np.median(quiet, axis=0), pull.entry.sensor.force_sigma_n
    peak = np.nanmax(np.linalg.norm(pull.wrenches[:, :3], axis=1))
    bias = np.linalg.norm(offset[:3])
    # Five standard deviations of the mean, and more than a few percent of the measured value.
    if bias <= 5 * sigma / np.sqrt(len(quiet)) or bias <= 0.03 * peak:
        return pull
    return replace(pull, wrenches=pull.wrenches - offset).warned(
        f"{pull.name}: the force sensor was not tared: it reads {bias:.3g} N with the branch at "
        "rest. That reading was subtracted from the whole pull.")


def _with_right_sign(pull: Pull) -> Pull:
    # By the change of the force: its zero may not be that of a recording that begins bent.
    first = pull.wrenches[np.isfinite(pull.wrenches[:, :3]).all(axis=1)]
    if not len(first) or not pull.entry.sensor.tared:
        # Without a zero, the work is unknown.
        return pull
    work = work_done(replace(pull, wrenches=pull.wrenches - np.nan_to_num(first[:1])))
    most, least = work.max(), work.min()
    # The noise of each reading, and that of the first one over the whole way.
    way = pull.poses[:, :3]
    noise = pull.entry.sensor.force_sigma_n * np.hypot(
        np.linalg.norm(np.diff(way, axis=0)), np.linalg.norm(np.ptp(way, axis=0)))
    if -least <= 3 * most or -least <= 3 * noise:
        return pull
    seen = (f"{pull.name}: according to the measured force, the branch did {-least:.3g} J of work "
            "on the gripper. A branch at rest cannot do this")
    if pull.entry.gravity_m_s2 is not None:
        return pull.warned(f"{seen} except by its weight. Check the sign of the force.")
    return replace(pull, wrenches=-pull.wrenches).warned(
        f"{seen}. The wrench is that of the branch on the gripper. Its sign was reversed.")


def _with_gaps_named(pull: Pull) -> Pull:
    messages = []
    clocks = {"robot": pull.times}
    if pull.observations is not None:
        clocks["observations"] = pull.observations.times
    for name, times in clocks.items():
        found = gaps(times)
        if len(found):
            messages.append(f"{pull.name}: there are {len(found)} gap(s) in the {name}, the "
                            f"longest {np.ptp(found, axis=1).max():.2f} s. Values are not "
                            "interpolated across gaps.")
    return pull.warned(*messages)


# Sensor presets: how the files of a scanner or camera are read, and the noise of a force sensor.


@dataclass(frozen=True)
class SensorPreset:
    """A sensor, the stage that reads its data, the settings of it that the sensor decides, and
    where their values are from."""

    title: str
    stage: str
    source: str
    settings: dict[str, Any] = field(default_factory=dict)


SENSORS = {name: SensorPreset(**known) for name, known in read_toml(
    Path(__file__).with_name("sensors.toml"), "the sensors' presets").items()}
