"""Motions of the virtual arm: each returns new joint angles at every step.

A move is a curve sampled closely in joint space and a speed along it that keeps the tool's and
the joints' limits; braking, servo and speed motions are integrated step by step.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from limber.core.numerics.rigid import angle_between, inverted, matrices, pose_between
from limber.robot.interface import Arm
from limber.robot.virtual.step_kernels import servo_step

JOINT_ACCELERATION = 40.0
"""Greatest acceleration of the motors [rad/s^2]."""
STOP_DECELERATION = 8.0
"""Joint deceleration of protective and emergency stops, and at a program's end [rad/s^2]."""

_SAMPLES = 300


class Unreachable(Exception):
    """A motion impossible for the arm; the controller answers with a protective stop."""


class Motion(Protocol):
    """A motion in progress."""

    finished: bool

    def step(self, joints: np.ndarray, speeds: np.ndarray, seconds: float, scale: float,
             ) -> tuple[np.ndarray, np.ndarray]:
        """Return joint angles and speeds ``seconds`` later, with the speed slider at ``scale``."""
        ...


@dataclass(frozen=True)
class Waypoint:
    """A stop on a path.

    Attributes:
        kind: ``joint`` or ``line``: shape of the path to this stop.
        target: Joint angles [rad] or the tool's pose [m, rad], shape [6], as ``is_pose`` says.
        speed, acceleration: Those of the leading joint [rad/s], or of the tool [m/s].
        blend: Radius [m] (or [rad] on joint paths) within which the corner is rounded.
    """

    kind: str
    target: np.ndarray
    is_pose: bool
    speed: float
    acceleration: float
    blend: float = 0.0


class TimedPath:
    """A path through samples, as fast as the limits along it allow, from standstill to standstill.

    Args:
        joints: Samples [rad], shape [n, 6].
        lengths: Length along the path [m or rad], shape [n], ascending.
        speeds, accelerations: Limits at each sample, shape [n].
        passed: Index of the waypoint to which a sample belongs, shape [n].
    """

    def __init__(self, arm: Arm, joints: np.ndarray, lengths: np.ndarray, speeds: np.ndarray,
                 accelerations: np.ndarray, passed: np.ndarray):
        keep = np.r_[True, np.diff(lengths) > 1e-12]
        self._joints, waypoints = joints[keep], lengths[keep]
        self._passed = passed[keep]
        self.finished = len(waypoints) < 2
        self._time = 0.0
        if self.finished:
            return
        steps = np.diff(waypoints)
        slope = np.abs(np.diff(self._joints, axis=0)) / steps[:, None]
        joint_bound = (np.asarray(arm.joint_speed) / np.maximum(slope, 1e-12)).min(axis=1)
        bound = np.minimum(speeds[keep], np.minimum(np.r_[joint_bound, np.inf],
                                                     np.r_[np.inf, joint_bound]))
        fastest = _reachable_speeds(bound, accelerations[keep], steps)
        self._speeds = fastest
        durations = 2 * steps / (fastest[1:] + fastest[:-1])
        self._times = np.r_[0.0, np.cumsum(durations)]
        self._waypoints = waypoints

    @property
    def waypoint(self) -> int:
        """Index of the waypoint towards which the arm moves."""
        if self.finished:
            return int(self._passed[-1])
        return int(self._passed[np.searchsorted(self._times, self._time, side="right") - 1])

    def step(self, joints: np.ndarray, speeds: np.ndarray, seconds: float, scale: float,
             ) -> tuple[np.ndarray, np.ndarray]:
        before = self._at(self._time)
        self._time += seconds * scale
        if self._time >= self._times[-1]:
            self.finished = True
            return self._joints[-1].copy(), np.zeros(6)
        after = self._at(self._time)
        return after, (after - before) / seconds

    def _at(self, time: float) -> np.ndarray:
        k = min(int(np.searchsorted(self._times, time, side="right")) - 1, len(self._waypoints) - 2)
        elapsed, span = time - self._times[k], self._times[k + 1] - self._times[k]
        slow, fast = self._speeds[k], self._speeds[k + 1]
        distance = slow * elapsed + 0.5 * (fast - slow) / span * elapsed * elapsed
        part = min(distance / (self._waypoints[k + 1] - self._waypoints[k]), 1.0)
        return (1 - part) * self._joints[k] + part * self._joints[k + 1]


class Braking:
    """The arm slows down to standstill on its path, every joint in the same time."""

    def __init__(self, speeds: np.ndarray, deceleration: float):
        """Brake the fastest joint with ``deceleration`` [rad/s^2]."""
        self._begin(speeds, float(np.abs(speeds).max()) / max(deceleration, 1e-3))

    @classmethod
    def of_tool(cls, speeds: np.ndarray, tool_speed: np.ndarray, deceleration: float) -> "Braking":
        """Brake the tool with ``deceleration`` [m/s^2] (and the same number in rad/s^2)."""
        braking = cls(speeds, STOP_DECELERATION)
        fastest = max(float(np.linalg.norm(tool_speed[:3])), float(np.linalg.norm(tool_speed[3:])))
        least = float(np.abs(speeds).max()) / JOINT_ACCELERATION
        braking._begin(speeds, max(fastest / max(deceleration, 1e-3), least))
        return braking

    def _begin(self, speeds: np.ndarray, duration: float) -> None:
        self._initial, self._duration, self._time = speeds.copy(), duration, 0.0
        self.finished = duration <= 0.0

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


class SpeedMotion:
    """Keeps a tool or joint speed (speedl, speedj) until it is stopped."""

    def __init__(self, arm: Arm, tool: np.ndarray):
        self.finished = False
        self._arm, self._tool = arm, tool
        self.target, self.acceleration, self.of_tool = np.zeros(6), 0.5, True
        self._now: np.ndarray | None = None

    def step(self, joints: np.ndarray, speeds: np.ndarray, seconds: float, scale: float,
             ) -> tuple[np.ndarray, np.ndarray]:
        scaled = self.target * scale
        if self.of_tool:
            slopes = _tool_jacobian(self._arm, joints, self._tool)
            now = slopes @ speeds if self._now is None else self._now
        else:
            now = speeds
        change = scaled - now
        largest = max(float(np.linalg.norm(change[:3])), float(np.linalg.norm(change[3:])))
        allowed = self.acceleration * seconds
        now = now + change * min(1.0, allowed / largest if largest > 0 else 1.0)
        self._now = now
        if not self.of_tool:
            return joints + now * seconds, now
        if np.linalg.cond(slopes) > 1e4:
            raise Unreachable("speedl near a singularity")
        new_speeds = np.linalg.solve(slopes, now)
        return joints + new_speeds * seconds, new_speeds


def joint_move(arm: Arm, start: np.ndarray, waypoints: list[Waypoint],
               tool: np.ndarray) -> TimedPath:
    """Return the motion through ``waypoints`` in joint space (movej), with blends."""
    corners = [start]
    for waypoint in waypoints:
        corners.append(nearest_joints(arm, waypoint.target, tool, corners[-1])
                       if waypoint.is_pose else np.asarray(waypoint.target, float))
    curve = _rounded(np.array(corners), waypoints, _joint_distance, _between_joints)
    return _timed(arm, curve.points, curve, curve.points, waypoints)


def line_move(arm: Arm, start: np.ndarray, start_pose: np.ndarray, waypoints: list[Waypoint],
              tool: np.ndarray) -> TimedPath:
    """Return the tool's motion through ``waypoints`` on straight lines (movel), with blends.

    Raises:
        Unreachable: a section of the path is out of reach, or passes a singularity.
    """
    corners = [start_pose, *(np.asarray(waypoint.target, float) for waypoint in waypoints)]
    curve = _rounded(np.array(corners), waypoints, _pose_distance, pose_between)
    solutions = arm.configurations(matrices(curve.points) @ inverted(tool), start)
    offset = np.abs((solutions[:, 0] - start + np.pi) % (2 * np.pi) - np.pi).max(axis=1)
    offset[np.isnan(solutions).any(axis=(1, 2))] = np.inf
    branch = int(offset.argmin())
    if not offset[branch] < 0.05:
        raise Unreachable("a pose on the path is out of reach")
    joints = np.unwrap(np.vstack([start, solutions[branch]]), axis=0)[1:]
    if len(joints) > 1 and np.abs(np.diff(joints, axis=0)).max() > 0.5:
        raise Unreachable("the path passes a singularity")
    return _timed(arm, joints, curve, curve.points[:, :3], waypoints)


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


def _timed(arm: Arm, joints: np.ndarray, curve: "_Curve", positions: np.ndarray,
           waypoints: list[Waypoint]) -> TimedPath:
    speeds = np.array([waypoints[k].speed for k in curve.passed])
    accelerations = np.array([waypoints[k].acceleration for k in curve.passed])
    # At the end of a leg the slower of both neighbours applies; without a blend the arm stops
    # there.
    speeds = np.minimum(speeds, np.r_[speeds[1:], speeds[-1]])
    speeds[curve.stops] = 0.0
    # In a curve the lateral acceleration counts as well.
    offsets = np.diff(positions, axis=0)
    steps = np.maximum(np.linalg.norm(offsets, axis=1), 1e-15)
    turned = np.linalg.norm(np.diff(offsets / steps[:, None], axis=0), axis=1)
    across = accelerations[1:-1] * 0.5 * (steps[1:] + steps[:-1]) / np.maximum(turned, 1e-12)
    speeds[1:-1] = np.minimum(speeds[1:-1], np.sqrt(across))
    return TimedPath(arm, joints, curve.lengths, speeds, accelerations, curve.passed)


def _reachable_speeds(bound: np.ndarray, accelerations: np.ndarray, steps: np.ndarray,
                      ) -> np.ndarray:
    """Greatest speeds [n] within ``bound`` that accelerations allow, zero at both ends."""
    speeds = bound.copy()
    speeds[0] = speeds[-1] = 0.0
    for k in range(len(steps)):
        speeds[k + 1] = min(speeds[k + 1],
                            math.sqrt(speeds[k] ** 2 + 2 * accelerations[k + 1] * steps[k]))
    for k in range(len(steps) - 1, -1, -1):
        speeds[k] = min(speeds[k],
                        math.sqrt(speeds[k + 1] ** 2 + 2 * accelerations[k] * steps[k]))
    return speeds


@dataclass(frozen=True)
class _Curve:
    """Samples of a path: points [n, 6], path length [n], target waypoint of each [n], stops [n]."""

    points: np.ndarray
    lengths: np.ndarray
    passed: np.ndarray
    stops: np.ndarray


def _rounded(corners: np.ndarray, waypoints: list[Waypoint], distance: Callable,
             between: Callable) -> _Curve:
    """Sample a polyline whose corners are rounded by parabolas (de Casteljau)."""
    legs = distance(corners[:-1], corners[1:])
    radii = [0.0]
    for k, waypoint in enumerate(waypoints[:-1]):
        # Blends may not overlap: at most half of each neighbouring leg.
        radii.append(min(waypoint.blend, 0.5 * legs[k], 0.5 * legs[k + 1]))
    radii.append(0.0)
    count = max(_SAMPLES // len(legs), 8)
    pieces, passed, stops = [corners[:1]], [np.zeros(1, int)], [np.zeros(1, bool)]
    for k, leg in enumerate(legs):
        if leg <= 0.0:
            continue
        first, last = radii[k] / leg, 1.0 - radii[k + 1] / leg
        if last > first:
            pieces.append(between(corners[k], corners[k + 1],
                                  np.linspace(first, last, count + 1)[1:]))
            passed.append(np.full(count, k))
            stops.append(np.r_[np.zeros(count - 1, bool), radii[k + 1] == 0.0])
        if radii[k + 1] > 0.0:
            parts = np.linspace(0, 1, 17)[1:]
            begin = between(corners[k], corners[k + 1], np.array([last]))[0]
            end = between(corners[k + 1], corners[k + 2],
                          np.array([radii[k + 1] / legs[k + 1]]))[0]
            pieces.append(between(between(begin, corners[k + 1], parts),
                                  between(corners[k + 1], end, parts), parts))
            passed.append(np.where(parts < 0.5, k, k + 1))
            stops.append(np.zeros(len(parts), bool))
    points = np.concatenate(pieces)
    return _Curve(points, np.r_[0.0, np.cumsum(distance(points[:-1], points[1:]))],
                  np.concatenate(passed), np.concatenate(stops))


def _joint_distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    return np.abs(second - first).max(axis=-1)


def _between_joints(first: np.ndarray, second: np.ndarray, parts: np.ndarray) -> np.ndarray:
    return first + parts[:, None] * (second - first)


def _pose_distance(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Path length of the tool [m]; its angle [rad] if it only rotates, as in the controller."""
    distance = np.linalg.norm(second[:, :3] - first[:, :3], axis=1)
    return np.where(distance > 1e-9, distance, angle_between(first[:, 3:], second[:, 3:]))


def _tool_jacobian(arm: Arm, joints: np.ndarray, tool: np.ndarray) -> np.ndarray:
    slopes = arm.jacobian(joints)
    lever = arm.forward(joints)[:3, :3] @ tool[:3, 3]
    slopes[:3] -= np.cross(lever, slopes[3:].T).T
    return slopes
