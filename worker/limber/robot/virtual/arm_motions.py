"""Motions of the virtual arm, integrated step by step: following a target, and braking."""

import numpy as np

from limber.cell.arm import Arm
from limber.core.numerics.rigid import inverted, matrices
from limber.robot.virtual.step_kernels import servo_step

JOINT_ACCELERATION = 40.0
"""Greatest acceleration of the motors [rad/s^2]."""
STOP_DECELERATION = 8.0
"""Joint deceleration of protective and emergency stops, and at a program's end [rad/s^2]."""


class Unreachable(Exception):
    """A motion impossible for the arm; the controller answers with a protective stop."""


class Braking:
    """The arm slows down to standstill on its path, every joint in the same time."""

    def __init__(self, speeds: np.ndarray, deceleration: float):
        """Brake the fastest joint with ``deceleration`` [rad/s^2]."""
        self._duration = float(np.abs(speeds).max()) / max(deceleration, 1e-3)
        self._initial, self._time = speeds.copy(), 0.0
        self.finished = self._duration <= 0.0

    def step(self, joints: np.ndarray, speeds: np.ndarray, seconds: float, scale: float,
             ) -> tuple[np.ndarray, np.ndarray]:
        first = self._time
        self._time = min(self._time + seconds, self._duration)
        self.finished = self._time >= self._duration
        # Exact path under constant deceleration between the two times.
        mean = 1.0 - 0.5 * (first + self._time) / self._duration if self._duration > 0 else 0.0
        moved = self._initial * mean * (self._time - first)
        left = 1.0 - self._time / self._duration if self._duration > 0 else 0.0
        return joints + moved, self._initial * left


class Servo:
    """Follows a target that is updated at any rate (servoj).

    The controller scales the time of its own motion by the speed slider. Below 1 the arm follows
    the target at that fraction of the target's speed and falls behind; it catches up when the
    slider is at 1 again.
    """

    def __init__(self) -> None:
        self.finished = False
        self.target = np.zeros(6)
        self.gain, self.lookahead = 300.0, 0.1
        self._last: np.ndarray | None = None
        self._commanded, self._since, self._pace = np.zeros(6), 0.0, 0.0

    def step(self, joints: np.ndarray, speeds: np.ndarray, seconds: float, scale: float,
             ) -> tuple[np.ndarray, np.ndarray]:
        return servo_step(joints, speeds, self._goal(joints, seconds, scale), self.gain,
                          self.lookahead, seconds, JOINT_ACCELERATION)

    def _goal(self, joints: np.ndarray, seconds: float, scale: float) -> np.ndarray:
        """Joint angles to which the arm is driven now [rad], with the slider at ``scale``."""
        if self._last is None:
            self._last = self._commanded = joints.copy()
        self._since += seconds
        moved = float(np.abs(self.target - self._last).max())
        if moved > 0.0:
            # Targets may be less frequent than steps.
            self._pace, self._since = moved / self._since, 0.0
            self._last = self.target.copy()
        if scale >= 1.0:
            self._commanded = self.target.copy()
            return self._commanded
        offset = self.target - self._commanded
        farthest = float(np.abs(offset).max())
        if farthest > 0.0:
            self._commanded = self._commanded + offset * min(1.0,
                                                             scale * self._pace * seconds
                                                             / farthest)
        return self._commanded


Motion = Servo | Braking


def nearest_joints(arm: Arm, pose: np.ndarray, tool: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the joint angles nearest to ``near`` that bring the tool to ``pose``.

    Raises:
        Unreachable: no joint angles reach it.
    """
    solutions = arm.inverse(matrices(pose) @ inverted(tool), near)
    solutions = solutions[np.isfinite(solutions).all(axis=1)]
    if len(solutions) == 0:
        raise Unreachable("the inverse kinematics has no solution")
    solutions = solutions + 2 * np.pi * np.round((near - solutions) / (2 * np.pi))
    return solutions[np.abs(solutions - near).sum(axis=1).argmin()]


