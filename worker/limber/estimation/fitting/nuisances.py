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
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_triangular

from limber.core.errors import Command, Option, Text
from limber.core.not_none import present
from limber.estimation.forward.forward_model import Forward, Simulated
from limber.estimation.parameters import BULK
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


class Cause(NamedTuple):
    """A cause of uncertainty, and what would reduce it."""

    name: str
    advice: str


class Action(NamedTuple):
    """A measurement of unknowns that are otherwise known by priors alone, and how to make it."""

    name: str
    how: str


@dataclass(frozen=True)
class Unknown:
    """A kind of error that is constant during a recording. This entry is all that fit, covariance,
    causes, next actions and tables need of it.

    Attributes:
        names: Of its errors in a pull; none where it does not act.
        unit: m, rad, N, N m, s, or empty: relative.
        sigma: Standard deviation of each in ``unit``, by the pull's calibration.
        slopes: Change of the measurements by each, [..., k], by their names in
            :class:`limber.estimation.forward.forward_model.Simulated`; of the grasp, simulated less
            recorded.
        is_shared: The cell has it, in one calibration; else each pull its own.
        measured: What measures it, and to which deviation.
    """

    cause: Cause
    names: Callable[[Forward], Sequence[str]]
    unit: str
    sigma: Callable[[CalibrationEntry], float]
    slopes: Callable[["_Pull"], dict[str, np.ndarray]]
    is_shared: bool = True
    measured: tuple[Action, float] | None = None


@dataclass(frozen=True)
class Nuisance:
    """An error of a fit, and its prior deviation; ``pull`` has it, None: the cell."""

    name: str
    unknown: Unknown
    sigma: float
    pull: str | None


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
class _Pull:
    """The data of a pull that its errors depend on. All pulls of a cell turn about its first pull's
    grasp, ``pivot``, and about the middle of that one's points at rest, ``rest``."""

    entry: PullEntry
    frames: Frames
    pivot: np.ndarray
    rest: np.ndarray
    tangent: np.ndarray | None
    directions: np.ndarray | None
    positions: np.ndarray
    forces: np.ndarray
    creep_time: float | None = None

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
        self._places: list[list[tuple[Unknown, float, np.ndarray]]] = []
        self._forwards = forwards
        known: dict[tuple[object, ...], int] = {}
        self._first: dict[CalibrationEntry, Forward] = {}
        for forward in forwards:
            calibration, indexed = calibration_of(forward.entry), []
            self._first.setdefault(calibration, forward)
            for unknown in UNKNOWNS:
                sigma, names = unknown.sigma(calibration), unknown.names(forward)
                if not names or not sigma > 0:
                    continue
                pull = None if unknown.is_shared else forward.name
                for name in names:
                    key = (name, pull if pull is not None else calibration)
                    if key not in known:
                        known[key] = len(self.nuisances)
                        self.nuisances.append(Nuisance(name, unknown, sigma, pull))
                used = [known[name, pull if pull is not None else calibration] for name in names]
                indexed.append((unknown, sigma, np.array(used)))
            self._places.append(indexed)

    @property
    def known(self) -> np.ndarray:
        """Parts of the errors that the simulations already have, in deviations, shape [k]."""
        parts = np.zeros(self.count)
        for forward, places in zip(self._forwards, self._places, strict=True):
            for unknown, sigma, used in places:
                if unknown.slopes is _along:
                    parts[used] = forward.point_shifts / sigma
        return parts

    @property
    def count(self) -> int:
        return len(self.nuisances)

    def slopes(self, index: int, simulated: Simulated) -> Simulated:
        """Change of a simulated pull ``index`` by all errors, each in its deviations."""
        forward = self._forwards[index]
        positions, frames = simulated.positions, forward.frames
        total = Simulated.none(len(frames), positions.shape[1], self.count)
        first = self._first[calibration_of(forward.entry)]
        pull = _Pull(forward.entry, frames, np.array(first.entry.grasp.point_m), first.rest_points,
                     forward.grasp_tangent, forward.point_directions, positions,
                     simulated.forces, forward.creep_time)
        for unknown, sigma, used in self._places[index]:
            for kind, slope in unknown.slopes(pull).items():
                getattr(total, kind)[..., used] += slope * sigma
        return total


def _alike(pull: _Pull, course: np.ndarray) -> np.ndarray:
    """Basis of a course over time on each axis, shape [f, 3, 3]."""
    return course[:, None, None] * np.eye(3)


def _rotations(arms: np.ndarray) -> np.ndarray:
    """Change of arms [..., 3] by a small rotation about each axis, shape [..., 3, 3]."""
    return np.stack([np.cross(axis, arms) for axis in np.eye(3)], axis=-1)


def _turned(pull: _Pull) -> dict[str, np.ndarray]:
    return {"positions": _rotations(pull.positions - pull.rest.mean(axis=0))}


def _along(pull: _Pull) -> dict[str, np.ndarray]:
    """Each point alone moves along the branch, which bends with it."""
    directions = present(pull.directions, "direction of the branch at the observed points")
    return {"positions": directions[..., None] * np.eye(directions.shape[1])[:, None, :]}


def _across(pull: _Pull) -> dict[str, np.ndarray]:
    """Each point alone is aside of the axis, in two ways, and turns as the branch there."""
    directions = present(pull.directions, "direction of the branch at the observed points")
    first, count = directions[0], directions.shape[1]
    aside = np.linalg.svd(first[:, None])[2][:, 1:].swapaxes(1, 2)
    # The least rotation from the first direction to each.
    turn = np.einsum("fmi,mik->fmk", directions, aside) / np.maximum(
        1 + np.einsum("fmi,mi->fm", directions, first), 0.1)[..., None]
    turned = aside - (directions + first)[..., None] * turn[:, :, None]
    return {"positions": np.einsum("fmik,mn->fmink", turned, np.eye(count)).reshape(
        *directions.shape, 2 * count)}


def _late(pull: _Pull) -> dict[str, np.ndarray]:
    times = pull.frames.times
    # Frames at one instant, such as those of a settled load, have no speed.
    if np.any(np.diff(times) <= 0):
        return {"positions": np.zeros((*pull.positions.shape, 1))}
    return {"positions": np.gradient(pull.positions, times, axis=0)[..., None]}


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


# The list of all unknowns, and of the other causes.

_CAMERA = Cause("camera frame", "register the camera to the branch (fixed markers), or add a "
                "second view")
_PLACES = Cause("places of the points", Text(
    "mark the points on the branch before the scan, and give their positions (", Option("nominal"),
    " of import-pull)"))
_ZERO = Cause("zero of the force sensor", "tare the sensor before each pull, and state it under "
              "[calibration]")
_GRIPPER = Cause("gripper frame", "calibrate the gripper's frame against the branch's (hand-eye), "
                 "and state its standard deviation under [calibration] in pull.toml")
REGISTER = Action("register the camera", "to 1 mm and 0.06 degrees (camera_sigma_m, "
                  "camera_sigma_rad)")
_MARK = Action("mark the points", Text("on the branch before the scan, to 0.5 mm (", Option(
    "nominal"), " of import-pull, point_sigma_m)"))
_TARE = Action("tare the force sensor", "right before the pull, to 0.05 N with a drift of 0.1 N "
               "(force_bias_sigma_n, force_drift_sigma_n)")
_HAND_EYE = Action("calibrate the gripper", "to 0.2 mm and 0.2 degrees against the branch's frame, "
                   "stated under [calibration] (pose_sigma_m, pose_sigma_rad)")


def _three(name: str, acts: Callable[[Forward], bool]) -> Callable[[Forward], list[str]]:
    return lambda forward: [f"{name} {axis}" for axis in AXES] if acts(forward) else []


def _one(name: str, acts: Callable[[Forward], bool]) -> Callable[[Forward], list[str]]:
    return lambda forward: [name] if acts(forward) else []


def _points(forward: Forward) -> range:
    return range(1, 1 + forward.frames.positions.shape[1])


def _has_points(forward: Forward) -> bool:
    return bool(_points(forward))


def _reads_force(forward: Forward) -> bool:
    return forward.uses_force and not forward.force_is_stated


def _watches(forward: Forward) -> bool:
    return forward.watches_pose


UNKNOWNS = [
    Unknown(_CAMERA, _three("camera position", _has_points), "m",
            lambda known: known.camera_sigma_m, lambda pull: {"positions": np.broadcast_to(
                np.eye(3), (*pull.positions.shape, 3))}, measured=(REGISTER, 1e-3)),
    Unknown(_CAMERA, _three("camera rotation about", _has_points), "rad",
            lambda known: known.camera_sigma_rad, _turned, measured=(REGISTER, 1e-3)),
    # Scan and observation locate a point each in its own way, in each pull, and the scanned axis
    # has an error: only a stated position is exact across the branch.
    Unknown(_PLACES, lambda forward: [f"position of point {each} along the branch"
                                      for each in _points(forward)], "m",
            lambda known: known.point_sigma_m, _along, is_shared=False, measured=(_MARK, 5e-4)),
    Unknown(_PLACES, lambda forward: [] if forward.entry.rest_points_m is not None else [
                f"position of point {each} across the branch ({way})"
                for each in _points(forward) for way in (1, 2)], "m",
            lambda known: known.point_sigma_m, _across, is_shared=False, measured=(_MARK, 5e-4)),
    Unknown(Cause("clock", "record all sensors with one clock"),
            _one("camera clock", lambda forward: _has_points(forward) and len(forward.frames) > 3),
            "s", lambda known: known.clock_sigma_s, _late, is_shared=False),
    Unknown(Cause("creep of the branch", "hold the branch at the end of the pull, or pull there "
                  "and back"), _one(CREEP, lambda forward: forward.creep_time is not None
                                    and _reads_force(forward)), "", lambda _: CREEP_SIGMA,
            lambda pull: {"forces": -relaxed(pull.frames.times, pull.forces, present(
                pull.creep_time, "time constant of creep"))[..., None]}),
    Unknown(Cause("force gain", "check the sensor with a known weight"),
            _one("force gain", _reads_force), "", lambda known: known.force_gain_sigma,
            lambda pull: {"forces": pull.forces[..., None]},
            measured=(Action("check the force sensor", "with a known weight, to 0.5 % "
                             "(force_gain_sigma)"), 5e-3)),
    Unknown(_ZERO, _three("force zero", _reads_force), "N", lambda known: known.force_bias_sigma_n,
            lambda pull: {"forces": _alike(pull, np.ones(len(pull.frames)))}, is_shared=False,
            measured=(_TARE, 0.05)),
    Unknown(_ZERO, _three("force drift", _reads_force), "N",
            lambda known: known.force_drift_sigma_n,
            lambda pull: {"forces": _alike(pull, pull.share)}, is_shared=False,
            measured=(_TARE, 0.1)),
    Unknown(_ZERO, _three("curvature of the force drift", _reads_force), "N",
            lambda known: BEND_OF_DRIFT * known.force_drift_sigma_n,
            lambda pull: {"forces": _alike(pull, 4 * pull.share * (1 - pull.share))},
            is_shared=False, measured=(_TARE, 0.03)),
    Unknown(_ZERO, _three("torque zero", lambda forward: _reads_force(forward)
                          and forward.uses_torque), "N m",
            lambda known: known.torque_bias_sigma_nm,
            lambda pull: {"torques": _alike(pull, np.ones(len(pull.frames)))}, is_shared=False,
            measured=(_TARE, 5e-3)),
    Unknown(_GRIPPER, _three("gripper position", _watches), "m", lambda known: known.pose_sigma_m,
            lambda pull: {"grasps": _alike(pull, np.ones(len(pull.frames)))},
            measured=(_HAND_EYE, 2e-4)),
    Unknown(_GRIPPER, _three("gripper rotation about", _watches), "rad",
            lambda known: known.pose_sigma_rad,
            lambda pull: {"grasps": _rotations(pull.frames.poses[:, :3] - pull.pivot)},
            measured=(_HAND_EYE, 3.5e-3)),
    Unknown(_GRIPPER, _one("grasp position along the branch", _watches), "m",
            lambda known: known.pose_sigma_m, lambda pull: {"grasps": pull.grip_axis[..., None]},
            is_shared=False, measured=(_HAND_EYE, 2e-4)),
    Unknown(Cause("slip of the grasp", "grasp without slip, or put a marker at the grasp"),
            _one("slip of the grasp along the branch", _watches), "m",
            lambda known: known.slip_sigma_m,
            lambda pull: {"grasps": (pull.share[:, None] * pull.grip_axis)[..., None]},
            is_shared=False)]
"""All errors of cell and sensors, in the order in which a fit has them."""

OTHER_CAUSES = {
    "form": Cause("modulus between the control points", "add markers along the branch, or pull at "
                  "another point"),
    BULK: Cause("Poisson's ratio", Text("measure it, and state it (", Option("poisson"),
                                             " of reconstruct); pulls do not determine it")),
    "density": Cause("density", Text("weigh a piece of the branch (", Option("density"), ", ",
                                     Option("density_sigma"), " of reconstruct)")),
    "link": Cause("moduli that the pulls do not determine", "pull at a point farther out"),
    "points": Cause("noise of the points", "use more frames, more pulls, or more visible markers"),
    "force": Cause("noise of the force", "pull farther, or slower with more readings"),
    "poses": Cause("noise of the gripper's poses", "use more pulls"),
    "geometry": Cause("shape of the scan", "scan from more sides, or with less noise"),
    "mesh": Cause("mesh", Text("use a finer mesh (", Option("mesh_spacing"), " of reconstruct)")),
    "path": _GRIPPER,
    "hung": Cause("mass of twigs and leaves", Text("mesh more twigs (", Option("twig_radius"),
                                                   " of reconstruct)")),
    "grip": Cause("length in the gripper", "measure it, and state it under [grasp] (radius_m: half "
                  "of it) and [calibration] (held_length_sigma_m) in pull.toml"),
    "graph": Cause("skeleton of the scan", Text(
        "look at the alternatives (", Command("skeleton"), "), and confirm or edit the doubtful "
        "parts"))}
"""Causes of the free vector's priors, of noise, and of what no residual shows."""


def advice_on(cause: str) -> str:
    """Return what would reduce a cause of uncertainty."""
    return next(each.advice for each in (*(unknown.cause for unknown in UNKNOWNS),
                                         *OTHER_CAUSES.values()) if each.name == cause)


def nuisance_records(nuisances: Sequence[Nuisance], found: Eliminated,
                     free: np.ndarray) -> list[dict]:
    """Return each error with its value, 95 % interval and prior deviation in its own unit; ``free``
    [p, p] is the free vector's covariance."""
    deviation = np.sqrt(np.diag(found.total_covariance(free)))
    listed = []
    for nuisance, value, sure in zip(nuisances, found.values, deviation, strict=True):
        middle, width = value * nuisance.sigma, 1.96 * sure * nuisance.sigma
        listed.append({"name": nuisance.name, "unit": nuisance.unknown.unit, "pull": nuisance.pull,
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
