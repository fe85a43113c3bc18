"""The retreat as a service of ROS, and a bag that is replayed to the guard."""

import threading
from pathlib import Path

import numpy as np
import pytest
from tests.robot.test_ros import CELL, HOME, line, robot_at
from tests.subjects.commands import answer

from benchmarks.robot_rosbridge import ReplayedBridge, RosBridge
from limber.cell.cell_file import write_cell
from limber.core.errors import SafetyStop

KINDS = {"/joint_states": "sensor_msgs/msg/JointState",
         "/force_torque_sensor_broadcaster/wrench": "geometry_msgs/msg/WrenchStamped"}


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.usefixtures("first_in_line")
def test_a_node_calls_the_retreat_as_a_service(monkeypatch, tmp_path):
    """Slow: there and back in real time. Not armed it answers; armed it goes back, once."""
    monkeypatch.setenv("LIMBER_STATE", str(tmp_path))
    write_cell(tmp_path / "cell.toml", CELL)
    with RosBridge(HOME) as server:
        robot = robot_at(server)
        assert robot.follow(line(0.012))["event"] == "reached"
        robot.close()
        away = server.joints.copy()

        def called(*arguments: str, times: int = 1) -> list[dict]:
            """Answers to calls of the service, which ends with rosbridge's connection."""
            calling = threading.Thread(target=server.call_service, args=("/limber/retreat", times))
            server.answers.clear()
            calling.start()
            code, told = answer("ros", "serve", tmp_path / "cell.toml", "--url", server.url,
                                *arguments)
            calling.join()
            assert code == 4 and told["calls"] == times, told
            return [answer["values"] for answer in server.answers]
        [told] = called()
        assert not told["success"] and "Not armed" in told["message"]
        assert server.joints == pytest.approx(away)
        first, second = called("--arm", "--confirm", "retreat", times=2)
        assert first["success"], first
        assert server.joints == pytest.approx(HOME, abs=2e-3)
        assert not second["success"] and "no path to return along" in second["message"]
        assert {order["id"] for order in server.answers} == {"call-0", "call-1"}


def test_a_service_that_may_move_needs_a_confirmation(tmp_path):
    write_cell(tmp_path / "cell.toml", CELL)
    code, told = answer("ros", "serve", tmp_path / "cell.toml", "--arm")
    assert code == 2 and "Nobody confirmed" in told["error"]


def test_a_moving_arm_is_not_sent_back(monkeypatch, tmp_path):
    """Another program drives it: the way back would be a second motion beside it."""
    monkeypatch.setenv("LIMBER_STATE", str(tmp_path))
    with RosBridge(HOME) as server:
        robot = robot_at(server)
        robot._way.begin(robot.last, line(0.02))
        server.drift = np.full(6, 0.02)
        with pytest.raises(SafetyStop, match="moves already"):
            robot.retreat()
        robot.close()
        assert not any(order["op"] == "send_action_goal" for _, order in server.heard)


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.usefixtures("first_in_line")
def test_a_recorded_bag_is_judged_as_the_robot_was(tmp_path):
    """Slow: twice in real time. A run with a push as a bag in MCAP; its replay stops there too."""
    path = line(0.1)
    with RosBridge(HOME) as server:
        robot = robot_at(server)
        threading.Timer(0.6, setattr, (server, "wrench", np.array([0, 0, 30.0, 0, 0, 0]))).start()
        live = robot.follow(path)
        robot.close()
    assert live["event"] == "stopped" and "force" in live["reason"], live
    write_bag(tmp_path / "run.mcap", server.sent)
    messages = read_bag(tmp_path / "run.mcap")
    assert [topic for _, topic, _ in messages] == [topic for _, topic, _ in server.sent]
    taken = []
    with ReplayedBridge(messages) as replay:
        robot = robot_at(replay, taken)
        again = robot.follow(path)
        robot.close()
    assert again["event"] == "stopped"
    assert again["reason"].split(" of ")[0] == live["reason"].split(" of ")[0]
    pushed = next(seconds for seconds, topic, message in messages
                  if topic.endswith("wrench") and message["wrench"]["force"]["z"] > 20)
    assert pushed <= taken[-1][0] < pushed + 0.1
    assert any(order["op"] == "cancel_action_goal" for _, order in replay.heard)


def write_bag(path: Path, messages: list[tuple[float, str, dict]]) -> None:
    """Messages of rosbridge as ROS records them: CDR in MCAP."""
    from mcap.writer import Writer
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_HUMBLE)

    def made(kind: str, fields: dict):
        content = {}
        for name, (_, of) in store.get_msgdef(kind).fields:
            value = fields[name]
            if isinstance(value, dict):
                value = made(of, value)
            elif isinstance(value, list) and name != "name":
                value = np.array(value, float)
            content[name] = value
        return store.types[kind](**content)
    with open(path, "wb") as stream:
        writer = Writer(stream)
        writer.start(profile="ros2", library="test")
        channels = {}
        for topic, kind in KINDS.items():
            text, _ = store.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, "ros2msg", text.encode())
            channels[topic] = writer.register_channel(topic, "cdr", schema)
        for seconds, topic, content in messages:
            data = bytes(store.serialize_cdr(made(KINDS[topic], content), KINDS[topic]))
            writer.add_message(channels[topic], round(1e9 * seconds), data, round(1e9 * seconds))
        writer.finish()


def read_bag(path: Path) -> list[tuple[float, str, dict]]:
    """Its messages as rosbridge sends them."""
    from rosbags.highlevel import AnyReader

    def plain(message):
        if isinstance(message, np.ndarray):
            return message.tolist()
        if not hasattr(message, "__msgtype__"):
            return message
        return {name: plain(value) for name, value in vars(message).items()
                if name != "__msgtype__"}
    with AnyReader([path]) as reader:
        return [(1e-9 * stamp, connection.topic, plain(reader.deserialize(
            data, connection.msgtype))) for connection, stamp, data in reader.messages()]
