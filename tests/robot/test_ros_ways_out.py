"""Whatever ends a goal in ROS cancels it and publishes a stop; no clock runs in most of these."""

import json
import re

import numpy as np
import pytest
from tests.robot.stepped_ros import SteppedRos
from tests.robot.test_ros import CELL, HOME, line
from tests.subjects.commands import answer

from benchmarks.robot_rosbridge import STEP, RosBridge
from limber.cell.cell_file import Cell, write_cell
from limber.core.errors import InputError, LimberError, SafetyStop, WorkError
from limber.robot.driver.controls import control_of
from limber.robot.driver.link import RobotLink
from limber.robot.motion.trajectory import ExpectedWrench, Trajectory
from limber.robot.ros.topics import Topics, wrench_topic

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


def _states(value: float | None, prefix: str, names=CELL.arm.ros_joints) -> dict:
    return {"name": [f"{prefix}{name}_joint" for name in names],
            "position": [value] * len(names), "velocity": [value] * len(names)}


GRIPPER = [_states(0.4, "", ["finger", "other_finger"])]
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
        others=[_states(0.0, "second_")])),
    "joint states without numbers": ("no number", _set(others=[_states(None, "")])),
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
    "push of 30 N": ("force", _set(wrench=np.array([0, 0, 30.0, 0, 0, 0])))}
"""Each with what the report must contain, as a regular expression; "": it is no fault, and the goal
is reached."""
_FOR_THE_NODE = ("kill -9", "connection to rosbridge lost")  # Limber can give no more orders

_OF_GOALS = ("stop topic not passed on", "goal aborted", "goal cancelled by another", "goal missed",
             "goal called reached early", "rosbridge without actions", "slider at a fifth")


def with_names(**names: str) -> Cell:
    return CELL.model_copy(update={"robot": CELL.robot.model_copy(update={"ros": names})})


def there_and_back(out: Trajectory, rest: float) -> Trajectory:
    poses, joints = np.r_[out.poses, out.poses[::-1]], np.r_[out.joints, out.joints[::-1]]
    return Trajectory(np.r_[out.times, out.duration + rest + out.times], poses,
                      ExpectedWrench.nothing(poses), joints)


class ServoBridge(RosBridge):
    """MoveIt Servo's end: it moves the joints by the last speeds that came, for 0.1 s."""

    until = 0

    def _hear(self, socket, order):
        super()._hear(socket, order)
        if order["op"] == "publish" and order["topic"] == Topics().jog:
            speeds = dict(zip(order["msg"]["joint_names"], order["msg"]["velocities"], strict=True))
            self.drift = np.array([speeds[f"{name}_joint"] for name in CELL.arm.ros_joints])
            self.until = 0.1 / STEP

    def _step(self, socket):
        self.until -= 1
        self.drift = self.drift * (self.until > 0 and not self.sticks)
        super()._step(socket)


@pytest.mark.parametrize("name, kind, output", [
    *((name, RosBridge, "trajectory") for name in FAULTS),
    *((name, ServoBridge, "servo") for name in FAULTS if name not in _OF_GOALS)])
def test_a_fault_is_stopped_and_named_and_nothing_moves_after_its_release(name, kind, output):
    told, fault = FAULTS[name]
    robot = SteppedRos(kind(HOME), has_node=not told or name in _FOR_THE_NODE)
    server, well = robot.server, dict(robot.server.status)
    with robot.here(), RobotLink(with_names(output=output)) as link:
        link.wait_for_samples()
        link.tare(0.25)
        link.start(there_and_back(line(0.07, 0.03), 0.02))
        robot.rest(50 * STEP)
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
    assert re.search(told or "reached", report) is not None, report
    assert not server.is_busy and np.array_equal(server.joints, stood)
    way = CELL.arm.forward(np.array([began, stood]))[:, :3, 3]
    assert not told or np.linalg.norm(way[1] - way[0]) < _MOST_M


def said(robot: SteppedRos) -> list[str]:
    """What Limber said, in its order, without repetitions."""
    words = {"send_action_goal": "goal", "cancel_action_goal": "cancel"}
    signs = {"/limber/stop": {False: "beat", True: "stop"}, "/limber/end": {None: "end"}}
    told = [words.get(order["op"]) or signs[order["topic"]][order["msg"].get("data")] for _, order
            in robot.server.heard if order["op"] not in ("advertise", "call_service")]
    return list(dict.fromkeys(told))


def test_a_cancel_is_said_again_until_the_goal_has_ended(stepped_ros):
    """rosbridge drops that of a goal which the controller has not accepted yet."""
    robot, link = stepped_ros(lambda robot, now: now == 2 and link.stop(), accepts_after=20)
    assert link.follow(line(0.1))["event"] == "stopped"
    robot.rest(0.5)
    assert said(robot)[:3] == ["beat", "goal", "stop"] and not robot.server.is_busy
    assert sum(order["op"] == "cancel_action_goal" for _, order in robot.server.heard) > 1


def test_a_pause_cancels_and_a_person_lets_the_rest_be_followed(stepped_ros):
    """The soft limit; the rest begins where the arm stands, and ends at the path's end."""
    path = line(0.05)
    unpredicted = Trajectory(path.times, path.poses, None, path.joints)
    robot, link = stepped_ros(lambda robot, step: step == 60 and setattr(
        robot.server, "wrench", np.array([12.0, 0, 0, 0, 0, 0])))
    assert link.follow(unpredicted)["event"] == "paused"
    robot.plan, robot.server.wrench[0] = None, 9.5
    robot.rest(0.5)
    assert not robot.server.is_busy and np.abs(robot.server.joints - path.joints[-1]).max() > 0.01
    assert link.resume()["event"] == "reached"
    assert robot.server.joints == pytest.approx(path.joints[-1], abs=1e-4)


def test_a_robot_in_a_protective_stop_is_sent_no_goal(stepped_ros):
    robot, link = stepped_ros()
    robot.server.status |= {SCALING: {"data": 0.0}, SAFETY: {"mode": 3}, PROGRAM: {"data": False}}
    robot.rest(2 * STEP)
    with pytest.raises(SafetyStop, match="cannot be moved: protective stop"):
        link.follow(line(0.02))
    assert said(robot) == []


def test_a_goal_that_is_never_accepted_is_stopped(stepped_ros):
    robot, link = stepped_ros(accepts_after=10**6)
    event = link.follow(line(0.02))
    robot.rest(2.5)
    link.close()
    assert "stood still" in event["reason"] and robot.server.followed == []
    assert "did not confirm" in link.warnings[-1]


@pytest.mark.parametrize("scaling", [100.0, 50.0])
def test_a_rest_of_the_path_and_a_slow_controller_are_no_standstill(stepped_ros, scaling):
    robot, link = stepped_ros()
    robot.server.status[SCALING] = {"data": scaling}
    event = link.follow(there_and_back(line(0.001, 0.02), 3.0))
    assert event["event"] == "reached", event


@pytest.mark.parametrize("settings, told", [
    ({"others": GRIPPER, "has_arm": False}, "It has the joints finger_joint, other_finger_joint, "),
    ({"silent": {Topics().wrench}}, f"Too little came on {Topics().wrench}"),
    *(({"silent": {topic}}, f"Nothing came on {topic} within 2 s.*launch.py ur_type:=ur5e")
      for topic in (SAFETY, MODE, PROGRAM, SCALING))])
def test_a_robot_that_says_too_little_is_not_moved(stepped_ros, settings, told):
    with pytest.raises(WorkError, match=told):
        stepped_ros(**settings)


def test_a_leg_to_its_end_gives_the_node_an_end_word_and_no_stop(stepped_ros):
    robot, link = stepped_ros()
    assert link.follow(line(0.02))["event"] == "reached"
    assert said(robot) == ["beat", "goal", "end"] and link.warnings == []


def test_the_noise_of_joint_speeds_is_no_motion(stepped_ros):
    robot, link = stepped_ros(speed_noise=2e-3)
    assert link.follow(line(0.02))["event"] == "reached"
    robot.rest(0.5)
    assert link.retreat()["event"] == "reached"


def test_a_name_space_and_a_prefix_choose_one_of_two_arms(stepped_ros):
    """Both publish on one topic; the goal is of this one's joints."""
    two = with_names(namespace="cell", prefix="left_", joint_states="/joint_states")
    robot, link = stepped_ros(cell=two, prefix="left_", space="/cell",
                              others=[_states(0.0, "right_")])
    assert link.follow(line(0.02))["event"] == "reached"
    [goal] = [order for _, order in robot.server.heard if order["op"] == "send_action_goal"]
    assert goal["action"] == "/cell/scaled_joint_trajectory_controller/follow_joint_trajectory"
    assert goal["args"]["trajectory"]["joint_names"][0] == "left_shoulder_pan_joint"


@pytest.mark.parametrize("name, told", [
    ("joint_state", "states joint_state.*Known are namespace, prefix"), ("output", "output is /x")])
def test_a_name_that_is_none_is_refused(stepped_ros, name, told):
    with pytest.raises(InputError, match=told):
        stepped_ros(cell=with_names(**{name: "/x"}))


def test_the_gripper_moves_by_its_action(stepped_ros):
    held = with_names(gripper_closed="0.7")
    robot, link = stepped_ros(cell=held.model_copy(update={
        "tool": CELL.tool.model_copy(update={"gripper": "ros"})}))
    link.gripper(close=True)
    assert robot.server.heard[-1][1]["args"] == {"command": {"position": 0.7, "max_effort": 0.0}}


def test_a_bridge_that_does_not_tell_what_is_published_is_warned_of(stepped_ros):
    robot, link = stepped_ros()
    robot.server._subscribed[robot.bridge] -= {"/limber/stop", "/limber/end"}
    assert link.follow(line(0.02))["event"] == "reached"
    link.close()
    assert "does not come back" in link.warnings[-1]


PAPER = Cell(robot={"model": "ur5", "address": "ws://stepped"}, base={"pose": (0,) * 6},
             sensor={"kind": "ft300"}, tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0), "mass_kg": 0.0})


def with_sensor(cell: Cell, **entries) -> Cell:
    return cell.model_copy(update={"sensor": cell.sensor.model_copy(update=entries)})


def test_the_guard_listens_to_the_stated_sensor(stepped_ros):
    assert wrench_topic(CELL) == Topics().wrench
    stated = with_sensor(PAPER, topic="/ft300/wrench")
    assert wrench_topic(stated) == "/ft300/wrench"
    robot, link = stepped_ros(cell=stated, wrench_topic="/ft300/wrench")
    robot.server.wrench = np.array([3.0, 0, 0, 0, 0, 0])
    robot.rest(0.5)
    assert np.linalg.norm(link.wait_for_samples()[13:16]) == pytest.approx(3.0, abs=0.1)


@pytest.mark.parametrize("cell, told", [
    (PAPER, "states no sensor.topic"),
    (with_sensor(PAPER, kind="ft300_usb", device="/dev/ttyUSB0"), "states no sensor.topic"),
    (with_sensor(PAPER, topic=Topics().wrench), "estimates from motor currents"),
    (with_sensor(PAPER, topic="/left/force_torque_sensor_broadcaster/wrench"),
     "estimates from motor currents"),
    (with_sensor(PAPER, kind="controller"), "A CB3 estimates it from motor currents"),
    (with_sensor(PAPER, kind="controller", topic="/ft300/wrench"), "A CB3 estimates it"),
    (with_sensor(PAPER, kind="none"), "names no force sensor"),
    (with_sensor(CELL, kind="ft300"), "states no sensor.topic"),
    (with_sensor(CELL, kind="ft300", topic=Topics().wrench), "or sensor.kind to controller")])
def test_a_sensor_that_is_not_heard_in_ros_is_refused(cell, told):
    with pytest.raises(InputError, match=told):
        wrench_topic(cell)
    with pytest.raises(InputError, match=told):
        control_of(cell)


@pytest.mark.parametrize("arguments", [
    ["ros", "serve"], ["robot", "check"], ["robot", "home"]])
def test_every_command_refuses_the_papers_cell_without_its_topic(tmp_path, arguments):
    """Before it asks for a branch, a path or rosbridge."""
    write_cell(tmp_path / "cell.toml", PAPER)
    code, told = answer(*arguments, tmp_path / "cell.toml")
    assert code == 2 and "sensor.topic" in told["error"]
