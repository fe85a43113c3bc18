"""A gripper's path as a table of poses, from a recording or a plan."""

import hashlib
from dataclasses import dataclass

import numpy as np

from limber.core.errors import InputError


@dataclass(frozen=True)
class PoseTable:
    """Poses of a gripper over time; only the motion relative to the first pose matters.

    Attributes:
        times: [s], ascending, shape [n].
        poses: Position and rotation vector [m, rad], shape [n, 6].

    Raises:
        InputError: fewer than two poses, or values that are not finite.
    """

    times: np.ndarray
    poses: np.ndarray

    def __post_init__(self) -> None:
        if self.poses.shape != (len(self.times), 6) or len(self.times) < 2 or not (
                np.isfinite(self.poses).all() and np.isfinite(self.times).all()
                and np.all(np.diff(self.times) > 0)):
            raise InputError(f"The table has {len(self.times)} times and poses of shape "
                             f"{self.poses.shape}.",
                             "A path needs at least two finite poses at ascending times.",
                             "Give t_s, x_m, y_m, z_m, rx_rad, ry_rad, rz_rad in each row.")

    @property
    def duration(self) -> float:
        """Duration from the first pose to the last [s]."""
        return float(self.times[-1] - self.times[0])

    def changes(self, times: np.ndarray) -> np.ndarray:
        """Return the gripper's displacement and rotation since the first pose, shape [m, 6].

        Args:
            times: Times since the first pose [s], shape [m]; after the last pose it stays there.
        """
        from scipy.spatial.transform import Rotation, Slerp

        since = self.times - self.times[0]
        at = np.clip(times, 0.0, since[-1])
        moved = np.column_stack([np.interp(at, since, column - column[0])
                                 for column in self.poses[:, :3].T])
        turns = Rotation.from_rotvec(self.poses[:, 3:].copy())
        turned = Slerp(since, turns * turns[0].inv())(at).as_rotvec()
        return np.hstack([moved, turned])

    def digest(self) -> str:
        """Key that distinguishes one path from another."""
        return hashlib.sha256(np.column_stack([self.times, self.poses]).tobytes()).hexdigest()
