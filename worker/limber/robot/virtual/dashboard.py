"""The dashboard server's answers: a text protocol, one line per command."""

from limber.robot.virtual.controller import Controller
from limber.robot.virtual.controller_modes import RobotMode, RuntimeState, SafetyMode

GREETING = "Connected: Universal Robots Dashboard Server"

_MODES = {RobotMode.POWER_OFF: "POWER_OFF", RobotMode.IDLE: "IDLE", RobotMode.RUNNING: "RUNNING"}
_STATES = {RuntimeState.STOPPED: "STOPPED", RuntimeState.PLAYING: "PLAYING",
           RuntimeState.PAUSED: "PAUSED"}
# Commands that change something are refused in local control, as on the e-Series.
_CHANGES = ("play", "stop", "pause", "load", "power on", "power off", "brake release",
            "unlock protective stop", "restart safety", "shutdown", "close safety popup")
_CB3 = 3
_REFUSED = "Command is not allowed due to safety reasons"


def answer(controller: Controller, line: str) -> str:
    """Return the reply to one command line."""
    command = line.strip().lower()
    if not controller.remote and command.startswith(_CHANGES):
        return _REFUSED
    reply = _QUESTIONS.get(command) or _ACTIONS.get(command)
    if reply is not None:
        return reply(controller)
    if command.startswith("load "):
        return f"Loading program: {line.strip()[5:]}"
    if command.startswith(("popup", "addtolog")):
        controller.say(line.strip())
        return "showing popup" if command.startswith("popup") else "Added log message"
    return f"could not understand: '{line.strip()}'"


def _stop(controller: Controller) -> str:
    if controller.program is None:
        return "Failed to execute: stop"
    controller.stop_program("dashboard")
    return "Stopped"


def _pause(controller: Controller) -> str:
    if controller.program is None or controller.paused:
        return "Failed to execute: pause"
    controller.pause_program()
    return "Pausing program"


def _play(controller: Controller) -> str:
    if controller.program is None or not controller.can_move:
        return "Failed to execute: play"
    controller.paused = False
    return "Starting program"


def _power(mode: RobotMode, reply: str):
    def change(controller: Controller) -> str:
        if controller.safety_mode == SafetyMode.ROBOT_EMERGENCY_STOP:
            return _REFUSED
        if mode == RobotMode.POWER_OFF:
            controller.stop_program("power off")
        controller.robot_mode = mode
        return reply
    return change


def _unlock(controller: Controller) -> str:
    if controller.safety_mode != SafetyMode.PROTECTIVE_STOP:
        return "Protective stop releasing"
    if controller.unlock():
        return "Protective stop releasing"
    return "Cannot unlock protective stop until 5s after occurrence"


def _remote(controller: Controller) -> str:
    """A CB3 knows no remote control (Universal Robots, "Dashboard server": e-Series, 5.6)."""
    if controller.version[0] <= _CB3:
        return "could not understand: 'is in remote control'"
    return "true" if controller.remote else "false"


_QUESTIONS = {
    "polyscopeversion": lambda c: f"URSoftware {'.'.join(map(str, c.version))} (Jan 01 2022)",
    "version": lambda c: ".".join(map(str, c.version)),
    "get serial number": lambda c: "20220000001",
    "get robot model": lambda c: c.arm.name.upper().rstrip("E"),
    "is in remote control": _remote,
    "get operational mode": lambda c: "NONE",
    "robotmode": lambda c: f"Robotmode: {_MODES[c.robot_mode]}",
    "safetymode": lambda c: f"Safetymode: {c.safety_mode.name}",
    "safetystatus": lambda c: f"Safetystatus: {c.safety_mode.name}",
    "running": lambda c: f"Program running: {str(c.runtime_state == RuntimeState.PLAYING).lower()}",
    "programstate": lambda c: f"{_STATES[c.runtime_state]} rtde_control",
    "get loaded program": lambda c: "No program loaded",
    "isprogramsaved": lambda c: "true rtde_control",
}
_ACTIONS = {
    "stop": _stop, "pause": _pause, "play": _play,
    "power on": _power(RobotMode.IDLE, "Powering on"),
    "power off": _power(RobotMode.POWER_OFF, "Powering off"),
    "brake release": _power(RobotMode.RUNNING, "Brake releasing"),
    "unlock protective stop": _unlock,
    "close popup": lambda c: "closing popup",
    "close safety popup": lambda c: "closing safety popup",
    "restart safety": lambda c: c.reset_emergency() or "Restarting safety",
}
