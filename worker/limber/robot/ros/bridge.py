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


_GRIPPER_COMMAND = "control_msgs/action/GripperCommand"
_GOAL = "limber-gripper"
_ACTION_SECONDS = 0.1
_SUCCEEDED = 4  # action_msgs/msg/GoalStatus


def drive(bridge: Bridge, action: str, position: float, effort: float, seconds: float,
          ) -> dict[str, Any]:
    """Move a gripper to a position as its controller counts it [m or rad], with at most ``effort``
    [N] (0: its choice), and wait for ``position``, ``stalled`` (something stopped it) and
    ``reached_goal``. WorkError without result in ``seconds`` [s], or a failed one; ConnectionError
    if the connection was lost."""
    bridge.send(op="send_action_goal", id=_GOAL, action=action, action_type=_GRIPPER_COMMAND,
                feedback=False, args={"command": {"position": position, "max_effort": effort}})
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        message = bridge.receive(_ACTION_SECONDS)
        if message is None or message.get("op") != "action_result" or message.get("id") != _GOAL:
            continue
        values = message.get("values")
        if not message.get("result") or message.get("status", _SUCCEEDED) != _SUCCEEDED or (
                not isinstance(values, dict)):
            raise WorkError(f"The gripper in ROS did not move ({values}).", "",
                            "See its controller's log.")
        return {name: values.get(name) for name in ("position", "stalled", "reached_goal")}
    raise WorkError(f"The gripper in ROS gave no result within {seconds:g} s.",
                    f"The action is {action}.",
                    "Check its name with `ros2 action list`, or raise tool.grip_seconds.")


_TRIGGER = "std_srvs/srv/Trigger"
_SERVICE_SECONDS = 0.2


class TriggerService:
    """Offers a service over a connection to rosbridge of its own until it is closed; a context
    manager. ``act`` is called for each call and returns success and a message."""

    def __init__(self, bridge: Bridge, name: str, act: Callable[[], tuple[bool, str]]):
        self._bridge, self._name, self._act = bridge, name, act
        bridge.send(op="advertise_service", service=name, type=_TRIGGER)

    def __enter__(self) -> "TriggerService":
        return self

    def __exit__(self, *exception: object) -> None:
        if not isinstance(exception[1], ConnectionError):
            self._bridge.send(op="unadvertise_service", service=self._name)

    def answer(self, seconds: float = _SERVICE_SECONDS) -> dict[str, Any] | None:
        """Answer a call if one comes within ``seconds``; return the answer, or None.
        ConnectionError if the connection was lost."""
        message = self._bridge.receive(seconds)
        if message is None or message.get("op") != "call_service" or (
                message.get("service") != self._name):
            return None
        success, told = self._act()
        values = {"success": success, "message": told}
        answer = {"service": self._name, "values": values, "result": True}
        if "id" in message:
            answer["id"] = message["id"]
        self._bridge.send(op="service_response", **answer)
        return values
