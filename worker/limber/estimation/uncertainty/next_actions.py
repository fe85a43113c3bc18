"""What to do next: the interval to expect after each action, from the information of the fit.

Each action changes the information at the end of the fit: a calibration or a weighing makes the
prior of an unknown narrower, another pull or a second view adds measurements. The inverse of the
changed information is the covariance to expect, and the interval shrinks as the standard deviation
does, with the errors of shape and mesh in both. An action helps only where its cause matters, which
the causes of the variance alone do not show: two causes that hide each other must both be mended.
"""

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from typing_extensions import TypedDict

from limber.core.errors import Command, Option, Text
from limber.core.not_none import present
from limber.estimation.fitting.nuisances import REGISTER, Action
from limber.estimation.fitting.objective import Evaluation, Objective, inverse_information
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.parameters import YOUNG_BOUNDS_PA, Values
from limber.estimation.uncertainty import covariance as known
from limber.estimation.uncertainty.model_error import ModelError, path_slopes, total_interval

WORTHWHILE = 0.98
"""Mean half width after an action over that before, above which it is not proposed."""
SHAPE_SHARE = 0.5
"""Error of the shape after a scan from more sides over that before: assumed."""
TORQUE_SIGMA_NM = 0.02
"""Standard deviation of one reading of a wrist sensor's torque: assumed."""
ANOTHER_PULL = "another pull"


_WEIGH = Action("weigh a piece of the branch", Text("to 2 % (", Option("density"), ", ", Option(
    "density_sigma", 0.02), " of reconstruct)"))
_WEIGHED = 0.02


class NextAction(TypedDict):
    """An action with its expected 95 % interval [K][2] [Pa] at the control points; ``width_share``
    is the mean half width of log E over today's."""

    action: str
    how: str
    young_interval_pa: list[list[float | None]]
    width_share: float


class Prospects:
    """Intervals to expect after actions, from the end of the fit with derivatives, its errors of
    shape and mesh, and the moduli on the mesh [K] [Pa]."""

    def __init__(self, evaluation: Evaluation, objective: Objective, sure: known.Uncertainty,
                 error: ModelError, young: np.ndarray):
        self._objective, self._error, self._spread = objective, error, sure.recording_spread
        self._evaluation = evaluation
        self._scale = sure.variance_factor * sure.repetition
        self._rows = known.information_rows(evaluation, objective, self._scale)
        self._pull_count = len(objective.forwards)
        self._middle = np.log(young * error.mesh_factor)
        self._interval = np.log(total_interval(young, sure.young_interval, error))
        self._now = self._deviation(self._rows)

    def best(self, count: int = 3) -> list[NextAction]:
        """Return the actions that narrow the intervals most, best first."""
        found = [self._result("scan again", "from more sides or with less noise, so that the "
                              "error of the shape halves", self._with_better_shape())]
        for each in self._factors():
            found.append(self._result(each.name, each.how, self._deviation(self._measured(each))))
        if (then := self._with_torque()) is not None:
            found.append(self._result("record the torque", f"of the clamping gripper to "
                                      f"{TORQUE_SIGMA_NM:g} N m, stated as torque_sigma_nm under "
                                      "[sensor]", then))
        found.append(self._result("add a second camera", "that sees the points from another side",
                                  self._deviation(self._seen_twice())))
        last = self._objective.forwards[-1].name
        found.append(self._result(ANOTHER_PULL, Text(f"like {last}. ", Command("suggest-pull"),
                                                     " finds a better one"),
                                  self.after_another_pull()))
        worth = [each for each in found if each["width_share"] < WORTHWHILE]
        return sorted(worth, key=lambda each: each["width_share"])[:count]

    def cost_of_the_frame(self) -> float:
        """Fraction by which the intervals would be narrower with a registered camera."""
        return 1.0 - float((self._deviation(self._measured(REGISTER)) / self._now).mean())

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

    def _deviation(self, rows: Sequence[known.InformationRows], pull_count: int | None = None,
                   error: ModelError | None = None) -> np.ndarray:
        """Standard deviation of log E at the control points, shape [K]."""
        covariance = inverse_information(np.vstack([each.rows for each in rows]))
        sensor = np.diag(covariance)[list(self._objective.space.groups)]
        sensor = sensor + self._spread**2 / (pull_count or self._pull_count)
        return (error or self._error).total(np.sqrt(sensor))

    def _with_better_shape(self) -> np.ndarray:
        geometry = self._error.parts.get("geometry")
        return self._deviation(self._rows, error=self._error.having(
            geometry=None if geometry is None else SHAPE_SHARE * geometry))

    def _factors(self) -> dict[Action, dict[str, float]]:
        """By action, the factor by which it narrows the prior of each unknown that it measures."""
        found: dict[Action, dict[str, float]] = {}
        for each in self._objective.cell_errors.nuisances:
            if each.unknown.measured is not None:
                action, after = each.unknown.measured
                found.setdefault(action, {})[each.name] = max(each.sigma / after, 1.0)
        for name, _, sigma in self._objective.space.priors:
            if name == "density":
                found[_WEIGH] = {name: max(sigma / _WEIGHED, 1.0)}
        return found

    def _measured(self, action: Action) -> list[known.InformationRows]:
        """The rows with narrower priors; anything else as it is."""
        factors = self._factors().get(action, {})
        return [replace(each, rows=factors.get(each.name, 1.0) * each.rows) for each in self._rows]

    def _seen_twice(self) -> list[known.InformationRows]:
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
            full = forward
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
        own = self._objective.space.own_row_count
        by_free, by_frame = (known.scaled_rows(each, own, self._scale)
                             for each in (found.slopes, slopes[1]))
        size = by_frame.shape[1]
        rows = np.block([[by_free, by_frame], [np.zeros((size, by_free.shape[1])), np.eye(size)]])
        return self._deviation([known.InformationRows("", rows)],
                               error=self._error.having(path=None))

    def _with_repetition(self, number: int) -> list[known.InformationRows]:
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
            forward.response.positions.shape[-1]) for forward in objective.forwards]
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
