"""Starts rosbridge and the stop node: ros2 launch limber_stop limber.launch.py."""

from launch import LaunchDescription
from launch_ros.actions import Node


def generate_launch_description():
    """rosbridge listens on this computer alone; give another address on the robot's own network."""
    return LaunchDescription([
        Node(package="rosbridge_server", executable="rosbridge_websocket",
             parameters=[{"address": "127.0.0.1", "port": 9090}]),
        Node(package="limber_stop", executable="stop_node")])
