"""What only ROS has: `limber ros describe`, `scan`, `gripper`, `serve`.

A robot whose robot.address is a rosbridge is moved by the same commands as any other. No ROS is
needed on this computer. rosbridge has no password: use it on the robot's own network alone.
"""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from pydantic import Field

from limber.cli.cell_tool import CellTool, require_word, views_in_turn
from limber.core.errors import InputError, LimberError, SafetyStop
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, given, option

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell

_TRIGGER = "std_srvs/srv/Trigger"
_LISTEN_SECONDS = 0.2


class RosDescribe(CellTool):
    """Write a cell as URDF and SRDF: arm, gripper, camera and obstacles in the branch's frame.

    robot_state_publisher makes TF of it, MoveIt a planning scene; the launch file of
    scripts/examples/ros2 takes it as urdf:=cell.urdf.
    """

    about = About("ros describe")

    output: Path = given("URDF to write; the SRDF is written beside it.", Path("cell.urdf"),
                         group="output", short="-o")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.core.files.atomic import write_atomically
        from limber.robot.ros.cell_description import cell_srdf, cell_urdf, joint_names

        cell, srdf = self.cell(), self.output.with_suffix(".srdf")
        write_atomically(self.output, cell_urdf(cell))
        write_atomically(srdf, cell_srdf(cell))
        return {"urdf": str(self.output), "srdf": str(srdf), "joints": joint_names(cell),
                "obstacles": len(cell.obstacles)}


class RosScan(CellTool):
    """Take clouds of a depth camera, in the branch's frame by the cell's [camera].

    A camera on the flange is placed by the arm's joints while it stands. Nothing moves.
    """

    about = About("ros scan", found=("{point_count:,} points from {view_count} views.",),
                  then="limber reconstruct {output} -o {output.stem}.branch")

    url: str | None = option("Address of rosbridge. Default: robot.address of the cell file.")
    topic: str = given("Topic of the camera's clouds (sensor_msgs/msg/PointCloud2).",
                       "/camera/depth/color/points")
    output: Path = given("PLY file to write.", Path("scan.ply"), group="output", short="-o")
    views: int = Field(1, ge=1, le=100, description=(
        "Number of clouds. Between them the arm or the branch is moved, and Enter pressed."))

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.geometry.cloud.cloud import Cloud
        from limber.robot.ros.messages import Bridge, CloudTopic

        cell, views = self.cell(), views_in_turn(self.views)
        with closing(Bridge(self.url or cell.robot.address)) as bridge:
            camera = CloudTopic(cell, bridge, self.topic)
            points = np.concatenate([camera.next_cloud() for _ in views])
        if not len(points):
            raise InputError(f"The clouds on {self.topic} have no point within camera.range_m.",
                             "", "Check the camera and [camera] in the cell file.")
        Cloud(points, {}).write_ply(self.output)
        return {"cloud": str(self.output), "point_count": len(points), "view_count": self.views}


class RosServe(CellTool):
    """Offer the retreat as a service in ROS, until Ctrl-C or until rosbridge ends.

    `ros2 service call /limber/retreat std_srvs/srv/Trigger` then does what `limber ros retreat`
    does, and answers how it ended. A call while the arm moves is refused.
    """

    about = About("ros serve", moves_robot="when armed")

    service: str = given("Name of the service (std_srvs/srv/Trigger).", "/limber/retreat")
    arm: bool = option("Move the robot when the service is called. Default: answer what would be "
                       "done.", False, switch=True, panel=False)
    confirm: str | None = option("The word retreat, to confirm that the robot may move.",
                                 panel=False)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.robot.ros.topics import Bridge, wrench_topic

        cell, service = self.cell(), self.service
        wrench_topic(cell)
        if self.arm:
            require_word("retreat", self.confirm, "Whoever calls the service moves it.")
        count = 0
        try:
            with closing(Bridge(cell.robot.address)) as bridge:
                bridge.send(op="advertise_service", service=service, type=_TRIGGER)
                progress(0.0, f"offering {service}")
                while True:
                    message = bridge.receive(_LISTEN_SECONDS) or {}
                    if message.get("op") != "call_service" or message.get("service") != service:
                        continue
                    success, told = _answered(self, cell)
                    bridge.send(op="service_response", service=service, result=True,
                                values={"success": success, "message": told}, id=message.get("id"))
                    count += 1
                    progress(0.0, f"{service}: {told}")
        except ConnectionError as error:
            raise SafetyStop(f"{error}.", f"{service} is no longer offered.", "Start it again.",
                             result={"calls": count}) from error


def _answered(asked: RosServe, cell: Cell) -> tuple[bool, str]:
    """Retreat for a call of the service; whether the branch is free, and in words."""
    from limber.robot.driver.link import RobotLink
    from limber.robot.motion.retreat import followed_path

    try:
        way = followed_path(cell, "Open the gripper, and free the branch by hand.")
        if not asked.arm:
            return False, (f"Not armed: it would go back along {len(way.poses)} places. Start "
                           "limber ros serve with --arm.")
        with RobotLink(cell) as link:
            link.wait_for_samples()
            event = link.retreat()
            force = f"{np.linalg.norm(link.wait_for_samples()[13:16]):.1f} N"
    except LimberError as error:
        return False, str(error)
    if event["event"] != "reached":
        return False, (f"Stopped: {event['reason']}. The force on the branch is {force}. Open the "
                       "gripper, and free it by hand.")
    return True, f"Back at the start of the path; the force is {force}."
