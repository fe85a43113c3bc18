"""The door to ROS 2, against a rosbridge server in the test: followed, guarded, stopped in time."""

import ast
import base64
import threading
import time
from dataclasses import replace
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import pytest

from benchmarks.robot_ros import linked
from benchmarks.robot_ros_stepped import HOME, TOOL, line, to_and_fro
from benchmarks.robot_ros_stepped import ROS_CELL as CELL
from benchmarks.robot_rosbridge import RosBridge
from limber.cell.cell_file import Cell
from limber.core.errors import InputError, SafetyStop, WorkError
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.robot.driver.link import RobotLink
from limber.robot.ros.bridge import Bridge
from limber.robot.ros.messages import CloudTopic, JointStates, cloud_of, goal_of, spline
from limber.robot.ros.ros_control import BEAT_SECONDS

ROOT = Path(__file__).parents[2]


@pytest.mark.real_time
@pytest.mark.usefixtures("first_in_line")
def test_a_plan_is_followed_and_a_force_stops_it_in_time():
    """All samples at 125 Hz; then a push: stop topic and cancel within 0.1 s, and standstill."""
    taken = []
    with RosBridge(HOME) as server, linked(server, taken.append) as link:
        path = line(0.02)
        taken.clear()
        assert link.follow(path)["event"] == "reached"
        assert server.joints == pytest.approx(path.joints[-1])
        times = np.concatenate(taken)[:, 0]
        assert np.diff(times) == pytest.approx(np.full(len(times) - 1, 0.008), abs=1e-6)
        assert len(times) > 0.9 * path.duration / 0.008
        time.sleep(0.5)
        assert link.retreat()["event"] == "reached"
        time.sleep(0.5)
        pushed = []

        def push() -> None:
            pushed.append(time.monotonic())
            server.wrench = np.array([0, 0, 30.0, 0, 0, 0])
        threading.Timer(0.4, push).start()
        event = link.follow(line(0.1))
        assert event["event"] == "stopped" and "force" in event["reason"]
        time.sleep(0.2)
        stops = {order["op"]: at for at, order in reversed(server.heard)
                 if order["op"] == "cancel_action_goal" or order.get("msg") == {"data": True}}
        assert set(stops) == {"publish", "cancel_action_goal"}
        assert max(stops.values()) - pushed[0] < 0.1
        assert server.stood_at - pushed[0] < 0.15 and not server.is_busy


@pytest.mark.slow
def test_after_a_stop_it_goes_back_along_its_way_until_no_force_is_left(monkeypatch, tmp_path,
                                                                        stepped_ros):
    """Another program goes back, by the tare of the first, though the sensor has 2 N of bias."""
    monkeypatch.setenv("LIMBER_STATE", str(tmp_path))
    start = CELL.arm.forward(HOME)[:3, 3]
    robot, link = stepped_ros(wrench=np.array([2.0, 0, 0, 0, 0, 0]))
    robot.server.load = lambda joints: np.r_[0, 0, 400.0 * np.linalg.norm(
        CELL.arm.forward(joints)[:3, 3] - start), 0, 0, 0]
    event = link.follow(replace(line(0.05), expected=None))
    assert event["event"] == "paused" and "soft force" in event["reason"]
    link.close()
    assert np.abs(robot.server.joints - HOME).max() > 0.01
    with RobotLink(CELL) as other:
        other.wait_for_samples()
        assert other.retreat()["event"] == "reached"
        robot.rest(0.5)
        assert np.linalg.norm(other.wait_for_samples()[13:16]) < 1.0
    assert robot.server.joints == pytest.approx(HOME, abs=2e-3)



def test_an_arm_elsewhere_is_refused_and_nobody_there_is_told_soon(stepped_ros):
    robot, link = stepped_ros(joints=HOME + [0, 0, 0, 0, 0, 0.8])
    with pytest.raises(SafetyStop, match="wrist 3"):
        link.follow(line(0.02))
    assert not any(order["op"] == "send_action_goal" for _, order in robot.server.heard)
    with pytest.raises(WorkError, match="No rosbridge answers"):
        Bridge("ws://127.0.0.1:1")


def test_a_moving_arm_is_sent_no_goal(stepped_ros):
    """Another program drives it: ours would be a second motion beside it."""
    robot, link = stepped_ros()
    robot.server.drift = np.full(6, 0.004)
    robot.rest(0.4)
    with pytest.raises(SafetyStop, match="moves already"):
        link.follow(line(0.02))
    assert not any(order["op"] == "send_action_goal" for _, order in robot.server.heard)


def test_joints_come_by_name_in_any_order_and_missing_numbers_are_none():
    names = ["elbow_joint", "tool_joint", *(f"{name}_joint" for name in CELL.arm.ros_joints
                                            if name != "elbow")]
    states = JointStates(CELL)
    message = {"header": {"stamp": {"sec": 3, "nanosec": 500000000}}, "name": names,
               "position": [HOME[2], 9.0, HOME[0], HOME[1], *HOME[3:]], "velocity": [0.1] * 7}
    assert states.sample({**message, "name": names[1:]}, 1.0) is None
    sample = states.sample(message, 1.0)
    assert states.ordered == [f"{name}_joint" for name in CELL.arm.ros_joints]
    assert sample.clock == 3.5 and sample.joints == pytest.approx(HOME)
    assert sample.pose == pytest.approx(pose_vectors(CELL.arm.forward(HOME) @ TOOL))
    step = CELL.arm.forward(HOME + 1e-6 * sample.joint_speeds) @ TOOL
    moved = (step[:3, 3] - sample.pose[:3]) / 1e-6
    assert sample.speed[:3] == pytest.approx(moved, abs=1e-4)
    assert np.isnan(states.sample(message | {"velocity": []}, 1.0).joint_speeds).all()
    lost = states.sample(message | {"position": [None] * 7}, 1.0)
    assert np.isnan(lost.joints).all() and np.isnan(lost.pose).all()


def test_joint_states_of_other_nodes_are_passed_over_and_a_second_arm_is_refused():
    states = JointStates(CELL)
    arm = {"header": {"stamp": {"sec": 0}}, "velocity": [0.0] * 6,
           "name": [f"{name}_joint" for name in CELL.arm.ros_joints], "position": HOME.tolist()}
    gripper = arm | {"name": ["finger_joint"], "position": [0.4]}
    assert states.sample(gripper, 0.0) is None and states.others == ["finger_joint"]
    assert states.sample(arm, 0.0).joints == pytest.approx(HOME)
    assert states.sample(gripper, 0.0) is None
    both = arm | {"name": ["finger_joint", *arm["name"]], "position": [0.4, *HOME],
                  "velocity": [0.0] * 7}
    assert states.sample(both, 0.0).joints == pytest.approx(HOME)
    second = arm | {"name": [f"second_{name}" for name in arm["name"]]}
    both = arm | {"name": arm["name"] + second["name"], "position": [*HOME, *(HOME + 1.0)]}
    assert states.sample(both, 0.0).joints == pytest.approx(HOME)
    with pytest.raises(InputError, match="2 joints of ROS are named like shoulder_pan"):
        states.sample(second, 0.0)
    with pytest.raises(InputError, match="2 joints of ROS are named like shoulder_pan"):
        JointStates(CELL).sample(both, 0.0)


def test_a_goal_carries_times_and_ends_at_rest():
    path = line(0.02)
    points = goal_of(path, ["a"] * 6)["trajectory"]["points"]
    assert points[0]["velocities"] == points[-1]["velocities"] == [0.0] * 6
    assert points[-1]["positions"] == pytest.approx(path.joints[-1])
    end = points[-1]["time_from_start"]
    assert end["sec"] + 1e-9 * end["nanosec"] == pytest.approx(path.duration)


def test_a_long_path_is_a_small_goal_that_the_controllers_spline_stays_on():
    """There and back five times with rests: a tenth of the points, none of them off the path."""
    out = line(0.1, 0.03)
    path = to_and_fro(out, 0.5, 5)
    points = goal_of(path, ["a"] * 6)["trajectory"]["points"]
    assert len(points) < 0.2 * len(path.times)
    at, joints, speeds = (np.array(column) for column in zip(*((
        point["time_from_start"]["sec"] + 1e-9 * point["time_from_start"]["nanosec"],
        point["positions"], point["velocities"]) for point in points), strict=True))

    def passed(wanted: np.ndarray) -> np.ndarray:
        rows = np.clip(np.searchsorted(at, wanted, side="right") - 1, 0, len(at) - 2)
        return np.array([spline(time, at[k:k + 2], joints[k:k + 2], speeds[k:k + 2])
                         for time, k in zip(wanted, rows, strict=True)])
    assert np.abs(passed(path.times) - path.joints).max() < 6e-5
    # While it rests no spline swings.
    rests = passed(np.linspace(out.duration, out.duration + 0.5, 50)) - out.joints[-1]
    assert np.abs(rests).max() < 1e-6


def test_the_example_node_stops_on_a_word_and_on_silence(monkeypatch):
    """What it decides by; the node itself needs ROS. The package declares all that it needs."""
    package = ROOT / "scripts" / "examples" / "ros2" / "limber_stop"
    monkeypatch.syspath_prepend(str(package))
    from limber_stop.watch import Watch

    watch = Watch(0.3)
    assert not watch.is_silent(100.0)
    assert not watch.heard(False, 100.0) and not watch.is_silent(100.2)
    assert watch.is_silent(100.31) and not watch.is_silent(100.4)
    assert watch.heard(True, 101.0) and not watch.is_silent(102.0)
    watch.heard(False, 103.0)
    watch.ended()
    assert not watch.is_silent(104.0)
    manifest = ElementTree.parse(package / "package.xml")
    declared = {each.text for each in manifest.iter("exec_depend")}
    for path in package.rglob("*.py"):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        imported = {node.module.split(".")[0] for node in ast.walk(tree)
                    if isinstance(node, ast.ImportFrom)}
        imported |= {name.name for node in ast.walk(tree) if isinstance(node, ast.Import)
                     for name in node.names}
        started = {keyword.value.value for node in ast.walk(tree) if isinstance(node, ast.Call)
                   for keyword in node.keywords if keyword.arg == "package"}
        assert imported | started <= declared | {"limber_stop", "setuptools"}, path
    assert BEAT_SECONDS < 0.3 / 2
    # Or rosbridge would hold back every stop while a goal runs.
    assert '"send_action_goals_in_new_thread": True' in (
        package / "launch" / "limber.launch.py").read_text(encoding="utf-8")


def cloud_message(points: np.ndarray, *, big: bool = False) -> dict:
    """As rosbridge sends it: padded points and rows, base64 text."""
    order = ">" if big else "<"
    layout = np.dtype({"names": ["x", "y", "z"], "formats": [f"{order}f4"] * 3,
                       "offsets": [4, 8, 12], "itemsize": 20})
    rows = np.zeros((2, len(points) // 2 + 1), layout)
    for axis, values in zip("xyz", points.T, strict=True):
        rows[axis][:, :-1] = values.reshape(2, -1)
    rows["x"][:, -1] = np.nan
    fields = [{"name": axis, "offset": 4 + 4 * k, "datatype": 7, "count": 1}
              for k, axis in enumerate("xyz")]
    return {"height": 2, "width": rows.shape[1], "fields": fields, "is_bigendian": big,
            "point_step": 20, "row_step": rows.strides[0],
            "data": base64.b64encode(rows.tobytes()).decode()}


@pytest.mark.parametrize("big", [False, True])
def test_a_cloud_comes_in_the_branchs_frame(big):
    """By a camera on the flange: only once it is known where the arm stands."""
    points = np.random.default_rng(1).uniform(-0.3, 0.3, (40, 3)) + [0, 0, 0.8]
    message = cloud_message(points, big=big)
    assert cloud_of(message) == pytest.approx(points, abs=1e-6)
    cell = Cell(robot={"model": "ur5e"}, base={"pose": (0.5, 0.1, 0, 0, 0, 1.2)},
                camera={"pose": (0.05, 0, 0.02, 0, 0, 0.1), "mount": "flange",
                        "range_m": (0.2, 0.9)})
    with RosBridge(HOME) as server:
        bridge = Bridge(server.url)
        camera = CloudTopic(cell, bridge, "/points")
        server.publish("/points", message)
        time.sleep(0.05)
        server.publish("/points", message)
        found = camera.next_cloud()
        bridge.close()
    frame = (matrices(np.array(cell.base.pose)) @ cell.arm.forward(HOME)
             @ matrices(np.array(cell.camera.pose)))
    near = points[points[:, 2] <= 0.9]
    assert 0 < len(near) < 40
    assert found == pytest.approx(near @ frame[:3, :3].T + frame[:3, 3], abs=1e-5)


@pytest.mark.parametrize("change", [
    {"data": "no base64!"}, {"data": "AAAA"}, {"fields": []}, {"point_step": 8}, {"width": 10**9},
    {"height": None}])
def test_what_is_no_cloud_is_refused(change):
    with pytest.raises(InputError, match="no cloud of points"):
        cloud_of(cloud_message(np.ones((4, 3))) | change)
