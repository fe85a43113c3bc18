"""The arms of Universal Robots: Denavit-Hartenberg tables, speeds, payloads.

Lengths are the maker's nominal ones ("DH Parameters for calculations of kinematics and dynamics").
A real arm is calibrated in the factory and its controller uses corrected tables: its poses differ
from these by up to some millimetres. So a measured joint pose is compared with the controller's
own pose before a motion (:mod:`limber.robot.driver.guard`), never taken as equal.
"""

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from limber.core.errors import InputError

Series = Literal["cb3", "e"]

# Offsets along and twists about x between the joints' axes: the same layout in every arm.
_TWIST = (math.pi / 2, 0.0, 0.0, math.pi / 2, -math.pi / 2, 0.0)
_QUICK, _SLOW, _WRIST = math.pi, 2 * math.pi / 3, 2 * math.pi
# Housings of the joints: three sizes of arm.
_SMALL, _MIDDLE, _LARGE = (0.055, 0.045, 0.035), (0.06, 0.06, 0.045), (0.075, 0.06, 0.055)


@dataclass(frozen=True)
class Arm:
    """A six-joint arm with three parallel axes and a wrist, as all Universal Robots have.

    Attributes:
        name: Model, lower case: ``ur5e``.
        series: ``cb3`` (125 Hz) or ``e`` (500 Hz).
        d: Offsets along the joints' axes [m], shape [6].
        a: Offsets along x [m], shape [6].
        joint_speed: Greatest joint speeds [rad/s], shape [6].
        payload: Greatest mass at the flange [kg].
        lateral: How far the axes of upper arm and forearm lie beside the shoulder's, along the
            second joint's axis [m] (offsets of the maker's ROS 2 description).
        housing: Radius of the joints' housings at shoulder, elbow and wrist [m], rounded up.
        endless_wrist: Whether the last joint turns without end.
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

    @cached_property
    def table(self) -> np.ndarray:
        """The Denavit-Hartenberg table: d [m], a [m] and twist [rad] a joint, shape [6, 3]."""
        return np.column_stack([self.d, self.a, _TWIST])

    @property
    def reach(self) -> float:
        """Greatest distance of the wrist's centre from the shoulder [m]."""
        return abs(self.a[1]) + abs(self.a[2]) + abs(self.d[4])

    @cached_property
    def joint_limits(self) -> np.ndarray:
        """Least and greatest joint angles [rad], shape [6, 2]: one turn each way."""
        limits = np.tile([-2 * math.pi, 2 * math.pi], (6, 1))
        if self.endless_wrist:
            limits[5] = [-np.inf, np.inf]
        return limits

    @property
    def rate(self) -> float:
        """Steps a second of the controller [Hz]."""
        return 125.0 if self.series == "cb3" else 500.0


def _arm(name: str, d: tuple[float, float, float, float], a: tuple[float, float],
         speeds: tuple[float, float], payload: float, lateral: tuple[float, float],
         housing: tuple[float, float, float], *, elbow: float = _QUICK,
         endless: bool = False) -> Arm:
    shoulder, wrist = speeds
    return Arm(name, "e" if name.endswith("e") else "cb3", (d[0], 0.0, 0.0, *d[1:]),
               (0.0, a[0], a[1], 0.0, 0.0, 0.0), (shoulder,) * 2 + (elbow,) + (wrist,) * 3,
               payload, lateral, housing, endless)


ARMS: dict[str, Arm] = {arm.name: arm for arm in (
    _arm("ur3", (0.1519, 0.11235, 0.08535, 0.0819), (-0.24365, -0.21325), (_QUICK, _WRIST), 3.0,
         (0.1198, 0.0275), _SMALL, endless=True),
    _arm("ur5", (0.089159, 0.10915, 0.09465, 0.0823), (-0.425, -0.39225), (_QUICK, _QUICK), 5.0,
         (0.13585, 0.0165), _MIDDLE),
    _arm("ur10", (0.1273, 0.163941, 0.1157, 0.0922), (-0.612, -0.5723), (_SLOW, _QUICK), 10.0,
         (0.220941, 0.049042), _LARGE),
    _arm("ur3e", (0.15185, 0.13105, 0.08535, 0.0921), (-0.24355, -0.2132), (_QUICK, _WRIST), 3.0,
         (0.12, 0.027), _SMALL, endless=True),
    _arm("ur5e", (0.1625, 0.1333, 0.0997, 0.0996), (-0.425, -0.3922), (_QUICK, _QUICK), 5.0,
         (0.138, 0.007), _MIDDLE),
    _arm("ur10e", (0.1807, 0.17415, 0.11985, 0.11655), (-0.6127, -0.57155), (_SLOW, _QUICK), 12.5,
         (0.1762, 0.0393), _LARGE),
    _arm("ur16e", (0.1807, 0.17415, 0.11985, 0.11655), (-0.4784, -0.36), (_SLOW, _QUICK), 16.0,
         (0.176, 0.04), _LARGE),
)}


def arm_named(name: str) -> Arm:
    """Return the arm called ``name``, in any case and with or without a hyphen.

    Raises:
        InputError: it is none of the known ones.
    """
    arm = ARMS.get(name.lower().replace("-", "").replace(" ", ""))
    if arm is None:
        raise InputError(f"Robot {name!r} is unknown.", "Its link lengths are needed.",
                         f"Known robots: {', '.join(ARMS)}.")
    return arm
