"""The wire: RTDE frames as the maker's guide has them, and the real client on all ports."""

import asyncio
import socket
import struct
import time

import numpy as np
import pytest
from tests.robot.conftest import let_go

from limber.core.errors import InputError, WorkError
from limber.robot.ur import rtde
from limber.robot.ur.ft300 import STREAM_PORT
from limber.robot.virtual.controller import Controller
from limber.robot.virtual.launch import VirtualRobot
from limber.robot.virtual.server import RTDE_PORT, RtdeClient, Server, answer


class Wire(asyncio.Transport):
    """Keeps what a connection sends."""

    def __init__(self):
        super().__init__()
        self.sent = bytearray()

    def is_closing(self) -> bool:
        return False

    def write(self, data: bytes) -> None:
        self.sent += data


def connected(server: Server) -> RtdeClient:
    client = RtdeClient(server)
    client.connection_made(Wire())
    return client


@pytest.fixture
def connection():
    return connected(Server(Controller("ur5e"), "127.0.0.1"))


def replies(connection) -> list[tuple[int, bytes]]:
    return rtde.split_frames(connection.transport.sent)


def test_only_protocol_version_2_is_spoken(connection):
    for version in (1, 2, 3):
        connection.take(rtde.VERSION_REQUEST, struct.pack(">H", version))
    assert replies(connection) == [(ord("V"), b"\0"), (ord("V"), b"\1"), (ord("V"), b"\0")]


def test_unknown_outputs_are_named_and_refused(connection):
    body = struct.pack(">d", 500.0) + b"timestamp,wrong_name"
    connection.take(rtde.OUTPUT_SETUP, body)
    connection.take(rtde.START, b"")
    assert replies(connection) == [(ord("O"), b"\0DOUBLE,NOT_FOUND"), (ord("S"), b"\0")]


def test_names_of_later_versions_are_not_found():
    assert rtde.output_types(["ft_raw_wrench"], (5, 8)) == ["NOT_FOUND"]
    assert rtde.output_types(["ft_raw_wrench"], (5, 9)) == ["VECTOR6D"]
    assert rtde.output_types(["ft_raw_wrench"], (3, 15)) == ["NOT_FOUND"]


def test_an_input_register_has_one_writer(connection):
    other = connected(connection._server)
    connection.take(rtde.INPUT_SETUP, b"input_int_register_0")
    other.take(rtde.INPUT_SETUP, b"input_int_register_0,speed_slider_mask")
    assert replies(connection) == [(ord("I"), b"\1INT32")]
    assert replies(other) == [(ord("I"), b"\0IN_USE,UINT32")]
    connection.connection_lost(None)
    other.take(rtde.INPUT_SETUP, b"input_int_register_0")
    assert replies(other) == [(ord("I"), b"\1INT32")]


def test_data_goes_both_ways_and_short_packages_give_what_is_whole(connection):
    connection.take(rtde.INPUT_SETUP, b"input_int_register_0,input_double_register_0")
    connection.take(rtde.DATA, b"\1" + struct.pack(">id", 7, 0.5))
    controller = connection._server.controller
    assert controller.inputs == {"input_int_register_0": 7, "input_double_register_0": 0.5}
    connection.take(rtde.DATA, b"\1" + struct.pack(">i", 8))
    assert controller.inputs["input_int_register_0"] == 8
    recipe = rtde.Recipe.of(1, ["timestamp", "actual_q", "robot_mode"], rtde.OUTPUT_TYPES)
    (command, body), = rtde.split_frames(bytearray(recipe.packed(controller.outputs())))
    assert command == rtde.DATA and body[0] == 1
    values = recipe.unpacked(body[1:])
    assert values["robot_mode"] == 7 and values["actual_q"] == pytest.approx(controller.joints)


def test_frames_come_whole_however_the_bytes_are_cut():
    data = rtde.frame(ord("U"), b"abc") + rtde.frame(ord("S"), b"")
    buffer, found = bytearray(), []
    for byte in data:
        buffer.append(byte)
        found += rtde.split_frames(buffer)
    assert found == [(ord("U"), b"abc"), (ord("S"), b"")]
    with pytest.raises(ValueError, match="0 bytes"):
        rtde.split_frames(bytearray(b"\0\0U"))


def test_dashboard_refuses_changes_in_local_control():
    controller = Controller("ur5e")
    assert answer(controller, "is in remote control\n") == "true"
    controller.set_remote(False)
    assert answer(controller, "is in remote control\n") == "false"
    assert "not allowed" in answer(controller, "power off\n")
    assert answer(controller, "robotmode\n") == "Robotmode: RUNNING"
    assert answer(Controller("ur5"), "is in remote control\n").startswith("could not understand")
    controller.load_script("def rtde_control():\nend\n")
    assert answer(controller, "running\n") == "Program running: false"


def test_it_listens_on_loopback_only():
    with pytest.raises(InputError, match="outside"):
        Server(Controller("ur5e"), "0.0.0.0")


def test_a_taken_port_is_told(own_address):
    with socket.create_server((own_address, RTDE_PORT)):
        with pytest.raises(WorkError, match="30004"):
            asyncio.run(Server(Controller("ur5e"), own_address).open())


@pytest.mark.slow
def test_a_second_robot_on_the_same_address_is_refused(own_address):
    with VirtualRobot("ur5e", own_address), pytest.raises(WorkError, match="cannot be opened"):
        VirtualRobot("ur5e", own_address)


rtde_control = pytest.importorskip("rtde_control")


def test_the_real_client_moves_it(robot):
    """ur-rtde connects, moves it as the driver does, stops and sets; its answers are true."""
    import dashboard_client
    import rtde_io
    import rtde_receive

    receive = rtde_receive.RTDEReceiveInterface(robot.address)
    control = rtde_control.RTDEControlInterface(robot.address)
    with let_go(control, receive):
        start = np.array(receive.getActualTCPPose())
        for k in range(50):
            assert control.servoL(list(start + [0, 0.0004 * k, 0, 0, 0, 0]), 0.1, 0.1, 0.008, 0.05,
                                  600)
            time.sleep(0.008)
        assert control.servoStop(10.0)
        time.sleep(0.1)
        assert receive.getActualTCPPose()[1] - start[1] == pytest.approx(0.0196, abs=0.006)
        assert not np.any(receive.getActualQd())
        joints = np.array(receive.getActualQ())
        for k in range(50):
            assert control.servoJ(list(joints + [0.002 * k, 0, 0, 0, 0, 0]), 0.1, 0.1, 0.008, 0.05,
                                  600)
            time.sleep(0.008)
        assert control.servoStop(10.0)
        time.sleep(0.1)
        assert receive.getActualQ()[0] - joints[0] == pytest.approx(0.098, abs=0.03)
        assert control.setPayload(0.7, [0, 0, 0.05]) and control.setTcp([0, 0, 0.1, 0, 0, 0])
        assert control.getTCPOffset() == pytest.approx([0, 0, 0.1, 0, 0, 0])
        assert robot.state["payload"] == 0.7

        io = rtde_io.RTDEIOInterface(robot.address)
        assert io.setSpeedSlider(0.5) and io.setStandardDigitalOut(2, True)
        time.sleep(0.1)
        assert receive.getTargetSpeedFraction() == 0.5
        assert receive.getActualDigitalOutputBits() == 4
        dashboard = dashboard_client.DashboardClient(robot.address)
        dashboard.connect()
        assert dashboard.running() and dashboard.robotmode() == "Robotmode: RUNNING"
        dashboard.stop()
        io.disconnect()
        time.sleep(0.1)
        assert not control.setTcp([0.0] * 6)
        assert robot.state["program"] == "STOPPED"


def test_watchdog_and_protective_stop_with_the_real_client(e_series):
    import rtde_receive

    receive = rtde_receive.RTDEReceiveInterface(e_series.address)
    control = rtde_control.RTDEControlInterface(e_series.address)
    with let_go(control, receive):
        start = receive.getActualTCPPose()
        for k in range(25):
            assert control.servoL([start[0], start[1] + 0.0004 * k, *start[2:]], 0.1, 0.1, 0.008,
                                  0.05, 600)
            time.sleep(0.008)
        e_series.ask("protective_stop")
        time.sleep(0.2)
        assert receive.isProtectiveStopped() and not np.any(receive.getActualQd())
        assert not control.setTcp([0.0] * 6)
        e_series.ask("unlock")
        assert control.reuploadScript()
        time.sleep(0.2)
        assert control.setWatchdog(10.0)
        for _ in range(10):
            assert control.kickWatchdog()
            time.sleep(0.02)
        assert e_series.state["program"] == "PLAYING"
        time.sleep(0.25)
        assert e_series.state["program"] == "STOPPED"


def test_the_ft300_stream_is_what_robotiq_sends(cb3):
    with socket.create_connection((cb3.address, STREAM_PORT), 5.0) as stream:
        cb3.ask("added_wrench", wrench=[0, 0, 40.0, 0, 0, 1.0])
        time.sleep(0.1)
        stream.recv(65536)
        text = stream.recv(4096).decode()
        time.sleep(0.2)
        text += stream.recv(65536).decode()
    messages = [m.split(")")[0] for m in text.split("(")[1:-1]]
    rows = np.array([[float(part) for part in m.split(",")] for m in messages])
    assert rows.shape[1] == 6 and 5 < len(rows) < 40
    assert rows[:, 2].mean() == pytest.approx(40.0, abs=10.0)


def test_a_reading_of_the_ft300_may_be_left_out():
    def sent(seed: int) -> list[bool]:
        server, wire = Server(Controller("ur5", seed=seed, ft300=True), "127.0.0.1"), Wire()
        came = []
        for _ in range(5000):
            before = len(wire.sent)
            assert server.send_ft300(wire)
            came.append(len(wire.sent) > before)
        return came

    came = sent(3)
    assert 8 <= came.count(False) <= 35 and came == sent(3) != sent(4)


@pytest.mark.slow
def test_the_process_ends_with_its_parents_pipe(own_address):
    robot = VirtualRobot("ur5e", own_address)
    robot.process.stdin.close()
    assert robot.process.wait(5.0) == 0
    robot.close()
