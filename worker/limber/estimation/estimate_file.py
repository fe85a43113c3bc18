"""Read ``estimate.json`` and check the values used by the report and predictions."""

from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from limber.core.files.reading import checked_as, read_json
from limber.estimation.estimated_branch import Subject
from limber.estimation.fit_assessment import Estimate
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.settings import FitSpec
from limber.estimation.uncertainty.covariance import Cause, largest, outliers
from limber.estimation.uncertainty.drift import Drift, PullModulus, drift, pull_moduli, scale_steps
from limber.estimation.uncertainty.model_error import bending_interval, total_interval
from limber.estimation.uncertainty.next_actions import NextAction
from limber.recordings.recording import Pull

_Positive = Annotated[float, Field(gt=0)]
_Modulus = Annotated[float, Field(ge=1.0, le=1e15)]
"""[Pa], also for a fit that ended far outside the range of branches."""
_Share = Annotated[float, Field(ge=0, le=1)]
_Maybe = float | None
_Vector = tuple[float, float, float]
_Rows = list[list[_Maybe]]


class _Told(BaseModel):
    model_config = ConfigDict(extra="allow", allow_inf_nan=False)


class _Score(_Told):
    rms_m: _Maybe = None
    rms_force_n: _Maybe = None
    relative_distance: _Maybe = None
    relative_force: _Maybe = None
    in_fit: bool = True


class _Creep(_Told):
    share: float
    interval: tuple[float, float]
    time_s: _Positive


class _OrderModulus(_Told):
    order: int
    factor: _Positive
    interval: tuple[_Maybe, _Maybe]


class _Evaluation(_Told):
    parameters: list[_Maybe] = []
    loss_m2: _Maybe = None


class _Pull(_Told):
    name: str
    times_s: list[float]
    observed_m: list[list[tuple[_Maybe, _Maybe, _Maybe]]]
    simulated_m: list[list[tuple[_Maybe, _Maybe, _Maybe]]]
    all_times_s: list[float]
    measured_force_n: list[tuple[_Maybe, _Maybe, _Maybe]]
    simulated_force_n: list[tuple[_Maybe, _Maybe, _Maybe]]
    point_residual: _Rows = []
    force_residual: list[_Maybe] = []

    @model_validator(mode="after")
    def _of_one_length(self) -> "_Pull":
        shown_count, count = len(self.times_s), len(self.all_times_s)
        widths = {len(frame) for frame in (*self.observed_m, *self.simulated_m)}
        if {len(self.observed_m), len(self.simulated_m)} != {shown_count} or len(widths) > 1:
            raise ValueError("the frames have different numbers of points")
        if {len(self.measured_force_n), len(self.simulated_force_n)} != {count}:
            raise ValueError("the numbers of forces and of times differ")
        if len(self.point_residual) not in (0, count) or len(self.force_residual) not in (0, count):
            raise ValueError("the numbers of residuals and of times differ")
        if len({len(row) for row in self.point_residual}) > 1:
            raise ValueError("the residuals have different numbers of points")
        return self


class _Truth(_Told):
    young_pa: list[_Positive] | None = None
    fractions: list[_Share] | None = None
    assumed: bool | None = None


class _Estimate(_Told):
    method: str
    young_pa: list[_Modulus] = Field(min_length=1)
    young_mesh_pa: list[_Positive] | None = None
    young_interval_pa: list[tuple[_Maybe, _Maybe]]
    young_interval_sensor_pa: list[tuple[_Maybe, _Maybe]] | None = None
    bending_stiffness_nm2: list[_Positive] | None = None
    bending_stiffness_interval_nm2: list[tuple[_Maybe, _Maybe]] | None = None
    bending_stiffness_share: list[list[float]] | None = None
    young_deviation: dict[str, list[_Maybe] | bool | None] = {}
    poisson: float = Field(gt=-1, lt=0.5)
    density: _Positive | None = None
    loss_m2: _Maybe
    forward_count: int
    converged: bool
    is_weightless: bool = False
    recording_spread: float = 0.0
    field_form: list[float] | None = None
    field_form_deviations: list[_Positive] | None = None
    creep: _Creep | None = None
    orders: bool = False
    section: dict[str, float] = {}
    initial: dict[str, float] = {}
    lumping_error: _Maybe = None
    order_moduli: list[_OrderModulus] = []
    causes: list[Cause] | None = None
    next_actions: list[NextAction] | None = None
    held_out: dict[str, _Score] | None = None
    pull_moduli: list[PullModulus] | None = None
    drift: Drift | None = None
    warnings: list[str] = []
    control_points_m: list[_Vector]
    fractions: list[_Share]
    parameters: list[str]
    groups: list[Annotated[int, Field(ge=0)]]
    covariance: _Rows
    deviations_before_fit: list[_Maybe]
    history: list[_Evaluation]
    pulls: list[_Pull]
    truth: _Truth | None = None

    @model_validator(mode="after")
    def _of_one_branch(self) -> "_Estimate":
        count = len(self.young_pa)
        lists = {
            "young_mesh_pa": self.young_mesh_pa, "young_interval_pa": self.young_interval_pa,
            "young_interval_sensor_pa": self.young_interval_sensor_pa,
            "bending_stiffness_nm2": self.bending_stiffness_nm2,
            "bending_stiffness_interval_nm2": self.bending_stiffness_interval_nm2,
            "bending_stiffness_share": self.bending_stiffness_share,
            "control_points_m": self.control_points_m, "fractions": self.fractions,
            "groups": self.groups,
            **{f"young_deviation.{name}": values for name, values in self.young_deviation.items()
               if isinstance(values, list)}}
        for name, values in lists.items():
            if values and len(values) != count:
                raise ValueError(f"{name} has {len(values)} entries for {count} moduli")
        size = len(self.parameters)
        if len(self.covariance) != size or any(len(row) != size for row in self.covariance):
            raise ValueError(f"the covariance does not have the size of its {size} parameters")
        if any(group >= size for group in self.groups):
            raise ValueError("a modulus belongs to a group that is not a parameter")
        return self


def read_estimate(path: Path) -> dict[str, Any]:
    """Return a checked ``estimate.json``; a number that was not measured is None. InputError with
    the position if it cannot be read or is not an estimate."""
    content = read_json(path, "an estimate")
    checked_as(path, _Estimate, content, "an estimate", strict=True)
    return content


# The output of an estimate: the result of the stage and ``estimate.json``.


def summary(found: Estimate, settings: FitSpec) -> dict[str, Any]:
    """Return the stage's result: DESIGN's keys and more."""
    values, sure = found.values, found.uncertainty
    return {
        "method": settings.method, "young_pa": found.young, "young_mesh_pa": values.young,
        "young_interval_pa": total_interval(values.young, sure.young_interval,
                                            found.model_error),
        "young_interval_sensor_pa": sure.young_interval * np.reshape(
            found.model_error.mesh_factor, (-1, 1)),
        "young_deviation": found.deviations, "poisson": values.poisson,
        "recording_spread": sure.recording_spread,
        "field_form": values.form, "cell_errors": found.cell_errors,
        "causes": [] if found.fit.is_unfinished else largest(found.causes),
        "next_actions": [] if found.fit.is_unfinished else found.prospects.best(),
        "led_by": {forward.name: "force; the gripper's path is observed" if forward.watches_pose
                   else forward.drive for forward in found.objective.forwards},
        "density": values.density, "loss_m2": found.fit.evaluation.loss,
        "forward_count": found.objective.forward_count, "converged": found.fit.converged,
        "stopped": found.stopped, "is_weightless": found.is_weightless, "held_out": found.held_out,
        "variance_factor": sure.variance_factor, "warnings": found.warnings,
        "creep": found.creep, "orders": "orders" in settings.also, "section": settings.section
    } | _bending(found) | _by_pull(found)


def _bending(found: Estimate) -> dict[str, Any]:
    """Bending stiffness at the control points, if the branch's shape was judged."""
    if found.second_moment is None:
        return {}
    interval = bending_interval(found.values.young, found.uncertainty.young_interval,
                                found.model_error)
    return {"bending_stiffness_nm2": found.young * found.second_moment,
            "bending_stiffness_interval_nm2": interval * found.second_moment[:, None]}


def _by_pull(found: Estimate) -> dict[str, Any]:
    """Each pull's modulus beside the joint one, and the change per day; of one pull nothing."""
    sure, objective = found.uncertainty, found.objective
    if len(objective.forwards) < 2 or found.fit.is_unfinished:
        return {}
    steps = scale_steps(found.fit.evaluation, objective, sure.variance_factor * sure.repetition)
    recorded = [objective.forwards[each.pull].entry.recorded for each in steps]
    return {"pull_moduli": pull_moduli(steps, objective),
            "drift": drift(steps, recorded, sure.recording_spread)}


def details(found: Estimate, subject: Subject, pulls: list[Pull]) -> dict[str, Any]:
    """Return the content of ``estimate.json`` beside the summary."""
    evaluation, objective = found.fit.evaluation, found.objective
    content: dict[str, Any] = {
        "control_points_m": subject.control_points,
        "fractions": _fractions(subject), "parameters": objective.space.names,
        "order_moduli": [] if subject.field is None else subject.field.order_moduli(
            found.values, dict(zip(objective.space.names, np.sqrt(np.diag(
                found.uncertainty.covariance)), strict=True))),
        "field_form_deviations": ([] if subject.field is None
                                  else subject.field.deviations(found.values)),
        "initial": {"young": subject.start.young[0], "poisson": subject.start.poisson,
                    "density": subject.start.density},
        "lumping_error": None if subject.lumping is None else subject.lumping.error,
        "groups": objective.space.groups, "links": objective.space.links,
        "covariance": found.uncertainty.covariance,
        "correlation": found.uncertainty.correlation,
        "singular_values": found.identifiability.singular_values,
        "deviations_before_fit": found.identifiability.deviations,
        "reason": found.fit.reason,
        "outliers": outliers(evaluation, objective),
        "history": [{"evaluation": number + 1, "parameters": entry.parameters,
                     "objective": entry.objective, "loss_m2": entry.loss,
                     "seconds": entry.seconds}
                    for number, entry in enumerate(objective.log.entries)],
        "pulls": [_pull_details(number, objective, evaluation)
                  for number in range(len(objective.forwards))]}
    first = content["pulls"][0]
    content |= {"times_s": first["times_s"], "observed_m": first["observed_m"],
                "simulated_m": first["simulated_m"]}
    if found.sections is not None:
        content["bending_stiffness_share"] = found.sections.share[
            :, subject.skeleton.main_path()]
    truth = next((pull.entry.truth for pull in pulls if pull.entry.truth), None)
    if truth:
        content["truth"] = truth
    return content


def _pull_details(number: int, objective: Objective, evaluation: Evaluation) -> dict[str, Any]:
    forward, simulated = objective.forwards[number], evaluation.pulls[number]
    frames = forward.frames
    rows = np.unique(np.linspace(0, len(frames) - 1, 6).round().astype(int))
    points, forces = objective.scored(evaluation)[number]
    return {"name": forward.name, "times_s": frames.times[rows],
            "observed_m": frames.positions[rows], "simulated_m": simulated.positions[rows],
            "measured_force_n": frames.wrenches[:, :3], "simulated_force_n": simulated.forces,
            "all_times_s": frames.times, "point_residual": points, "force_residual": forces}


def _fractions(subject: Subject) -> list[float]:
    path = subject.skeleton.main_path()
    along = subject.skeleton.arc_length[path]
    nearest = [np.argmin(np.linalg.norm(subject.skeleton.nodes[path] - point, axis=1))
               for point in subject.control_points]
    return [float(along[index] / along[-1]) for index in nearest]
