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
from limber.kernels import Kernel, for_kernels

_TABLE, _JOINTS = "table float64[6, 3]", "joints float64[poses, 6]"
_link_frames = Kernel("ur_link_frames", _TABLE, _JOINTS, "out frames float64[poses, 6, 4, 4]")
_jacobian = Kernel("ur_jacobian", _TABLE, _JOINTS, "out slopes float64[poses, 6, 6]")
_singularity_distance = Kernel("ur_singularity_distance", _TABLE, _JOINTS,
                               "out distances float64[poses, 3]", "reach float")
_inverse = Kernel("ur_inverse", _TABLE, "frames float64[poses, 4, 4]", "last float64[poses]",
                  "out solutions float64[poses, 8, 6]")

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
        joints = for_kernels(joints)
        frames = np.empty((*joints.shape[:-1], 6, 4, 4))
        _link_frames(self.table, joints.reshape(-1, 6), frames.reshape(-1, 6, 4, 4))
        return frames

    def inverse(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return every joint pose [rad] that brings the flange to ``frames`` [..., 4, 4], base
        frame, within half a turn, shape [..., 8, 6]. The order is fixed, so that a row followed
        along a path is one continuous branch: bit 2 is the shoulder's side, bit 1 the wrist's, bit
        0 the elbow's. The last joint of ``near`` (zero where absent) is kept where the wrist is
        singular, as only the sum of two joints is determined."""
        frames = for_kernels(frames)
        flat = frames.reshape(-1, 4, 4)
        last = np.zeros(len(flat)) if near is None else np.broadcast_to(
            np.asarray(near, float)[..., 5], frames.shape[:-2]).reshape(-1)
        solutions = np.empty((len(flat), 8, 6))
        _inverse(self.table, flat, for_kernels(last), solutions)
        return solutions.reshape(*frames.shape[:-2], 8, 6)

    def configurations(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        return np.moveaxis(self.inverse(frames, near), -2, 0)

    def jacobian(self, joints: np.ndarray) -> np.ndarray:
        joints = for_kernels(joints)
        slopes = np.empty((*joints.shape[:-1], 6, 6))
        _jacobian(self.table, joints.reshape(-1, 6), slopes.reshape(-1, 6, 6))
        return slopes

    def singularity_distance(self, joints: np.ndarray) -> np.ndarray:
        """Return the distance of each joint pose from each singularity, shape [..., 3].

        The Jacobian's determinant is a product of three factors, each of which vanishes at one
        singularity: the wrist's (axes of joints 4 and 6 parallel), the elbow's (arm stretched or
        folded) and the shoulder's (wrist over the base's axis). Each is scaled to at most about 1.
        """
        joints = for_kernels(joints)
        distances = np.empty((*joints.shape[:-1], 3))
        _singularity_distance(self.table, joints.reshape(-1, 6), distances.reshape(-1, 3),
                              self.reach)
        return distances

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
