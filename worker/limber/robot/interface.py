"""Interface of an arm and its controller to the rest of Limber.

Cell, motion, guard, virtual controller, planning and scenes use a robot only through these. An arm
that meets :class:`Arm` can be planned with and checked once it has a name
(:func:`limber.robot.known_arms.register_arm`). It can be moved if a driver of its controller exists
too (:class:`ArmControl`, :func:`limber.robot.driver.controls.register_control`).

Frames are those of the controller: its base frame and the flange. Joints are revolute; angles are
in radians. ``n`` is the number of joints.
"""

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

PLAYING = 2
"""A running program, as RTDE reports it."""


@dataclass(frozen=True)
class Rods:
    """The moving links of an arm in some poses, as capsules, in its base's frame.

    Attributes:
        names: Names of the links, one per rod.
        starts, ends: End points of the rods' axes [m], shape [poses, rods, 3].
        radii: [m], shape [rods].
    """

    names: tuple[str, ...]
    starts: np.ndarray
    ends: np.ndarray
    radii: np.ndarray


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


@dataclass(frozen=True)
class Sample:
    """The robot at one step of its controller.

    Attributes:
        clock: The controller's time [s].
        arrived: Time of arrival, on this computer's monotonic clock [s].
        joints, joint_speeds: [rad], [rad/s], shape [n].
        pose, speed: Pose and speed of the tool's centre in the base's frame [m, rad], [m/s, rad/s],
        shape [6].
        wrench: Wrench of the surroundings on the tool as the controller reports it: the base's
            axes, about the tool's centre [N, N m], shape [6].
        robot_mode, safety_mode, runtime_state: The controller's numbers (7, 1 and 2 are well).
        slider: Speed slider, 0 to 1.
        tool: Tool that is set in the controller, the flange's frame [m, rad], shape [6]; None if
            its version does not report it.
        payload: Mass set in the controller [kg], and ``payload_centre`` its centre in the flange's
            frame [m], shape [3]; None likewise.
        outputs: Digital outputs, one per bit; None if it has none.
    """

    clock: float
    arrived: float
    joints: np.ndarray
    joint_speeds: np.ndarray
    pose: np.ndarray
    speed: np.ndarray
    wrench: np.ndarray
    robot_mode: int
    safety_mode: int
    runtime_state: int
    slider: float
    tool: np.ndarray | None = None
    payload: float | None = None
    payload_centre: np.ndarray | None = None
    outputs: int | None = None

    @property
    def program_runs(self) -> bool:
        """Whether a program runs on the controller."""
        return self.runtime_state == PLAYING


class ArmControl(Protocol):
    """An open controller, as the loop of :mod:`limber.robot.driver.control_loop` moves its arm.

    The opening function has checked that it is the cell's controller and may be moved. Forces, tare
    and every limit belong to the loop: a control only reads and sends.

    Attributes:
        rate: Samples a second [Hz].
        lookahead: Delay of the arm behind its target [s].
        silence: Time without a message after which the controller stops automatically [s].
        facts: Description of the controller and the arm's state, as plain data, for the parent.
    """

    rate: float
    lookahead: float
    silence: float
    facts: dict[str, Any]

    def read(self, timeout: float, beside: Sequence[socket.socket] = ()) -> list[Sample]:
        """Return the next samples, waiting at most ``timeout`` [s] for the first, or until data
        arrives ``beside``.

        Raises:
            ConnectionError: the connection to the robot was lost.
        """
        ...

    def skip(self) -> None:
        """Drop the samples that have arrived so far."""
        ...

    def connect(self) -> None:
        """Connect to move the arm, set its tool and payload, and call :meth:`watch`.

        Nothing is written to an opened controller before this.

        Raises:
            WorkError: it rejects its settings.
        """
        ...

    def watch(self) -> None:
        """Let the controller stop automatically after :attr:`silence`."""
        ...

    def program_runs(self) -> bool:
        """Whether the controller accepts targets now."""
        ...

    def start_program(self) -> bool:
        """Let it accept targets; returns whether that was begun, and does not wait for it."""
        ...

    def servo(self, pose: np.ndarray) -> bool:
        """Send the next target of the tool's centre [m, rad], shape [6]; whether it was accepted.
        """
        ...

    def servo_joints(self, joints: np.ndarray) -> bool:
        """Send the next joint angles [rad], shape [n]; whether they were accepted."""
        ...

    def end_motion(self) -> bool:
        """Brake the arm; whether that is confirmed."""
        ...

    def stop_at_once(self) -> None:
        """Stop the arm on a second channel, which does not depend on the first.

        Raises:
            OSError: the connection is broken.
        """
        ...

    def keep_alive(self) -> bool:
        """Signal that this process is alive if nothing else is sent; returns whether it arrived."""
        ...

    def grip(self, close: bool) -> None:
        """Close or open the gripper.

        Raises:
            LimberError: it cannot.
        """
        ...

    def put_back(self) -> str | None:
        """Restore the settings from before :meth:`connect`; returns in words what failed."""
        ...

    def close(self) -> None:
        """Release the robot."""
        ...
