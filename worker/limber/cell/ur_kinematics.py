"""Kernels of the kinematics of an arm of Universal Robots, by its Denavit-Hartenberg table.

Frames are the controller's: the base frame that its pendant shows (not ROS's ``base_link``, which
is rotated by 180 degrees about z) and the flange, as homogeneous matrices. All kernels take many
poses; :class:`limber.cell.ur_arms.UrArm` calls them.
"""

import math

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.core.numerics.rigid_kernels import inverse_of


@compiled
def _link(table: np.ndarray, joint: int, angle: float) -> np.ndarray:
    """The frame of one joint in the one before it (classic Denavit-Hartenberg)."""
    d, a, twist = table[joint]
    c, s, ct, st = math.cos(angle), math.sin(angle), math.cos(twist), math.sin(twist)
    return np.array([[c, -s * ct, s * st, a * c], [s, c * ct, -c * st, a * s],
                     [0.0, st, ct, d], [0.0, 0.0, 0.0, 1.0]])


@compiled
def forward(table: np.ndarray, joints: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(link_frames(table, joints)[:, 5])


@compiled
def link_frames(table: np.ndarray, joints: np.ndarray) -> np.ndarray:
    frames = np.empty((len(joints), 6, 4, 4))
    for n in range(len(joints)):
        frames[n, 0] = _link(table, 0, joints[n, 0])
        for k in range(1, 6):
            frames[n, k] = _product(frames[n, k - 1], _link(table, k, joints[n, k]))
    return frames


@compiled
def _product(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    result = np.zeros((4, 4))
    for i in range(4):
        for j in range(4):
            for k in range(4):
                result[i, j] += first[i, k] * second[k, j]
    return result


@compiled
def jacobian(table: np.ndarray, joints: np.ndarray) -> np.ndarray:
    slopes = np.empty((len(joints), 6, 6))
    frames = np.empty((7, 4, 4))
    for n in range(len(joints)):
        frames[0] = np.eye(4)
        for k in range(6):
            frames[k + 1] = _product(frames[k], _link(table, k, joints[n, k]))
        for k in range(6):
            axis = frames[k, :3, 2]
            arm = frames[6, :3, 3] - frames[k, :3, 3]
            slopes[n, 0, k] = axis[1] * arm[2] - axis[2] * arm[1]
            slopes[n, 1, k] = axis[2] * arm[0] - axis[0] * arm[2]
            slopes[n, 2, k] = axis[0] * arm[1] - axis[1] * arm[0]
            slopes[n, 3:, k] = axis
    return slopes


@compiled
def singularity_distance(table: np.ndarray, reach: float, joints: np.ndarray) -> np.ndarray:
    distances = np.empty((len(joints), 3))
    a2, a3, d5 = table[1, 1], table[2, 1], table[4, 0]
    for n in range(len(joints)):
        q2, q3, q4, q5 = joints[n, 1], joints[n, 2], joints[n, 3], joints[n, 4]
        lever = a2 * math.cos(q2) + a3 * math.cos(q2 + q3) + d5 * math.sin(q2 + q3 + q4)
        distances[n, 0], distances[n, 1] = abs(math.sin(q5)), abs(math.sin(q3))
        distances[n, 2] = abs(lever) / reach
    return distances


@compiled
def inverse(table: np.ndarray, frames: np.ndarray, last: np.ndarray) -> np.ndarray:
    """Analytic solution after Hawkins, "Analytic inverse kinematics for the UR-5/UR-10 arms", by
    arc tangents also for the paper's arc cosines, which lose half of the digits near a
    singularity."""
    solutions = np.full((len(frames), 8, 6), np.nan)
    d4, d5, d6 = table[3, 0], table[4, 0], table[5, 0]
    a2, a3 = table[1, 1], table[2, 1]
    for n in range(len(frames)):
        frame = frames[n]
        # The wrist's centre seen from above is at distance d4 from the plane of the arm.
        px, py = frame[0, 3] - d6 * frame[0, 2], frame[1, 3] - d6 * frame[1, 2]
        across = px * px + py * py - d4 * d4
        if across < 0.0:
            continue
        bearing, aside = math.atan2(py, px), math.atan2(math.sqrt(across), d4)
        for shoulder in range(2):
            q1 = bearing + math.pi / 2 + (aside if shoulder == 0 else -aside)
            s1, c1 = math.sin(q1), math.cos(q1)
            # The flange's axes along the normal of the arm's plane.
            along_x = frame[0, 0] * s1 - frame[1, 0] * c1
            along_y = frame[0, 1] * s1 - frame[1, 1] * c1
            along_z = frame[0, 2] * s1 - frame[1, 2] * c1
            spread = math.sqrt(along_x * along_x + along_y * along_y)
            for wrist in range(2):
                side = 1.0 if wrist == 0 else -1.0
                q5 = math.atan2(side * spread, along_z)
                q6 = last[n]
                if spread > 1e-9:
                    q6 = math.atan2(-side * along_y, side * along_x)
                _solve_plane(table, frame, q1, q5, q6, a2, a3, d5,
                             solutions[n, 4 * shoulder + 2 * wrist:4 * shoulder + 2 * wrist + 2])
    return solutions


@compiled
def _solve_plane(table: np.ndarray, frame: np.ndarray, q1: float, q5: float, q6: float, a2: float,
                 a3: float, d5: float, rows: np.ndarray) -> None:
    """Fill the two elbow solutions ``rows`` [2, 6] with the remaining three parallel joints."""
    end = _product(_link(table, 4, q5), _link(table, 5, q6))
    middle = _product(inverse_of(_link(table, 0, q1)), _product(frame, inverse_of(end)))
    # Frame 4 in frame 1: joints 2 to 4 rotate about one direction, its z.
    x, y = middle[0, 3], middle[1, 3]
    # Frame 4 follows a twist of a quarter turn: its x axis carries the sum of the angles.
    total = math.atan2(middle[1, 0], middle[0, 0])
    far = x * x + y * y
    cosine = (far - a2 * a2 - a3 * a3) / (2.0 * a2 * a3)
    if abs(cosine) > 1.0 + 1e-12:
        return
    cosine = min(max(cosine, -1.0), 1.0)
    # (1 - cosine)(1 + cosine) from lengths: no digits are lost near the stretched arm.
    stretch = (abs(a2) + abs(a3)) ** 2 - far
    fold = far - (abs(a2) - abs(a3)) ** 2
    sine = math.sqrt(max(stretch * fold, 0.0)) / (2.0 * abs(a2 * a3))
    for elbow in range(2):
        s3 = sine if elbow == 0 else -sine
        q3 = math.atan2(s3, cosine)
        q2 = math.atan2(y, x) - math.atan2(a3 * s3, a2 + a3 * cosine)
        rows[elbow, 0], rows[elbow, 1], rows[elbow, 2] = _half_turn(q1), _half_turn(q2), q3
        rows[elbow, 3] = _half_turn(total - q2 - q3)
        rows[elbow, 4], rows[elbow, 5] = q5, _half_turn(q6)


@compiled
def _half_turn(angle: float) -> float:
    """The same angle within half a turn of zero."""
    return angle - 2.0 * math.pi * math.floor(angle / (2.0 * math.pi) + 0.5)
