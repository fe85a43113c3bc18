"""A controller of Universal Robots for the driver's loop: RTDE, ur-rtde, dashboard."""

from importlib import import_module
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.errors import InputError, SafetyStop, WorkError
from limber.robot.interface import Sample
from limber.robot.ur.grippers import RobotiqGripper
from limber.robot.ur.rtde import Dashboard, SampleStream

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell

_WATCHDOG_HZ = 10.0
_GAIN = 900.0
_STOP_DECELERATION = 8.0  # rad/s^2 of the joints


class UrControl(SampleStream):
    """One controller, as a :class:`limber.robot.interface.ArmControl`: its samples, the program
    that moves its arm, and its dashboard. InputError if it is another robot, SafetyStop if it must
    not be moved now, WorkError without data."""

    lookahead = 0.06
    silence = 1.0 / _WATCHDOG_HZ

    def __init__(self, cell: "Cell"):
        super().__init__(cell.robot.address)
        self._cell = cell
        self._dashboard = Dashboard(cell.robot.address)
        self._control: Any = None
        self._outputs: Any = None
        self._gripper: RobotiqGripper | None = None
        self.facts = self._identified()
        self._first = _first_sample(self)
        self.facts |= {"pose": self._first.pose.tolist(), "joints": self._first.joints.tolist(),
                       "slider": self._first.slider}
        self._before: dict[str, Any] = {}
        # Loaded now, to be kept in memory with the rest.
        import_module("rtde_control")

    def _identified(self) -> dict[str, Any]:
        """The controller's description, after a check against the cell."""
        version = ".".join(map(str, self.version[:3]))
        arm, calibrated = self._cell.arm, self._cell.robot.version
        if self.rate != arm.rate:
            raise InputError(f"The controller has version {version}, but the cell states "
                             f"{arm.name}.", "They belong to different series of arms.", "Correct "
                             "robot.model in the cell file.")
        if calibrated and calibrated.split(".")[:2] != version.split(".")[:2]:
            raise InputError(f"The controller has version {version}, but the cell was calibrated "
                             f"with {calibrated}.", "Settings of tool, kinematics and safety may "
                             "differ between versions.", "Calibrate again, or compare the settings "
                             "and correct robot.version in the cell file.")
        ask = self._dashboard.ask
        model = ask("get robot model")
        facts = {"address": self.address, "version": version, "model": model,
                 "serial": ask("get serial number"),
                 # None if it does not know the question, as a CB3.
                 "remote": {"true": True, "false": False}.get(ask("is in remote control")),
                 "rate_hz": self.rate}
        known = model.lower()
        if known.startswith("ur") and known != arm.name.rstrip("e"):
            raise InputError(f"The robot reports that it is a {model}, but the cell file states "
                             f"{arm.name}.", "Reach and limits would be those of another arm.",
                             "Correct robot.model in the cell file.")
        if facts["remote"] is False:
            raise SafetyStop("The robot is not in remote control.", "It would not accept a "
                             "program.", "Switch it to remote control on the pendant.")
        return facts

    def connect(self) -> None:
        """Connect with ur-rtde, set tool, payload and watchdog. SafetyStop if another program runs,
        WorkError if the robot rejects its settings, RuntimeError of ur-rtde."""
        from rtde_control import RTDEControlInterface

        if self._first.program_runs:
            raise SafetyStop("A program is running on the controller "
                             f"({self._dashboard.ask('programState')}).", "Limber's own program "
                             "would end it, wherever it is.", "Stop it on the pendant.")
        tool = self._cell.tool
        self._control = RTDEControlInterface(self.address, self.rate)
        self._before["tool"] = self._control.getTCPOffset()
        if self._first.payload is not None and self._first.payload_centre is not None:
            self._before["payload"] = (self._first.payload, self._first.payload_centre.tolist())
        if tool.gripper == "robotiq":
            # It answers within the time that the watchdog waits, or the motion ends.
            self._gripper = RobotiqGripper(self.address, 0.5 / _WATCHDOG_HZ)
        if tool.gripper == "digital_output":
            from rtde_io import RTDEIOInterface

            # Made now: later the watchdog would not wait for it.
            self._outputs = RTDEIOInterface(self.address)
        _require(self._control.setTcp(list(tool.grasp_pose)), "set its tool")
        _require(self._control.setPayload(tool.mass_kg or 0.0, list(tool.centre_of_mass_m)),
                 "set its payload")
        self.watch()

    def watch(self) -> None:
        """Let the controller end its program when it receives nothing for :attr:`silence`."""
        _require(self._control.setWatchdog(_WATCHDOG_HZ), "start its watchdog")

    def program_runs(self) -> bool:
        """Whether a program runs that accepts targets."""
        return self._control.isProgramRunning()

    def start_program(self) -> bool:
        """Upload the control program once more; ur-rtde does not wait until it runs."""
        return self._control.reuploadScript()

    def servo(self, pose: np.ndarray) -> bool:
        """Send the next target of the tool's centre [m, rad], shape [6]."""
        return self._control.servoL(list(pose), 0.1, 0.1, 1.0 / self.rate, self.lookahead, _GAIN)

    def servo_joints(self, joints: np.ndarray) -> bool:
        """Send the next joint angles [rad], shape [6]."""
        return self._control.servoJ(list(joints), 0.1, 0.1, 1.0 / self.rate, self.lookahead, _GAIN)

    def end_motion(self) -> bool:
        """Brake the arm: the control program's own stop."""
        return bool(self._control.servoStop(_STOP_DECELERATION))

    def stop_at_once(self) -> None:
        """Stop by the dashboard: it depends on no step of the controller, nor on the program."""
        self._dashboard.stop()

    def keep_alive(self) -> bool:
        """Signal to the controller that this process is alive."""
        return self._control.kickWatchdog()

    def grip(self, close: bool) -> None:
        """Close or open the gripper; InputError if it is not driven from here, WorkError if the
        robot does not do it."""
        tool = self._cell.tool
        if self._gripper is not None:
            self._gripper.drive(close, tool.grip_force)
            return
        if self._outputs is None:
            raise InputError("Limber does not drive the cell's gripper.",
                             f"tool.gripper is {tool.gripper}.", "Close and open it by hand.")
        _require(self._outputs.setStandardDigitalOut(tool.close_output, close), "drive its gripper")

    def put_back(self) -> str | None:
        """Restore tool and payload; returns in words what failed."""
        if not self._before:
            return None
        before, self._before = self._before, {}
        try:
            # A stopped program accepts nothing, and is not started for this alone.
            done = (self._control.isProgramRunning() and "payload" in before
                    and self._control.setTcp(before["tool"])
                    and self._control.setPayload(*before["payload"]))
        except RuntimeError:
            done = False
        return None if done else ("The controller keeps the tool centre point and payload of the "
                                  "cell file: its program had ended before they could be put back. "
                                  "Set them on the pendant if another program needs others.")

    def close(self) -> None:
        """Release the robot."""
        for interface in (self._outputs, self._control):
            if interface is not None:
                interface.disconnect()
        if self._gripper is not None:
            self._gripper.close()
        super().close()
        self._dashboard.close()


def _first_sample(stream: SampleStream) -> Sample:
    """The first sample, if the arm may be moved."""
    samples: list[Sample] = stream.read(1.0)
    if not samples:
        raise WorkError("The robot sends no data.", "", "Restart its controller.")
    sample = samples[-1]
    if sample.safety_mode != 1 or sample.robot_mode != 7:
        raise SafetyStop(f"The robot is not ready: safety mode {sample.safety_mode}, robot mode "
                         f"{sample.robot_mode}.", "Limber neither releases stops nor switches an "
                         "arm on.", "Check the robot, then release or switch it on at the pendant.")
    return sample


def _require(done: bool, what: str) -> None:
    """Raise a WorkError if an order of ur-rtde returned no success."""
    if not done:
        raise WorkError(f"The robot did not {what}.", "It returned no success.",
                        "See the controller's log, and restart the program.")
