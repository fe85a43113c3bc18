"""The arms of Universal Robots: Denavit-Hartenberg tables, speeds, payloads, kinematics.

Frames are the controller's: the base frame that its pendant shows (not ROS's ``base_link``, which
is rotated by 180 degrees about z) and the flange.

Lengths are the manufacturer's nominal ones ("DH Parameters for calculations of kinematics and
dynamics"). A real arm is calibrated in the factory and its controller uses corrected tables: its
poses differ from these by up to some millimetres. So a measured joint pose is compared with the
controller's own pose before a motion (:mod:`limber.robot.driver.guard`), never assumed to be equal.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from limber.cell.arm import Rods
from limber.core.numerics.compiled import compiled, for_kernels
from limber.core.numerics.rigid_kernels import inverse_of

# Kernels of the kinematics of an arm of Universal Robots, by its Denavit-Hartenberg table.
#
# Frames are the controller's: the base frame that its pendant shows (not ROS's ``base_link``,
# which is rotated by 180 degrees about z) and the flange, as homogeneous matrices. All kernels
# take many poses; ``UrArm`` calls them.

@compiled
def _link(table: np.ndarray, joint: int, angle: float) -> np.ndarray:
    """The frame of one joint in the one before it (classic Denavit-Hartenberg)."""
    d, a, twist = table[joint]
    c, s, ct, st = math.cos(angle), math.sin(angle), math.cos(twist), math.sin(twist)
    return np.array([[c, -s * ct, s * st, a * c], [s, c * ct, -c * st, a * s],
                     [0.0, st, ct, d], [0.0, 0.0, 0.0, 1.0]])


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


Series = Literal["cb3", "e"]

# Offsets along and twists about x between the joints' axes: the same layout in every arm.
_TWIST = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
_QUICK, _SLOW, _WRIST = math.pi, 2 * math.pi / 3, 2 * math.pi
# Housings of the joints: four sizes of arm.
_SMALL, _MIDDLE, _LARGE = (0.055, 0.045, 0.035), (0.06, 0.06, 0.045), (0.075, 0.06, 0.055)
_HEAVY = (0.1, 0.085, 0.055)  # the maker's meshes: 0.09, 0.077, 0.05; upper arm 0.089
_UPPER_TUBE, _FORE_TUBE = 0.9, 0.75  # radii of the two long tubes over those of their housings
_DRAWN = 0.05  # radius of the drawn links over the length of the two tubes


@dataclass(frozen=True)
class UrArm:
    """A six-joint arm with three parallel axes and a wrist, as all Universal Robots have.

    Attributes:
        name: Model, lower case: ``ur5e``.
        series: ``cb3`` (125 Hz) or ``e`` (500 Hz).
        d: Offsets along the joints' axes [m], shape [6].
        a: Offsets along x [m], shape [6].
        joint_speed: Greatest joint speeds [rad/s], shape [6].
        payload: Greatest mass at the flange [kg].
        lateral: Offsets of the axes of upper arm and forearm from the shoulder's, along the second
            joint's axis [m] (from the manufacturer's ROS 2 description).
        housing: Radius of the joints' housings at shoulder, elbow and wrist [m], rounded up.
        endless_wrist: Whether the last joint rotates without end.
    """

    name: str
    series: Series
    d: tuple[float, ...]
    a: tuple[float, ...]
    joint_speed: tuple[float, ...]
    payload: float
    lateral: tuple[float, float]
    housing: tuple[float, float, float]
    endless_wrist: bool = False

    controller = "ur"
    joint_names = ("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3")
    ros_joints = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    home = (0.0, -1.57, 1.57, -1.57, -1.57, 0.0)
    singularity_names = ("wrist", "elbow", "shoulder")

    @property
    def measures_force(self) -> bool:
        """A CB3 estimates the force from its motors' currents, with drifting errors of newtons."""
        return self.series == "e"

    @property
    def shoulder(self) -> np.ndarray:
        return np.array([0.0, 0.0, self.d[0]])

    @property
    def link_radius(self) -> float:
        return _DRAWN * float(np.abs(self.a).sum())

    @cached_property
    def table(self) -> np.ndarray:
        """The Denavit-Hartenberg table: d [m], a [m] and twist [rad] per joint, shape [6, 3]."""
        return np.column_stack([self.d, self.a, _TWIST])

    @property
    def reach(self) -> float:
        """Greatest distance of the wrist's centre from the shoulder [m]."""
        return abs(self.a[1]) + abs(self.a[2]) + abs(self.d[4])

    @cached_property
    def joint_limits(self) -> np.ndarray:
        """Least and greatest joint angles [rad], shape [6, 2]: one turn in each direction."""
        limits = np.tile([-2 * math.pi, 2 * math.pi], (6, 1))
        if self.endless_wrist:
            limits[5] = [-np.inf, np.inf]
        return limits

    @property
    def rate(self) -> float:
        """Steps per second of the controller [Hz]."""
        return 125.0 if self.series == "cb3" else 500.0

    def forward(self, joints: np.ndarray) -> np.ndarray:
        return np.ascontiguousarray(self.link_frames(joints)[..., 5, :, :])

    def link_frames(self, joints: np.ndarray) -> np.ndarray:
        """Return the frames of all six links in the base's, the last of them the flange's,
        shape [..., 6, 4, 4]."""
        joints = np.asarray(joints, float)
        frames = link_frames(self.table, for_kernels(joints.reshape(-1, 6)))
        return frames.reshape(*joints.shape[:-1], 6, 4, 4)

    def inverse(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return every joint pose [rad] that brings the flange to ``frames`` [..., 4, 4], base
        frame, within half a turn, shape [..., 8, 6]. The order is fixed, so that a row followed
        along a path is one continuous branch: bit 2 is the shoulder's side, bit 1 the wrist's, bit
        0 the elbow's. The last joint of ``near`` (zero where absent) is kept where the wrist is
        singular, as only the sum of two joints is determined."""
        frames = np.asarray(frames, float)
        flat = for_kernels(frames.reshape(-1, 4, 4))
        last = np.zeros(len(flat)) if near is None else np.broadcast_to(
            np.asarray(near, float)[..., 5], frames.shape[:-2]).reshape(-1)
        solutions = inverse(self.table, flat, for_kernels(last))
        return solutions.reshape(*frames.shape[:-2], 8, 6)

    def configurations(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        return np.moveaxis(self.inverse(frames, near), -2, 0)

    def jacobian(self, joints: np.ndarray) -> np.ndarray:
        joints = np.asarray(joints, float)
        return jacobian(self.table, for_kernels(joints.reshape(-1, 6))).reshape(
            *joints.shape[:-1], 6, 6)

    def singularity_distance(self, joints: np.ndarray) -> np.ndarray:
        """Return the distance of each joint pose from each singularity, shape [..., 3].

        The Jacobian's determinant is a product of three factors, each of which vanishes at one
        singularity: the wrist's (axes of joints 4 and 6 parallel), the elbow's (arm stretched or
        folded) and the shoulder's (wrist over the base's axis). Each is scaled to at most about 1.
        """
        joints = np.asarray(joints, float)
        distances = singularity_distance(
            self.table, self.reach, for_kernels(joints.reshape(-1, 6)))
        return distances.reshape(*joints.shape[:-1], 3)

    def rods(self, joints: np.ndarray) -> Rods:
        """Return the links at joint angles [rad], shape [n, 6]: tubes offset from the
        Denavit-Hartenberg lines at shoulder and elbow, without the base's foot, which touches its
        mount."""
        frames = self.link_frames(joints)
        positions, axis = frames[:, :, :3, 3], frames[:, 0, :3, 2]
        at_shoulder, at_forearm = self.lateral
        shoulder = positions[:, 0] + at_shoulder * axis
        elbow = positions[:, 1] + at_shoulder * axis
        inner = positions[:, 1] + at_forearm * axis
        wrist = positions[:, 2] + at_forearm * axis
        thick, middle, thin = self.housing
        # The last rod's round end stops at the flange.
        last = positions[:, 5] - min(thin, self.d[5]) * frames[:, 5, :3, 2]
        links = (
            ("shoulder", positions[:, 0], shoulder, thick),
            ("upper arm", shoulder, elbow, _UPPER_TUBE * thick),
            ("elbow", elbow, inner, middle),
            ("forearm", inner, wrist, _FORE_TUBE * middle),
            ("wrist 1", wrist, positions[:, 3], thin),
            ("wrist 2", positions[:, 3], positions[:, 4], thin),
            ("wrist 3", positions[:, 4], last, thin))
        names, starts, ends, radii = zip(*links, strict=True)
        return Rods(names, np.stack(starts, axis=1), np.stack(ends, axis=1), np.array(radii))


def _arm(name: str, d: tuple[float, float, float, float], a: tuple[float, float],
         speeds: tuple[float, float], payload: float, lateral: tuple[float, float],
         housing: tuple[float, float, float], *, elbow: float = _QUICK,
         endless: bool = False) -> UrArm:
    shoulder, wrist = speeds
    return UrArm(name, "cb3" if name in ("ur3", "ur5", "ur10") else "e", (d[0], 0.0, 0.0, *d[1:]),
               (0.0, a[0], a[1], 0.0, 0.0, 0.0), (shoulder,) * 2 + (elbow,) + (wrist,) * 3,
               payload, lateral, housing, endless)


ARMS: dict[str, UrArm] = {arm.name: arm for arm in (
    _arm("ur3", (0.1519, 0.11235, 0.08535, 0.0819), (-0.24365, -0.21325), (_QUICK, _WRIST), 3.0,
         (0.1198, 0.0275), _SMALL, endless=True),
    _arm("ur5", (0.089159, 0.10915, 0.09465, 0.0823), (-0.425, -0.39225), (_QUICK, _QUICK), 5.0,
         (0.13585, 0.0165), _MIDDLE),
    _arm("ur10", (0.1273, 0.163941, 0.1157, 0.0922), (-0.612, -0.5723), (_SLOW, _QUICK), 10.0,
         (0.220941, 0.049042), _LARGE),
    _arm("ur3e", (0.15185, 0.13105, 0.08535, 0.0921), (-0.24355, -0.2132), (_QUICK, _WRIST), 3.0,
         (0.12, 0.027), _SMALL, endless=True),
    *(_arm(name, (0.1625, 0.1333, 0.0997, 0.0996), (-0.425, -0.3922), (_QUICK, _QUICK), payload,
           (0.138, 0.007), _MIDDLE) for name, payload in (("ur5e", 5.0), ("ur7e", 7.5))),
    *(_arm(name, (0.1807, 0.17415, 0.11985, 0.11655), (-0.6127, -0.57155), (_SLOW, _QUICK), 12.5,
           (0.1762, 0.0393), _LARGE) for name in ("ur10e", "ur12e")),
    _arm("ur16e", (0.1807, 0.17415, 0.11985, 0.11655), (-0.4784, -0.36), (_SLOW, _QUICK), 16.0,
         (0.176, 0.04), _LARGE),
    *(_arm(name, (0.2363, 0.201, 0.1593, 0.1543), lengths, (_SLOW, 7 * math.pi / 6), payload,
           (0.26, 0.043), _HEAVY, elbow=5 * math.pi / 6)
      for name, lengths, payload in (("ur20", (-0.862, -0.7287), 20.0),
                                     ("ur30", (-0.637, -0.5037), 30.0))),
)}
NAMES = ", ".join(ARMS)
