"""Interface of an arm and its controller to the rest of Limber.

Cell, motion, guard, virtual controller, planning and scenes use a robot only through these. An arm
that meets :class:`Arm` can be planned with and checked once it has a name
(:func:`limber.cell.known_arms.register_arm`). It can be moved if a driver of its controller exists
too (:class:`ArmControl`, :func:`limber.robot.driver.controls.register_control`).

Frames are those of the controller: its base frame and the flange. Joints are revolute; angles are
in radians. ``n`` is the number of joints.
"""

import socket
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError

if TYPE_CHECKING:
    from limber.robot.motion.trajectory import Trajectory

PLAYING = 2
"""A running program, as RTDE reports it."""


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


@dataclass(frozen=True)
class Reading:
    """Wrench of the surroundings on the tool, flange axes, about the flange [N, N m], shape [6];
    its age [s], and the numbers as the sensor sent them."""

    wrench: np.ndarray
    age: float
    raw: np.ndarray


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


@runtime_checkable
class TrajectoryControl(ArmControl, Protocol):
    """A controller that follows whole trajectories by itself; the loop judges where the arm is."""

    def follow(self, trajectory: "Trajectory", since: float = 0.0) -> None:
        """Follow a trajectory from its time ``since`` [s] on, until :meth:`end_motion`.

        Raises:
            SafetyStop: the arm moves already.
        """
        ...

    def progress(self, sample: Sample) -> tuple[float, str | None]:
        """Return the time along the trajectory where the arm is [s], and how it ended: "" at its
        end, else why; None while it is followed."""
        ...


def require_sensor(cell: Cell) -> None:
    """Refuse a cell without a force sensor that the guard can rely on: InputError if it names none,
    or a CB3's own estimate."""
    if cell.sensor.kind == "none":
        raise InputError("The cell file names no force sensor.", "The guard does not move a branch "
                         "that it cannot feel.", "Set sensor.kind to ft300 or controller.")
    if cell.sensor.kind == "controller" and not cell.arm.measures_force:
        raise InputError(f"The cell uses the force of the {cell.arm.name}'s own controller.",
                         "A CB3 estimates it from motor currents, with drifting errors of several "
                         "newtons.",
                         "Mount a force-torque sensor and set sensor.kind to ft300.")
