"""What happens before a robot moves: it is looked at, refused or connected with."""

from typing import Any

from limber.core.errors import InputError, SafetyStop, WorkError
from limber.robot.cell.cell import Cell
from limber.robot.driver.real_time import claim_real_time
from limber.robot.ur.samples import Dashboard, SampleStream

WATCHDOG_HZ = 10.0
"""The controller ends the program when it hears nothing for a tenth of a second."""


def checked(cell: Cell, stream: SampleStream, dashboard: Dashboard) -> dict[str, Any]:
    """Refuse a robot that is not what the cell says or cannot be moved; returns its facts.

    Raises:
        InputError: it is another robot. SafetyStop: nobody may move it now. WorkError: no data.
    """
    version = ".".join(map(str, stream.version[:3]))
    series = "cb3" if stream.version[0] == 3 else "e"
    arm = cell.arm
    if series != arm.series:
        raise InputError(f"The controller has version {version}, but the cell states {arm.name}.",
                         "They belong to different series of arms.",
                         "Correct robot.model in the cell file.")
    calibrated = cell.robot.version
    if calibrated and calibrated.split(".")[:2] != version.split(".")[:2]:
        raise InputError(f"The controller has version {version}, but the cell was calibrated with "
                         f"{calibrated}.", "Another version may have other settings of tool, "
                         "kinematics and safety.", "Calibrate again, or compare the settings and "
                         "correct robot.version in the cell file.")
    facts = {"address": cell.robot.address, "version": version,
             "model": dashboard.ask("get robot model"),
             "serial": dashboard.ask("get serial number"),
             "remote": dashboard.ask("is in remote control"),
             "rate_hz": stream.rate, "real_time": claim_real_time()}
    known = facts["model"].lower()
    if known.startswith("ur") and known != arm.name.rstrip("e"):
        raise InputError(f"The robot reports the model {facts['model']}, but the cell states "
                         f"{arm.name}.",
                         "Reach and limits would be those of another arm.",
                         "Correct robot.model in the cell file.")
    if facts["remote"] == "false":
        raise SafetyStop("The robot is not in remote control.",
                         "It would not accept a program.",
                         "Switch it to remote control on the pendant.")
    samples = stream.read(1.0)
    if not samples:
        raise WorkError("The robot sends no data.", "", "Restart its controller.")
    sample = samples[-1]
    if sample.safety_mode != 1 or sample.robot_mode != 7:
        raise SafetyStop(f"The robot is not ready: safety mode {sample.safety_mode}, robot "
                         f"mode {sample.robot_mode}.", "Limber does not release stops or switch "
                         "an arm on.", "Check the robot, then do it on the pendant.")
    if sample.slider <= 0.0:
        raise SafetyStop("The speed slider is at 0.", "The robot would not move.",
                         "Raise it on the pendant.")
    facts |= {"pose": sample.pose.tolist(), "joints": sample.joints.tolist(),
              "slider": sample.slider}
    return facts


def connect(cell: Cell, rate: float) -> tuple[Any, Any]:
    """Return ur-rtde's control interface, its watchdog running, and its outputs where needed.

    Raises:
        WorkError: the robot does not take its settings. RuntimeError: ur-rtde's own.
    """
    from rtde_control import RTDEControlInterface

    address = cell.robot.address
    control = RTDEControlInterface(address, rate)
    outputs = None
    if cell.tool.gripper == "digital_output":
        from rtde_io import RTDEIOInterface

        # Made now: later the watchdog would not wait for it.
        outputs = RTDEIOInterface(address)
    require(control.setTcp(list(cell.tool.grasp_pose)), "set its tool")
    require(control.setPayload(cell.tool.mass_kg or 0.0, list(cell.tool.centre_of_mass_m)),
            "set its payload")
    require(control.setWatchdog(WATCHDOG_HZ), "start its watchdog")
    return control, outputs


def require(done: bool, what: str) -> None:
    """Raise a WorkError where an order of ur-rtde returned no success."""
    if not done:
        raise WorkError(f"The robot did not {what}.", "It returned no success.",
                        "See the controller's log, and restart the program.")
