"""Whatever ends a goal in ROS cancels it and publishes a stop; no clock runs in most of these."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.commands import answer

from benchmarks import robot_ros_faults as faults
from benchmarks.robot_ros_faults import CASES, GRIPPER, provoked, states, with_names
from benchmarks.robot_ros_stepped import ROS_CELL as CELL
from benchmarks.robot_ros_stepped import SteppedRos, line, to_and_fro
from benchmarks.robot_rosbridge import STEP
from limber.cell.cell_file import Cell, write_cell
from limber.core.errors import InputError, SafetyStop, WorkError
from limber.robot.driver.controls import control_of
from limber.robot.ros.topics import Topics, wrench_topic


@pytest.mark.parametrize("name, output", CASES)
def test_a_fault_is_stopped_and_named_and_nothing_moves_after_its_release(name, output):
    found = provoked(name, output)
    assert found["is_good"] and not found["moved"], found


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
    path = replace(line(0.05), expected=None)
    robot, link = stepped_ros(lambda robot, step: step == 60 and setattr(
        robot.server, "wrench", np.array([12.0, 0, 0, 0, 0, 0])))
    assert link.follow(path)["event"] == "paused"
    robot.plan, robot.server.wrench[0] = None, 9.5
    robot.rest(0.5)
    assert not robot.server.is_busy and np.abs(robot.server.joints - path.joints[-1]).max() > 0.01
    assert link.resume()["event"] == "reached"
    assert robot.server.joints == pytest.approx(path.joints[-1], abs=1e-4)


def test_a_robot_in_a_protective_stop_is_sent_no_goal(stepped_ros):
    robot, link = stepped_ros()
    robot.server.status |= {faults.SCALING: {"data": 0.0}, faults.SAFETY: {"mode": 3},
                            faults.PROGRAM: {"data": False}}
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
    robot.server.status[faults.SCALING] = {"data": scaling}
    event = link.follow(to_and_fro(line(0.001, 0.02), 3.0))
    assert event["event"] == "reached", event


@pytest.mark.parametrize("settings, told", [
    ({"others": GRIPPER, "has_arm": False}, "It has the joints finger_joint, other_finger_joint, "),
    ({"silent": {Topics().wrench}}, f"Too little came on {Topics().wrench}"),
    *(({"silent": {topic}}, f"Nothing came on {topic} within 2 s.*launch.py ur_type:=ur5e")
      for topic in (faults.SAFETY, faults.MODE, faults.PROGRAM, faults.SCALING))])
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
                              others=[states(0.0, "right_")])
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
