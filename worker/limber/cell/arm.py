"""Interface of an arm to the rest of Limber: kinematics, limits, shape, and its greatest loads.

Cell, motion, guard, virtual controller, planning and scenes use an arm only through :class:`Arm`.
An arm that meets it can be planned with and checked once it has a name
(:func:`limber.cell.known_arms.register_arm`). To be moved it also needs a driver of its controller
(:class:`limber.robot.interface.ArmControl`).

Frames are those of the controller: its base frame and the flange. Joints are revolute; angles are
in radians. ``n`` is the number of joints.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol

import numpy as np

from limber.core.constants import STANDARD_GRAVITY

if TYPE_CHECKING:
    from limber.cell.cell_file import LimitsEntry

@dataclass(frozen=True)
class Rods:
    """Links of an arm, or parts of its gripper, in some poses as capsules in the base's frame:
    names and radii [m], [rods], end points of their axes [m], [poses, rods, 3]."""

    names: tuple[str, ...]
    starts: np.ndarray
    ends: np.ndarray
    radii: np.ndarray

    def placed(self, frame: np.ndarray) -> "Rods":
        """Return the rods in the frame in which ``frame`` [4, 4] is the base's."""
        starts, ends = (points @ frame[:3, :3].T + frame[:3, 3]
                        for points in (self.starts, self.ends))
        return Rods(self.names, starts, ends, self.radii)

    def joined(self, others: "Rods") -> "Rods":
        """Return these rods, then others in the same poses."""
        return Rods((*self.names, *others.names),
                    np.concatenate([self.starts, others.starts], axis=1),
                    np.concatenate([self.ends, others.ends], axis=1),
                    np.concatenate([self.radii, others.radii]))


class Arm(Protocol):
    """The description of an arm: kinematics, limits, shape. It never changes.

    Attributes:
        name: Its name in a cell file (``robot.model``).
        controller: Kind of its controller, which determines its driver.
        rate: Steps a second of the controller [Hz].
        measures_force: Whether the controller itself measures the force at the flange well enough
            for the guard.
        payload: Greatest mass at the flange [kg].
        joint_names: One name per joint, for a person.
        ros_joints: Parts of the names under which ROS sends the joints.
        joint_limits: Least and greatest angles [rad], infinite for an endless joint, shape [n, 2].
        joint_speed: Greatest speeds [rad/s], shape [n].
        home: Angles far from every singularity and limit [rad], shape [n].
        shoulder: Centre of the arm's reach, base frame [m], shape [3].
        reach: Greatest distance of the wrist from there [m].
        link_radius: Radius of the links in drawings [m].
        singularity_names: Names of the columns of :meth:`singularity_distance`.
    """

    @property
    def name(self) -> str: ...
    @property
    def controller(self) -> str: ...
    @property
    def rate(self) -> float: ...
    @property
    def measures_force(self) -> bool: ...
    @property
    def payload(self) -> float: ...
    @property
    def joint_names(self) -> tuple[str, ...]: ...
    @property
    def ros_joints(self) -> tuple[str, ...]: ...
    @property
    def joint_limits(self) -> np.ndarray: ...
    @property
    def joint_speed(self) -> Sequence[float] | np.ndarray: ...
    @property
    def home(self) -> Sequence[float] | np.ndarray: ...
    @property
    def shoulder(self) -> np.ndarray: ...
    @property
    def reach(self) -> float: ...
    @property
    def link_radius(self) -> float: ...
    @property
    def singularity_names(self) -> tuple[str, ...]: ...

    def forward(self, joints: np.ndarray) -> np.ndarray:
        """Return the flange's frames [..., 4, 4] at joint angles [..., n]."""
        ...

    def link_frames(self, joints: np.ndarray) -> np.ndarray:
        """Return the frames [..., m, 4, 4] of the links from the base on, the flange's last, at
        joint angles [..., n]."""
        ...

    def jacobian(self, joints: np.ndarray) -> np.ndarray:
        """Return the flange's velocity [m/s] over its angular velocity [rad/s], base frame, one
        column per unit joint speed, shape [..., 6, n], at joint angles [..., n].
        """
        ...

    def inverse(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return joint angles that bring the flange to ``frames``, up to whole turns.

        Args:
            frames: Frames of the flange, shape [..., 4, 4].
            near: Angles [..., n] near the requested solution. The nearest solution is among those
                returned; others may be omitted.

        Returns:
            One configuration per row, shape [..., k, n] with any k; rows that do not exist are NaN.
        """
        ...

    def configurations(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return the joint paths through ``frames``: in each the arm keeps its configuration.

        Args:
            frames: Frames of the flange, in order and close together, shape [poses, 4, 4].
            near: Angles [n] from which the first is reached, as :meth:`inverse` takes them.

        Returns:
            Angles [rad] up to whole turns, shape [k, poses, n]; poses that a configuration does
            not reach are NaN.
        """
        ...

    def singularity_distance(self, joints: np.ndarray) -> np.ndarray:
        """Return the distance of joint angles [..., n] from each kind of singularity, shape [...,
        s]: 0 in it, at most about 1.
        """
        ...

    def rods(self, joints: np.ndarray) -> Rods:
        """Return the moving links at joint angles [poses, n], for collision checks."""
        ...


MOST_FORCE = 140.0
"""[N], also for an arm without a known payload: about the force that a clamped hand bears without
harm.
"""
MOST_SPEED = 0.25
"""[m/s], the reduced speed of industrial arms with people beside them."""
MOST_TURN_SPEED = 1.5
"""[rad/s]"""
_PAYLOADS = 2.0  # payload weights that an arm exerts: it moves its payload too
_LEVER = 0.15  # m beyond the flange at which arms still carry their payload


def greatest_force(arm: Arm) -> float:
    """Return the greatest force [N] that a limit of this arm may be set to."""
    return min(MOST_FORCE, _PAYLOADS * arm.payload * STANDARD_GRAVITY)


def greatest_torque(arm: Arm) -> float:
    """Return the greatest torque [N m] that a limit of this arm may be set to."""
    return _LEVER * greatest_force(arm)


def within_ratings(arm: Arm, limits: "LimitsEntry") -> "LimitsEntry":
    """Return the limits, each within the arm's table."""
    force = greatest_force(arm)
    return limits.model_copy(update={
        name: min(getattr(limits, name), most) for name, most in (
            ("hard_force_n", force), ("soft_force_n", force), ("unexpected_force_n", force),
            ("hard_torque_nm", greatest_torque(arm)), ("speed_m_s", MOST_SPEED),
            ("turn_speed_rad_s", MOST_TURN_SPEED))})
