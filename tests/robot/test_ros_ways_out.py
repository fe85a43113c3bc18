"""Whatever ends a goal in ROS cancels it and publishes a stop; no clock runs in most of these."""

import os
import signal
import threading

import numpy as np
import pytest
from tests.robot.test_ros import CELL, HOME, ROOT, line, robot_at
from tests.subjects.commands import answer

from benchmarks.robot_rosbridge import STEP, RosBridge, SteppedBridge
from limber.cell.cell_file import Cell, write_cell
from limber.core.errors import Cancelled, InputError, SafetyStop, WorkError
from limber.robot.motion.trajectory import Trajectory
from limber.robot.ros.guarded_robot import RosRobot, Topics
from limber.robot.ros.messages import wrench_topic

GRIPPER = {"name": ["finger_joint", "other_finger_joint"], "position": [0.4, 0.4],
           "velocity": [0.0, 0.0]}


@pytest.fixture(autouse=True)
def own_state(monkeypatch, tmp_path):
    monkeypatch.setenv("LIMBER_STATE", str(tmp_path / "state"))


def at(step: int, act):
    """A plan that acts once."""
    return lambda server, now: act(server) if now == step else None


def raising(error: BaseException):
    def act(*_given, **_more):
        raise error
    return act


def said(server: RosBridge) -> list[str]:
    """What the robot said, in its order, without repetitions."""
    words = {"send_action_goal": "goal", "cancel_action_goal": "cancel"}
    signs = {"/limber/stop": {False: "beat", True: "stop"}, "/limber/end": {None: "end"}}
    told = [words.get(order["op"]) or signs[order["topic"]][order["msg"].get("data")]
            for _, order in server.heard if order["op"] != "advertise"]
    return list(dict.fromkeys(told))


STOPPED = ["beat", "goal", "stop", "cancel"]
WAY_M = 0.012  # at most, of 30 steps at 50 mm/s


def require_stopped(server: RosBridge, robot: RosRobot) -> None:
    """All was said, and the arm stands near its start however long one waits."""
    assert said(server) == STOPPED and not server.is_busy
    stood = server.joints.copy()
    robot.watched(1.0)
    assert server.joints == pytest.approx(stood, abs=0)
    moved = CELL.arm.forward(stood)[:3, 3] - CELL.arm.forward(HOME)[:3, 3]
    assert np.linalg.norm(moved) < WAY_M


@pytest.mark.parametrize("error", [ValueError("a fault"), KeyboardInterrupt(), SystemExit(3),
                                   InputError("bad"), MemoryError()])
def test_an_error_or_an_interrupt_cancels_the_goal(stepped_ros, error):
    server, robot = stepped_ros(at(30, raising(error)))
    with pytest.raises(type(error)):
        robot.follow(line(0.1))
    require_stopped(server, robot)
    assert robot.warnings[-1].endswith("The arm stands")
    with pytest.raises(SafetyStop, match="Choose"):
        robot.guard.begin()


def test_an_error_while_the_motion_is_watched_cancels_the_goal(stepped_ros):
    """As an add-on's drawing may raise, or a cancelled job."""
    server, robot = stepped_ros()
    robot._on_sample = raising(Cancelled())
    with pytest.raises(Cancelled):
        robot.follow(line(0.1))
    assert {"stop", "cancel"} <= set(said(server)) and not server.is_busy


def test_an_error_that_comes_again_does_not_hinder_the_cancel(stepped_ros):
    """The joint states of a second arm: each of its messages raises."""
    def second(server):
        server.others = [{"name": [f"second_{name}_joint" for name in CELL.arm.ros_joints],
                          "position": [0.0] * 6, "velocity": [0.0] * 6}]
    server, robot = stepped_ros(at(30, second))
    with pytest.raises(InputError, match="2 joints of ROS are named like"):
        robot.follow(line(0.1))
    server.others = []
    require_stopped(server, robot)


def test_a_cancel_is_said_again_until_the_goal_has_ended(stepped_ros):
    """rosbridge drops that of a goal which the controller has not accepted yet."""
    server, robot = stepped_ros(at(2, raising(KeyboardInterrupt())), accepts_after=20)
    with pytest.raises(KeyboardInterrupt):
        robot.follow(line(0.1))
    require_stopped(server, robot)
    assert sum(order["op"] == "cancel_action_goal" for _, order in server.heard) > 1


def test_a_connection_that_is_lost_meanwhile_is_told(stepped_ros):
    def lose(server):
        server.obey = raising(ConnectionError("the connection was lost"))
        raise KeyboardInterrupt
    _, robot = stepped_ros(at(30, lose))
    with pytest.raises(KeyboardInterrupt):
        robot.follow(line(0.1))
    assert "the connection was lost: whether the arm stands is not known" in robot.warnings[-1]


SAFETY, MODE, PROGRAM, SCALING = RosBridge(HOME).status


@pytest.mark.parametrize("topic, message, told", [
    (SAFETY, {"mode": 3}, "protective stop"), (SAFETY, {"mode": 5}, "safeguard stop"),
    (SAFETY, {"mode": 7}, "emergency stop"), (SAFETY, {"mode": 2}, "reduced mode"),
    (SAFETY, {"mode": 12}, "safeguard stop of the automatic mode"),
    (MODE, {"mode": 5}, "robot mode 5"),
    (PROGRAM, {"data": False}, "the program on the controller was stopped"),
    (SCALING, {"data": 0.0}, "scales the speed to 0"),
    (SCALING, {"data": None}, "scales the speed to 0")])
def test_what_the_controller_reports_cancels_at_once(stepped_ros, topic, message, told):
    server, robot = stepped_ros(at(30, lambda server: server.status.update({topic: message})))
    event = robot.follow(line(0.1))
    assert event["event"] == "stopped" and told in event["reason"] and event["stands"]
    assert len(server.followed) <= 31
    server.status |= {SCALING: {"data": 100.0}, PROGRAM: {"data": True}}
    require_stopped(server, robot)


@pytest.mark.parametrize("pause", [1, 200])
def test_after_a_released_protective_stop_nothing_moves_and_nothing_is_reached(stepped_ros, pause):
    def plan(server, step):
        if step == 30:
            server.protective_stop()
        elif step == 30 + pause:
            server.release()
    server, robot = stepped_ros(plan)
    event = robot.follow(line(0.1))
    assert event["event"] == "stopped" and "protective stop" in event["reason"]
    robot.watched(STEP * pause)
    require_stopped(server, robot)


def test_a_protective_stop_is_named_also_where_the_ended_program_is_heard_first(stepped_ros):
    def stop(server):
        server.status = {PROGRAM: {"data": False}, SAFETY: {"mode": 3}}
    _, robot = stepped_ros(at(30, stop))
    assert robot.follow(line(0.1))["reason"] == (
        "the program on the controller was stopped (protective stop)")


def test_a_robot_in_a_protective_stop_is_sent_no_goal(stepped_ros):
    server, robot = stepped_ros()
    server.protective_stop()
    robot.watched(STEP)
    with pytest.raises(SafetyStop, match="cannot be moved: protective stop"):
        robot.follow(line(0.02))
    assert said(server) == []


def test_standstill_under_a_goal_is_stopped_and_named(stepped_ros):
    server, robot = stepped_ros(at(30, lambda server: setattr(server, "sticks", True)))
    event = robot.follow(line(0.1))
    assert event["event"] == "stopped" and "stood still for 2.0 s" in event["reason"]
    server.sticks = False
    require_stopped(server, robot)


def test_a_goal_that_is_never_accepted_is_stopped(stepped_ros):
    server, robot = stepped_ros(accepts_after=10**6)
    event = robot.follow(line(0.02))
    assert "stood still" in event["reason"] and server.followed == []
    assert "did not confirm" in robot.warnings[-1]


@pytest.mark.parametrize("scaling", [100.0, 50.0])
def test_a_rest_of_the_path_and_a_slow_controller_are_no_standstill(stepped_ros, scaling):
    out = line(0.001, 0.02)
    path = Trajectory(np.r_[out.times, out.duration + 3.0 + out.times],
                      np.concatenate([out.poses, out.poses[::-1]]), None,
                      np.concatenate([out.joints, out.joints[::-1]]))
    server, robot = stepped_ros()
    server.status[SCALING] = {"data": scaling}
    assert robot.follow(path) == {"event": "reached"}


def test_another_nodes_joint_states_do_not_disturb_a_motion(stepped_ros):
    server, robot = stepped_ros(at(5, lambda server: server.others.append(GRIPPER)))
    path = line(0.02)
    assert robot.follow(path) == {"event": "reached"}
    assert server.joints == pytest.approx(path.joints[-1])


def test_another_nodes_joint_states_are_no_sign_of_life(stepped_ros):
    def only_the_gripper(server):
        server.others.append(GRIPPER)
        server.has_arm = False
    server, robot = stepped_ros(at(30, only_the_gripper))
    event = robot.follow(line(0.1))
    assert "no data from the robot" in event["reason"]
    server.has_arm = True
    require_stopped(server, robot)


def test_a_robot_whose_joint_states_are_of_another_node_alone_is_refused(stepped_ros):
    with pytest.raises(WorkError, match="does not have the joints of a ur5e: finger_joint"):
        stepped_ros(others=[GRIPPER], has_arm=False)


@pytest.mark.parametrize("topic", [SAFETY, MODE, PROGRAM, SCALING])
def test_a_ur_arm_is_not_moved_without_what_its_driver_publishes(stepped_ros, topic):
    with pytest.raises(WorkError, match=f"Nothing came on {topic} within 2 s.*"
                                        "ur_control.launch.py ur_type:=ur5e"):
        stepped_ros(silent={topic})


@pytest.mark.parametrize("status, values, told", [
    (6, {"error_code": -4, "error_string": "path tolerance violated"}, "path tolerance violated"),
    (5, {}, "no reason was given"),
    (4, {"error_code": -5, "error_string": "goal tolerance"}, "goal tolerance"),
    (4, {"error_code": 0}, "calls its goal reached, but the arm is")])
def test_a_goal_that_the_controller_ends_early_is_not_reached(stepped_ros, status, values, told):
    server, robot = stepped_ros()
    robot._bridge.plan = lambda step: (
        robot._bridge.end_goal(status, **values) if step == 30 else None)
    event = robot.follow(line(0.1))
    assert event["event"] == "stopped" and told in event["reason"] and event["stands"]
    require_stopped(server, robot)


def test_a_stop_of_another_node_is_obeyed(stepped_ros):
    server, robot = stepped_ros()
    robot._bridge.plan = lambda step: step == 30 and server.obey(
        None, {"op": "publish", "topic": "/limber/stop", "msg": {"data": True}})
    assert robot.follow(line(0.1))["reason"] == "a stop was published"
    require_stopped(server, robot)


def test_a_leg_to_its_end_gives_the_node_an_end_word_and_no_stop(stepped_ros, monkeypatch):
    """The example's node, which hears these words, reports no silence after the leg."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts" / "examples" / "ros2" / "limber_stop"))
    from limber_stop.watch import Watch

    server, robot = stepped_ros()
    assert robot.follow(line(0.02)) == {"event": "reached"}
    assert said(server) == ["beat", "goal", "end"] and robot.warnings == []
    watch = Watch()
    for when, order in server.heard:
        assert not watch.is_silent(when)
        if order["op"] == "publish" and order["topic"] == "/limber/stop":
            assert not watch.heard(order["msg"]["data"], when)
        elif order["op"] == "publish":
            watch.ended()
    assert not watch.is_silent(when + 1.0)


def test_joint_states_without_numbers_stop_it(stepped_ros):
    names = [f"{name}_joint" for name in CELL.arm.ros_joints]
    lost = {"name": names, "position": [None] * 6, "velocity": [None] * 6}
    server, robot = stepped_ros(at(30, lambda server: server.others.append(lost)))
    event = robot.follow(line(0.1))
    assert event["event"] == "stopped" and "gives no number" in event["reason"]
    server.others = []
    require_stopped(server, robot)


def test_a_bridge_that_a_goal_blocks_is_noticed(stepped_ros):
    """rosbridge's default: a stop waits there until the goal has ended."""
    _, robot = stepped_ros(blocks=True)
    event = robot.follow(line(0.1, 0.01))
    assert event["event"] == "stopped" and not event["stands"]
    assert "send_action_goals_in_new_thread:=true" in event["reason"]
    assert "did not confirm" in robot.warnings[-1]


def test_a_bridge_that_does_not_tell_what_is_published_is_warned_of(stepped_ros):
    _, robot = stepped_ros()
    robot._bridge._server._subscribed[robot._bridge._inbox] -= {"/limber/stop", "/limber/end"}
    assert robot.follow(line(0.02)) == {"event": "reached"}
    assert "does not come back" in robot.warnings[-1]


@pytest.mark.real_time
@pytest.mark.usefixtures("first_in_line")
def test_ctrl_c_in_a_leg_stops_the_arm():
    with RosBridge(HOME) as server:
        robot = robot_at(server)
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        with pytest.raises(KeyboardInterrupt):
            robot.follow(line(0.1))
        assert said(server) == STOPPED and not server.is_busy
        assert np.abs(server.joints - HOME).max() > 1e-3
        robot.close()


@pytest.mark.real_time
@pytest.mark.usefixtures("first_in_line")
def test_a_closed_connection_in_a_leg_is_told():
    with RosBridge(HOME) as server:
        robot = robot_at(server)
        threading.Timer(0.3, server.hang_up).start()
        with pytest.raises(ConnectionError, match="was lost"):
            robot.follow(line(0.1))


PAPER = Cell(robot={"model": "ur5"}, base={"pose": (0,) * 6}, sensor={"kind": "ft300"},
             tool={"grasp_pose": (0, 0, 0.15, 0, 0, 0), "mass_kg": 0.0})


def with_sensor(cell: Cell, **entries) -> Cell:
    return cell.model_copy(update={"sensor": cell.sensor.model_copy(update=entries)})


def test_the_guard_listens_to_the_stated_sensor(stepped_ros):
    assert wrench_topic(CELL) == Topics().wrench
    stated = with_sensor(PAPER, topic="/ft300/wrench")
    assert wrench_topic(stated) == "/ft300/wrench"
    server, robot = stepped_ros(cell=stated, wrench_topic="/ft300/wrench")
    server.wrench = np.array([3.0, 0, 0, 0, 0, 0])
    _, forces = robot.watched(1.0)
    assert forces.mean(axis=0) == pytest.approx([3, 0, 0], abs=0.1)


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
        RosRobot(cell, SteppedBridge(RosBridge(HOME)), Topics())


@pytest.mark.parametrize("arguments", [
    ["check"], ["follow", "a.branch"], ["retreat"], ["serve"]])
def test_every_command_refuses_the_papers_cell_without_its_topic(tmp_path, arguments):
    """Before it asks for a branch, a path or rosbridge: `follow` in its dry run too."""
    write_cell(tmp_path / "cell.toml", PAPER)
    name, *rest = arguments
    code, told = answer("ros", name, tmp_path / "cell.toml", *rest)
    assert code == 2 and "sensor.topic" in told["error"]
