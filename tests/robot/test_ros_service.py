"""The retreat as a service of ROS, other commands, and a run that is replayed to the guard."""

import json
import threading
from collections import deque

import numpy as np
import pytest
from tests.robot.test_ros import CELL, HOME, line, linked
from tests.subjects.commands import answer

from benchmarks.robot_ros_stepped import SteppedRos
from benchmarks.robot_rosbridge import STEP, RosBridge
from limber.cell.cell_file import write_cell
from limber.robot.driver.link import RobotLink


@pytest.mark.slow
@pytest.mark.real_time
@pytest.mark.usefixtures("first_in_line")
def test_a_node_calls_the_retreat_as_a_service(monkeypatch, tmp_path):
    """Slow: there and back in real time. Not armed it answers; armed it goes back, once."""
    monkeypatch.setenv("LIMBER_STATE", str(tmp_path))
    with RosBridge(HOME) as server:
        write_cell(tmp_path / "cell.toml", CELL.model_copy(update={
            "robot": CELL.robot.model_copy(update={"address": server.url})}))
        with linked(server) as link:
            assert link.follow(line(0.012))["event"] == "reached"
        away = server.joints.copy()

        def called(*arguments: str, times: int = 1) -> list[dict]:
            """Answers to calls of the service, which ends with rosbridge's connection."""
            calling = threading.Thread(target=server.call_service, args=("/limber/retreat", times))
            server.answers.clear()
            calling.start()
            code, told = answer("ros", "serve", tmp_path / "cell.toml", *arguments)
            calling.join()
            assert code == 4 and told["calls"] == times, told
            return [answer["values"] for answer in server.answers]
        [told] = called()
        assert not told["success"] and "Not armed" in told["message"]
        assert server.joints == pytest.approx(away)
        first, second = called("--arm", "--confirm", "retreat", times=2)
        assert first["success"], first
        assert server.joints == pytest.approx(HOME, abs=2e-3)
        assert not second["success"] and "no path to return" in second["message"]
        assert {order["id"] for order in server.answers} == {"call-0", "call-1"}


def test_a_service_that_may_move_needs_a_confirmation(tmp_path):
    write_cell(tmp_path / "cell.toml", CELL)
    code, told = answer("ros", "serve", tmp_path / "cell.toml", "--arm")
    assert code == 2 and "Nobody confirmed" in told["error"]


class ReplayedBridge(RosBridge):
    """Sends recorded messages at their times; its arm moves as it was recorded.

    Args:
        messages: Times [s], topics and contents, by time.
    """

    def __init__(self, messages):
        super().__init__(np.zeros(6))
        self._messages = deque(messages)

    def turn(self, socket, count, told):
        self._send_status(socket, told)
        while self._messages and self._messages[0][0] < (count + 0.5) * STEP:
            _, topic, message = self._messages.popleft()
            socket.send(json.dumps({"op": "publish", "topic": topic, "msg": message}))


def test_a_replayed_run_is_judged_as_the_robot_was():
    """A run with a push; what was sent, replayed, stops there too."""
    def stopped(robot: SteppedRos) -> dict:
        with robot.here(), RobotLink(CELL) as link:
            link.wait_for_samples()
            link.tare()
            event = link.follow(line(0.1))
        assert any(order["op"] == "cancel_action_goal" for _, order in robot.server.heard)
        return {key: event.get(key) for key in ("event", "reason", "clock")}
    robot = SteppedRos(RosBridge(HOME), lambda step: step == 75 and setattr(
        robot.server, "wrench", np.array([0, 0, 30.0, 0, 0, 0])))
    live, sent = stopped(robot), robot.server.sent
    assert live["event"] == "stopped" and "force" in live["reason"], live
    assert stopped(SteppedRos(ReplayedBridge(sent))) == live


def test_the_commands_of_any_robot_check_weigh_and_move_one_in_ros(monkeypatch, tmp_path):
    """The sensor feels 1.2 kg at the flange, which its driver does not compute away."""
    monkeypatch.setenv("LIMBER_STATE", str(tmp_path))
    cell = CELL.model_copy(update={"sensor": CELL.sensor.model_copy(update={
        "kind": "ft300", "topic": "/ft300/wrench"}), "tool": CELL.tool.model_copy(update={
            "mass_kg": 1.2, "centre_of_mass_m": (0.0, 0.0, 0.05)})})
    write_cell(tmp_path / "cell.toml", cell)
    server = RosBridge(HOME + [0.1, 0, 0, 0, 0, 0])
    server.wrench_topic = "/ft300/wrench"

    def weight(joints: np.ndarray) -> np.ndarray:
        force = CELL.arm.forward(joints)[:3, :3].T @ [0.0, 0.0, -9.81 * 1.2]
        return np.r_[force, np.cross([0.0, 0.0, 0.05], force)]
    server.load = weight
    with SteppedRos(server).here():
        code, told = answer("robot", "check", tmp_path / "cell.toml")
        assert code == 0 and told["samples_per_second"] == pytest.approx(125, abs=3)
        assert told["differences"] == [] and told["wrench_topic"] == "/ft300/wrench"
        code, told = answer("robot", "weigh", tmp_path / "cell.toml", "--arm", "--confirm", "weigh")
        assert code == 0 and told["mass_kg"] == pytest.approx(1.2, abs=0.02), told
        code, told = answer("robot", "home", tmp_path / "cell.toml", "--arm", "--confirm", "home")
        assert code == 0 and told["reached"], told
    assert server.joints == pytest.approx(HOME, abs=1e-4)
