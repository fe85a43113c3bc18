"""Faults of a robot in ROS while it moves, in stepped time: by goals, and by two servo streams."""

import json
import re
from typing import Any

import numpy as np

from benchmarks.robot_ros_stepped import HOME, ROS_CELL, ServoBridge, SteppedRos, line, to_and_fro
from benchmarks.robot_rosbridge import STEP, RosBridge
from benchmarks.table import Asked, Row, Setting
from limber.cell.cell_file import Cell
from limber.core.errors import LimberError
from limber.robot.driver.link import RobotLink

_MOST_M = 0.02  # of way until it stands: at 30 mm/s 0.6 s, the node beside the controller takes 0.3
SAFETY, MODE, PROGRAM, SCALING = RosBridge(HOME).status


def _told(topic: str, **message):
    return lambda robot, link: robot.server.status.update({topic: message})


def _set(**values):
    return lambda robot, link: vars(robot.server).update(values)


def _ended(status: int, **values):
    return lambda robot, link: robot.end_goal(status, **values)


def _released(steps: int):
    def fault(robot, link):
        before = dict(robot.server.status)
        robot.server.status |= {SAFETY: {"mode": 3}, SCALING: {"data": 0.0}}
        robot.rest(steps * STEP)
        robot.server.status |= before
    return fault


def states(value: float | None, prefix: str, names=ROS_CELL.arm.ros_joints) -> dict:
    """Joint states of another publisher, all joints at ``value`` [rad]."""
    return {"name": [f"{prefix}{name}_joint" for name in names],
            "position": [value] * len(names), "velocity": [value] * len(names)}


GRIPPER = [states(0.4, "", ["finger", "other_finger"])]
FAULTS = {
    "exception in the program": ("has ended", lambda robot, link: link.abandon()),
    "link closed": ("has ended", lambda robot, link: link.close()),
    "Ctrl-C": ("a stop was requested", lambda robot, link: link.stop()),
    "kill -9": ("driver has ended", lambda robot, link: link.process.kill()),
    "protective stop": ("protective stop", _told(SAFETY, mode=3)),
    "protective stop, released at once": ("protective stop", _released(1)),
    "protective stop, released later": ("protective stop", _released(200)),
    "safeguard stop": ("safeguard stop", _told(SAFETY, mode=5)),
    "its automatic mode's": ("of the automatic mode", _told(SAFETY, mode=12)),
    "emergency stop": ("emergency stop", _told(SAFETY, mode=7)),
    "reduced mode": ("reduced mode", _told(SAFETY, mode=2)),
    "arm switched off": ("robot mode 5", _told(MODE, mode=5)),
    "paused on the pendant": ("program", _told(PROGRAM, data=False)),
    "slider at 0": ("scales the speed to 0", _told(SCALING, data=0.0)),
    "slider without a number": ("scales the speed to 0", _told(SCALING, data=None)),
    "slider at a fifth": ("", _told(SCALING, data=20.0)),
    "a gripper's joint states beside": ("", _set(others=GRIPPER)),
    "a gripper's joint states alone": ("no data", _set(others=GRIPPER, has_arm=False)),
    "second arm on the topic": ("2 joints of ROS are named like", _set(
        others=[states(0.0, "second_")])),
    "joint states without numbers": ("no number", _set(others=[states(None, "")])),
    "joint states silent": ("no data from the robot", _set(silent={"/joint_states"})),
    "wrench silent": ("sensor is frozen", _set(
        silent={"/force_torque_sensor_broadcaster/wrench"})),
    "stop topic not passed on": ("passes on nothing", _set(silent={"/limber/stop"})),
    "connection to rosbridge lost": (
        "connection .* was lost", lambda robot, link: setattr(robot.bridge, "is_lost", True)),
    "goal aborted": ("path tolerance", _ended(6, error_code=-4, error_string="path tolerance")),
    "goal cancelled by another": ("no reason was given", _ended(5)),
    "goal missed": ("goal tolerance", _ended(4, error_code=-5, error_string="goal tolerance")),
    "goal called reached early": ("calls its goal reached", _ended(4, error_code=0)),
    "rosbridge without actions": ("update rosbridge_suite", lambda robot, link: robot.bridge.send(
        json.dumps({"op": "status", "level": "error", "msg": "Unknown operation"}))),
    "arm stands under its goal": ("stood still for 2|its path", _set(sticks=True)),
    "clock jumps ahead": ("clock jumped", _set(clock_ahead=7.0)),
    "clock jumps back": ("clock ran backwards", _set(clock_ahead=-1.0)),
    "stop of another node": ("[aA] stop was published", lambda robot, link: robot.server.obey(
        None, {"op": "publish", "topic": "/limber/stop", "msg": {"data": True}})),
    "twist taken in base_link's axes": ("left its path|speed", _set(
        axes=np.diag([-1.0, -1.0, 1.0]))),
    "push of 30 N": ("force", _set(wrench=np.array([0, 0, 30.0, 0, 0, 0])))}
"""Each with what the report must contain, as a regular expression; "": it is no fault, and the goal
is reached."""
_FOR_THE_NODE = ("kill -9", "connection to rosbridge lost")  # Limber can give no more orders

_OF_GOALS = ("stop topic not passed on", "goal aborted", "goal cancelled by another", "goal missed",
             "goal called reached early", "rosbridge without actions", "slider at a fifth")
_OF_TWISTS = ("twist taken in base_link's axes",)

def with_names(**names: str) -> Cell:
    """The cell with names in ROS."""
    return ROS_CELL.model_copy(update={"robot": ROS_CELL.robot.model_copy(update={"ros": names})})


CASES = [(name, output) for output in ("trajectory", "servo", "twist") for name in FAULTS
         if (output == "trajectory" or name not in _OF_GOALS)
         and (output == "twist" or name not in _OF_TWISTS)]


def provoked(name: str, output: str, onset: int = 50) -> dict[str, Any]:
    """Move the arm to and fro, provoke a fault after ``onset`` steps, and release it later. Return
    the report; whether that names it and the arm stood after a short way, ``is_good``; and whether
    the arm ``moved`` after the release."""
    told, fault = FAULTS[name]
    robot = SteppedRos((RosBridge if output == "trajectory" else ServoBridge)(HOME),
                       has_node=not told or name in _FOR_THE_NODE)
    server, well = robot.server, dict(robot.server.status)
    # Where only the node can stop the arm, Servo itself goes on without a stream.
    server.holds = 1e3 if name in _FOR_THE_NODE else 0.1
    with robot.here(), RobotLink(with_names(output=output)) as link:
        link.wait_for_samples()
        link.tare(0.25)
        link.start(to_and_fro(line(0.07, 0.03), 0.02))
        robot.rest(onset * STEP)
        began = server.joints
        fault(robot, link)
        try:
            event = link.wait("reached", "stopped", "paused", seconds=60.0)
            report = event.get("reason", "reached")
        except LimberError as error:
            report = str(error)
        robot.rest(1.0)
        stood = server.joints
        server.status |= well
        vars(server).update(others=[], has_arm=True, sticks=False, silent=set())
        robot.rest(1.0)
    way = np.diff(ROS_CELL.arm.forward(np.array([began, stood]))[:, :3, 3], axis=0)
    is_good = re.search(told or "reached", report) is not None and (
        not told or float(np.linalg.norm(way)) < _MOST_M)
    return {"report": report, "is_good": is_good,
            "moved": server.is_busy or not np.array_equal(server.joints, stood)}


ROS_FAULT_ROWS = (
    Asked(f"{len(FAULTS) - 1} faults of a robot in ROS, by goals and by two servo streams: stopped "
          "within 20 mm and named", "every one"),
    Asked("the same: motion after a fault's release", "0"))


def ros_faults(setting: Setting) -> list[Row]:
    """Provoke each fault by each output, each time somewhere else on the way."""
    def one(number: int) -> dict[str, Any]:
        case = CASES[number % len(CASES)]
        found = provoked(*case, onset=int(np.random.default_rng(number).integers(30, 200)))
        if not found["is_good"] or found["moved"]:
            print(f"{case}: {found}", flush=True)
        return found
    runs = setting.trials("ROS faults", setting.seeds(3 * len(CASES), 6), one, "robot")
    good, moved = (sum(bool(each[key]) for each in runs) for key in ("is_good", "moved"))
    return [Row(*asked, f"{seen} of {len(runs)}", False if seen != wanted else
                True if len(runs) >= len(CASES) else None, len(runs))
            for asked, seen, wanted in zip(ROS_FAULT_ROWS, (good, moved), (len(runs), 0),
                                           strict=True)]
