"""A path planned anew where a force stopped the arm: from its pose, with the modulus at hand."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.errors import NoPathError, SafetyStop
from limber.core.not_none import present
from limber.core.numerics.rigid import inverted, matrices
from limber.core.progress import Progress
from limber.planning.constraints.limits import Limits, limits_in_file
from limber.planning.cost import arc_lengths
from limber.planning.field.other_modulus import corrected_field
from limber.planning.make_plan import plan_motion
from limber.planning.settings import PlanSettings
from limber.planning.timing import Pace
from limber.results.findings import certificate_sentence
from limber.robot.driver.link import RobotLink
from limber.robot.motion.execution import robot_motion
from limber.robot.motion.retreat import JOINT_RAD
from limber.robot.motion.trajectory import along, speed_within
from limber.stages.paths.execute_path import PlannedMotion, checked_motion, predicted_along
from limber.stages.paths.plan import InCell
from limber.stages.paths.plan_cell import KeptClear

if TYPE_CHECKING:
    from limber.planning.field.grasp_model import GraspModel

_OTHER_MODULUS = ("soft force limit", "the branch is softer", "the branch is stiffer")
_NOT_HELD = ("nothing is held", "broke", "slip", "sensor")  # nobody should go on
_OF_LIMIT = 0.9  # of the force's limit, with which a path may begin
_SURE = 0.1  # largest deviation of the factor of E, as a fraction of it
_POSITION, _FORCE, _JOINTS = slice(1, 4), slice(13, 16), slice(19, 25)
"""In a sample, as :data:`limber.robot.driver.link.COLUMNS`."""


def is_of_modulus(reason: str) -> bool:
    """Return whether a stop is for the soft force limit, or may be for a branch of another modulus,
    and not as likely for one that is not held as it was, or for a wrong sensor."""
    causes = reason.partition(": the force has changed")[0]
    return any(cause in causes for cause in _OTHER_MODULUS) and not any(
        cause in causes for cause in _NOT_HELD)


def planned_anew(planned: PlannedMotion, event: dict[str, Any], link: RobotLink,
                 progress: Progress) -> PlannedMotion:
    """Return the motion to the plan's goal from where a stop ended its path, with the modulus that
    the guard's filter found until then; where the force is not well within its limit, from the
    start of the path, to which the arm goes back. LimberError if the modulus is not known, or no
    path keeps the limits; ``progress`` is told what changed."""
    branch, cell, stated = planned.branch, planned.cell, planned.stated
    if stated.get("turning") or stated.get("goal") is None:
        raise NoPathError("The plan turns the gripper beyond the branch's own rotation, or states "
                          "no goal.", "It cannot be repeated from here.", "Plan again.")
    factor, deviation = event.get("force_factor") or (1.0, np.inf)
    if not deviation < _SURE * factor:
        raise NoPathError(f"The forces so far tell the modulus as {factor:.2f} +- {deviation:.2f} "
                          "times the known one.", "That is no ground for another path.", "")
    loaded = planned.model.branch
    model = replace(planned.model, branch=loaded.with_young(factor * loaded.model.young))
    settings, in_cell = _asked(planned, model, progress)
    link.acknowledge()
    here = link.wait_for_samples()
    if np.linalg.norm(here[_FORCE]) > _OF_LIMIT * in_cell.limits.force:
        # From here no path begins within the limits: back along the one that came here.
        back = link.retreat()
        if back["event"] != "reached":
            raise SafetyStop(f"The arm could not go back: {back['reason']}.")
        here = link.wait_for_samples()
    before = planned.predicted.poses[:, :3]
    gone = int(np.linalg.norm(before - here[_POSITION], axis=1).argmin())
    field = corrected_field(branch.path("energy.npz"), model, progress)
    if field is None:
        raise NoPathError("The energy field does not tell for which branch it was sampled.", "", (
            "Sample it again."))
    found = plan_motion(
        field, model, settings.model_copy(update={"start": tuple(here[_POSITION].tolist())}),
        limits=in_cell.limits, cell=in_cell.positions, progress=progress,
        uncertainty=planned.known if settings.confidence else None,
        pace=in_cell.slowed(Pace(settings.speed), progress))
    if found.summary["stopped"]:
        raise NoPathError("The search for another path was stopped.")
    clear = KeptClear.of(cell, planned.asked.cell.parent, model, stated.get("clearance_m"))
    predicted = predicted_along(model, planned.known, np.vstack([
        before[:max(gone, 1)], here[None, _POSITION],
        found.plan.solved.poses[1:, :3]]), None, clear, progress)

    def blocked(flange: np.ndarray, joints: np.ndarray) -> NoPathError | None:
        if np.abs(joints - here[_JOINTS]).max(axis=1).min() > JOINT_RAD:
            return NoPathError("The arm cannot go on in the configuration that it is in.")
        return planned.wish["blocked"](flange, joints)
    motion = robot_motion(cell, predicted, model.reach.axis, **planned.wish | {
        "rotation": planned.motion.rotation, "blocked": blocked})
    # By the pose where the gripper closed all legs are known to hold the branch since then.
    closed = present(planned.motion.path.expected, "wrench of the path").rest_pose
    motion = replace(motion, path=replace(motion.path, expected=replace(
        present(motion.path.expected, "wrench of the path"), rest_pose=closed)))
    first = int(np.linalg.norm(predicted.poses[:, :3] - here[_POSITION], axis=1).argmin())
    result = checked_motion(cell, planned.asked, predicted, motion, planned.across, clear, progress,
                            first)
    place = inverted(matrices(np.array(cell.base.pose))) @ np.r_[here[_POSITION], 1.0]
    row = int(np.linalg.norm(motion.path.poses[:, :3] - place[:3], axis=1).argmin())
    begun = motion.path.since(row, along(
        motion.path.poses[row:], speed_within(cell, planned.wish["speed"]),
        cell.limits.acceleration_m_s2, turn_speed=0.8 * cell.limits.turn_speed_rad_s))
    peak = float(np.linalg.norm(predicted.wrenches[first:, :3], axis=1).max())
    left = float(arc_lengths(predicted.poses[first:, :3])[-1])
    progress.warn(f"Young's modulus is {factor:.2f} +- {deviation:.2f} times the one before. "
                  f"{1e3 * left:.0f} mm are left to the goal, with at most {peak:.2f} N of "
                  f"{in_cell.limits.force:.3g} N. {certificate_sentence(found.summary)}")
    told = {"stop_reason": event["reason"], "position_m": here[_POSITION], "young_factor": factor,
            "young_factor_sigma": deviation, "length_m": left, "peak_force_n": peak,
            "certificate": found.summary["certificate"]}
    return replace(planned, model=model, predicted=predicted, motion=motion, begun=begun,
                   result=result | {"replans": [*planned.result.get("replans", ()), told]})


def _asked(planned: PlannedMotion, model: GraspModel, progress: Progress,
           ) -> tuple[PlanSettings, InCell]:
    """Return the plan's settings, with the goal that its file states, and the cell with the limits
    that it states."""
    stated, branch = planned.stated, planned.branch
    given = branch.manifest.stages[f"plan:{planned.asked.name}"].settings
    settings = PlanSettings.model_validate({
        name: given[name] for name in PlanSettings.model_fields if name in given} | {
            "start_seed": None} | ({} if stated["goal"]["kind"] != "grasp" else {
                "goal": stated["goal"]["position_m"], "goal_seed": None}))
    own = Limits.of(settings)
    own = replace(limits_in_file(stated["limits"]), low=own.low, high=own.high,
                  constraints=own.constraints)
    return settings, InCell.of(branch, planned.asked.cell, own, progress, settings, model)
