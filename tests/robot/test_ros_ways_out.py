"""Whatever ends a goal in ROS cancels it and publishes a stop; no clock runs in most of these."""

import numpy as np
import pytest
from tests.robot.stepped_ros import SteppedRos
from tests.robot.test_ros import CELL, HOME, ROOT, line
from tests.subjects.commands import answer

from benchmarks.robot_rosbridge import STEP, RosBridge
from limber.cell.cell_file import Cell, write_cell
from limber.core.errors import InputError, SafetyStop, WorkError
from limber.robot.driver.controls import control_of
from limber.robot.motion.trajectory import Trajectory
from limber.robot.ros.topics import Topics, wrench_topic

GRIPPER = {"name": ["finger_joint", "other_finger_joint"], "position": [0.4, 0.4],
           "velocity": [0.0, 0.0]}


@pytest.fixture(autouse=True)
def own_state(monkeypatch, tmp_path):
    monkeypatch.setenv("LIMBER_STATE", str(tmp_path / "state"))


def at(step: int, act):
    """A plan that acts once on the server."""
    return lambda robot, now: act(robot.server) if now == step else None


def said(robot: SteppedRos) -> list[str]:
    """What Limber said, in its order, without repetitions."""
    words = {"send_action_goal": "goal", "cancel_action_goal": "cancel"}
    signs = {"/limber/stop": {False: "beat", True: "stop"}, "/limber/end": {None: "end"}}
    told = [words.get(order["op"]) or signs[order["topic"]][order["msg"].get("data")]
            for _, order in robot.server.heard
            if order["op"] not in ("advertise", "call_service")]
    return list(dict.fromkeys(told))


STOPPED = ["beat", "goal", "stop", "cancel"]
WAY_M = 0.013  # at most, of 30 steps at 50 mm/s


def require_stopped(robot: SteppedRos) -> None:
    """All was said, and the arm stands near its start however long one waits."""
    robot.rest(0.3)
    assert said(robot)[:3] == STOPPED[:3] and not robot.server.is_busy
    stood = robot.server.joints.copy()
    robot.rest(1.0)
    assert robot.server.joints == pytest.approx(stood, abs=0)
    moved = CELL.arm.forward(stood)[:3, 3] - CELL.arm.forward(HOME)[:3, 3]
    assert np.linalg.norm(moved) < WAY_M


@pytest.mark.parametrize("end", ["abandon", "stop", "close"])
def test_who_gives_orders_and_ends_stops_the_arm(stepped_ros, end):
    """A killed program, Ctrl-C, and an error that closes the link."""
    robot, link = stepped_ros()
    link.start(line(0.1))
    robot.rest(30 * STEP)
    getattr(link, end)()
    robot.rest(0.5)
    require_stopped(robot)


def test_after_a_stop_only_a_person_lets_it_move(stepped_ros):
    robot, link = stepped_ros()
    link.start(line(0.1))
    robot.rest(15 * STEP)
    link.stop()
    assert link.wait("stopped", seconds=1.0)["moving"]
    robot.rest(0.5)
    with pytest.raises(SafetyStop, match="Choose"):
        link.follow(line(0.1))


def test_the_joint_states_of_a_second_arm_stop_it(stepped_ros):
    def second(server):
        server.others = [{"name": [f"second_{name}_joint" for name in CELL.arm.ros_joints],
                          "position": [0.0] * 6, "velocity": [0.0] * 6}]
    robot, link = stepped_ros(at(30, second))
    with pytest.raises(InputError, match="2 joints of ROS are named like"):
        link.follow(line(0.1))
    require_stopped(robot)


def test_a_cancel_is_said_again_until_the_goal_has_ended(stepped_ros):
    """rosbridge drops that of a goal which the controller has not accepted yet."""
    robot, link = stepped_ros(lambda robot, now: now == 2 and link.stop(), accepts_after=20)
    assert link.follow(line(0.1))["event"] == "stopped"
    require_stopped(robot)
    assert sum(order["op"] == "cancel_action_goal" for _, order in robot.server.heard) > 1


def test_a_pause_cancels_and_a_person_lets_the_rest_be_followed(stepped_ros):
    """The soft limit; the rest begins where the arm stands, and ends at the path's end."""
    path = line(0.05)
    unpredicted = Trajectory(path.times, path.poses, None, path.joints)
    robot, link = stepped_ros(at(60, lambda server: setattr(
        server, "wrench", np.array([12.0, 0, 0, 0, 0, 0]))))
    assert link.follow(unpredicted)["event"] == "paused"
    robot.plan, robot.server.wrench[0] = None, 9.5
    robot.rest(0.5)
    assert not robot.server.is_busy and np.abs(robot.server.joints - path.joints[-1]).max() > 0.01
    assert link.resume()["event"] == "reached"
    assert robot.server.joints == pytest.approx(path.joints[-1], abs=1e-4)


SAFETY, MODE, PROGRAM, SCALING = WELL = RosBridge(HOME).status
PROTECTED = {SCALING: {"data": 0.0}, SAFETY: {"mode": 3}, PROGRAM: {"data": False}}


@pytest.mark.parametrize("topic, message, told", [
    (SAFETY, {"mode": 3}, "protective stop"), (SAFETY, {"mode": 5}, "safeguard stop"),
    (SAFETY, {"mode": 7}, "emergency stop"), (SAFETY, {"mode": 2}, "reduced mode"),
    (SAFETY, {"mode": 12}, "safeguard stop of the automatic mode"),
    (MODE, {"mode": 5}, "robot mode 5"),
    (PROGRAM, {"data": False}, "the program on the controller was stopped"),
    (SCALING, {"data": 0.0}, "scales the speed to 0"),
    (SCALING, {"data": None}, "scales the speed to 0")])
def test_what_the_controller_reports_cancels_at_once(stepped_ros, topic, message, told):
    robot, link = stepped_ros(at(30, lambda server: server.status.update({topic: message})))
    event = link.follow(line(0.1))
    assert event["event"] == "stopped" and told in event["reason"]
    robot.rest(0.3)
    assert len(robot.server.followed) <= 33
    robot.server.status |= {SCALING: {"data": 100.0}, PROGRAM: {"data": True}}
    require_stopped(robot)


@pytest.mark.parametrize("pause", [1, 200])
def test_after_a_released_protective_stop_nothing_moves_and_nothing_is_reached(stepped_ros, pause):
    def plan(robot, step):
        if step == 30:
            robot.server.status |= PROTECTED
        elif step == 30 + pause:
            robot.server.status |= WELL
    robot, link = stepped_ros(plan)
    event = link.follow(line(0.1))
    assert event["event"] == "stopped" and "protective stop" in event["reason"]
    robot.rest(STEP * pause)
    require_stopped(robot)


def test_a_robot_in_a_protective_stop_is_sent_no_goal(stepped_ros):
    robot, link = stepped_ros()
    robot.server.status |= PROTECTED
    robot.rest(2 * STEP)
    with pytest.raises(SafetyStop, match="cannot be moved: protective stop"):
        link.follow(line(0.02))
    assert said(robot) == []


def test_standstill_under_a_goal_is_stopped_and_named(stepped_ros):
    robot, link = stepped_ros(at(30, lambda server: setattr(server, "sticks", True)))
    event = link.follow(line(0.1))
    assert event["event"] == "stopped" and "stood still for 2.0 s" in event["reason"]
    robot.server.sticks = False
    require_stopped(robot)


def test_a_goal_that_is_never_accepted_is_stopped(stepped_ros):
    robot, link = stepped_ros(accepts_after=10**6)
    event = link.follow(line(0.02))
    robot.rest(2.5)
    link.close()
    assert "stood still" in event["reason"] and robot.server.followed == []
    assert "did not confirm" in link.warnings[-1]


@pytest.mark.parametrize("scaling", [100.0, 50.0])
def test_a_rest_of_the_path_and_a_slow_controller_are_no_standstill(stepped_ros, scaling):
    out = line(0.001, 0.02)
    path = Trajectory(np.r_[out.times, out.duration + 3.0 + out.times],
                      np.concatenate([out.poses, out.poses[::-1]]), None,
                      np.concatenate([out.joints, out.joints[::-1]]))
    robot, link = stepped_ros()
    robot.server.status[SCALING] = {"data": scaling}
    event = link.follow(path)
    assert event["event"] == "reached", event


def test_another_nodes_joint_states_do_not_disturb_a_motion(stepped_ros):
    robot, link = stepped_ros(at(5, lambda server: server.others.append(GRIPPER)))
    path = line(0.02)
    assert link.follow(path)["event"] == "reached"
    assert robot.server.joints == pytest.approx(path.joints[-1])


def test_another_nodes_joint_states_are_no_sign_of_life(stepped_ros):
    def only_the_gripper(server):
        server.others.append(GRIPPER)
        server.has_arm = False
    robot, link = stepped_ros(at(30, only_the_gripper))
    event = link.follow(line(0.1))
    assert "no data from the robot" in event["reason"]
    robot.server.has_arm = True
    require_stopped(robot)


def test_a_robot_whose_joint_states_are_of_another_node_alone_is_refused(stepped_ros):
    with pytest.raises(WorkError, match="It has the joints finger_joint, other_finger_joint, not"):
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
    robot, link = stepped_ros()
    robot.plan = lambda step: robot.end_goal(status, **values) if step == 30 else None
    event = link.follow(line(0.1))
    assert event["event"] == "stopped" and told in event["reason"]
    require_stopped(robot)


def test_a_stop_of_another_node_is_obeyed(stepped_ros):
    robot, link = stepped_ros()
    robot.plan = lambda step: step == 30 and robot.server.obey(
        None, {"op": "publish", "topic": "/limber/stop", "msg": {"data": True}})
    assert link.follow(line(0.1))["reason"] == "a stop was published"
    require_stopped(robot)


def test_a_leg_to_its_end_gives_the_node_an_end_word_and_no_stop(stepped_ros, monkeypatch):
    """The example's node, which hears these words, reports no silence after the leg."""
    monkeypatch.syspath_prepend(str(ROOT / "scripts" / "examples" / "ros2" / "limber_stop"))
    from limber_stop.watch import Watch

    robot, link = stepped_ros()
    assert link.follow(line(0.02))["event"] == "reached"
    assert said(robot) == ["beat", "goal", "end"] and link.warnings == []
    watch = Watch()
    for when, order in robot.server.heard:
        assert not watch.is_silent(when)
        if order["op"] == "publish" and order["topic"] == "/limber/stop":
            assert not watch.heard(order["msg"]["data"], when)
        elif order["op"] == "publish":
            watch.ended()
    assert not watch.is_silent(when + 1.0)


def test_joint_states_without_numbers_stop_it(stepped_ros):
    names = [f"{name}_joint" for name in CELL.arm.ros_joints]
    lost = {"name": names, "position": [None] * 6, "velocity": [None] * 6}
    robot, link = stepped_ros(at(30, lambda server: server.others.append(lost)))
    event = link.follow(line(0.1))
    assert event["event"] == "stopped" and "gives no number" in event["reason"]
    robot.server.others = []
    require_stopped(robot)


def test_a_bridge_that_a_goal_blocks_is_noticed(stepped_ros):
    """rosbridge's default: a stop waits there until the goal has ended."""
    _, link = stepped_ros(blocks=True)
    event = link.follow(line(0.1, 0.01))
    assert event["event"] == "stopped"
    assert "send_action_goals_in_new_thread:=true" in event["reason"]


def test_a_bridge_that_knows_no_actions_is_named(stepped_ros):
    """As that of Humble: it answers with an error, and nothing moves."""
    robot, link = stepped_ros(knows_actions=False)
    event = link.follow(line(0.02))
    assert event["event"] == "stopped" and "update rosbridge_suite" in event["reason"]
    assert robot.server.followed == []


def test_the_noise_of_joint_speeds_is_no_motion(stepped_ros):
    robot, link = stepped_ros(speed_noise=2e-3)
    assert link.follow(line(0.02))["event"] == "reached"
    robot.rest(0.5)
    assert link.retreat()["event"] == "reached"


def test_a_name_space_and_a_prefix_choose_one_of_two_arms(stepped_ros):
    """Both publish on one topic; the goal is of this one's joints."""
    two = CELL.model_copy(update={"robot": CELL.robot.model_copy(update={
        "ros": {"namespace": "cell", "prefix": "left_", "joint_states": "/joint_states"}})})
    names = [f"right_{name}_joint" for name in CELL.arm.ros_joints]
    right = {"name": names, "position": [0.0] * 6, "velocity": [0.0] * 6}
    robot, link = stepped_ros(cell=two, prefix="left_", space="/cell", others=[right])
    assert link.follow(line(0.02))["event"] == "reached"
    [goal] = [order for _, order in robot.server.heard if order["op"] == "send_action_goal"]
    assert goal["action"] == "/cell/scaled_joint_trajectory_controller/follow_joint_trajectory"
    assert goal["args"]["trajectory"]["joint_names"][0] == "left_shoulder_pan_joint"


def test_a_name_that_is_none_is_refused(stepped_ros):
    with pytest.raises(InputError, match=r"states joint_state.*Known are namespace, prefix"):
        stepped_ros(cell=CELL.model_copy(update={"robot": CELL.robot.model_copy(update={
            "ros": {"joint_state": "/x"}})}))


def test_the_gripper_moves_by_its_action(stepped_ros):
    held = CELL.model_copy(update={"tool": CELL.tool.model_copy(update={"gripper": "ros"}),
                                   "robot": CELL.robot.model_copy(update={
                                       "ros": {"gripper_closed": "0.7"}})})
    robot, link = stepped_ros(cell=held)
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
