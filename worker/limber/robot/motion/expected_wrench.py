"""The wrench that a model expects along a path: its value, slope and uncertainty.

A branch is stiff along its axis: a tenth of a millimetre of the gripper's position is newtons
there.
So the expected wrench is that at the gripper's *actual* position: the wrench at the planned pose
plus the tangent stiffness times the displacement from there. Errors of that displacement (the arm's
own repeatability, a base that is rotated against its calibration) times the stiffness are errors of
the wrench.
The covariance states them, and the guard and the report allow for it.
"""

from dataclasses import dataclass

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.numerics.rigid import rotations_at, turn_between


@dataclass(frozen=True)
class ExpectedWrench:
    """Expected wrenches along a path of the gripper, branch frame.

    Attributes:
        wrenches: Wrenches of the gripper on the branch, about its middle [N, N m], shape [n, 6].
        slopes: Their derivative to the gripper's position [m] and rotation [rad], shape [n, 6, 6].
        covariance: Covariance of the wrenches, shape [n, 6, 6].
        rest_pose: Pose of the gripper when it closes on the resting branch, the robot's base frame
            [m, rad], shape [6].
    """

    wrenches: np.ndarray
    slopes: np.ndarray
    covariance: np.ndarray
    rest_pose: np.ndarray

    @classmethod
    def nothing(cls, poses: np.ndarray) -> "ExpectedWrench":
        """Return the wrenches of an empty gripper that passes through ``poses`` [n, 6]."""
        count = len(poses)
        return cls(np.zeros((count, 6)), np.zeros((count, 6, 6)), np.zeros((count, 6, 6)),
                   poses[0])

    def reversed(self) -> "ExpectedWrench":
        """Return the same in reverse order."""
        return ExpectedWrench(self.wrenches[::-1], self.slopes[::-1], self.covariance[::-1],
                              self.rest_pose)

    def at(self, k: int, part: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return wrench [6], slopes [6, 6] and covariance [6, 6] between rows k and k + 1."""
        return ((1 - part) * self.wrenches[k] + part * self.wrenches[k + 1],
                (1 - part) * self.slopes[k] + part * self.slopes[k + 1],
                (1 - part) * self.covariance[k] + part * self.covariance[k + 1])


@dataclass(frozen=True)
class Predicted:
    """A clamped grasp along a path, as predicted by the model.

    Attributes:
        poses: Poses of the grasped piece from its rest pose on, branch frame [m, rad], shape [n,
        6].
        wrenches: Wrenches of a rigid gripper [N, N m], shape [n, 6].
        stiffness: Their derivative to the pose, shape [n, 6, 6].
        young_covariance: Covariance of the forces from the uncertainty of Young's modulus, [n, 3,
        3].
    """

    poses: np.ndarray
    wrenches: np.ndarray
    stiffness: np.ndarray
    young_covariance: np.ndarray

    @classmethod
    def of_forces(cls, poses: np.ndarray, forces: np.ndarray, torques: np.ndarray | None = None,
                  ) -> "Predicted":
        """Return a prediction from forces and torques [n, 3] at poses [n, 6] alone."""
        count = len(poses)
        torques = np.zeros((count, 3)) if torques is None else torques
        return cls(poses, np.hstack([forces, torques]), np.zeros((count, 6, 6)),
                   np.zeros((count, 3, 3)))

    def first(self, count: int) -> "Predicted":
        """Return the prediction at the first ``count`` poses alone."""
        return Predicted(self.poses[:count], self.wrenches[:count], self.stiffness[:count],
                         self.young_covariance[:count])

    def felt(self, cell: Cell, rest_pose: np.ndarray) -> ExpectedWrench:
        """Return the wrench expected at a cell's gripper, which has some compliance itself.

        Args:
            rest_pose: Pose of the gripper when it closes, base frame [m, rad], shape [6].
        """
        count = len(self.poses)
        yielding = np.tile(np.eye(6), (count, 1, 1))
        yielding[:, :, :3] += cell.tool.compliance_m_per_n * self.stiffness[:, :, :3]
        slopes = np.linalg.solve(yielding, self.stiffness)
        wrenches = np.linalg.solve(yielding, self.wrenches[..., None])[..., 0]
        covariance = slopes @ self._path_covariance(cell) @ slopes.transpose(0, 2, 1)
        young = np.zeros((count, 6, 6))
        young[:, :3, :3] = self.young_covariance
        inverse = np.linalg.inv(yielding)
        covariance += inverse @ young @ inverse.transpose(0, 2, 1)
        return ExpectedWrench(wrenches, slopes, covariance, rest_pose)

    def _path_covariance(self, cell: Cell) -> np.ndarray:
        """Covariance of the gripper's displacement since it closed, shape [n, 6, 6] in m and rad.
        """
        offsets = self.poses[:, :3] - self.poses[0, :3]
        turns = turn_between(self.poses[0, 3:], self.poses[:, 3:])
        by_base = np.concatenate([_crossing(offsets), _crossing(turns)], axis=1)
        covariance = cell.base.rotation_sigma_rad**2 * by_base @ by_base.transpose(0, 2, 1)
        own = np.r_[np.full(3, cell.robot.pose_sigma_m), np.full(3, cell.robot.pose_sigma_rad)]
        return covariance + np.diag(own**2)


def interpolated(predicted: Predicted, positions: np.ndarray, query: np.ndarray) -> Predicted:
    """Return a prediction interpolated from ``positions`` [n] along its path to others [m]."""
    def carried(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        return np.column_stack([np.interp(query, positions, column) for column in flat.T]
                               ).reshape(len(query), *values.shape[1:])

    poses = carried(predicted.poses)
    kept = np.r_[True, np.diff(positions) > 0]
    if kept.sum() > 1:
        poses[:, 3:] = rotations_at(positions[kept], predicted.poses[kept, 3:],
                                    np.clip(query, positions[0], positions[-1]))
    return Predicted(poses, carried(predicted.wrenches), carried(predicted.stiffness),
                     carried(predicted.young_covariance))


def _crossing(vectors: np.ndarray) -> np.ndarray:
    """Matrices from a small rotation to the displacement of ``vectors`` [n, 3], [n, 3, 3]."""
    x, y, z = vectors.T
    nothing = np.zeros_like(x)
    return np.stack([np.stack([nothing, z, -y], axis=-1), np.stack([-z, nothing, x], axis=-1),
                     np.stack([y, -x, nothing], axis=-1)], axis=1)
