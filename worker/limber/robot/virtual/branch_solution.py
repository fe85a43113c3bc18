"""The branch at one pose of the gripper, and the extrapolation of its wrench from there."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from limber.core.numerics.rigid_kernels import inverse_of, rotation_vector
from limber.robot.virtual.step_kernels import steer

_LEAST_WAY = 2e-3  # m between two solutions whose tangents are compared

Bends = tuple[np.ndarray, np.ndarray]
"""Displacements [m], shape [n, 3], and the change of stiffness over each, shape [n, 6, 6]."""
NO_BENDS: Bends = np.zeros((0, 3)), np.zeros((0, 6, 6))


def joined(first: Bends, then: Bends) -> Bends:
    return np.concatenate((first[0], then[0])), np.concatenate((first[1], then[1]))


@dataclass
class Solution:
    """The branch at one pose of the held patch.

    Attributes:
        frame: Frame of the patch, branch frame, shape [4, 4].
        wrench: Wrench of the gripper on the branch, about the patch's position, branch frame [N, N
        m].
        stiffness: Its derivative to position and rotation, shape [6, 6].
        points: Seen points [m], shape [n, 3].
        point_slopes: Their derivative to position and rotation, shape [3 n, 6].
        peak_strain: Greatest principal strain.
        seconds: Computing time.
        converged: Whether it is an equilibrium; if not, the rest is of the last one.
        bends: Changes of the stiffness, first over the displacement from an earlier solution, then
            over those tried when the gripper closed.
    """

    frame: np.ndarray
    wrench: np.ndarray
    stiffness: np.ndarray
    points: np.ndarray
    point_slopes: np.ndarray
    peak_strain: float
    seconds: float
    converged: bool
    bends: Bends = NO_BENDS

    def wrench_at(self, patch: np.ndarray, compliance: float) -> np.ndarray:
        """Return the wrench [6] at the patch's frame ``patch`` of a rigid gripper.

        The patch stays behind by ``compliance`` [m/N] times the force; valid near its own frame.
        """
        return steer(self.frame, self.wrench, self.stiffness, *self.bends, patch, compliance)

    def change_to(self, patch: np.ndarray) -> np.ndarray:
        """Return the translation [m] and rotation [rad] to another frame of the patch, shape [6].
        """
        return np.concatenate((patch[:3, 3] - self.frame[:3, 3],
                               rotation_vector(patch @ inverse_of(self.frame))))

    def bend_from(self, before: "Solution") -> Bends:
        """Return the change of stiffness from another solution; none if it is unknown."""
        offset = self.frame[:3, 3] - before.frame[:3, 3]
        if not (self.converged and before.converged and np.linalg.norm(offset) > _LEAST_WAY):
            return NO_BENDS
        return offset[None], (self.stiffness - before.stiffness)[None]

    def add_predictions(self, past: Sequence["Solution"], tried: Bends) -> None:
        """Set the bends from ``past`` solutions, the latest first; else copy the latest's."""
        for before in past:
            newest = self.bend_from(before)
            if len(newest[0]):
                self.bends = joined(newest, tried)
                return
        # It hardly moved: the earlier bends still hold.
        self.bends = past[0].bends if past else tried
