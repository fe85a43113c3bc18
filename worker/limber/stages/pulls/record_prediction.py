"""Predicted force along the first outward motion of a pull or a nudge, by the branch's model."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.core.progress import Progress
from limber.robot.recorder import LOOKED_M, PredictedPull, certain_directions
from limber.stages.pulls.record_path import GRASP_RADIUS_M
from limber.store import Branch

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.mechanics import BranchModel, StaticResult
    from limber.robot.motion.trajectory import Trajectory

_SHARES = (0.35, 0.7, 1.0)  # of the travel in which a wrong sensor is noticed
_STEP_M = 0.02  # between places beyond it
_SMALL_M = 3e-4  # displacements by which the stiffness is found
_BENT = 1.1  # times the distance from the start: a longer way is no longer one direction
_DEVIATIONS, _LEAST_FACTOR = 3.0, 2.0


class PullModel:
    """The branch's model as it hangs, clamped where the gripper holds it at ``point``, branch frame
    [m, 3], in a cell; ``deviation`` of log E, None if the moduli are not known; ``stiffness``:
    force over displacement of the gripper that does not turn [N/m], [3, 3]. ConvergenceError if a
    small displacement has no solution."""

    def __init__(self, model: BranchModel, deviation: float | None, cell: Cell,
                 point: np.ndarray):
        from limber.mechanics import Grasp

        self._factor = None if deviation is None else max(
            float(np.exp(_DEVIATIONS * deviation)), _LEAST_FACTOR)
        self._grasp = Grasp.gripping(model.mesh, point, GRASP_RADIUS_M)
        self._model = model.gripped(self._grasp)
        self._base = matrices(np.array(cell.base.pose))
        self._compliance = cell.tool.compliance_m_per_n
        self._rest = np.eye(4)
        self._rest[:3, 3] = point
        self.stiffness = self._stiffness()

    @classmethod
    def of_branch(cls, branch: Branch, cell: Cell, point: np.ndarray, progress: Progress,
                  ) -> PullModel:
        """Return the model of a branch folder; LimberError if there is no usable one."""
        from limber.store.loading import load_branch, stiffness_deviation

        return cls(load_branch(branch, progress=progress).model, stiffness_deviation(branch), cell,
                   point)

    def _stiffness(self) -> np.ndarray:
        from limber.mechanics import solve_static

        def force(step: np.ndarray) -> np.ndarray:
            pose = pose_vectors(self._rest) + np.r_[step, np.zeros(3)]
            found = solve_static(self._model, grasp=self._grasp, pose=pose)
            return found.require().reaction_force
        still = force(np.zeros(3))
        return np.column_stack([(force(_SMALL_M * unit) - still) / _SMALL_M for unit in np.eye(3)])

    def predicted(self, trajectory: Trajectory) -> PredictedPull:
        """Return the forces on the first outward motion of a trajectory of the gripper, base frame;
        beyond the first :data:`.LOOKED_M` they end where the model does not converge any more,
        before that with a ConvergenceError."""
        from limber.mechanics import follow_poses

        frames = self._base @ matrices(trajectory.poses)
        chosen, away = _prediction_rows(frames[:, :3, 3])
        poses = pose_vectors(frames[chosen] @ inverted(frames[0]) @ self._rest)
        results = follow_poses(self._model, self._grasp, poses)
        forces = [self._felt(result.require()) for result in results[:len(_SHARES)]]
        for result in results[len(_SHARES):]:
            if not result.converged:
                break
            forces.append(self._felt(result))
        way = frames[chosen[len(_SHARES) - 1], :3, 3] - frames[0, :3, 3]
        return PredictedPull(np.r_[0.0, away[:len(forces)]], np.vstack([np.zeros(3), *forces]),
                             self._factor, certain_directions(self.stiffness, way))

    def _felt(self, result: StaticResult) -> np.ndarray:
        """Force of a gripper that yields itself [N], shape [3], as :meth:`.Predicted.felt`."""
        from limber.mechanics.sensitivities import grasp_slopes

        slopes = grasp_slopes(self._model, self._grasp, result.displacement).wrench[:3, :3]
        return np.linalg.solve(np.eye(3) + self._compliance * slopes, result.reaction_force)


def _prediction_rows(positions: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Rows of ``positions`` [n, 3] at which the force is predicted, and their travels [m]."""
    away = np.linalg.norm(positions - positions[0], axis=1)
    passed = np.r_[0.0, np.cumsum(np.linalg.norm(np.diff(positions, axis=0), axis=1))]
    # Beyond a corner, or on the return, the distance no longer determines the position.
    straight = away[:int(np.argmin(np.r_[passed <= _BENT * away + 1e-6, False]))]
    end = int(np.argmax(straight >= 0.999 * straight.max()))
    looked = min(LOOKED_M, away[end])
    travels = [part * looked for part in _SHARES]
    beyond = away[end] - looked
    if beyond > 0.0:
        count = int(np.ceil(beyond / _STEP_M))
        travels += (looked + beyond * np.arange(1, count + 1) / count).tolist()
    chosen = np.array([int(np.argmax(away[:end + 1] >= min(travel, away[end])))
                       for travel in travels])
    return chosen, away[chosen]
