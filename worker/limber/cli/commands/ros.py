"""Move a robot through ROS 2 by rosbridge: `limber ros check`, `follow`, `retreat`, `serve`."""

from __future__ import annotations

import sys
import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np

from limber.cli.main import Run, stage_command
from limber.core.errors import Option, Text

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.motion.trajectory import Trajectory
    from limber.stages.pulls.record_nudge import Nudge

_SECONDS = 1.0
_LEGS = ("approach", "path", "return", "leaving")


@click.group("ros")
def command() -> None:
    """Move a robot through ROS 2; only rosbridge is needed, no ROS on this computer.

    rosbridge has no password: use it on the robot's own network alone.
    """


def _url(function: Any) -> Any:
    return click.option("--url", default="ws://127.0.0.1:9090", show_default=True,
                        help="Address of rosbridge.")(function)


@stage_command("check")
@click.argument("cell_file", type=click.Path(path_type=Path))
@_url
def check(run: Run, cell_file: Path, url: str) -> dict[str, Any]:
    """Read joint states, wrenches and the controller's modes, and move nothing."""
    from limber.cell.cell_file import read_cell
    from limber.robot.ros.bridge import Bridge
    from limber.robot.ros.guarded_robot import RosRobot, Topics
    from limber.robot.ros.messages import wrench_topic

    cell = read_cell(cell_file)
    felt = wrench_topic(cell)
    bridge = Bridge(url)
    try:
        robot = RosRobot(cell, bridge, Topics())
        ages, forces = robot.watched(_SECONDS)
    finally:
        bridge.close()
    assert robot.last is not None
    modes = {name: value for name, value in (
        ("safety_mode", robot.last.safety_mode), ("robot_mode", robot.last.robot_mode),
        ("program_runs", robot.last.program_runs), ("speed_scaling", robot.last.slider))
        if robot.reported}
    return {"url": url, "arm": cell.arm.name, "wrench_topic": felt, **modes,
            "joints_rad": robot.last.joints,
            "samples_per_second": len(ages) / _SECONDS,
            "longest_gap_s": float(np.diff(ages).max()) if len(ages) > 1 else None,
            "force_without_tare_n": forces.mean(axis=0), "force_sigma_n": forces.std(axis=0)}


@stage_command("describe")
@click.argument("cell_file", type=click.Path(path_type=Path))
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("cell.urdf"),
              show_default=True, help="URDF to write; the SRDF is written beside it.")
def describe(run: Run, cell_file: Path, output: Path) -> dict[str, Any]:
    """Write a cell as URDF and SRDF: arm, gripper, camera and obstacles in the branch's frame.

    robot_state_publisher makes TF of it, MoveIt a planning scene; the launch file of
    scripts/examples/ros2 takes it as urdf:=cell.urdf.
    """
    from limber.cell.cell_file import read_cell
    from limber.core.files.atomic import write_atomically
    from limber.robot.ros.cell_description import cell_srdf, cell_urdf, joint_names

    cell = read_cell(cell_file)
    srdf = output.with_suffix(".srdf")
    write_atomically(output, cell_urdf(cell))
    write_atomically(srdf, cell_srdf(cell))
    return {"urdf": str(output), "srdf": str(srdf), "joints": joint_names(cell.arm),
            "obstacles": len(cell.obstacles)}


@stage_command("scan")
@click.argument("cell_file", type=click.Path(path_type=Path))
@click.option("--topic", default="/camera/depth/color/points", show_default=True,
              help="Topic of the camera's clouds (sensor_msgs/msg/PointCloud2).")
@click.option("-o", "--output", type=click.Path(path_type=Path), default=Path("scan.ply"),
              show_default=True, help="PLY file to write.")
@click.option("--views", default=1, show_default=True, help="Number of clouds. Between them the "
              "arm or the branch is moved, and Enter pressed.")
@_url
def scan(run: Run, cell_file: Path, topic: str, output: Path, views: int, url: str,
         ) -> dict[str, Any]:
    """Take clouds of a depth camera, in the branch's frame by the cell's [camera].

    A camera on the flange is placed by the arm's joints while it stands. Nothing moves.
    """
    import shlex

    from limber.cell.cell_file import read_cell
    from limber.core.errors import InputError
    from limber.geometry.cloud.cloud import Cloud
    from limber.robot.ros.bridge import Bridge
    from limber.robot.ros.messages import CloudTopic, Topics

    cell = read_cell(cell_file)
    if views > 1 and not sys.stdin.isatty():
        raise InputError(Text(Option("views", views), " needs a terminal, and standard input is "
                              "none."), "",
                         "Run it in a terminal, or take one view at a time.")
    found = []
    bridge = Bridge(url)
    try:
        camera = CloudTopic(cell, bridge, topic, Topics().joint_states)
        for number in range(views):
            if number:
                input(f"View {number + 1} of {views}: move the camera, then press Enter ")
            found.append(camera.next_cloud())
    finally:
        bridge.close()
    points = np.concatenate(found)
    if not len(points):
        raise InputError(f"The clouds on {topic} have no point within camera.range_m.", "",
                         "Check the camera and [camera] in the cell file.")
    Cloud(points, {}).write_ply(output)
    run.close(f"{len(points):,} points from {views} views.", where=output,
              then=f"limber reconstruct {shlex.quote(str(output))} -o "
              f"{shlex.quote(output.stem)}.branch")
    return {"cloud": str(output), "point_count": len(points), "view_count": views}


@stage_command("follow")
@click.argument("cell_file", type=click.Path(path_type=Path))
@click.argument("branch_folder", type=click.Path(path_type=Path))
@click.option("--name", default="path", show_default=True, help="Name of the plan.")
@click.option("--leg", type=click.Choice(_LEGS), default="approach", show_default=True,
              help="Part of the motion. Close the gripper after the approach, and open it after "
              "the return.")
@click.option("--speed", default=0.03, show_default=True, help="Speed of the gripper [m/s].")
@click.option("--arm", "armed", is_flag=True, help="Move the robot. Default: a dry run.")
@click.option("--confirm", help="The plan's name, to confirm that the robot may move.")
@click.option("--unwatched", is_flag=True, help="Follow the path also where its forces are too "
              "small for the guard to see an empty gripper, a slip or a broken branch.")
@_url
def follow(run: Run, cell_file: Path, branch_folder: Path, name: str, leg: str, speed: float,
           armed: bool, confirm: str | None, unwatched: bool, url: str) -> dict[str, Any]:
    """Follow one leg of a plan by the joint trajectory controller, under the guard.

    A stop, an error and Ctrl-C cancel the goal and publish True on /limber/stop. A websocket is no
    safety channel: run the node of scripts/examples/ros2 beside the controller; it also acts on
    silence.
    """
    from limber.cell.cell_file import read_cell
    from limber.core.errors import InputError, SafetyStop
    from limber.robot.robot_state import require_weighed
    from limber.robot.ros.bridge import SECONDS
    from limber.robot.ros.messages import wrench_topic
    from limber.stages.paths.execute import ExecutePlan, planned_motion

    wrench_topic(read_cell(cell_file))
    if armed:
        require_weighed(read_cell(cell_file))
    planned = planned_motion(
        ExecutePlan(branch_folder=branch_folder, name=name, cell=cell_file, speed=speed,
                    unwatched=unwatched), run.progress, is_to_move=armed)
    cell, motion, result = planned.cell, planned.motion, planned.result
    trajectory = {"approach": motion.approach, "path": motion.path, "return": motion.return_path,
                  "leaving": motion.leaving}[leg]
    result |= {"leg": leg, "leg_seconds": trajectory.duration, "armed": armed}
    if not armed:
        return result
    if confirm != name:
        raise InputError("Nobody confirmed that the robot may move.", "",
                         "Give ", Option("confirm", name), ", with the workspace free and a hand "
                         "at the emergency stop.")
    began = time.monotonic()
    event = _followed(run, cell, trajectory, url, is_held=leg in ("path", "return"),
                      goes_on=leg == "return", across=planned.across if leg == "path" else None)
    result |= {"reached": event["event"] == "reached", "stop_reason": event.get("reason"),
               "followed_s": time.monotonic() - began}
    if not result["reached"]:
        raise SafetyStop(f"The robot was stopped: {event['reason']}.", "" if event.get("stands")
                         else f"It did not stand within {SECONDS:g} s.", "Check the branch and the "
                         "robot before anything moves.", result=result)
    return result


@stage_command("retreat")
@click.argument("cell_file", type=click.Path(path_type=Path))
@click.option("--arm", "armed", is_flag=True, help="Move the robot. Default: a dry run.")
@click.option("--confirm", help="The word retreat, to confirm that the robot may move.")
@_url
def retreat(run: Run, cell_file: Path, armed: bool, confirm: str | None, url: str,
            ) -> dict[str, Any]:
    """Go back along the path followed last while the force falls, judged by its tare.

    The path is on disk, so this works after a stop and after a crash. Exit code 4 where the force
    does not fall: open the gripper then.
    """
    from limber.cell.cell_file import read_cell
    from limber.core.errors import InputError, SafetyStop
    from limber.robot.motion.retreat import followed_path
    from limber.robot.ros.messages import wrench_topic

    cell = read_cell(cell_file)
    wrench_topic(cell)
    followed = followed_path(cell, "Open the gripper, and free the branch by hand.")
    result: dict[str, Any] = {"armed": armed, "tare_known": followed.bias is not None,
                              "places": len(followed.poses)}
    if not armed:
        return result
    if confirm != "retreat":
        raise InputError("Nobody confirmed that the robot may move.", "", "Give ",
                         Option("confirm", "retreat"), ", with a hand at the emergency stop.")
    event = _followed(run, cell, None, url, is_held=True)
    result |= {"retreated": event["event"] == "reached", "stop_reason": event.get("reason"),
               "force_n": event["force_n"]}
    if not result["retreated"]:
        raise SafetyStop(f"The robot was stopped: {event['reason']}.",
                         f"The force on the branch is {event['force_n']:.1f} N.",
                         "Open the gripper, and free the branch by hand.", result=result)
    return result


@stage_command("serve")
@click.argument("cell_file", type=click.Path(path_type=Path))
@click.option("--service", default="/limber/retreat", show_default=True,
              help="Name of the service (std_srvs/srv/Trigger).")
@click.option("--arm", "armed", is_flag=True, help="Move the robot when the service is called. "
              "Default: answer what would be done.")
@click.option("--confirm", help="The word retreat, to confirm that the robot may move.")
@_url
def serve(run: Run, cell_file: Path, service: str, armed: bool, confirm: str | None, url: str,
          ) -> dict[str, Any]:
    """Offer the retreat as a service in ROS, until Ctrl-C or until rosbridge ends.

    `ros2 service call /limber/retreat std_srvs/srv/Trigger` then does what `limber ros retreat`
    does, and answers how it ended. A call while the arm moves is refused.
    """
    from limber.cell.cell_file import read_cell
    from limber.core.errors import InputError, SafetyStop
    from limber.robot.ros.bridge import Bridge, TriggerService
    from limber.robot.ros.messages import wrench_topic

    cell = read_cell(cell_file)
    wrench_topic(cell)
    if armed and confirm != "retreat":
        raise InputError("Nobody confirmed that the robot may move.", "Whoever calls the service "
                         "moves it.", "Give ", Option("confirm", "retreat"), ", with a hand at the "
                         "emergency stop.")
    bridge, count = Bridge(url), 0
    try:
        with TriggerService(bridge, service, lambda: _answered(run, cell, armed, url)) as offered:
            run.progress(0.0, f"offering {service}")
            while True:
                if (values := offered.answer()) is not None:
                    count += 1
                    run.progress(0.0, f"{service}: {values['message']}")
    except ConnectionError as error:
        raise SafetyStop(f"{error}.", f"{service} is no longer offered.", "Start it again.",
                         result={"calls": count}) from error
    finally:
        bridge.close()


def _answered(run: Run, cell: Cell, armed: bool, url: str) -> tuple[bool, str]:
    """Retreat for a call of the service; whether the branch is free, and in words."""
    from limber.core.errors import LimberError
    from limber.robot.motion.retreat import followed_path

    try:
        way = followed_path(cell, "Open the gripper, and free the branch by hand.")
        if not armed:
            return False, (f"Not armed: it would go back along {len(way.poses)} places. Start "
                           "limber ros serve with --arm.")
        event = _followed(run, cell, None, url, is_held=True)
    except LimberError as error:
        return False, str(error)
    if event["event"] != "reached":
        return False, (f"Stopped: {event['reason']}. The force on the branch is "
                       f"{event['force_n']:.1f} N. Open the gripper, and free it by hand.")
    return True, f"Back at the start of the path; the force is {event['force_n']:.1f} N."


@stage_command("gripper")
@click.argument("cell_file", type=click.Path(path_type=Path))
@click.option("--position", type=float, required=True,
              help="Where it moves, as its controller counts [m or rad].")
@click.option("--effort", default=0.0, show_default=True,
              help="Greatest effort [N]; 0 leaves it to the controller.")
@click.option("--action", default="/gripper_controller/gripper_cmd", show_default=True,
              help="Name of its action (control_msgs/action/GripperCommand).")
@click.option("--arm", "armed", is_flag=True, help="Move it. Default: a dry run.")
@click.option("--confirm", help="The word gripper, to confirm that it may move.")
@_url
def gripper(run: Run, cell_file: Path, position: float, effort: float, action: str, armed: bool,
            confirm: str | None, url: str) -> dict[str, Any]:
    """Close or open the gripper by its action in ROS; `stalled` tells that it holds something."""
    from limber.cell.cell_file import read_cell
    from limber.core.errors import InputError, SafetyStop
    from limber.robot.ros.bridge import SECONDS, Bridge, drive

    cell = read_cell(cell_file)
    result: dict[str, Any] = {"armed": armed, "action": action, "wanted": position}
    if not armed:
        return result
    if confirm != "gripper":
        raise InputError("Nobody confirmed that the gripper may move.", "A bent branch springs "
                         "back where it opens.", "Give ", Option("confirm", "gripper"), ".")
    bridge = Bridge(url)
    try:
        result |= drive(bridge, action, position, effort, cell.tool.grip_seconds + SECONDS)
    except ConnectionError as error:
        raise SafetyStop(f"{error}.", "Whether the gripper moved is not known.",
                         "Check the gripper.") from error
    finally:
        bridge.close()
    return result


def _followed(run: Run, cell: Cell, trajectory: Trajectory | None, url: str, *, is_held: bool,
              goes_on: bool = False, across: Nudge | None = None) -> dict[str, Any]:
    """Tare, or with the branch held recall the tare, and follow ``trajectory``, None: back along
    the last path; return how that ended. ``goes_on``: a retreat goes back along the leg before as
    well; ``across``: nudge of the held branch before, which shows a wrong sensor."""
    from limber.core.errors import SafetyStop
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
            around.callback(_warn, run, robot.warnings)
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


def _warn(run: Run, texts: list[str]) -> None:
    for text in texts:
        run.progress.warn(text)


for each in (check, describe, scan, follow, gripper, retreat, serve):
    command.add_command(each)
