"""Move a robot through ROS 2 by rosbridge: `limber ros check`, `follow`, `retreat`, `serve`.

Only rosbridge is needed, no ROS on this computer. rosbridge has no password: use it on the robot's
own network alone.
"""

from __future__ import annotations

import time
from contextlib import ExitStack, closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from pydantic import Field

from limber.cli.cell_tool import ArmedTool, CellTool, require_word, views_in_turn
from limber.core.errors import InputError, LimberError, SafetyStop
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About, argument, given, option, required

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.motion.trajectory import Trajectory
    from limber.stages.pulls.record_nudge import Nudge

_SECONDS = 1.0


class _RosTool(CellTool):
    """A command over rosbridge."""

    url: str = option("Address of rosbridge.", "ws://127.0.0.1:9090")


def _confirmed_by(what: str) -> Any:
    return option(f"{what}, to confirm that the robot may move.", panel=False)


class RosCheck(_RosTool):
    """Read joint states, wrenches and the controller's modes, and move nothing."""

    about = About("ros check")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.robot.ros.bridge import Bridge
        from limber.robot.ros.guarded_robot import RosRobot, Topics
        from limber.robot.ros.messages import wrench_topic

        cell = self.cell()
        felt = wrench_topic(cell)
        with closing(Bridge(self.url)) as bridge:
            robot = RosRobot(cell, bridge, Topics())
            ages, forces = robot.watched(_SECONDS)
        assert robot.last is not None
        modes = {name: value for name, value in (
            ("safety_mode", robot.last.safety_mode), ("robot_mode", robot.last.robot_mode),
            ("program_runs", robot.last.program_runs), ("speed_scaling", robot.last.slider))
            if robot.reported}
        return {"url": self.url, "arm": cell.arm.name, "wrench_topic": felt, **modes,
                "joints_rad": robot.last.joints,
                "samples_per_second": len(ages) / _SECONDS,
                "longest_gap_s": float(np.diff(ages).max()) if len(ages) > 1 else None,
                "force_without_tare_n": forces.mean(axis=0), "force_sigma_n": forces.std(axis=0)}


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
        return {"urdf": str(self.output), "srdf": str(srdf), "joints": joint_names(cell.arm),
                "obstacles": len(cell.obstacles)}


class RosScan(_RosTool):
    """Take clouds of a depth camera, in the branch's frame by the cell's [camera].

    A camera on the flange is placed by the arm's joints while it stands. Nothing moves.
    """

    about = About("ros scan", found=("{point_count:,} points from {view_count} views.",),
                  then="limber reconstruct {output} -o {output.stem}.branch")

    topic: str = given("Topic of the camera's clouds (sensor_msgs/msg/PointCloud2).",
                       "/camera/depth/color/points")
    output: Path = given("PLY file to write.", Path("scan.ply"), group="output", short="-o")
    views: int = Field(1, ge=1, le=100, description=(
        "Number of clouds. Between them the arm or the branch is moved, and Enter pressed."))

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.geometry.cloud.cloud import Cloud
        from limber.robot.ros.bridge import Bridge
        from limber.robot.ros.messages import CloudTopic, Topics

        cell, views = self.cell(), views_in_turn(self.views)
        with closing(Bridge(self.url)) as bridge:
            camera = CloudTopic(cell, bridge, self.topic, Topics().joint_states)
            points = np.concatenate([camera.next_cloud() for _ in views])
        if not len(points):
            raise InputError(f"The clouds on {self.topic} have no point within camera.range_m.",
                             "", "Check the camera and [camera] in the cell file.")
        Cloud(points, {}).write_ply(self.output)
        return {"cloud": str(self.output), "point_count": len(points), "view_count": self.views}


class RosFollow(_RosTool, ArmedTool):
    """Follow one leg of a plan by the joint trajectory controller, under the guard.

    A stop, an error and Ctrl-C cancel the goal and publish True on /limber/stop. A websocket is no
    safety channel: run the node of scripts/examples/ros2 beside the controller; it also acts on
    silence.
    """

    about = About("ros follow", moves_robot="when armed")

    branch_folder: Path = argument("The branch folder.")
    name: str = given("Name of the plan.", "path")
    leg: Literal["approach", "path", "return", "leaving"] = given(
        "Part of the motion. Close the gripper after the approach, and open it after the return.",
        "approach")
    speed: float = Field(0.03, description="Speed of the gripper [m/s].")
    confirm: str | None = _confirmed_by("The plan's name")
    unwatched: bool = option(
        "Follow the path also where its forces are too small for the guard to see an empty "
        "gripper, a slip or a broken branch.", False, switch=True, panel=False)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.robot.robot_state import require_weighed
        from limber.robot.ros.bridge import SECONDS
        from limber.robot.ros.messages import wrench_topic
        from limber.stages.paths.execute import ExecutePlan, planned_motion

        wrench_topic(self.cell())
        if self.arm:
            require_weighed(self.cell())
        planned = planned_motion(
            ExecutePlan(branch_folder=self.branch_folder, name=self.name, cell=self.cell_file,
                        speed=self.speed, unwatched=self.unwatched), progress, is_to_move=self.arm)
        motion, result, leg = planned.motion, planned.result, self.leg
        trajectory = {"approach": motion.approach, "path": motion.path,
                      "return": motion.return_path, "leaving": motion.leaving}[leg]
        result |= {"leg": leg, "leg_seconds": trajectory.duration, "armed": self.arm}
        if not self.arm:
            return result
        require_word(self.name, self.confirm)
        began = time.monotonic()
        event = _followed(planned.cell, trajectory, self.url, progress,
                          is_held=leg in ("path", "return"), goes_on=leg == "return",
                          across=planned.across if leg == "path" else None)
        result |= {"reached": event["event"] == "reached", "stop_reason": event.get("reason"),
                   "followed_s": time.monotonic() - began}
        if not result["reached"]:
            raise SafetyStop(f"The robot was stopped: {event['reason']}.",
                             "" if event.get("stands") else
                             f"It did not stand within {SECONDS:g} s.", "Check the branch and "
                             "the robot before anything moves.", result=result)
        return result


class RosRetreat(_RosTool, ArmedTool):
    """Go back along the path followed last while the force falls, judged by its tare.

    The path is on disk, so this works after a stop and after a crash. Exit code 4 where the force
    does not fall: open the gripper then.
    """

    about = About("ros retreat", moves_robot="when armed")

    confirm: str | None = _confirmed_by("The word retreat")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.robot.motion.retreat import followed_path
        from limber.robot.ros.messages import wrench_topic

        cell = self.cell()
        wrench_topic(cell)
        followed = followed_path(cell, "Open the gripper, and free the branch by hand.")
        result: dict[str, Any] = {"armed": self.arm, "tare_known": followed.bias is not None,
                                  "places": len(followed.poses)}
        if not self.arm:
            return result
        require_word("retreat", self.confirm)
        event = _followed(cell, None, self.url, progress, is_held=True)
        result |= {"retreated": event["event"] == "reached", "stop_reason": event.get("reason"),
                   "force_n": event["force_n"]}
        if not result["retreated"]:
            raise SafetyStop(f"The robot was stopped: {event['reason']}.",
                             f"The force on the branch is {event['force_n']:.1f} N.",
                             "Open the gripper, and free the branch by hand.", result=result)
        return result


class RosServe(_RosTool):
    """Offer the retreat as a service in ROS, until Ctrl-C or until rosbridge ends.

    `ros2 service call /limber/retreat std_srvs/srv/Trigger` then does what `limber ros retreat`
    does, and answers how it ended. A call while the arm moves is refused.
    """

    about = About("ros serve", moves_robot="when armed")

    service: str = given("Name of the service (std_srvs/srv/Trigger).", "/limber/retreat")
    arm: bool = option("Move the robot when the service is called. Default: answer what would be "
                       "done.", False, switch=True, panel=False)
    confirm: str | None = _confirmed_by("The word retreat")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.robot.ros.bridge import Bridge, TriggerService
        from limber.robot.ros.messages import wrench_topic

        cell, service = self.cell(), self.service
        wrench_topic(cell)
        if self.arm:
            require_word("retreat", self.confirm, "Whoever calls the service moves it.")
        count = 0
        try:
            with closing(Bridge(self.url)) as bridge, TriggerService(
                    bridge, service, lambda: _answered(self, cell, progress)) as offered:
                progress(0.0, f"offering {service}")
                while True:
                    if (values := offered.answer()) is not None:
                        count += 1
                        progress(0.0, f"{service}: {values['message']}")
        except ConnectionError as error:
            raise SafetyStop(f"{error}.", f"{service} is no longer offered.", "Start it again.",
                             result={"calls": count}) from error


def _answered(asked: RosServe, cell: Cell, progress: Progress) -> tuple[bool, str]:
    """Retreat for a call of the service; whether the branch is free, and in words."""
    from limber.robot.motion.retreat import followed_path

    try:
        way = followed_path(cell, "Open the gripper, and free the branch by hand.")
        if not asked.arm:
            return False, (f"Not armed: it would go back along {len(way.poses)} places. Start "
                           "limber ros serve with --arm.")
        event = _followed(cell, None, asked.url, progress, is_held=True)
    except LimberError as error:
        return False, str(error)
    if event["event"] != "reached":
        return False, (f"Stopped: {event['reason']}. The force on the branch is "
                       f"{event['force_n']:.1f} N. Open the gripper, and free it by hand.")
    return True, f"Back at the start of the path; the force is {event['force_n']:.1f} N."


class RosGripper(_RosTool):
    """Close or open the gripper by its action in ROS; `stalled` tells that it holds something."""

    about = About("ros gripper", moves_robot="when armed")

    position: float = required("Where it moves, as its controller counts [m or rad].", "0.8")
    effort: float = Field(0.0, description="Greatest effort [N]; 0 leaves it to the controller.")
    action: str = given("Name of its action (control_msgs/action/GripperCommand).",
                        "/gripper_controller/gripper_cmd")
    arm: bool = option("Move it. Default: a dry run.", False, switch=True, panel=False)
    confirm: str | None = option("The word gripper, to confirm that it may move.", panel=False)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.robot.ros.bridge import SECONDS, Bridge, drive

        cell = self.cell()
        result: dict[str, Any] = {"armed": self.arm, "action": self.action, "wanted": self.position}
        if not self.arm:
            return result
        require_word("gripper", self.confirm, "A bent branch springs back where it opens.",
                     what="gripper")
        with closing(Bridge(self.url)) as bridge:
            try:
                return result | drive(bridge, self.action, self.position, self.effort,
                                      cell.tool.grip_seconds + SECONDS)
            except ConnectionError as error:
                raise SafetyStop(f"{error}.", "Whether the gripper moved is not known.",
                                 "Check the gripper.") from error


def _followed(cell: Cell, trajectory: Trajectory | None, url: str, progress: Progress, *,
              is_held: bool, goes_on: bool = False, across: Nudge | None = None,
              ) -> dict[str, Any]:
    """Tare, or with the branch held recall the tare, and follow ``trajectory``, None: back along
    the last path; return how that ended. ``goes_on``: a retreat goes back along the leg before as
    well; ``across``: nudge of the held branch before, which shows a wrong sensor."""
    from limber.robot.driver.real_time import claim_real_time, keep_awake
    from limber.robot.ros.bridge import Bridge
    from limber.robot.ros.guarded_robot import RosRobot, Topics

    # Before the connection: the thread that receives has the priority of the one that begins it.
    claim_real_time()
    keep_awake()
    with ExitStack() as around:
        bridge = Bridge(url)
        around.callback(bridge.close)
        try:
            robot = RosRobot(cell, bridge, Topics())
            around.callback(robot.close)
            around.callback(_warn, progress, robot.warnings)
            if trajectory is None or is_held:
                robot.recall_tare()
            else:
                robot.tare(_SECONDS)
            event = {"event": "reached"}
            if across is not None:
                event = robot.follow(across.motion, check=across.check)
                robot.watched(_SECONDS)  # until the branch rests again
            if event["event"] == "reached":
                event = (robot.retreat() if trajectory is None
                         else robot.follow(trajectory, goes_on=goes_on))
        except ConnectionError as error:
            raise SafetyStop(f"{error}.", "Whether the arm stands is not known.",
                             "Check the robot; its stop node acts on silence.") from error
    return event


def _warn(progress: Progress, texts: list[str]) -> None:
    for text in texts:
        progress.warn(text)
