"""What the virtual controller computes at every step, compiled: flange pose and speed, servo."""

import math

import numpy as np

from limber.compiled import compiled
from limber.constants import STANDARD_GRAVITY
from limber.robot.kinematics import _forward, _jacobian


@compiled
def rotation_vector(frame: np.ndarray) -> np.ndarray:
    """Return the rotation vector [rad] of a 4 x 4 frame."""
    # Through the quaternion with the largest component, which loses no digits at half a turn.
    m00, m11, m22 = frame[0, 0], frame[1, 1], frame[2, 2]
    squares = np.array([1 + m00 + m11 + m22, 1 + m00 - m11 - m22, 1 - m00 + m11 - m22,
                        1 - m00 - m11 + m22])
    largest = squares.argmax()
    q = np.empty(4)
    part = math.sqrt(max(squares[largest], 1e-300))
    x, y, z = (frame[2, 1] - frame[1, 2], frame[0, 2] - frame[2, 0], frame[1, 0] - frame[0, 1])
    xy, xz, yz = frame[0, 1] + frame[1, 0], frame[0, 2] + frame[2, 0], frame[1, 2] + frame[2, 1]
    if largest == 0:
        q[0], q[1], q[2], q[3] = part, x / part, y / part, z / part
    elif largest == 1:
        q[0], q[1], q[2], q[3] = x / part, part, xy / part, xz / part
    elif largest == 2:
        q[0], q[1], q[2], q[3] = y / part, xy / part, part, yz / part
    else:
        q[0], q[1], q[2], q[3] = z / part, xz / part, yz / part, part
    q *= 0.5
    if q[0] < 0:
        q = -q
    sine = math.sqrt(q[1] ** 2 + q[2] ** 2 + q[3] ** 2)
    angle = 2.0 * math.atan2(sine, q[0])
    scale = angle / sine if sine > 1e-12 else 2.0
    return scale * q[1:]


@compiled
def tool_state(table: np.ndarray, joints: np.ndarray, speeds: np.ndarray, tool: np.ndarray,
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tool's pose [6], its speed [6] (base frame) and the flange's frame [4, 4].

    Args:
        table: Denavit-Hartenberg table, shape [6, 3].
        joints, speeds: [rad], [rad/s], shape [6].
        tool: Frame of the tool in the flange's, shape [4, 4].
    """
    row = joints.reshape(1, 6)
    flange = _forward(table, row)[0]
    slopes = _jacobian(table, row)[0]
    tip = flange @ tool
    motion = slopes @ speeds
    lever = tip[:3, 3] - flange[:3, 3]
    motion[0] += motion[4] * lever[2] - motion[5] * lever[1]
    motion[1] += motion[5] * lever[0] - motion[3] * lever[2]
    motion[2] += motion[3] * lever[1] - motion[4] * lever[0]
    pose = np.empty(6)
    pose[:3] = tip[:3, 3]
    pose[3:] = rotation_vector(tip)
    return pose, motion, flange


@compiled
def weight_wrench(mass: float, centre: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return what a mass at the flange pulls with, flange frame, shape [6] in N and N m.

    Args:
        mass: [kg].
        centre: Of mass, flange frame [m], shape [3].
        rotation: Of the flange in a frame whose z points up, shape [3, 3].
    """
    wrench = np.empty(6)
    for k in range(3):
        wrench[k] = -mass * STANDARD_GRAVITY * rotation[2, k]
    wrench[3:] = crossed(centre, wrench[:3])
    return wrench


@compiled
def crossed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the cross product of two vectors [3]."""
    return np.array([first[1] * second[2] - first[2] * second[1],
                     first[2] * second[0] - first[0] * second[2],
                     first[0] * second[1] - first[1] * second[0]])


@compiled
def servo_step(joints: np.ndarray, speeds: np.ndarray, target: np.ndarray, gain: float,
               lookahead: float, step: float, largest: float) -> tuple[np.ndarray, np.ndarray]:
    """One step of servoj: a spring of ``gain`` [1/s^2] to the target, damped by ``lookahead`` [s].

    The controller's own law is not published. This one has its known traits: a target that moves
    steadily is followed ``lookahead`` seconds behind, more gain follows more closely, and a short
    lookahead with a high gain overshoots.

    Returns:
        New joints [6] and speeds [6]; accelerations stay within ``largest`` [rad/s^2].
    """
    new_speeds = np.empty(6)
    new_joints = np.empty(6)
    # Implicit in the speed, so that any gain is stable at 125 Hz as well.
    damping = 1.0 + step * gain * lookahead + step * step * gain
    for k in range(6):
        wanted = (speeds[k] + step * gain * (target[k] - joints[k])) / damping
        change = min(max(wanted - speeds[k], -largest * step), largest * step)
        new_speeds[k] = speeds[k] + change
        new_joints[k] = joints[k] + step * new_speeds[k]
    return new_joints, new_speeds
