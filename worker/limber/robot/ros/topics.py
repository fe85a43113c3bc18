"""Names of a robot's topics and actions in ROS, as its cell states them."""

from dataclasses import dataclass, fields

from limber.cell.cell_file import Cell
from limber.core.errors import InputError
from limber.robot.interface import require_sensor
from limber.robot.ros.bridge import Bridge

WRENCH = "geometry_msgs/msg/WrenchStamped"


@dataclass(frozen=True)
class Topics:
    """Names of the robot's topics and actions, by default the UR driver's; ``output`` is
    trajectory, servo, which streams to ``jog``, or twist, which streams to ``twist`` in the axes
    of ``twist_frame``, the controller's base in TF; ``safety_mode`` to ``slider`` are what a UR
    arm's driver publishes of its controller, ``prefix`` that of its joints' names."""

    prefix: str = ""
    joint_states: str = "/joint_states"
    wrench: str = "/force_torque_sensor_broadcaster/wrench"
    output: str = "trajectory"
    jog: str = "/servo_node/delta_joint_cmds"
    twist: str = "/servo_node/delta_twist_cmds"
    twist_frame: str = "base"
    stop: str = "/limber/stop"
    end: str = "/limber/end"
    trajectory: str = "/scaled_joint_trajectory_controller/follow_joint_trajectory"
    safety_mode: str = "/io_and_status_controller/safety_mode"
    robot_mode: str = "/io_and_status_controller/robot_mode"
    runtime_state: str = "/io_and_status_controller/robot_program_running"
    slider: str = "/speed_scaling_state_broadcaster/speed_scaling"
    gripper: str = "/gripper_controller/gripper_cmd"
    gripper_closed: str = "0.8"
    gripper_open: str = "0.0"
    set_payload: str = "/io_and_status_controller/set_payload"

    @classmethod
    def of_cell(cls, cell: Cell) -> "Topics":
        """Return the names as a cell's [robot.ros] states them, in its ``namespace``; InputError
        for a name that is none of them."""
        stated = dict(cell.robot.ros)
        space = stated.pop("namespace", "").strip("/")
        known = {each.name: str(each.default) for each in fields(cls)}
        if unknown := [name for name in stated if name not in known]:
            raise InputError(f"[robot.ros] states {', '.join(unknown)}.", "",
                             f"Known are namespace, {', '.join(known)}.")
        if stated.get("output", "servo") not in ("trajectory", "servo", "twist"):
            raise InputError(f"robot.ros.output is {stated['output']}.", "",
                             "It is trajectory, servo or twist.")
        return cls(**{name: f"/{space}{usual}" if space and usual.startswith("/") else usual
                      for name, usual in known.items()} | stated)


def grip_by_action(cell: Cell, bridge: Bridge, close: bool) -> None:
    """Send a gripper to its stated place, without waiting; InputError if it has no action."""
    if cell.tool.gripper != "ros":
        raise InputError("Limber does not drive the cell's gripper through ROS.",
                         f"tool.gripper is {cell.tool.gripper}.", "Use ros or by_hand.")
    topics = Topics.of_cell(cell)
    position = float(topics.gripper_closed if close else topics.gripper_open)
    bridge.send(op="send_action_goal", id="limber-gripper", action=topics.gripper, feedback=False,
                action_type="control_msgs/action/GripperCommand",
                args={"command": {"position": position, "max_effort": 0.0}})


def is_ros(cell: Cell) -> bool:
    """Whether a cell's robot is reached through rosbridge."""
    return cell.robot.address.startswith(("ws://", "wss://"))


def wrench_topic(cell: Cell, own: str = Topics.wrench) -> str:
    """Return the topic of the cell's force sensor, ``own`` for the arm's; InputError if the cell
    names none that is heard in ROS, or a CB3's own estimate."""
    require_sensor(cell)
    sensor = cell.sensor
    is_ur = cell.arm.controller == "ur"
    if sensor.kind == "controller" and (is_ur or sensor.topic):
        return sensor.topic or own
    if sensor.topic is None:
        raise InputError(f"sensor.kind is {sensor.kind}, but the cell file states no sensor.topic.",
                         f"On {own} a UR arm's driver publishes its controller's own force, and "
                         "nothing else does.", "Set sensor.topic to the topic on which the "
                         f"sensor's node publishes {WRENCH}; `ros2 topic list -t` lists it.")
    # Under a name space too.
    if is_ur and sensor.topic.split("/")[-2:] == own.split("/")[-2:]:
        measures = cell.arm.measures_force
        raise InputError(f"sensor.kind is {sensor.kind}, but sensor.topic is {sensor.topic}.",
                         "There the UR driver publishes the controller's own force" + (
                             "." if measures else ", which a CB3 estimates from motor currents."),
                         "Set sensor.topic to the topic of the sensor's own node" + (
                             ", or sensor.kind to controller." if measures else "."))
    return sensor.topic
