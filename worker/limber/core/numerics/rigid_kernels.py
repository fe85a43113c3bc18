"""Rigid transforms one at a time, compiled, for loops at the controller's rate.

Arrays of poses use :mod:`limber.core.numerics.rigid`; here a call takes about a microsecond.
"""

import math

import numpy as np

from limber.core.constants import STANDARD_GRAVITY
from limber.core.numerics.compiled import compiled


@compiled
def rotation_vector(frame: np.ndarray) -> np.ndarray:
    """Return the rotation vector [rad] of a frame [4, 4] or rotation matrix [3, 3]."""
    # Through the quaternion with the largest component, which loses no digits near half a turn.
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
def frame_of(pose: np.ndarray) -> np.ndarray:
    """Return the frame [4, 4] of a pose [6] in m and rad (Rodrigues)."""
    x, y, z = pose[3], pose[4], pose[5]
    angle = math.sqrt(x * x + y * y + z * z)
    if angle > 1e-9:
        sine, bend = math.sin(angle) / angle, (1.0 - math.cos(angle)) / (angle * angle)
    else:
        sine, bend = 1.0, 0.5
    frame = np.zeros((4, 4))
    cosine = 1.0 - bend * angle * angle
    frame[0, 0], frame[1, 1], frame[2, 2] = (cosine + bend * x * x, cosine + bend * y * y,
                                             cosine + bend * z * z)
    frame[0, 1], frame[1, 0] = bend * x * y - sine * z, bend * x * y + sine * z
    frame[0, 2], frame[2, 0] = bend * x * z + sine * y, bend * x * z - sine * y
    frame[1, 2], frame[2, 1] = bend * y * z - sine * x, bend * y * z + sine * x
    frame[:3, 3] = pose[:3]
    frame[3, 3] = 1.0
    return frame


@compiled
def pose_of(frame: np.ndarray) -> np.ndarray:
    """Return the pose [6] in m and rad of a frame [4, 4]."""
    pose = np.empty(6)
    pose[:3] = frame[:3, 3]
    pose[3:] = rotation_vector(frame)
    return pose


@compiled
def inverse_of(frame: np.ndarray) -> np.ndarray:
    """Return the inverse of a frame [4, 4]."""
    result = np.zeros((4, 4))
    for i in range(3):
        for j in range(3):
            result[i, j] = frame[j, i]
            result[i, 3] -= frame[j, i] * frame[j, 3]
    result[3, 3] = 1.0
    return result


@compiled
def turn_between(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the relative rotation vector from one pose's rotation to another's [rad]."""
    return rotation_vector(frame_of(second) @ inverse_of(frame_of(first)))


@compiled
def pose_between(first: np.ndarray, second: np.ndarray, part: float) -> np.ndarray:
    """Return the pose at fraction ``part`` of a straight line and the shortest rotation."""
    turn = np.zeros(6)
    turn[3:] = part * turn_between(first, second)
    turned = frame_of(turn) @ frame_of(first)
    pose = np.empty(6)
    pose[:3] = first[:3] + part * (second[:3] - first[:3])
    pose[3:] = rotation_vector(turned)
    return pose


@compiled
def length(vector: np.ndarray) -> float:
    """Return the Euclidean length of a vector [n]."""
    square = 0.0
    for k in range(len(vector)):
        square += vector[k] * vector[k]
    return math.sqrt(square)


@compiled
def crossed(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    """Return the cross product of two vectors [3]."""
    return np.array([first[1] * second[2] - first[2] * second[1],
                     first[2] * second[0] - first[0] * second[2],
                     first[0] * second[1] - first[1] * second[0]])


@compiled
def weight_wrench(mass: float, centre: np.ndarray, rotation: np.ndarray) -> np.ndarray:
    """Return the wrench of gravity on a mass at the flange, flange frame, shape [6] in N and N m.

    Args:
        mass: [kg].
        centre: Centre of mass, flange frame [m], shape [3].
        rotation: Rotation of the flange in a frame with z up, shape [3, 3].
    """
    wrench = np.empty(6)
    for k in range(3):
        wrench[k] = -mass * STANDARD_GRAVITY * rotation[2, k]
    wrench[3:] = crossed(centre, wrench[:3])
    return wrench


@compiled
def turned_wrench(rotation: np.ndarray, wrench: np.ndarray, lever: np.ndarray) -> np.ndarray:
    """Return ``wrench`` [6] in other axes and about another point.

    Args:
        rotation: From its axes to the new ones, shape [3, 3].
        lever: From the new point to its old one, new axes [m], shape [3].
    """
    result = np.empty(6)
    for i in range(3):
        result[i] = (rotation[i, 0] * wrench[0] + rotation[i, 1] * wrench[1]
                     + rotation[i, 2] * wrench[2])
        result[3 + i] = (rotation[i, 0] * wrench[3] + rotation[i, 1] * wrench[4]
                         + rotation[i, 2] * wrench[5])
    result[3:] += crossed(lever, result[:3])
    return result
