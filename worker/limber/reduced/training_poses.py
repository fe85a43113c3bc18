"""The distance of a pose from the training poses of a reduced model."""

import numpy as np

from limber.core.numerics.rigid import rotation_matrix, rotation_vector
from limber.mechanics.grasp import RADIAN


class TrainingPoses:
    """Poses to which distances are measured."""

    def __init__(self, poses: np.ndarray, extent: float):
        self.positions = np.atleast_2d(poses)[:, :3]
        self.rotations = rotation_matrix(np.atleast_2d(poses)[:, 3:])
        self.extent = extent

    def distance(self, pose: np.ndarray) -> np.ndarray:
        """Return the distance of each pose to one [m], shape [s]."""
        away = self.rotations - rotation_matrix(pose[3:])
        # |R1 - R2| is sqrt(2) times the angle between them, where that is small.
        turns = np.sqrt(0.5 * np.einsum("sij,sij->s", away, away))
        return np.linalg.norm(self.positions - pose[:3], axis=1) + RADIAN * self.extent * turns

    def spacing(self) -> float:
        """Return the 90th percentile of the distance to the nearest other pose [m]."""
        if len(self.positions) < 3:
            return self.extent
        vectors = rotation_vector(self.rotations)
        nearest = [np.partition(self.distance(np.concatenate([position, vector])), 1)[1]
                   for position, vector in zip(self.positions, vectors, strict=True)]
        return float(np.percentile(nearest, 90))
