"""What an arm and its controller must be, for the rest of Limber.

Cell, motion, guard, virtual controller, planning and scenes know a robot through these alone. An
arm that meets :class:`Arm` is planned with and checked once it has a name
(:func:`limber.robot.known_arms.register_arm`); it is moved where a driver of its controller is
there too (:class:`ArmControl`, :func:`limber.robot.driver.controls.register_control`).

Frames are those of the controller: its base frame and the flange. Joints turn; angles are in
radians. ``n`` is the number of joints.
"""

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np


@dataclass(frozen=True)
class Rods:
    """The moving links of an arm in some poses, as rods with round ends, in its base's frame.

    Attributes:
        names: Of the links, one a rod.
        starts, ends: Of the rods' axes [m], shape [poses, rods, 3].
        radii: [m], shape [rods].
    """

    names: tuple[str, ...]
    starts: np.ndarray
    ends: np.ndarray
    radii: np.ndarray


class Arm(Protocol):
    """The description of an arm: kinematics, limits, shape. It never changes.

    Attributes:
        name: What a cell file calls it (``robot.model``).
        controller: Kind of its controller, by which its driver is found.
        rate: Steps a second of the controller [Hz].
        measures_force: Whether the controller itself measures the force at the flange well enough
            for the guard.
        payload: Greatest mass at the flange [kg].
        joint_names: One a joint, for a person.
        ros_joints: What the names have in them under which ROS sends the joints.
        joint_limits: Least and greatest angles [rad], infinite where a joint turns without end,
            shape [n, 2].
        joint_speed: Greatest speeds [rad/s], shape [n].
        home: Angles far from every singularity and limit [rad], shape [n].
        shoulder: Middle of what the arm reaches, base frame [m], shape [3].
        reach: Greatest distance of the wrist from there [m].
        link_radius: Of the links where they are drawn [m].
        singularity_names: Of the columns of :meth:`singularity_distance`.
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
        """Return the flange's velocity [m/s] over its angular velocity [rad/s], base frame, a unit
        joint speed a column, shape [..., 6, n], at joint angles [..., n]."""
        ...

    def inverse(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return joint angles that bring the flange to ``frames``, up to whole turns.

        Args:
            frames: Frames of the flange, shape [..., 4, 4].
            near: Angles [..., n] near which the answer is wanted. The one nearest to them is among
                those returned; others may be omitted.

        Returns:
            One configuration a row, shape [..., k, n] with any k; rows that do not exist are NaN.
        """
        ...

    def configurations(self, frames: np.ndarray, near: np.ndarray | None = None) -> np.ndarray:
        """Return the ways of going through ``frames``: in each the arm keeps its configuration.

        Args:
            frames: Frames of the flange, in order and close together, shape [poses, 4, 4].
            near: Angles [n] from which the first is reached, as :meth:`inverse` takes them.

        Returns:
            Angles [rad] up to whole turns, shape [k, poses, n]; poses that a configuration does
            not reach are NaN.
        """
        ...

    def singularity_distance(self, joints: np.ndarray) -> np.ndarray:
        """Return how far joint angles [..., n] are from each kind of singularity, shape [..., s]:
        0 in it, at most about 1."""
        ...

    def rods(self, joints: np.ndarray) -> Rods:
        """Return the moving links at joint angles [poses, n], for what stands in the way."""
        ...


@dataclass(frozen=True)
class Sample:
    """The robot at one step of its controller.

    Attributes:
        clock: The controller's time [s].
        arrived: When it came, on this computer's monotonic clock [s].
        joints, joint_speeds: [rad], [rad/s], shape [n].
        pose, speed: Of the tool's centre in the base's frame [m, rad], [m/s, rad/s], shape [6].
        wrench: Of the surroundings on the tool as the controller reports it: the base's axes,
            about the tool's centre [N, N m], shape [6].
        robot_mode, safety_mode, runtime_state: The controller's numbers (7, 1 and 2 are well).
        slider: Speed slider, 0 to 1.
        tool: Tool that is set in the controller, the flange's frame [m, rad], shape [6]; None where
            its version does not tell it.
        payload: Mass that is set there [kg], and ``payload_centre`` its centre in the flange's
            frame [m], shape [3]; None likewise.
        outputs: Digital outputs, one a bit; None where it has none.
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


class ArmControl(Protocol):
    """An open controller, as the loop of :mod:`limber.robot.driver.control_loop` moves its arm.

    Whoever opens one has seen that it is the cell's and may be moved. Forces, tare and every limit
    are the loop's own: a control only reads and sends.

    Attributes:
        rate: Samples a second [Hz].
        lookahead: By how much the arm is behind its target [s].
        silence: After so long without a word the controller stops by itself [s].
        facts: What it is and where the arm stands, as plain data, for the parent.
    """

    rate: float
    lookahead: float
    silence: float
    facts: dict[str, Any]

    def read(self, timeout: float, beside: Sequence[socket.socket] = ()) -> list[Sample]:
        """Return the next samples, waiting at most ``timeout`` [s] for the first, or until
        something comes ``beside``.

        Raises:
            ConnectionError: the connection to the robot was lost.
        """
        ...

    def skip(self) -> None:
        """Drop the samples that have come so far."""
        ...

    def connect(self) -> None:
        """Connect what moves the arm, set its tool and payload, and :meth:`watch`.

        Nothing else writes to a controller that only was opened.

        Raises:
            WorkError: it does not take its settings.
        """
        ...

    def watch(self) -> None:
        """Let the controller stop by itself after :attr:`silence`."""
        ...

    def program_runs(self) -> bool:
        """Whether the controller takes targets now."""
        ...

    def start_program(self) -> bool:
        """Let it take targets; returns whether that was begun, and does not wait for it."""
        ...

    def servo(self, pose: np.ndarray) -> bool:
        """Send the next target of the tool's centre [m, rad], shape [6]; whether it was taken."""
        ...

    def servo_joints(self, joints: np.ndarray) -> bool:
        """Send the next joint angles [rad], shape [n]; whether they were taken."""
        ...

    def end_motion(self) -> bool:
        """Brake the arm; whether that is confirmed."""
        ...

    def stop_at_once(self) -> None:
        """Stop the arm on a second way, which does not depend on the first.

        Raises:
            OSError: it is broken.
        """
        ...

    def keep_alive(self) -> bool:
        """Say that this process lives, where nothing is sent; whether it was heard."""
        ...

    def grip(self, close: bool) -> None:
        """Close or open the gripper.

        Raises:
            LimberError: it cannot.
        """
        ...

    def put_back(self) -> str | None:
        """Set what was set before :meth:`connect`; returns in words what could not be."""
        ...

    def close(self) -> None:
        """Let go of the robot."""
        ...
