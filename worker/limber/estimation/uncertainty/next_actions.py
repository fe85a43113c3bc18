"""What to do next: the interval to expect after each action, from the information of the fit.

Each action changes the information at the end of the fit: a calibration or a weighing makes the
prior of an unknown narrower, another pull or a second view adds measurements. The inverse of the
changed information is the covariance to expect, and the interval shrinks as the standard deviation
does, with the errors of shape and mesh in both. An action helps only where its cause matters, which
the causes of the variance alone do not show: two causes that hide each other must both be mended.
"""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TypedDict

import numpy as np

from limber.core.errors import Command, Option, Text
from limber.core.not_none import present
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.parameters import YOUNG_BOUNDS_PA, Values
from limber.estimation.uncertainty.covariance import (
    InformationRows,
    Uncertainty,
    information_rows,
    inverse_information,
    scaled_rows,
)
from limber.estimation.uncertainty.model_error import ModelError, path_slopes, total_interval

WORTHWHILE = 0.98
"""Mean half width after an action over that before, above which it is not proposed."""
SHAPE_SHARE = 0.5
"""Error of the shape after a scan from more sides over that before: assumed."""
TORQUE_SIGMA_NM = 0.02
"""Standard deviation of one reading of a wrist sensor's torque: assumed."""
ANOTHER_PULL = "another pull"
REGISTER = "register the camera"


@dataclass(frozen=True)
class _Measurement:
    """A measurement of unknowns that are known by priors alone: how, where to state it, and the
    deviation afterwards by beginning of their names, in their units."""

    action: str
    how: str
    sigmas: dict[str, float]


_MEASUREMENTS = (
    _Measurement("calibrate the gripper", "to 0.2 mm and 0.2 degrees against the branch's frame, "
                 "stated under [calibration] (pose_sigma_m, pose_sigma_rad)",
                 {"gripper position": 2e-4, "gripper rotation": 3.5e-3, "grasp position": 2e-4}),
    _Measurement("tare the force sensor", "right before the pull, to 0.05 N with a drift of 0.1 N "
                 "(force_bias_sigma_n, force_drift_sigma_n)",
                 {"force zero": 0.05, "force drift": 0.1, "curvature of the force": 0.03,
                  "torque zero": 5e-3}),
    _Measurement("check the force sensor", "with a known weight, to 0.5 % (force_gain_sigma)",
                 {"force gain": 5e-3}),
    _Measurement(REGISTER, "to 1 mm and 0.06 degrees (camera_sigma_m, camera_sigma_rad)",
                 {"camera position": 1e-3, "camera rotation": 1e-3}),
    _Measurement("mark the points", Text("on the branch before the scan, to 0.5 mm (",
                                         Option("nominal"), " of import-pull, point_sigma_m)"),
                 {"position of point": 5e-4}),
    _Measurement("weigh a piece of the branch", Text("to 2 % (", Option("density"), ", ",
                                                     Option("density_sigma", 0.02), " of "
                                                     "reconstruct)"),
                 {"density": 0.02}))


class NextAction(TypedDict):
    """An action with its expected 95 % interval [K][2] [Pa] at the control points; ``width_share``
    is the mean half width of log E over today's."""

    action: str
    how: str
    young_interval_pa: list[list[float]]
    width_share: float


class Prospects:
    """Intervals to expect after actions, from the end of the fit with derivatives, its errors of
    shape and mesh, and the moduli on the mesh [K] [Pa]."""

    def __init__(self, evaluation: Evaluation, objective: Objective, sure: Uncertainty,
                 error: ModelError, young: np.ndarray):
        self._objective, self._error, self._spread = objective, error, sure.recording_spread
        self._evaluation = evaluation
        self._scale = sure.variance_factor * sure.repetition
        self._rows = information_rows(evaluation, objective, self._scale)
        self._pull_count = len(objective.forwards)
        self._middle = np.log(young * error.mesh_factor)
        self._interval = np.log(total_interval(young, sure.young_interval, error))
        self._now = self._deviation(self._rows)

    def best(self, count: int = 3) -> list[NextAction]:
        """Return the actions that narrow the intervals most, best first."""
        found = [self._result("scan again", "from more sides or with less noise, so that the "
                              "error of the shape halves", self._with_better_shape())]
        for each in _MEASUREMENTS:
            found.append(self._result(each.action, each.how,
                                      self._deviation(self._measured(each.sigmas))))
        if (then := self._with_torque()) is not None:
            found.append(self._result("record the torque", f"of the clamping gripper to "
                                      f"{TORQUE_SIGMA_NM:g} N m, stated as torque_sigma_nm under "
                                      "[sensor]", then))
        found.append(self._result("add a second camera", "that sees the points from another side",
                                  self._deviation(self._seen_twice())))
        last = self._objective.forwards[-1].name
        found.append(self._result(ANOTHER_PULL, Text(f"like {last}. ", Command("suggest-pull"),
                                                     " finds one that says "
                                                     "more"), self.after_another_pull()))
        worth = [each for each in found if each["width_share"] < WORTHWHILE]
        return sorted(worth, key=lambda each: each["width_share"])[:count]

    def cost_of_the_frame(self) -> float:
        """Fraction by which the intervals would be narrower with a registered camera."""
        sigmas = next(each.sigmas for each in _MEASUREMENTS if each.action == REGISTER)
        return 1.0 - float((self._deviation(self._measured(sigmas)) / self._now).mean())

    def after_another_pull(self) -> np.ndarray:
        """Standard deviation of log E after the last pull is repeated, shape [K]."""
        return self._deviation(self._with_repetition(self._pull_count - 1), self._pull_count + 1)

    def _result(self, action: str, how: str, then: np.ndarray) -> NextAction:
        share = then / self._now
        interval = self._middle[:, None] + share[:, None] * (
            self._interval - self._middle[:, None])
        # Wider than any modulus means unknown.
        interval = np.exp(np.clip(interval, *np.log(YOUNG_BOUNDS_PA)))
        return {"action": action, "how": how, "young_interval_pa": interval.tolist(),
                "width_share": float(share.mean())}

    def _deviation(self, rows: Sequence[InformationRows], pull_count: int | None = None,
                   error: ModelError | None = None) -> np.ndarray:
        """Standard deviation of log E at the control points, shape [K]."""
        covariance = inverse_information(np.vstack([each.rows for each in rows]))
        sensor = np.diag(covariance)[list(self._objective.space.groups)]
        sensor = sensor + self._spread**2 / (pull_count or self._pull_count)
        return (error or self._error).total(np.sqrt(sensor))

    def _with_better_shape(self) -> np.ndarray:
        geometry = self._error.geometry
        return self._deviation(self._rows, error=replace(
            self._error, geometry=None if geometry is None else SHAPE_SHARE * geometry))

    def _measured(self, sigmas: dict[str, float]) -> list[InformationRows]:
        return [self._narrowed(each, sigmas) for each in self._rows]

    def _narrowed(self, each: InformationRows, sigmas: dict[str, float]) -> InformationRows:
        """The prior of an unknown that was measured; anything else as it is."""
        after = next((sigma for start, sigma in sigmas.items()
                      if each.name.startswith(start)), None)
        if after is None:
            return each
        return replace(each, rows=each.rows * max(self._prior_sigma(each.name) / after, 1.0))

    def _prior_sigma(self, name: str) -> float:
        known = {each.name: each.sigma for each in self._objective.cell_errors.nuisances}
        return known.get(name) or next(
            sigma for prior, _, sigma in self._objective.space.priors if prior == name)

    def _seen_twice(self) -> list[InformationRows]:
        """Two cameras with independent errors see the mean of both as one with smaller errors."""
        causes = ("noise of the points", "camera frame", "places of the points")
        return [replace(each, rows=2**0.5 * each.rows) if each.cause in causes else each
                for each in self._rows]

    def _with_torque(self) -> np.ndarray | None:
        """Standard deviation of log E if the torque of each clamped grasp had been recorded too,
        shape [K]; None if there is no such grasp without torque, or no equilibrium."""
        values = self._objective.space.unpack(self._evaluation.free)
        forwards, is_new = [], False
        for forward in self._objective.forwards:
            full = forward.full
            if (isinstance(full, QuasiStaticForward) and full.drive == "pose"
                    and full.entry.grasp.mode == "rigid" and not full.uses_torque):
                if full.simulate(values, (), False) is None:
                    return None
                full, is_new = _torque_recorded(full, values), True
            forwards.append(full)
        if not is_new:
            return None
        then = Objective(forwards, self._objective.space, force_sigma=self._objective.force_sigma)
        found, slopes = (then.evaluate(self._evaluation.free, jacobian=True),
                         path_slopes(self._evaluation, then))
        if found is None or slopes is None:
            return None
        # With the torque, the gripper's frame is an unknown of the fit.
        by_free, by_frame = (scaled_rows(each, self._objective.space.own_row_count, self._scale)
                             for each in (found.slopes, slopes[1]))
        size = by_frame.shape[1]
        rows = np.block([[by_free, by_frame], [np.zeros((size, by_free.shape[1])), np.eye(size)]])
        return self._deviation([InformationRows("", rows)],
                               error=replace(self._error, path=None))

    def _with_repetition(self, number: int) -> list[InformationRows]:
        """Measurements of a pull once more, with its own errors and its own course of the force."""
        own = self._own_columns(number)
        width = self._rows[0].rows.shape[1]

        def spread(rows: np.ndarray, *, is_new: bool) -> np.ndarray:
            wide = np.zeros((len(rows), width + len(own)))
            wide[:, :width] = rows
            if is_new:
                wide[:, width:], wide[:, own] = rows[:, own], 0.0
            return wide

        found = [replace(each, rows=spread(each.rows, is_new=False)) for each in self._rows]
        for each in self._rows:
            # Its own priors apply to the new unknowns as well.
            is_own = each.pull is None and np.any(each.rows[:, own])
            if each.pull == number or is_own:
                found.append(replace(each, rows=spread(each.rows, is_new=True)))
        return found

    def _own_columns(self, number: int) -> np.ndarray:
        """Columns of the unknowns that only this pull has."""
        objective = self._objective
        name = objective.forwards[number].name
        errors = [objective.space.size + column
                  for column, each in enumerate(objective.cell_errors.nuisances)
                  if each.pull == name]
        first = objective.space.size + objective.cell_errors.count
        counts = [0 if forward.response is None else (
            forward.response.points.shape[-1]) for forward in objective.forwards]
        start = first + sum(counts[:number])
        return np.array([*errors, *range(start, start + counts[number])], int)


def _torque_recorded(pull: QuasiStaticForward, values: Values) -> QuasiStaticForward:
    """A pose-driven pull of a clamped grasp as if its torque had been recorded. ValueError if the
    pull has no equilibrium under the values."""
    asked = copy.copy(pull)
    asked.uses_torque = True
    simulated = present(asked.simulate(values, (), False), "equilibrium of the pull")
    wrenches = pull.frames.wrenches.copy()
    wrenches[:, 3:] = present(simulated.torques, "torque of the pull")
    entry = pull.entry.model_copy(update={"sensor": pull.entry.sensor.model_copy(
        update={"torque_sigma_nm": TORQUE_SIGMA_NM})})
    made = type(pull)(pull.name, pull.model, pull.weights, entry,
                      replace(pull.frames, wrenches=wrenches), pull.rest_points,
                      key_count=pull.key_count, field=pull.field)
    made.point_shifts = pull.point_shifts
    made.begin_at(pull)
    return made
