"""Errors of cell and sensors as unknowns of a fit, and their effect on the measurements.

Gripper frame, zero and gain of the force, camera frame, clock, slip of the grasp and places of the
observed points are constant during a recording. If they are taken as exact, their errors end up in
the moduli (1 mm of the gripper's pose: over 60 %). To first order each changes the predicted
measurements linearly. All of them are therefore eliminated from the residuals together with their
priors (variable projection, Golub and Pereyra 1973, with the prior as further rows). The remaining
residuals depend on the moduli alone. The covariance of the moduli includes the errors, and the
errors have their own covariance.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular

from limber.core.not_none import present
from limber.estimation.forward.forward_model import Forward
from limber.recordings.recording import CalibrationEntry, PullEntry, calibration_of
from limber.recordings.synchronisation import Frames

AXES = "xyz"
BEND_OF_DRIFT = 0.3
"""A sensor's zero drifts as it warms up: curvature of the drift, as a fraction of its linear part.
"""
NAMED = 3.0
"""Deviations from zero above which an error is reported: without it the fit would be poor."""
NAMED_SHARE = 0.3
"""It must also exceed this fraction of the prior deviation."""
UNLIKELY = 10.0
"""Prior deviations above which an error invalidates the result. Seen: a force gain 35 deviations
off, with moduli five times too high and narrow intervals.
"""

_MOST_NAMED = 4
CREEP = "creep of the branch"
CREEP_SIGMA = 0.1
"""Prior deviation of the force's fall under a lasting bend: some percent in green wood."""


@dataclass(frozen=True)
class Nuisance:
    """An error that is constant during a recording, and its prior deviation in ``unit`` (m, rad, N,
    N m, s, or empty: relative). ``pull`` has it; None: the cell, in one calibration."""

    name: str
    unit: str
    sigma: float
    pull: str | None


@dataclass(frozen=True)
class ErrorSlopes:
    """Change of predicted measurements by k errors, each in its deviations: points [f, m, 3, k],
    forces and torques [f, 3, k], and simulated less recorded grasp point [f, 3, k] [m]."""

    points: np.ndarray
    forces: np.ndarray
    torques: np.ndarray
    grasps: np.ndarray


@dataclass(frozen=True)
class Eliminated:
    """Estimated errors [k] in units of their deviations, their covariance [k, k] for a fixed free
    vector, and their derivative to it [k, p] (None: without derivatives)."""

    values: np.ndarray
    covariance: np.ndarray
    gain: np.ndarray | None

    def total_covariance(self, free: np.ndarray) -> np.ndarray:
        """Covariance that includes that of the free vector, shape [p, p]."""
        if self.gain is None:
            return self.covariance
        return self.covariance + self.gain @ free @ self.gain.T


def eliminated(residual: np.ndarray, jacobian: np.ndarray | None, columns: np.ndarray,
               known: np.ndarray | float = 0.0) -> tuple[np.ndarray, np.ndarray | None, Eliminated]:
    """Eliminate k errors of unit deviation with slopes ``columns`` [r, k]: residual [r + k] and
    Jacobian [r + k, p] with the priors' rows, and the errors. The simulation has ``known`` [k]."""
    count = columns.shape[1]
    basis, triangle = np.linalg.qr(np.vstack([columns, np.eye(count)]))
    residual = np.concatenate([residual, np.broadcast_to(known, count)])
    inside = basis.T @ residual
    values = -solve_triangular(triangle, inside)
    inverse = solve_triangular(triangle, np.eye(count))
    gain = None
    if jacobian is not None:
        jacobian = np.vstack([jacobian, np.zeros((count, jacobian.shape[1]))])
        along = basis.T @ jacobian
        gain = -solve_triangular(triangle, along)
        jacobian = jacobian - basis @ along
    covariance = inverse @ inverse.T
    return residual - basis @ inside, jacobian, Eliminated(values + known, covariance, gain)


@dataclass(frozen=True)
class _Source:
    """Errors that belong together, and their slopes."""

    names: tuple[str, ...]
    unit: str
    sigma: tuple[float, ...]
    is_shared: bool
    slopes: Callable[["_Pull"], dict[str, np.ndarray]]


@dataclass(frozen=True)
class _Pull:
    """The data of a pull that its errors depend on."""

    entry: PullEntry
    frames: Frames
    pivot: np.ndarray
    tangent: np.ndarray | None
    directions: np.ndarray | None
    positions: np.ndarray
    forces: np.ndarray

    @property
    def grip_axis(self) -> np.ndarray:
        """Direction of the branch at the grasp, shape [f, 3]; only if the path is observed."""
        return present(self.tangent, "direction of the branch at the grasp")

    @property
    def share(self) -> np.ndarray:
        """Elapsed fraction of the recording's duration, shape [f]."""
        since = self.frames.times - self.frames.times[0]
        return since / max(float(since[-1]), 1e-12)


class CellErrors:
    """The errors of all pulls of a fit."""

    def __init__(self, forwards: Sequence[Forward]):
        self.nuisances: list[Nuisance] = []
        self._indexed_sources: list[list[tuple[_Source, np.ndarray]]] = []
        self._forwards = forwards
        known: dict[tuple[object, ...], int] = {}
        self._pivots: dict[CalibrationEntry, np.ndarray] = {}
        for forward in forwards:
            indexed = []
            calibration = calibration_of(forward.entry)
            self._pivots.setdefault(calibration, np.array(forward.entry.grasp.point_m))
            for source in _sources(forward, calibration):
                used = np.empty(len(source.names), int)
                for k, (name, sigma) in enumerate(zip(source.names, source.sigma,
                                                      strict=True)):
                    pull = None if source.is_shared else forward.name
                    key = (name, pull if pull is not None else calibration)
                    if key not in known:
                        known[key] = len(self.nuisances)
                        self.nuisances.append(Nuisance(name, source.unit, sigma, pull))
                    used[k] = known[key]
                indexed.append((source, used))
            self._indexed_sources.append(indexed)

    @property
    def known(self) -> np.ndarray:
        """Parts of the errors that the simulations already have, in deviations, shape [k]."""
        parts = np.zeros(self.count)
        for forward, places in zip(self._forwards, self._indexed_sources, strict=True):
            for source, used in places:
                if source.slopes is _along:
                    parts[used] = forward.point_shifts / np.array(source.sigma)
        return parts

    @property
    def count(self) -> int:
        return len(self.nuisances)

    def slopes(self, index: int, positions: np.ndarray, forces: np.ndarray) -> ErrorSlopes:
        """Slopes of pull ``index`` at its simulated positions [f, m, 3] and forces [f, 3]."""
        forward = self._forwards[index]
        frames, count = forward.frames, self.count
        total = {"points": np.zeros((*positions.shape, count)),
                 **{kind: np.zeros((len(frames), 3, count))
                    for kind in ("forces", "torques", "grasps")}}
        pull = _Pull(forward.entry, frames, self._pivots[calibration_of(forward.entry)],
                     forward.grasp_tangent, forward.point_directions, positions, forces)
        for source, used in self._indexed_sources[index]:
            for kind, slope in source.slopes(pull).items():
                total[kind][..., used] += slope * np.array(source.sigma)
        return ErrorSlopes(**total)


def _sources(forward: Forward, known: CalibrationEntry) -> list[_Source]:
    found = []

    def add(names: Sequence[str], unit: str, sigma: float | Sequence[float], is_shared: bool,
            slopes: Callable[[_Pull], dict[str, np.ndarray]]) -> None:
        each = tuple(np.broadcast_to(sigma, len(names)).tolist())
        if any(value > 0 for value in each):
            found.append(_Source(tuple(names), unit, each, is_shared, slopes))

    if forward.frames.positions.shape[1]:
        add([f"camera position {axis}" for axis in AXES], "m", known.camera_sigma_m, True, _shifted)
        add([f"camera rotation about {axis}" for axis in AXES], "rad", known.camera_sigma_rad, True,
            _turned)
        # Scan and observation locate a point each in its own way, in each pull, and the scanned
        # axis has an error: only a stated position is exact across the branch.
        points, off = range(1, 1 + forward.frames.positions.shape[1]), known.point_sigma_m
        add([f"position of point {each} along the branch" for each in points], "m", off, False,
            _along)
        if forward.entry.rest_points_m is None:
            add([f"position of point {each} across the branch ({way})" for each in points
                 for way in (1, 2)], "m", off, False, _across)
        if len(forward.frames) > 3:
            add(["camera clock"], "s", known.clock_sigma_s, False, _late)
    seconds = forward.creep_time
    if seconds is not None and forward.uses_force and not forward.force_is_stated:
        add([CREEP], "", CREEP_SIGMA, True, lambda pull: {
            "forces": -relaxed(pull.frames.times, pull.forces, seconds)[..., None]})
    if forward.uses_force and not forward.force_is_stated:
        add(["force gain"], "", known.force_gain_sigma, True,
            lambda pull: {"forces": pull.forces[..., None]})
        add([f"force zero {axis}" for axis in AXES], "N", known.force_bias_sigma_n, False,
            lambda pull: {"forces": _alike(pull, np.ones(len(pull.frames)))})
        add([f"force drift {axis}" for axis in AXES], "N", known.force_drift_sigma_n, False,
            lambda pull: {"forces": _alike(pull, pull.share)})
        add([f"curvature of the force drift {axis}" for axis in AXES], "N",
            BEND_OF_DRIFT * known.force_drift_sigma_n, False,
            lambda pull: {"forces": _alike(pull, 4 * pull.share * (1 - pull.share))})
        if forward.uses_torque:
            add([f"torque zero {axis}" for axis in AXES], "N m", known.torque_bias_sigma_nm,
                False, lambda pull: {"torques": _alike(pull, np.ones(len(pull.frames)))})
    if forward.watches_pose:
        add([f"gripper position {axis}" for axis in AXES], "m", known.pose_sigma_m, True,
            lambda pull: {"grasps": _alike(pull, np.ones(len(pull.frames)))})
        add([f"gripper rotation about {axis}" for axis in AXES], "rad", known.pose_sigma_rad, True,
            lambda pull: {"grasps": _rotations(pull.frames.poses[:, :3] - pull.pivot)})
        add(["grasp position along the branch"], "m", known.pose_sigma_m, False,
            lambda pull: {"grasps": pull.grip_axis[..., None]})
        add(["slip of the grasp along the branch"], "m", known.slip_sigma_m, False,
            lambda pull: {"grasps": (pull.share[:, None] * pull.grip_axis)[..., None]})
    return found


def _alike(pull: _Pull, course: np.ndarray) -> np.ndarray:
    """Basis of a course over time on each axis, shape [f, 3, 3]."""
    return course[:, None, None] * np.eye(3)


def _rotations(arms: np.ndarray) -> np.ndarray:
    """Change of arms [..., 3] by a small rotation about each axis, shape [..., 3, 3]."""
    return np.stack([np.cross(axis, arms) for axis in np.eye(3)], axis=-1)


def _shifted(pull: _Pull) -> dict[str, np.ndarray]:
    return {"points": np.broadcast_to(np.eye(3), (*pull.positions.shape, 3))}


def _turned(pull: _Pull) -> dict[str, np.ndarray]:
    middle = pull.positions.mean(axis=(0, 1))
    return {"points": _rotations(pull.positions - middle)}


def _along(pull: _Pull) -> dict[str, np.ndarray]:
    """Each point alone moves along the branch, which bends with it."""
    directions = present(pull.directions, "direction of the branch at the observed points")
    return {"points": directions[..., None] * np.eye(directions.shape[1])[:, None, :]}


def _across(pull: _Pull) -> dict[str, np.ndarray]:
    """Each point alone is aside of the axis, in two ways, and turns as the branch there."""
    directions = present(pull.directions, "direction of the branch at the observed points")
    first, count = directions[0], directions.shape[1]
    aside = np.linalg.svd(first[:, None])[2][:, 1:].swapaxes(1, 2)
    # The least rotation from the first direction to each.
    turn = np.einsum("fmi,mik->fmk", directions, aside) / np.maximum(
        1 + np.einsum("fmi,mi->fm", directions, first), 0.1)[..., None]
    turned = aside - (directions + first)[..., None] * turn[:, :, None]
    return {"points": np.einsum("fmik,mn->fmink", turned, np.eye(count)).reshape(
        *directions.shape, 2 * count)}


def _late(pull: _Pull) -> dict[str, np.ndarray]:
    times = pull.frames.times
    # Frames at one instant, such as those of a settled load, have no speed.
    if np.any(np.diff(times) <= 0):
        return {"points": np.zeros((*pull.positions.shape, 1))}
    return {"points": np.gradient(pull.positions, times, axis=0)[..., None]}


def relaxed(times: np.ndarray, forces: np.ndarray, seconds: float) -> np.ndarray:
    """Return what a standard linear solid relaxes of a force [f, 3] [N], per share: the integral of
    (1 - exp(-(t - s) / seconds)) dF(s), exact between frames. The first force acted for long."""
    found = np.zeros_like(forces)
    waiting = np.zeros(forces.shape[1])
    for frame in range(1, len(times)):
        step = (times[frame] - times[frame - 1]) / seconds
        kept = np.exp(-step)
        new = (1 - kept) / step if step > 0 else 1.0
        waiting = kept * waiting + new * (forces[frame] - forces[frame - 1])
        found[frame] = forces[frame] - forces[0] - waiting
    return found


def nuisance_records(nuisances: Sequence[Nuisance], found: Eliminated,
                     free: np.ndarray) -> list[dict]:
    """Return each error with its value, 95 % interval and prior deviation in its own unit; ``free``
    [p, p] is the free vector's covariance."""
    deviation = np.sqrt(np.diag(found.total_covariance(free)))
    listed = []
    for nuisance, value, sure in zip(nuisances, found.values, deviation, strict=True):
        middle, width = value * nuisance.sigma, 1.96 * sure * nuisance.sigma
        listed.append({"name": nuisance.name, "unit": nuisance.unit, "pull": nuisance.pull,
                       "value": middle, "interval": [middle - width, middle + width],
                       "prior_sigma": nuisance.sigma,
                       "explains_misfit": bool(abs(value) > NAMED * sure
                                               and abs(value) > NAMED_SHARE)})
    return listed


def in_words(listed: Sequence[dict]) -> str | None:
    """Return a sentence with the errors without which the fit would be poor, largest first."""
    named = sorted((each for each in listed
                    if each["explains_misfit"] and each["name"] != CREEP),
                   key=lambda each: -abs(each["value"] / each["prior_sigma"]))
    if not named:
        return None
    rest = len(named) - _MOST_NAMED
    more = f"; {rest} more stand in estimate.json" if rest > 0 else ""
    return ("The fit found these errors of the measurement and corrected for them; the intervals "
            f"include them: {'; '.join(map(_shown, named[:_MOST_NAMED]))}{more}.")


def unlikely(listed: Sequence[dict]) -> str | None:
    """Return a sentence on the error that far exceeds its stated deviation, or None."""
    def deviations(each: dict) -> float:
        return abs(each["value"]) / each["prior_sigma"]

    worst = max(listed, key=deviations, default=None)
    if worst is None or deviations(worst) <= UNLIKELY:
        return None
    scale, unit = _SHOWN[worst["unit"]]
    whose = f"{worst['pull']}: the" if worst["pull"] else "The"
    return (f"{whose} {worst['name']} would have an error of {scale * worst['value']:+.2g} "
            f"{unit}. That is {deviations(worst):.0f} times the standard deviation in the pull's "
            "[calibration]. The fit may have found a wrong solution, or the [calibration] may be "
            "wrong.")


_SHOWN = {"m": (1e3, "mm"), "rad": (180 / np.pi, "degrees"), "N": (1.0, "N"),
          "N m": (1.0, "N m"), "s": (1e3, "ms"), "": (100.0, "%")}


def _shown(each: dict) -> str:
    scale, unit = _SHOWN[each["unit"]]
    width = scale * (each["interval"][1] - each["value"])
    whose = f"{each['pull']}, " if each["pull"] else ""
    return f"{whose}{each['name']} {scale * each['value']:+.2g} {unit} (± {width:.1g} {unit})"
