"""An FT300: its stream's text in any pieces, and Modbus RTU from a pseudo-terminal that answers."""

import os
import socket
import struct
import threading
import time

import numpy as np
import pytest

from limber.cell.cell_file import Cell
from limber.core.errors import WorkError
from limber.robot.driver.force_samples import Ft300Sensor
from limber.robot.interface import Sample
from limber.robot.ur.ft300 import REQUEST, STREAM_PORT, Ft300Line, checked, parsed_message

pty = pytest.importorskip("pty")
SAMPLE = Sample(0, 0, np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6), np.zeros(6), 7, 1, 2, 1.0)


class Line:
    """The sensor's end of a line; a context manager.

    Attributes:
        registers: What it answers, shape [6].
        spoil: Changes an answer's bytes.
    """

    def __init__(self):
        self.registers, self.spoil = [1234, -200, 0, 50, -1500, 7], bytes
        self.requests = 0

    def __enter__(self):
        import tty

        self._ours, theirs = pty.openpty()
        tty.setraw(theirs)
        self.device, self._theirs = os.ttyname(theirs), theirs
        self._thread = threading.Thread(target=self._answer, daemon=True)
        self._thread.start()
        return self

    def __exit__(self, *_exception):
        os.close(self._theirs)
        # Its reading ends with the last user of the line; only then its number may be another's.
        self._thread.join(2.0)
        os.close(self._ours)

    def _answer(self):
        data = b""
        try:
            while True:
                data += os.read(self._ours, 64)
                while REQUEST in data:
                    data = data[data.index(REQUEST) + len(REQUEST):]
                    self.requests += 1
                    told = checked(bytes([9, 3, 12]) + struct.pack(">6h", *self.registers))
                    os.write(self._ours, self.spoil(told))
        except OSError:
            return


def read_soon(line: Ft300Line) -> np.ndarray:
    while (found := line.poll()) is None:  # pytest's own limit ends it
        time.sleep(0.001)
    return found


def test_the_request_is_the_protocols():
    """Slave 9, function 3, six registers from 180 on, and the CRC as in Modbus's own example."""
    assert REQUEST[:6] == bytes([9, 3, 0, 180, 0, 6])
    assert checked(bytes([2, 7])) == bytes([2, 7, 0x41, 0x12])


def test_readings_come_in_newtons_and_turn_into_the_flange():
    cell = Cell(robot={"model": "ur5"}, base={"pose": (0,) * 6},
                sensor={"kind": "ft300_usb", "device": "/dev/x", "pose": (0, 0, 0, 0, 0, np.pi)})
    with Line() as line:
        serial = Ft300Line(line.device)
        assert read_soon(serial) == pytest.approx([12.34, -2.0, 0.0, 0.05, -1.5, 0.007])
        line.registers = [100, 0, 0, 0, 0, 0]
        read_soon(serial)
        assert read_soon(serial) == pytest.approx([1.0, 0, 0, 0, 0, 0])
        serial.close()
        sensor = Ft300Sensor(cell.model_copy(update={"sensor": cell.sensor.model_copy(
            update={"device": line.device})}))
        while np.isnan((reading := sensor.read(SAMPLE)).raw).any():
            time.sleep(0.001)
        assert reading.wrench == pytest.approx([-1.0, 0, 0, 0, 0, 0], abs=1e-9)
        line.spoil = lambda told: b""
        sensor.read(SAMPLE)
        time.sleep(0.08)
        assert sensor.read(SAMPLE).age > 0.05
        sensor.close()


@pytest.mark.parametrize("spoil", [
    lambda told: told[:-1], lambda told: told[:4] + b"\xff" + told[5:], lambda told: b""])
def test_answers_that_are_cut_or_changed_are_no_readings(spoil):
    with Line() as line:
        line.spoil = spoil
        with pytest.raises(WorkError, match="No FT300 answers"):
            Ft300Line(line.device, 0.15)
        assert line.requests > 1
    with pytest.raises(WorkError, match="cannot be opened"):
        Ft300Line("/dev/no-such-line")


@pytest.mark.parametrize("text, good", [
    (" 1.0 , 2.0 , -3.5 , 0.1 , 0.2 , 0.3 ", True), ("1,2,3,4,5", False),
    ("1,2,3,4,5,6,7", False), ("1,2,3,,5,6", False), ("a,b,c,d,e,f", False)])
def test_torn_messages_are_dropped(text, good):
    assert (parsed_message(text) is not None) == good


def test_ft300_messages_in_any_pieces(own_address):
    """A hundred messages cut at random places; the last whole one is the reading."""
    sent = [f"( {k} , {-k} , 3.0 , 0.1 , 0.2 , 0.3 )" for k in range(100)]
    data, rng = "".join(sent).encode(), np.random.default_rng(0)
    cuts = np.sort(rng.choice(len(data), 60, replace=False))
    with socket.create_server((own_address, STREAM_PORT)) as server:
        cell = Cell(robot={"model": "ur5", "address": own_address}, base={"pose": (0,) * 6},
                    sensor={"kind": "ft300"})
        sensor = Ft300Sensor(cell)
        peer, _ = server.accept()
        sample = SAMPLE
        assert np.isnan(sensor.read(sample).wrench).all()
        with peer:
            for piece in np.split(np.frombuffer(data, np.uint8), cuts):
                peer.sendall(piece.tobytes())
                sensor.read(sample)
            threading.Event().wait(0.1)
            reading = sensor.read(sample)
            assert reading.wrench[:3] == pytest.approx([99, -99, 3]) and reading.age < 0.5
        threading.Event().wait(0.1)
        with pytest.raises(ConnectionError):
            sensor.read(sample)
        sensor.close()
