"""What a model expects the gripper to feel along a path: wrench, its slope, and how sure it is.

A branch is stiff along its axis: there a tenth of a millimetre of the gripper's place is newtons.
So what is expected is the wrench where the gripper *is*: that at the planned pose and the tangent
stiffness times the way from there. And what is not known of the way (the arm's own repeatability, a
base that is turned against its calibration) is known of the wrench as little as the stiffness
makes of it: a covariance, which the guard and the report allow for.
"""

from dataclasses import dataclass

import numpy as np

from limber.core.numerics.rigid import rotations_at, turn_between
from limber.robot.cell.cell import Cell


@dataclass(frozen=True)
class ExpectedWrench:
    """Along a path of the gripper, branch frame.

    Attributes:
        wrenches: Of the gripper on the branch, about its middle [N, N m], shape [n, 6].
        slopes: Their derivative to the gripper's position [m] and rotation [rad], shape [n, 6, 6].
        covariance: Of what is not known of them, shape [n, 6, 6].
        rest_pose: Of the gripper, the robot's base frame, where it closes on the resting branch
            [m, rad], shape [6].
    """

    wrenches: np.ndarray
    slopes: np.ndarray
    covariance: np.ndarray
    rest_pose: np.ndarray

    @classmethod
    def nothing(cls, poses: np.ndarray) -> "ExpectedWrench":
        """Return what a gripper feels that goes through ``poses`` [n, 6] with nothing in it."""
        count = len(poses)
        return cls(np.zeros((count, 6)), np.zeros((count, 6, 6)), np.zeros((count, 6, 6)),
                   poses[0])

    def reversed(self) -> "ExpectedWrench":
        """Return the same from the end on."""
        return ExpectedWrench(self.wrenches[::-1], self.slopes[::-1], self.covariance[::-1],
                              self.rest_pose)

    def at(self, k: int, part: float) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return wrench [6], slopes [6, 6] and covariance [6, 6] between rows k and k + 1."""
        return ((1 - part) * self.wrenches[k] + part * self.wrenches[k + 1],
                (1 - part) * self.slopes[k] + part * self.slopes[k + 1],
                (1 - part) * self.covariance[k] + part * self.covariance[k + 1])


@dataclass(frozen=True)
class Predicted:
    """A clamped grasp along a path, as the model has it.

    Attributes:
        poses: Of the grasped piece from its rest pose on, branch frame [m, rad], shape [n, 6].
        wrenches: Of a gripper that gives nothing [N, N m], shape [n, 6].
        stiffness: Their derivative to the pose, shape [n, 6, 6].
        young_covariance: Of the forces for what is not known of Young's modulus, [n, 3, 3].
    """

    poses: np.ndarray
    wrenches: np.ndarray
    stiffness: np.ndarray
    young_covariance: np.ndarray

    @classmethod
    def of_forces(cls, poses: np.ndarray, forces: np.ndarray) -> "Predicted":
        """Return forces [n, 3] at poses [n, 6] of which nothing else is known."""
        count = len(poses)
        return cls(poses, np.hstack([forces, np.zeros((count, 3))]), np.zeros((count, 6, 6)),
                   np.zeros((count, 3, 3)))

    def felt(self, cell: Cell, rest_pose: np.ndarray) -> ExpectedWrench:
        """Return what a cell's gripper will feel, which gives way a little itself.

        Args:
            rest_pose: Of the gripper where it closes, base frame [m, rad], shape [6].
        """
        count = len(self.poses)
        yielding = np.tile(np.eye(6), (count, 1, 1))
        yielding[:, :, :3] += cell.tool.compliance_m_per_n * self.stiffness[:, :, :3]
        slopes = np.linalg.solve(yielding, self.stiffness)
        wrenches = np.linalg.solve(yielding, self.wrenches[..., None])[..., 0]
        covariance = slopes @ self._way_covariance(cell) @ slopes.transpose(0, 2, 1)
        young = np.zeros((count, 6, 6))
        young[:, :3, :3] = self.young_covariance
        inverse = np.linalg.inv(yielding)
        covariance += inverse @ young @ inverse.transpose(0, 2, 1)
        return ExpectedWrench(wrenches, slopes, covariance, rest_pose)

    def _way_covariance(self, cell: Cell) -> np.ndarray:
        """Of the gripper's way since it closed, shape [n, 6, 6] in m and rad."""
        ways = self.poses[:, :3] - self.poses[0, :3]
        turns = turn_between(self.poses[0, 3:], self.poses[:, 3:])
        by_base = np.concatenate([_crossing(ways), _crossing(turns)], axis=1)
        covariance = cell.base.rotation_sigma_rad**2 * by_base @ by_base.transpose(0, 2, 1)
        own = np.r_[np.full(3, cell.robot.pose_sigma_m), np.full(3, cell.robot.pose_sigma_rad)]
        return covariance + np.diag(own**2)


def at_places(predicted: Predicted, places: np.ndarray, wanted: np.ndarray) -> Predicted:
    """Return a prediction carried from ``places`` [n] along its path to others [m]."""
    def carried(values: np.ndarray) -> np.ndarray:
        flat = values.reshape(len(values), -1)
        return np.column_stack([np.interp(wanted, places, column) for column in flat.T]
                               ).reshape(len(wanted), *values.shape[1:])

    poses = carried(predicted.poses)
    kept = np.r_[True, np.diff(places) > 0]
    if kept.sum() > 1:
        poses[:, 3:] = rotations_at(places[kept], predicted.poses[kept, 3:],
                                    np.clip(wanted, places[0], places[-1]))
    return Predicted(poses, carried(predicted.wrenches), carried(predicted.stiffness),
                     carried(predicted.young_covariance))


def _crossing(vectors: np.ndarray) -> np.ndarray:
    """Matrices that turn a small rotation into what it moves ``vectors`` [n, 3] by, [n, 3, 3]."""
    x, y, z = vectors.T
    nothing = np.zeros_like(x)
    return np.stack([np.stack([nothing, z, -y], axis=-1), np.stack([-z, nothing, x], axis=-1),
                     np.stack([y, -x, nothing], axis=-1)], axis=1)
