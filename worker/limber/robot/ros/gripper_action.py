"""A gripper in ROS, moved by the action GripperCommand."""

import time
from typing import Any

from limber.core.errors import WorkError
from limber.robot.ros.bridge import Bridge

KIND = "control_msgs/action/GripperCommand"
_GOAL = "limber-gripper"
_LISTEN_SECONDS = 0.1
_SUCCEEDED = 4  # action_msgs/msg/GoalStatus


def drive(bridge: Bridge, action: str, position: float, effort: float, seconds: float,
          ) -> dict[str, Any]:
    """Move a gripper and wait for its result.

    Args:
        action: Name of the action.
        position: As its controller counts it [m or rad].
        effort: Greatest [N]; 0 leaves it to the controller.
        seconds: Longest wait for the result [s].

    Returns:
        ``position``, ``stalled`` (something stopped it) and ``reached_goal``, as it reports them.

    Raises:
        WorkError: no result, or it failed.
        ConnectionError: the connection was lost.
    """
    bridge.send(op="send_action_goal", id=_GOAL, action=action, action_type=KIND, feedback=False,
                args={"command": {"position": position, "max_effort": effort}})
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        message = bridge.receive(_LISTEN_SECONDS)
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
