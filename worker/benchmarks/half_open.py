"""A cable to a robot that can be cut in one direction: connections stay, sent data vanishes.

The relay is a process of its own, ``python -m benchmarks.half_open ADDRESS ROBOT``, since a delay
of its parent would delay the robot. It reads directions to cut as lines of JSON on standard input
and ends with it.
"""

import json
import selectors
import socket
import sys
from typing import Literal

from limber.core.processes.child import Child
from limber.robot.driver.real_time import (
    VIRTUAL_ROBOT_PRIORITY,
    claim_real_time,
    spare_what_is_loaded,
)

Direction = Literal["to the robot", "from the robot"]
DIRECTIONS: tuple[Direction, ...] = ("to the robot", "from the robot")
_PORTS = (30004, 30003, 29999)  # of e-Series arms; importing them would load the whole controller
_CONNECT_SECONDS, _START_SECONDS = 1.0, 30.0


class Cable:
    """A relay from one loopback address to another; a context manager.

    Args:
        address: Where clients connect.
        robot: Where the controller listens.
    """

    def __init__(self, address: str, robot: str):
        self.address = address
        self._child = Child([sys.executable, "-m", "benchmarks.half_open", address, robot])
        self._hear()

    def __enter__(self) -> "Cable":
        return self

    def __exit__(self, *_exception: object) -> None:
        self._child.close()

    def cut(self, direction: Direction) -> None:
        """From now on, data sent in ``direction`` vanishes, also on new connections."""
        self._child.send({"cut": direction})
        self._hear()

    def _hear(self) -> None:
        if self._child.wait(self._child.first, _START_SECONDS) is None:
            raise RuntimeError("the relay has ended")


class _Relay:
    def __init__(self, address: str, robot: str):
        self._robot = robot
        self._cut: set[str] = set()
        self._selector = selectors.DefaultSelector()
        for port in _PORTS:
            self._selector.register(socket.create_server((address, port)),
                                    selectors.EVENT_READ, port)
        self._selector.register(sys.stdin, selectors.EVENT_READ)

    def run(self) -> None:
        print("{}", flush=True)
        while True:
            for key, _ in self._selector.select():
                if key.fileobj is sys.stdin:
                    if not (line := sys.stdin.readline()):
                        return
                    self._cut.add(json.loads(line)["cut"])
                    print("{}", flush=True)
                elif isinstance(key.data, int):
                    self._accept(key.fileobj, key.data)
                elif key.fileobj in self._selector.get_map():
                    self._pass(key.fileobj, *key.data)

    def _accept(self, listener: socket.socket, port: int) -> None:
        client, _ = listener.accept()
        robot = socket.create_connection((self._robot, port), _CONNECT_SECONDS)
        for near, far, direction in ((client, robot, "to the robot"),
                                     (robot, client, "from the robot")):
            near.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._selector.register(near, selectors.EVENT_READ, (far, direction))

    def _pass(self, near: socket.socket, far: socket.socket, direction: str) -> None:
        try:
            data = near.recv(65536)
            if data and direction not in self._cut:
                far.sendall(data)
        except ConnectionError:
            # One of the two was closed: pass that on.
            data = b""
        if not data:
            for end in (near, far):
                self._selector.unregister(end)
                end.close()


if __name__ == "__main__":
    claim_real_time(VIRTUAL_ROBOT_PRIORITY)
    relay = _Relay(*sys.argv[1:])
    spare_what_is_loaded()
    relay.run()
