"""A client of rosbridge: JSON over a websocket (rosbridge_suite, "rosbridge v2 Protocol").

The maintained package websockets transports it, and every wait has a limit. roslibpy has the same
protocol, but through a reactor (Twisted) that a process can start only once and whose thread
delivers messages without their time of arrival.
"""

import json
import time
from collections.abc import Callable
from contextlib import ExitStack
from typing import Any

from limber.core.errors import WorkError
from limber.core.json_values import json_object
from limber.core.optional import require_extra

SECONDS = 2.0
"""Longest wait for any answer."""


class Bridge:
    """A connection to a rosbridge server, such as ``ws://127.0.0.1:9090``; WorkError if it does not
    answer, or websockets is not installed."""

    def __init__(self, url: str):
        require_extra("ros", ("websockets",), "The door to ROS 2")
        from websockets.exceptions import InvalidHandshake, InvalidURI
        from websockets.sync.client import connect

        self.url, self._around = url, ExitStack()
        try:
            # Uncompressed: a sample is small, and a stop must not be delayed.
            self._socket = self._around.enter_context(connect(
                url, open_timeout=SECONDS, close_timeout=0.5, ping_interval=None,
                compression=None, proxy=None))
        except (OSError, TimeoutError, InvalidHandshake, InvalidURI) as error:
            raise WorkError(f"No rosbridge answers at {url} ({error}).",
                            "Limber reaches ROS 2 through it.",
                            "Start it: ros2 launch rosbridge_server rosbridge_websocket_launch.xml "
                            "send_action_goals_in_new_thread:=true (see scripts/examples/ros2).",
                            ) from error

    def send(self, **content: Any) -> None:
        """Send an operation; ConnectionError if the connection was lost."""
        from websockets.exceptions import ConnectionClosed

        try:
            self._socket.send(json.dumps(content))
        except (ConnectionClosed, OSError) as error:
            raise ConnectionError(f"the connection to {self.url} was lost") from error

    def receive(self, seconds: float) -> dict[str, Any] | None:
        """Return the next message, None if none arrived in ``seconds`` [s]; ConnectionError if the
        connection was lost."""
        from websockets.exceptions import ConnectionClosed

        end = time.monotonic() + seconds
        while True:
            try:
                text = self._socket.recv(max(end - time.monotonic(), 0.0))
            except TimeoutError:
                return None
            except (ConnectionClosed, OSError) as error:
                raise ConnectionError(f"the connection to {self.url} was lost") from error
            if (content := json_object(text)) is not None:
                return content

    def subscribe(self, topic: str, kind: str) -> None:
        """Subscribe to all messages of a topic."""
        self.send(op="subscribe", topic=topic, type=kind, throttle_rate=0, queue_length=0)

    def advertise(self, topic: str, kind: str) -> None:
        """Advertise a topic that is published from here."""
        self.send(op="advertise", topic=topic, type=kind)

    def close(self) -> None:
        """Close the connection."""
        self._around.close()


_CALL = "limber-call"


def call(bridge: Bridge, service: str, kind: str, take: Callable[[dict[str, Any]], None],
         values: dict[str, Any]) -> None:
    """Call a service and wait for its answer, while ``take`` gets all other messages; WorkError
    without one within :data:`SECONDS`, or where it reports no success."""
    bridge.send(op="call_service", id=_CALL, service=service, type=kind, args=values)
    end = time.monotonic() + SECONDS
    while (left := end - time.monotonic()) > 0.0:
        message = bridge.receive(left) or {}
        if message.get("op") == "service_response" and message.get("id") == _CALL:
            answered = message.get("values")
            if message.get("result") and isinstance(answered, dict) and answered.get("success"):
                return
            raise WorkError(f"{service} refused ({answered}).", "", "See the driver's log.")
        if message:
            take(message)
    raise WorkError(f"{service} gave no answer within {SECONDS:g} s.", "",
                    "Check its name with `ros2 service list`.")


