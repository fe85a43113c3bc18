"""A service of ROS (std_srvs/srv/Trigger) that is answered here, through rosbridge."""

from collections.abc import Callable
from typing import Any

from limber.robot.ros.bridge import Bridge

KIND = "std_srvs/srv/Trigger"
_LISTEN_SECONDS = 0.2


class TriggerService:
    """Offers a service until it is closed; a context manager.

    Args:
        bridge: Connection to rosbridge, which this service alone uses.
        name: Of the service.
        act: Called for each call; returns success and a message.
    """

    def __init__(self, bridge: Bridge, name: str, act: Callable[[], tuple[bool, str]]):
        self._bridge, self._name, self._act = bridge, name, act
        bridge.send(op="advertise_service", service=name, type=KIND)

    def __enter__(self) -> "TriggerService":
        return self

    def __exit__(self, *exception: object) -> None:
        if not isinstance(exception[1], ConnectionError):
            self._bridge.send(op="unadvertise_service", service=self._name)

    def answer(self, seconds: float = _LISTEN_SECONDS) -> dict[str, Any] | None:
        """Answer a call if one comes within ``seconds``; return the answer, or None.

        Raises:
            ConnectionError: the connection was lost.
        """
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
