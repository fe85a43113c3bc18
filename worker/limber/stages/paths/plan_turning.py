"""The gripper's rotation of a plan where the arm cannot follow the branch's own, and its torque."""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import NoPathError, Option
from limber.mechanics import BranchModel, Grasp, StaticResult, follow_poses
from limber.mechanics.sensitivities import grasp_slopes
from limber.planning.constraints.limits import Limits
from limber.planning.cost import arc_lengths
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.path_on_full_model import SolvedPoses
from limber.robot.motion.execution import TurnCost, Turned, turned, turned_motion
from limber.robot.motion.trajectory import Predicted
from limber.stages.pulls.record_path import GRASP_RADIUS_M

_OF_HARD = 0.8  # of the torque at which the guard stops the arm, that an offset may need
_STATES = 6  # along the path, of which the stiffness is computed, and the turned ones solved


@dataclass(frozen=True)
class Clamped:
    """The branch clamped by a rigid gripper (``firm``, ``grasp``) at the states ``rows`` [k] of a
    plan, at its natural rotations: poses [m, rad], [k, 6], displacements [m], [nodes, 3] each,
    wrenches and stiffness (``cost``)."""

    firm: BranchModel
    grasp: Grasp
    rows: np.ndarray
    poses: np.ndarray
    displacements: list[np.ndarray]
    cost: TurnCost

    @classmethod
    def of(cls, grasp_model: GraspModel, states: SolvedPoses) -> "Clamped":
        """Solve the clamped branch at some of a plan's states; NoPathError if one has no
        solution."""
        grasp = Grasp.gripping(grasp_model.mesh, grasp_model.grasp.centre, GRASP_RADIUS_M)
        firm = grasp_model.model.gripped(grasp)
        rows = np.unique(np.linspace(0, len(states.poses) - 1, _STATES).astype(int))
        solved = [_solved(firm, grasp, states.poses[row], states.displacements[row])
                  for row in rows]
        wrenches = np.array([np.r_[one.reaction_force, one.reaction_torque] for one in solved])
        slopes = np.array([grasp_slopes(firm, grasp, one.displacement).wrench[:, 3:]
                           for one in solved])
        return cls(firm, grasp, rows, states.poses[rows], [one.displacement for one in solved],
                   TurnCost(arc_lengths(states.poses[:, :3])[rows], wrenches, slopes))

    def checked(self, offsets: np.ndarray, limits: Limits) -> dict[str, float]:
        """Return the largest torque and force on the full model with ``offsets`` [k, 3] at these
        states, and the error of the second-order function, as plain data. NoPathError if a state
        has no solution, or breaks a limit."""
        wrenches = []
        for pose, begin in zip(turned(self.poses, offsets), self.displacements, strict=True):
            one = _solved(self.firm, self.grasp, pose, begin)
            wrenches.append(np.r_[one.reaction_force, one.reaction_torque])
        found = np.array(wrenches)
        force, torque = (np.linalg.norm(part, axis=1) for part in (found[:, :3], found[:, 3:]))
        for size, limit, what in ((force, limits.force, "force [N]"),
                                  (torque, limits.torque, "torque [N m]")):
            if size.max() > limit:
                raise NoPathError(
                    f"With the gripper turned beyond the branch's own rotation the {what} is "
                    f"{size.max():.3g} on the full model, and the limit is {limit:.3g}.",
                    "The arm cannot follow the branch without that rotation.",
                    "Move the robot's base, raise the limit, or reduce ", Option("turn_slack"), ".")
        off = np.linalg.norm((found - self.cost.wrench(offsets))[:, 3:], axis=1)
        return {"peak_torque_nm": float(torque.max()), "peak_force_n": float(force.max()),
                "torque_error_nm": float(off.max())}


def _solved(firm: BranchModel, grasp: Grasp, pose: np.ndarray, begin: np.ndarray) -> StaticResult:
    found = follow_poses(firm, grasp, pose[None], start=begin)[0]
    if (reason := refusal(found)) is not None:
        place = ", ".join(f"{x:.3f}" for x in pose[:3])
        raise NoPathError(f"The branch has no reliable state with the gripper turned at ({place}) "
                          f"m ({reason}).", "The arm cannot follow it without turning it.",
                          "Move the robot's base, or reduce ", Option("turn_slack"), ".")
    return found


def turned_by(cell: Cell, predicted: Predicted, grasp_model: GraspModel, states: SolvedPoses,
              slack: float, limits: Limits, **asked: Any) -> tuple[Turned, dict[str, Any]]:
    """Return the robot's motion with the gripper turned by at most ``slack`` [rad] beyond the
    branch's own rotation, checked on the full model, its torque below the guard's stop, and a
    plan's entry about it. NoPathError if no such rotation helps, or it breaks a limit."""
    limits = replace(limits, torque=min(limits.torque, _OF_HARD * cell.limits.hard_torque_nm))
    clamped = Clamped.of(grasp_model, states)
    along = arc_lengths(states.poses[:, :3])
    found = turned_motion(cell, predicted, grasp_model.reach.axis, clamped.cost.at(along), slack,
                          (limits.force, limits.torque), **asked)
    return found, {
        "slack_rad": slack, "along_m": along, "offsets_rad": found.offsets,
        "largest_rad": float(np.linalg.norm(found.offsets, axis=1).max()),
        "peak_energy_j": float(found.energies.max()),
        "peak_torque_nm": float(found.torques.max()),
        "full_model": clamped.checked(found.offsets[clamped.rows], limits)}
