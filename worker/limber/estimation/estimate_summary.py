"""The output of an estimate: the result of the stage and ``estimate.json``."""

from typing import Any

import numpy as np

from limber.estimation.estimated_branch import Subject
from limber.estimation.fit_assessment import Estimate
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.settings import EstimateSettings
from limber.estimation.uncertainty.covariance import outliers
from limber.estimation.uncertainty.drift import drift, pull_moduli, scale_steps
from limber.estimation.uncertainty.model_error import bending_interval, total_interval
from limber.estimation.uncertainty.variance_parts import largest
from limber.recordings.recording import Pull


def summary(found: Estimate, settings: EstimateSettings) -> dict[str, Any]:
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
        "causes": [] if found.stopped else largest(found.causes),
        "next_actions": [] if found.stopped else found.prospects.best(),
        "led_by": {forward.name: "force; the gripper's path is observed" if forward.watches_pose
                   else forward.drive for forward in found.objective.forwards},
        "density": values.density, "loss_m2": found.fit.evaluation.loss,
        "forward_count": found.objective.forward_count, "converged": found.fit.converged,
        "stopped": found.stopped, "is_weightless": found.is_weightless, "held_out": found.held_out,
        "variance_factor": sure.variance_factor, "warnings": found.warnings,
        "creep": found.creep, "orders": settings.orders, "section": settings.section,
        "forward": settings.forward} | _bending(found) | _reduced_error(found) | _by_pull(found)


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
    if len(objective.forwards) < 2 or found.stopped:
        return {}
    steps = scale_steps(found.fit.evaluation, objective, sure.variance_factor * sure.repetition)
    recorded = [objective.forwards[each.pull].entry.recorded for each in steps]
    return {"pull_moduli": pull_moduli(steps, objective),
            "drift": drift(steps, recorded, sure.recording_spread)}


def _reduced_error(found: Estimate) -> dict[str, Any]:
    """Error of the reduced model before its correction by the full one."""
    errors = [error for forward in found.objective.forwards
              if (error := forward.reduction_error) is not None]
    if not errors:
        return {}
    position, force = np.max(errors, axis=0)
    return {"reduced_error_m": position, "reduced_error_force_share": force}


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
