"""The topics of a cell in ROS."""

from dataclasses import dataclass

from limber.cell.cell_file import Cell
from limber.core.errors import InputError
from limber.robot.driver.force_sensors import require_sensor
from limber.robot.ros.messages import WRENCH


@dataclass(frozen=True)
class Topics:
    """Names of the robot's topics and actions; by default those of the UR driver.

    ``safety_mode`` to ``slider`` are what a UR arm's driver publishes of its controller.
    """

    joint_states: str = "/joint_states"
    wrench: str = "/force_torque_sensor_broadcaster/wrench"
    stop: str = "/limber/stop"
    end: str = "/limber/end"
    trajectory: str = "/scaled_joint_trajectory_controller/follow_joint_trajectory"
    safety_mode: str = "/io_and_status_controller/safety_mode"
    robot_mode: str = "/io_and_status_controller/robot_mode"
    runtime_state: str = "/io_and_status_controller/robot_program_running"
    slider: str = "/speed_scaling_state_broadcaster/speed_scaling"


_USUAL = Topics()


def wrench_topic(cell: Cell, own: str = _USUAL.wrench) -> str:
    """Return the topic of the cell's force sensor.

    Args:
        own: Topic of the arm's own sensor.

    Raises:
        InputError: the cell names no sensor that is heard in ROS, or a CB3's own estimate.
    """
    require_sensor(cell)
    sensor = cell.sensor
    if sensor.kind == "replay":
        raise InputError(f"The cell file replays forces from {sensor.file}.",
                         "The guard would not feel the branch of the robot in ROS.",
                         "Name the mounted sensor in the cell file.")
    if sensor.kind == "controller":
        return sensor.topic or own
    if sensor.topic is None:
        raise InputError(f"sensor.kind is {sensor.kind}, but the cell file states no sensor.topic.",
                         f"{own} is not that sensor: there the arm's driver publishes the "
                         "controller's own force.",
                         "Set sensor.topic to the topic on which the sensor's node publishes "
                         f"{WRENCH}; `ros2 topic list -t` lists it.")
    # Under a name space too.
    if cell.arm.controller == "ur" and sensor.topic.split("/")[-2:] == own.split("/")[-2:]:
        measures = cell.arm.measures_force
        raise InputError(f"sensor.kind is {sensor.kind}, but sensor.topic is {sensor.topic}.",
                         "There the UR driver publishes the controller's own force" + (
                             "." if measures else ", which a CB3 estimates from motor currents."),
                         "Set sensor.topic to the topic of the sensor's own node" + (
                             ", or sensor.kind to controller." if measures else "."))
    return sensor.topic
