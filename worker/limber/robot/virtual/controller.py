"""The virtual controller: its arm, safety and program states, step by step.

It is independent of sockets: :mod:`limber.robot.virtual.server` passes on what clients send and
returns what they request. One call of :meth:`Controller.step` is one step of its control loop.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Any

import numpy as np

from limber.cell.arm import Arm
from limber.cell.known_arms import arm_named
from limber.cell.ur_arms import UrArm
from limber.core.errors import InputError
from limber.core.numerics.rigid import inverted, matrices
from limber.geometry.rigid_kernels import crossed, frame_of, weight_wrench
from limber.robot.ur.factory_calibration import FactoryCalibration, one_arm
from limber.robot.virtual.payload import (
    CB3_ESTIMATE,
    E_SERIES,
    FT300,
    ForceSensor,
    Load,
    RobotiqRegisters,
)
from limber.robot.virtual.step_kernels import servo_step, tool_state


class SafetyMode(IntEnum):
    """As in RTDE's ``safety_mode`` (Universal Robots, "RTDE guide", controller output data)."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    SAFEGUARD_STOP = 5
    ROBOT_EMERGENCY_STOP = 7


_SAFETY_BITS = dict(zip(SafetyMode, (0x1, 0x2, 0x404, 0x410, 0x4C0), strict=True))


class RuntimeState(IntEnum):
    """As in RTDE's ``runtime_state``."""

    STOPPED = 1
    PLAYING = 2
    PAUSED = 4


class RobotMode(IntEnum):
    """As in RTDE's ``robot_mode``."""

    POWER_OFF = 3
    IDLE = 5
    RUNNING = 7


@dataclass
class SensorFault:
    """Faults of the force readings, for tests: a wrench added in the flange's frame [N, N m], the
    last reading repeated, no numbers as forces, or none as joint angles."""

    added: np.ndarray = field(default_factory=lambda: np.zeros(6))
    frozen: bool = False
    nan: bool = False
    joints_nan: bool = False


JOINT_ACCELERATION = 40.0
"""Greatest acceleration of the motors [rad/s^2]."""
STOP_DECELERATION = 8.0
"""Joint deceleration of protective and emergency stops, and at a program's end [rad/s^2]."""


class Unreachable(Exception):
    """A motion impossible for the arm; the controller answers with a protective stop."""


class Braking:
    """The arm slows down to standstill on its path, every joint in the same time."""

    def __init__(self, speeds: np.ndarray, deceleration: float):
        """Brake the fastest joint with ``deceleration`` [rad/s^2]."""
        self._duration = float(np.abs(speeds).max()) / max(deceleration, 1e-3)
        self._initial, self._time = speeds.copy(), 0.0
        self.finished = self._duration <= 0.0

    def step(self, joints: np.ndarray, speeds: np.ndarray, seconds: float, scale: float,
             ) -> tuple[np.ndarray, np.ndarray]:
        first = self._time
        self._time = min(self._time + seconds, self._duration)
        self.finished = self._time >= self._duration
        # Exact path under constant deceleration between the two times.
        mean = 1.0 - 0.5 * (first + self._time) / self._duration if self._duration > 0 else 0.0
        moved = self._initial * mean * (self._time - first)
        left = 1.0 - self._time / self._duration if self._duration > 0 else 0.0
        return joints + moved, self._initial * left


class Servo:
    """Follows a target that is updated at any rate (servoj). Below 1 the speed slider scales its
    time: the arm follows at that fraction of the target's speed, falls behind, and catches up at
    1."""

    def __init__(self) -> None:
        self.finished = False
        self.target = np.zeros(6)
        self.gain, self.lookahead = 300.0, 0.1
        self._last: np.ndarray | None = None
        self._commanded, self._since, self._pace = np.zeros(6), 0.0, 0.0

    def step(self, joints: np.ndarray, speeds: np.ndarray, seconds: float, scale: float,
             ) -> tuple[np.ndarray, np.ndarray]:
        return servo_step(joints, speeds, self._goal(joints, seconds, scale), self.gain,
                          self.lookahead, seconds, JOINT_ACCELERATION)

    def _goal(self, joints: np.ndarray, seconds: float, scale: float) -> np.ndarray:
        """Joint angles to which the arm is driven now [rad], with the slider at ``scale``."""
        if self._last is None:
            self._last = self._commanded = joints.copy()
        self._since += seconds
        moved = float(np.abs(self.target - self._last).max())
        if moved > 0.0:
            # Targets may be less frequent than steps.
            self._pace, self._since = moved / self._since, 0.0
            self._last = self.target.copy()
        if scale >= 1.0:
            self._commanded = self.target.copy()
            return self._commanded
        offset = self.target - self._commanded
        farthest = float(np.abs(offset).max())
        if farthest > 0.0:
            self._commanded = self._commanded + offset * min(1.0,
                                                             scale * self._pace * seconds
                                                             / farthest)
        return self._commanded


class Led:
    """A hand leads the arm to ``joints`` [rad], in so many ``seconds``; its force is not felt."""

    def __init__(self, joints: np.ndarray, seconds: float):
        self._joints, self._left, self.finished = joints, max(seconds, 1e-3), False

    def step(self, joints: np.ndarray, speeds: np.ndarray, seconds: float, scale: float,
             ) -> tuple[np.ndarray, np.ndarray]:
        self.finished = self._left <= seconds
        moved = min(seconds / self._left, 1.0) * (self._joints - joints)
        self._left -= seconds
        return joints + moved, 0.0 * moved if self.finished else moved / seconds


Motion = Servo | Braking | Led


def nearest_joints(arm: Arm, pose: np.ndarray, tool: np.ndarray, near: np.ndarray) -> np.ndarray:
    """Return the joint angles nearest to ``near`` that bring the tool to ``pose``; Unreachable if
    none does."""
    solutions = arm.inverse(matrices(pose) @ inverted(tool), near)
    solutions = solutions[np.isfinite(solutions).all(axis=1)]
    if len(solutions) == 0:
        raise Unreachable("the inverse kinematics has no solution")
    solutions = solutions + 2 * np.pi * np.round((near - solutions) / (2 * np.pi))
    return solutions[np.abs(solutions - near).sum(axis=1).argmin()]


# The function of ur-rtde's control script on a controller, without an interpreter.
#
# ur-rtde uploads a script that waits for commands in RTDE registers. This class answers the same
# registers in the same way: ``output_int_register_0`` is 1 when ready and 2 when a command is done.
# The client writes a command's number and arguments, waits for 2 and writes 0. Numbers and
# arguments are those of ur-rtde 1.6; those that no driver of Limber sends end the program.

_READY, _DONE = 1, 2
_SERVO_JOINTS, _SERVO_STOP, _SERVO_POSE = 11, 16, 24
# Commands that the script does at once, without the handshake's second half.
_REAL_TIME = {_SERVO_JOINTS, _SERVO_POSE}


class ControlProgram:
    """The control script while it runs."""

    def __init__(self, text: str):
        self.is_control_script = "def rtde_control():" in text
        self._phase = "starting"
        self._waiting_for: Braking | None = None

    def step(self, controller: "Controller") -> None:
        """One cycle of the script's loop."""
        if not self.is_control_script:
            controller.stop_program("end of script")
            return
        command = _command(controller)
        if self._phase == "starting":
            controller.outputs_int[0] = _READY
            self._phase = "ready"
        if self._waiting_for is not None:
            if not self._waiting_for.finished:
                return
            self._waiting_for = None
            controller.outputs_int[0] = _DONE
        elif command == 0:
            controller.outputs_int[0] = _READY
            self._phase = "ready"
        elif self._phase == "ready" and command not in _REAL_TIME:
            self._phase = "executing"
            self._execute(command, controller)

    def written(self, controller: "Controller") -> None:
        """Take a real-time command as it arrives: the client clears it before the next step."""
        command = _command(controller)
        if command == _SERVO_STOP and self._phase == "ready":
            controller.say(f"stop command {command} was received")
        if command in _REAL_TIME and self._phase == "ready" and self._waiting_for is None:
            self._execute(command, controller)

    def _execute(self, command: int, controller: "Controller") -> None:
        if command == _SERVO_STOP:
            controller.say(f"stop command {command}")
        action = _ACTIONS.get(command)
        if action is None:
            # The real controller would do it; this one must not pretend that it did.
            controller.stop_program(f"the virtual controller has no command {command}")
            return
        try:
            waiting = action(controller)
        except Unreachable as reason:
            controller.protective_stop(str(reason))
            return
        if waiting is not None and not waiting.finished:
            self._waiting_for = waiting
        elif command not in _REAL_TIME:
            controller.outputs_int[0] = _DONE


def _command(controller: "Controller") -> int:
    return int(controller.inputs.get("input_int_register_0", 0))


def _argument(controller: "Controller", number: int) -> float:
    return float(controller.inputs.get(f"input_double_register_{number}", 0.0))


def _vector(controller: "Controller") -> np.ndarray:
    return np.array([_argument(controller, number) for number in range(6)])


def _servo(controller: "Controller", is_pose: bool) -> None:
    target = _vector(controller)
    if is_pose:
        target = nearest_joints(controller.arm, target, controller.tool, controller.joints)
    motion = controller.motion
    if not isinstance(motion, Servo):
        motion = controller.motion = Servo()
    motion.target = target
    motion.lookahead = float(np.clip(_argument(controller, 9), 0.03, 0.2))
    motion.gain = float(np.clip(_argument(controller, 10), 100.0, 2000.0))


def _stop(controller: "Controller") -> Braking:
    controller.motion = braking = Braking(controller.speeds, _argument(controller, 0))
    return braking


def _set_payload(controller: "Controller") -> None:
    controller.payload = _argument(controller, 0)
    controller.payload_centre = _vector(controller)[1:4]


def _set_watchdog(controller: "Controller") -> None:
    frequency = _argument(controller, 0)
    controller.watchdog = ((1.0 / frequency, controller.step_count) if frequency > 0 else None)


def _tell_tool(controller: "Controller") -> None:
    controller.outputs_double[:6] = map(float, controller.tool_offset)


_ACTIONS: dict[int, Callable[["Controller"], Braking | None]] = {
    _SERVO_JOINTS: lambda c: _servo(c, False),
    _SERVO_STOP: _stop,
    17: _set_payload,
    _SERVO_POSE: lambda c: _servo(c, True),
    29: lambda c: c.set_tool(_vector(c)),
    35: _set_watchdog,
    40: _tell_tool,
    255: lambda c: c.stop_program("client asked"),
}


_TRACKER_SIGMA_M = 1e-3
_SLOW_HZ = 125.0  # the rate of a CB3


class Controller:
    """A controller with its arm: model, initial joint angles [rad] (else its home), actual payload
    at the flange [kg], [m], the gripper's load; ``seed`` of the sensors' noise, ``off_nominal``:
    largest difference of a length of this arm from the nominal one [m]."""

    def __init__(self, model: str, *, joints: np.ndarray | None = None, mass: float = 0.0,
                 centre: tuple[float, float, float] = (0.0, 0.0, 0.0), seed: int = 0,
                 load: Load | None = None, ft300: bool = False, robotiq: bool = False,
                 off_nominal: float = 0.0):
        self.arm: Arm = arm_named(model)
        self.calibration: FactoryCalibration | None = None
        """The arm's own dimensions, if it is one of Universal Robots."""
        if isinstance(self.arm, UrArm):
            self.arm = one_arm(self.arm, off_nominal, np.random.default_rng([seed, 1]))
            self.calibration = FactoryCalibration.of(self.arm)
        self.version = (3, 15, 8, 106339) if self.arm.rate == _SLOW_HZ else (5, 11, 6, 1010327)
        self.seconds = 1.0 / self.arm.rate
        self.joints = _six(self.arm.home if joints is None else joints)
        self.speeds = np.zeros(6)
        self.tool = np.eye(4)
        self.tool_offset = np.zeros(6)
        self.mass, self.centre = mass, np.asarray(centre, float)
        self.payload, self.payload_centre = 0.0, np.zeros(3)
        self.seed = seed
        rng = np.random.default_rng(seed)
        self.sensor = ForceSensor(E_SERIES if self.arm.measures_force else CB3_ESTIMATE, rng)
        self.ft300 = ForceSensor(FT300, rng) if ft300 else None
        self.ft300_reading = np.zeros(6)
        self.tracker_off = _TRACKER_SIGMA_M * rng.standard_normal(3)
        """Offset of the simulated tracker's frame from the base's [m], shape [3]."""
        self.load = load or Load()
        self.robotiq = RobotiqRegisters(
            self._drive_gripper, lambda: self.load.report().get("branch", "")) if robotiq else None
        self.fault = SensorFault()
        self.step_count, self.clock_offset = 0, 0.0
        self.clock_stands_at: float | None = None
        self.since_step: Callable[[], float] = lambda: 0.0
        """Wall-clock seconds since the last step, if the controller is stepped by the clock."""
        self.robot_mode, self.safety_mode = RobotMode.RUNNING, SafetyMode.NORMAL
        self.remote = True
        self.slider = 1.0
        self.program: ControlProgram | None = None
        self.paused = self.shows_popup = False
        self.motion: Motion | None = None
        self.watchdog: tuple[float, int] | None = None
        self.inputs: dict[str, Any] = {}
        self.outputs_int = [0] * 48
        self.outputs_double = [0.0] * 48
        self.digital_outputs, self.gripper_output = 0, 0
        self.log: deque[str] = deque(maxlen=200)
        self._zeroes = False
        self._reading = np.zeros(6)
        self._update_tool()

    # Time

    @property
    def clock(self) -> float:
        """Seconds since the controller was started, as it reports them."""
        if self.clock_stands_at is not None:
            return self.clock_stands_at
        return self.step_count * self.seconds + self.clock_offset

    def step(self) -> None:
        """Advance by one step."""
        self.step_count += 1
        self._check_watchdog()
        if self.program is not None and not self.paused:
            self.program.step(self)
        self._move()
        self._feel()

    def _move(self) -> None:
        before = self.speeds
        if self.motion is None or self.motion.finished:
            self.speeds = np.zeros(6)
        else:
            self.joints, self.speeds = self.motion.step(
                self.joints, self.speeds, self.seconds, self.slider)
            if np.any(np.abs(self.speeds) > 1.05 * np.asarray(self.arm.joint_speed)):
                self.protective_stop("a joint exceeds its speed limit")
        self.accelerations = (self.speeds - before) / self.seconds
        limits = self.arm.joint_limits
        if np.any(self.joints < limits[:, 0]) or np.any(self.joints > limits[:, 1]):
            self.joints = np.clip(self.joints, limits[:, 0], limits[:, 1])
            self.protective_stop("joint limit")
        self._update_tool()

    def _update_tool(self) -> None:
        self.flange = self.arm.forward(self.joints)
        self.pose, self.tool_speed = tool_state(
            self.flange, self.arm.jacobian(self.joints), self.speeds, self.tool)

    def _feel(self) -> None:
        rotation = self.flange[:3, :3]
        held = self.load.wrench(self.flange, self.seconds)
        weight = weight_wrench(self.mass, self.centre, rotation)
        supposed = weight_wrench(self.payload, self.payload_centre, rotation)
        fault = self.fault
        if self._zeroes:
            self._zeroes = False
            self.sensor.zero(held + weight - supposed)
        if not fault.frozen:
            reading = self.sensor.read(held + weight - supposed, self.seconds) + fault.added
            # Reported in the base's axes, the torque about the tool's centre.
            torque = reading[3:] - crossed(self.tool[:3, 3], reading[:3])
            self._reading = np.concatenate((rotation @ reading[:3], rotation @ torque))
            if self.ft300 is not None:
                # The FT300 knows no payload.
                self.ft300_reading = self.ft300.read(held + weight, self.seconds) + fault.added
        if fault.nan:
            self._reading = np.full(6, np.nan)
            self.ft300_reading = np.full(6, np.nan)

    # Safety

    def protective_stop(self, reason: str) -> None:
        """Stop the arm and pause the program, as on a collision."""
        if self.safety_mode in (SafetyMode.NORMAL, SafetyMode.REDUCED):
            self.say(f"protective stop: {reason}")
            self.safety_mode = SafetyMode.PROTECTIVE_STOP
            self.paused = self.program is not None
            self._brake()

    def safeguard_stop(self) -> None:
        """Open the safeguard input, as a light curtain does: the arm stops, and the program is
        paused until it is played (user manual, "Safety functions": category 2 stop)."""
        if self.can_move:
            self.say("safeguard stop")
            self.safety_mode = SafetyMode.SAFEGUARD_STOP
            self.paused = self.program is not None
            self._brake()

    def reduce(self) -> None:
        """Switch to reduced mode, as its input or a safety plane does: programs go on within other,
        lower limits (user manual, "Safety modes")."""
        if self.safety_mode == SafetyMode.NORMAL:
            self.say("reduced mode")
            self.safety_mode = SafetyMode.REDUCED

    def power_off(self) -> None:
        """Switch the arm off: the brakes engage."""
        self.stop_program("power off")
        self.robot_mode = RobotMode.POWER_OFF

    def hold_clock(self, stands: bool) -> None:
        """Let the reported clock stand still, or go on."""
        self.clock_stands_at = None
        self.clock_stands_at = self.clock if stands else None

    def emergency_stop(self) -> None:
        """Press the button: the arm stops, the program ends, power is switched off."""
        self.say("emergency stop")
        self.safety_mode = SafetyMode.ROBOT_EMERGENCY_STOP
        self.stop_program("emergency stop")
        self._brake()
        self.robot_mode = RobotMode.POWER_OFF

    def unlock(self) -> bool:
        """Release a protective stop; the program stays paused until it is played."""
        if self.safety_mode != SafetyMode.PROTECTIVE_STOP or np.any(self.speeds):
            return False
        self.safety_mode = SafetyMode.NORMAL
        self.motion = None
        return True

    def reset_emergency(self) -> None:
        """Turn the button back and switch the arm on again."""
        self.safety_mode, self.robot_mode, self.motion = SafetyMode.NORMAL, RobotMode.RUNNING, None

    def stand(self, joints: Sequence[float] | None = None) -> None:
        """Set the joints [rad] at once, without a path, by default to the arm's home."""
        target = _six(self.arm.home if joints is None else joints)
        self.stop_program("set to a pose")
        self.load.release()
        self.joints, self.speeds, self.motion = target, np.zeros(6), None
        self._update_tool()

    def set_remote(self, remote: bool) -> None:
        """Switch between remote and local control; a running program ends in local control."""
        self.remote = remote
        if not remote:
            self.stop_program("local control")

    def _brake(self) -> None:
        self.motion = Braking(self.speeds, STOP_DECELERATION)

    # Programs

    @property
    def runtime_state(self) -> RuntimeState:
        if self.program is None:
            return RuntimeState.STOPPED
        return RuntimeState.PAUSED if self.paused else RuntimeState.PLAYING

    @property
    def can_move(self) -> bool:
        """Whether programs may run at all."""
        return (self.safety_mode in (SafetyMode.NORMAL, SafetyMode.REDUCED)
                and self.robot_mode == RobotMode.RUNNING)

    def load_script(self, text: str) -> None:
        """Run an uploaded script, ending the running one; refused in local control. An e-Series
        then zeroes its own sensor, whatever it carries ("it is zeroed every time you start a
        program": Universal_Robots_ROS_Driver, issue 512, by the maker)."""
        if not self.remote:
            self.say("script refused: not in remote control")
            return
        if not self.can_move:
            self.say("script refused: the robot is stopped")
            return
        self.stop_program("another script")
        self.watchdog = None
        self.outputs_int = [0] * 48
        self.program, self.paused = ControlProgram(text), False
        self._zeroes = self.arm.measures_force

    def stop_program(self, reason: str) -> None:
        """End the program and brake the arm."""
        if self.program is not None:
            self.say(f"program stopped: {reason}")
            self.program = None
            self.paused = False
            self.watchdog = None
            self._brake()

    def pause_program(self) -> None:
        """Hold the program and brake the arm; playing it continues with the next command."""
        self.paused = True
        self._brake()

    def popup(self, text: str) -> None:
        """Show a blocking popup on the pendant: the program "does not continue (behind the popup)"
        (Universal_Robots_ExternalControl_URCap, pull request 3) until it is closed."""
        self.say(f"popup: {text}")
        self.shows_popup = True
        if self.program is not None and not self.paused:
            self.pause_program()

    def close_popup(self) -> None:
        """Close it, at the pendant or by the dashboard's ``close popup``: the program goes on,
        unless a safety function has stopped it since."""
        if self.shows_popup:
            self.shows_popup, self.paused = False, not self.can_move

    def freedrive(self, joints: Sequence[float], seconds: float = 2.0) -> None:
        """Hold the button on the pendant and lead the arm by hand to ``joints`` [rad], if nothing
        else may move it: in this mode it follows no trajectory (URScript, ``freedrive_mode``), and
        in an e-Series' remote control the pendant starts no motion, "including freedrive"
        (Universal_Robots_ROS2_Driver, "Operation modes")."""
        if not self.can_move or self.program is not None or (
                self.remote and self.arm.measures_force):
            self.say("freedrive refused: remote control, a program runs or the arm is stopped")
            return
        self.motion = Led(_six(joints), seconds)

    def set_tool(self, offset: np.ndarray) -> None:
        """Set the tool's pose in the flange's frame [m, rad]."""
        self.tool_offset, self.tool = np.asarray(offset, float), frame_of(np.asarray(offset, float))
        self._update_tool()

    def say(self, text: str) -> None:
        """Write to the controller's log."""
        self.log.append(f"{self.clock + self.since_step():.4f} {text}")

    # Written by clients

    def write_inputs(self, values: dict[str, Any]) -> None:
        """Accept values that a client sent."""
        self.inputs.update(values)
        if "input_int_register_0" in values and self.watchdog:
            self.watchdog = (self.watchdog[0], self.step_count)
        if self.program is not None and not self.paused and self.program.is_control_script:
            self.program.written(self)
        if values.get("speed_slider_mask"):
            self.slider = float(np.clip(values.get("speed_slider_fraction", self.slider), 0.0, 1.0))
        self._write_digital(values, "standard_digital_output", 0)
        self._write_digital(values, "configurable_digital_output", 8)
        self._write_digital(values, "tool_digital_output", 16)

    def _write_digital(self, values: dict[str, Any], name: str, first: int) -> None:
        mask = int(values.get(f"{name}_mask", 0)) << first
        bits = int(values.get(name, 0)) << first
        before, self.digital_outputs = (
            self.digital_outputs, self.digital_outputs & ~mask | bits & mask)
        changed = before ^ self.digital_outputs
        if changed >> self.gripper_output & 1:
            self._drive_gripper(bool(self.digital_outputs >> self.gripper_output & 1))

    def _drive_gripper(self, close: bool) -> None:
        if close:
            self.load.grasp()
        else:
            self.load.release()

    def _check_watchdog(self) -> None:
        """End a program whose client no longer writes: after the requested time, at least a step.
        """
        if self.watchdog is None or self.paused:
            return
        longest, last = self.watchdog
        if (self.step_count - last) * self.seconds > max(longest, self.seconds):
            self.stop_program(f"watchdog: no input for {1000 * longest:.0f} ms")

    # Read by clients

    def outputs(self) -> dict[str, Any]:
        """Return every RTDE output by name."""
        moving = self.motion is not None and not self.motion.finished
        scaling = self.slider if moving else 1.0
        values: dict[str, Any] = dict(_STEADY)
        values.update(
            timestamp=self.clock, target_q=self.joints,
            actual_q=np.full(6, np.nan) if self.fault.joints_nan else self.joints,
            target_qd=self.speeds, actual_qd=self.speeds, target_qdd=self.accelerations,
            actual_TCP_pose=self.pose, target_TCP_pose=self.pose,
            actual_TCP_speed=self.tool_speed, target_TCP_speed=self.tool_speed,
            actual_TCP_force=self._reading, ft_raw_wrench=self._reading,
            tcp_force_scalar=float(np.linalg.norm(self._reading[:3])),
            speed_scaling=scaling, target_speed_fraction=self.slider,
            robot_mode=int(self.robot_mode), safety_mode=int(self.safety_mode),
            safety_status=int(self.safety_mode), runtime_state=int(self.runtime_state),
            robot_status_bits=int(self.robot_mode == RobotMode.RUNNING)
            | (self.runtime_state == RuntimeState.PLAYING) << 1,
            safety_status_bits=_SAFETY_BITS[self.safety_mode],
            actual_digital_output_bits=self.digital_outputs,
            payload=self.payload, payload_cog=self.payload_centre, tcp_offset=self.tool_offset)
        values.update(zip(_INT_NAMES, self.outputs_int, strict=True))
        values.update(zip(_DOUBLE_NAMES, self.outputs_double, strict=True))
        return values

    accelerations = np.zeros(6)


def _six(joints: Sequence[float] | np.ndarray) -> np.ndarray:
    """Return joint angles as an array; InputError if they are not the six finite numbers of an arm
    that RTDE supports."""
    angles = np.array(joints, float)
    if angles.shape != (6,) or not np.isfinite(angles).all():
        raise InputError(f"The joint angles are {joints}.", "Six finite numbers [rad] are needed, "
                         "because the virtual controller imitates that of a six-joint arm of "
                         "Universal Robots.", "Give one angle per joint.")
    return angles


def _steady() -> dict[str, Any]:
    """Outputs that this controller does not model: plausible constants."""
    from limber.robot.ur.rtde import OUTPUT_TYPES

    fill = {"VECTOR6D": (0.0,) * 6, "VECTOR3D": (0.0,) * 3, "VECTOR6INT32": (253,) * 6,
            "DOUBLE": 0.0, "BOOL": False}
    values = {name: fill.get(kind, 0) for name, kind in OUTPUT_TYPES.items()}
    return values | {"actual_main_voltage": 48.0, "actual_robot_voltage": 48.0,
                     "joint_temperatures": (25.0,) * 6, "actual_joint_voltage": (48.0,) * 6}


_STEADY = _steady()
_INT_NAMES = [f"output_int_register_{k}" for k in range(48)]
_DOUBLE_NAMES = [f"output_double_register_{k}" for k in range(48)]
