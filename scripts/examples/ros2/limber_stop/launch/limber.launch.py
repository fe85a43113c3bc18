"""Starts rosbridge and the stop node: ros2 launch limber_stop limber.launch.py.

With urdf:=cell.urdf (limber ros describe) it publishes the cell's frames as TF too. Leave that out
where the robot's own driver publishes them.
"""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import Command, LaunchConfiguration, PythonExpression
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue


def generate_launch_description():
    """rosbridge listens on this computer alone; give another address on the robot's own network."""
    urdf = LaunchConfiguration("urdf")
    return LaunchDescription([
        DeclareLaunchArgument("urdf", default_value=""),
        Node(package="rosbridge_server", executable="rosbridge_websocket",
             # Or a running goal blocks whatever comes after it, its own cancel too.
             parameters=[{"address": "127.0.0.1", "port": 9090,
                          "send_action_goals_in_new_thread": True}]),
        Node(package="limber_stop", executable="stop_node"),
        Node(package="robot_state_publisher", executable="robot_state_publisher",
             condition=IfCondition(PythonExpression(["'", urdf, "' != ''"])),
             parameters=[{"robot_description": ParameterValue(Command(["cat ", urdf]),
                                                              value_type=str)}])])
