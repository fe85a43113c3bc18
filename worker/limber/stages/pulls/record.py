"""Stage ``record``."""

from __future__ import annotations

import re
import time
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

import numpy as np
from pydantic import Field

from limber.core.errors import InputError, LimberError, Option, SafetyStop, Text, WorkError
from limber.core.progress import SILENT, Progress
from limber.core.settings import Groups
from limber.robot.operator_decisions import AfterStop, grip, require_confirmation, retreat_if_chosen
from limber.stages.pulls.import_pull import Pull
from limber.stages.stage import About, BranchStage, given, option, required
from limber.store import Branch

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.driver.link import RobotLink
    from limber.robot.motion.execution import Blocked
    from limber.robot.motion.trajectory import Trajectory
    from limber.robot.recorder import PullPlausibility, PullRecorder
    from limber.stages.pulls.record_observers import Observers
    from limber.store import Stream

_TARE_SECONDS = 1.0
_FEWEST_ROWS = 2  # of a pull, after the title line
_FEWEST_IMAGES = 2  # of a pull that is observed
_SETTLE_SECONDS = 0.5  # until the branch rests in the closed gripper


class RecordPull(BranchStage):
    """Record a pull with a robot, under the guard."""

    about = About(
        "record", 55, Pull, key="record:{name}", reads=("skeleton.swc",),
        writes=("pulls/{name}/",),
        found=("Pull {pull}: {sample_count:count} samples in {seconds:s}, {marker_frames} marker "
               "frames, peak force {peak_force_n:N}; ended: {ended}.",
               "{depth_images} depth images."),
        then="limber estimate {branch_folder}", step="pulls", label="Record a Pull",
        moves_robot="always")
    groups: ClassVar[Groups] = {
        "pull": ("direction", "distance", "shape", "waypoints", "suggested", "speed", "cycles",
                 "pause")}
    common = ("direction", "distance", "speed", "suggested")

    cell: Path = required("The robot's cell file.", "cell.toml")
    name: str = given("Name of the recording.", "pull-1", group="output", common=True)
    direction: tuple[float, float, float] = Field(
        (1.0, 0.0, 0.0), description="Direction of the pull in the branch's frame; its length is "
                                     "ignored.")
    distance: float = Field(0.05, gt=0, le=0.5, description="Distance of the pull [m].")
    shape: Literal["arc", "straight"] = Field(
        "arc", description="Shape of the pull. arc: the arc that the branch follows when it is "
        "pulled along --direction, with the gripper turning along. straight: a line without "
        "turning.")
    waypoints: str | None = Field(
        None, description="CSV of way-points instead: x_m,y_m,z_m, and rx_rad,ry_rad,rz_rad if "
        "the gripper turns, in the branch's frame. The first one is the gripper's position.")
    suggested: bool = Field(
        False, description="Use direction and distance of the best pull of `limber suggest-pull`. "
        "The gripper must be at its grasp.", json_schema_extra={"switch": True})
    speed: float = Field(0.03, gt=0, le=0.25, description="Speed of the gripper [m/s].")
    cycles: int = Field(1, ge=1, le=20, description="Number of times out and back.")
    pause: float = Field(0.5, ge=0, le=10, description="Time at rest at each end [s].")
    confirm: str | None = option(
        "The recording's name, to confirm that the robot may move. Default: ask at the terminal.",
        common=True, panel=False)
    markers: int | None = option(
        "Port at the robot's address where a tracker sends observed points as JSON lines (the "
        "virtual robot's is 63400).", limits={"ge": 1, "le": 65535})
    realsense: bool = option(
        "Record depth images with the connected RealSense camera, which stands still at the pose "
        "of [camera] in the cell file. `limber estimate` tracks the control points in them.", False,
        switch=True)
    after_stop: AfterStop = option(
        "What to do after a stop. ask: ask at the terminal, or hold without one.", "ask",
        panel=False)
    recover: bool = option(
        "Move nothing, and recover an interrupted recording of this name.", False, switch=True)

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        """Record a predefined pull, out and back.

        The sensor is tared with the gripper empty. The gripper closes and nudges the branch across
        the pull, which shows a sensor whose axes are wrong; then it pulls and returns. Every sample
        of the pull is written to ``robot.csv`` at once; after a kill or a stop at most the last
        second is missing. A branch pulled far sideways without following its arc is stretched; its
        force then rises steeply, and the guard pauses.

        Returns:
            ``ended`` (``reached`` or the reason of a stop), ``after_stop`` (after a stop, as
            :func:`limber.robot.operator_decisions.retreat_if_chosen` returns it),
            ``sample_count``, ``seconds``, ``peak_force_n``, ``marker_frames``.

        Raises:
            InputError: cell and branch do not belong together, or the user did not confirm.
            SafetyStop: the guard stopped the pull; the recording so far is nevertheless in the
                folder.
        """
        from limber.cell.cell_file import check_branch, read_cell, require_payload
        from limber.cell.obstacles import cell_obstacles
        from limber.cell.reach_and_collision import blocked_by
        from limber.robot.robot_state import require_weighed

        name = self.name
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9_.-]*", name):
            raise InputError(Text(Option("name"), f" {name!r} cannot name a recording."),
                             "The name becomes a folder's name.",
                             "Use letters, digits, dash and dot.")
        branch, cell = Branch.open(self.branch_folder), read_cell(self.cell)
        if warning := check_branch(cell, branch.uuid, self.branch_folder):
            progress.warn(warning)
        if self.recover:
            if branch.growing(f"pulls/{name}") and not _left_samples(branch, name):
                raise InputError(f"The recording {name} was interrupted before its pull began.",
                                 "There is nothing to recover.",
                                 "Record it again; its name is free.")
            return _finish(branch, self, {"ended": "recovered after an interruption"})
        if branch.has(f"pulls/{name}/pull.toml"):
            raise InputError(f"{self.branch_folder} already has a recording {name}.",
                             "A recording is never overwritten.", "Give another ",
                             Option("name"), ".")
        if _left_samples(branch, name):
            raise InputError(f"A recording {name} was interrupted.", "It would be lost.",
                             "Recover it with ", Option("recover", True), ", or give another ",
                             Option("name"), ".")
        require_payload(cell)
        require_weighed(cell)
        blocked = blocked_by(cell, cell_obstacles(cell, self.cell.parent))
        require_confirmation(name, self.confirm, cell, progress)
        with branch.writing(f"the recording {name}"):
            _remove_empty(branch, name)
            ended = _recorded(branch, cell, self, blocked, progress)
            # Nothing is recorded of a stop before the pull: the name stays free.
            result = _finish(branch, self, ended) if ended["sample_count"] else ended
        if ended["ended"] != "reached":
            left = (f"{ended['sample_count']} samples are in pulls/{name}." if ended["sample_count"]
                    else "No sample was recorded.")
            raise SafetyStop(f"The recording was stopped: {ended['ended']}.",
                             f"{ended['after_stop']['outcome']} {left}",
                             "Check the branch and the robot before anything moves.", result=result)
        return result


def _left_samples(branch: Branch, name: str) -> bool:
    """Whether an interrupted recording has samples."""
    folder = branch.growing(f"pulls/{name}")
    rows = None if folder is None else folder / "robot.csv"
    return rows is not None and rows.is_file() and rows.read_bytes().count(b"\n") > _FEWEST_ROWS


def _remove_empty(branch: Branch, name: str) -> None:
    """Remove what a recording left that was interrupted before its pull began."""
    folder = branch.growing(f"pulls/{name}")
    for file in () if folder is None else [*folder.iterdir()]:
        if file.is_file():
            file.unlink()


def _recorded(branch: Branch, cell: Cell, asked: RecordPull, blocked: Blocked,
              progress: Progress) -> dict[str, Any]:
    from limber.robot.driver.link import LiveForce, RobotLink
    from limber.robot.recorder import PullRecorder, off_axis
    from limber.stages.pulls.record_nudge import nudge_and_checks, nudged
    from limber.stages.pulls.record_observers import Observers
    from limber.stages.pulls.record_path import grasp_point

    name = asked.name
    stream = branch.stream(f"pulls/{name}/robot.csv")
    entry_lines = branch.stream(f"pulls/{name}/pull.toml")
    observers = Observers(branch, cell, name, stream.path.parent, asked.markers,
                          asked.realsense)
    recorders: list[PullRecorder] = []
    try:
        progress(0.02, "connecting")
        live = LiveForce(branch.folder, f"Recording {name}", cell.limits.soft_force_n)
        doubts: list[PullPlausibility] = []

        def take(rows: np.ndarray) -> None:
            observers.heard(rows)
            if recorders:
                recorders[0].take(rows)
            live.take(rows)
            if doubts and doubts[-1].reason is None and doubts[-1].take(rows):
                link.stop()
        with observers, live, RobotLink(cell, take) as link:
            sample = link.wait_for_samples()
            point, off = grasp_point(branch, sample[1:4])
            if warning := off_axis(cell, sample[1:4], off):
                progress.warn(warning)
            recorder = PullRecorder(stream, point, cell.tool.compliance_m_per_n)
            recorders.append(recorder)
            # Before the tare: during long work the sensor would drift.
            trajectory = _pull(branch, cell, point, sample, asked, blocked,
                               progress.part(0.02, 0.1))
            across, predicted = nudge_and_checks(branch, cell, point, sample, trajectory, blocked,
                                                 progress.part(0.08, 0.1))
            progress(0.1, "taring: keep the gripper free")
            live.at("taring")
            tared = link.tare(_TARE_SECONDS)
            grip(cell, link, close=True, progress=progress)
            time.sleep(_SETTLE_SECONDS)
            if across is not None:
                progress(0.13, "nudging the branch across the pull")
                event = nudged(link, live, across, doubts)
                if event["event"] != "reached":
                    return {"ended": event["reason"], "after_stop": retreat_if_chosen(
                        cell, link, asked.after_stop, progress), "peak_force_n": 0.0,
                        "sample_count": 0, "warnings": list(link.warnings)}
            _write_entry(entry_lines, cell, point, tared, trajectory.duration, observers)
            recorder.close_gripper()
            live.at("pulling")
            doubts += predicted
            link.start(trajectory)
            event = _watched(link, observers, recorder, trajectory, progress)
            ended: dict[str, Any] = {"ended": _how_it_ended(event, doubts)}
            if event["event"] == "reached":
                # The last observations arrive a little later.
                time.sleep(0.5)
                observers.end(recorder, progress)
                _warn_of_what_is_left(doubts, recorder, progress)
                grip(cell, link, close=False, progress=progress)
            else:
                observers.end(recorder, progress)
                ended["after_stop"] = retreat_if_chosen(cell, link, asked.after_stop, progress)
        return ended | {"peak_force_n": recorder.peak_force, "sample_count": recorder.count,
                        "warnings": list(link.warnings)}
    finally:
        _close_lines([stream, entry_lines, observers.lines], recorders)


def _close_lines(streams: list[Stream | None], recorders: list[PullRecorder]) -> None:
    for lines in streams:
        if lines is not None:
            lines.close()
            if not (recorders and recorders[0].count):
                # No sample came: there is nothing to import, and the name stays free.
                lines.path.unlink(missing_ok=True)


def _how_it_ended(event: dict[str, Any], doubts: list[PullPlausibility]) -> str:
    """``reached``, or why the pull was stopped: by the guard, or by an implausible force."""
    if event["event"] == "reached":
        return "reached"
    reason = doubts[-1].reason if doubts else None
    return event["reason"] if reason is None else f"implausible: {reason}"


def _warn_of_what_is_left(doubts: list[PullPlausibility], recorder: PullRecorder,
                          progress: Progress) -> None:
    """Warn of a remaining force once the gripper is back at its start."""
    if doubts and recorder.last is not None and (
            warning := doubts[-1].left_at_end(recorder.last[None])):
        progress.warn(f"{warning}.")


def _watched(link: RobotLink, observers: Observers, recorder: PullRecorder,
             trajectory: Trajectory, progress: Progress) -> dict[str, Any]:
    """Wait for the end of the motion; observations are written as they arrive."""
    begin = time.monotonic()
    while True:
        try:
            return link.wait("reached", "stopped", "paused", seconds=0.05)
        except LimberError as error:
            if not isinstance(error, WorkError) or link.process.poll() is not None or \
                    time.monotonic() - begin > 3 * trajectory.duration + 30:
                raise
        except BaseException:
            # Ctrl-C stops the arm before anything else.
            link.stop()
            raise
        observers.write(recorder)
        progress(0.15 + 0.8 * min((time.monotonic() - begin) / trajectory.duration, 1.0),
                 "pulling", force_n=recorder.peak_force)


def _pull(branch: Branch, cell: Cell, point: np.ndarray, sample: np.ndarray,
          asked: RecordPull, blocked: Blocked, progress: Progress) -> Trajectory:
    """The motion of the gripper from its position in a sample of the robot."""
    from limber.core.numerics.rigid import matrices
    from limber.robot.motion.trajectory import speed_within
    from limber.stages.pulls.record_path import (
        arc_path,
        suggested_pull,
        there_and_back,
        waypoint_path,
    )

    direction, distance = np.array(asked.direction, float), asked.distance
    if asked.suggested:
        direction, distance = suggested_pull(branch, point)
    length = np.linalg.norm(direction)
    if length < 1e-9 and asked.waypoints is None:
        raise InputError(Text(Option("direction"), " is 0 0 0."), "It has no direction.",
                         "Give a direction.")
    if asked.speed > cell.limits.speed_m_s:
        raise InputError(Text(Option("speed"), f" {asked.speed:g} exceeds the cell's "
                              f"{cell.limits.speed_m_s:g} m/s."), "The guard would slow it down.",
                         "Reduce ", Option("speed"), ", or raise limits.speed_m_s in the cell "
                         "file.")
    speed = speed_within(cell, asked.speed, progress.warn)
    gripper, joints = sample[1:7], sample[19:25]
    here = matrices(gripper)
    if asked.waypoints is not None:
        frames = waypoint_path(Path(asked.waypoints), gripper)
    elif asked.shape == "arc":
        frames = arc_path(branch, point, direction, distance, progress) @ here
    else:
        frames = np.array([here, here])
        frames[1, :3, 3] += distance * direction / length
    return there_and_back(cell, frames, speed=speed, cycles=asked.cycles,
                          pause=asked.pause, start=joints, blocked=blocked)


def _write_entry(lines: Stream, cell: Cell, point: np.ndarray, tared: dict[str, Any],
                 seconds: float, observers: Observers) -> None:
    """Write ``pull.toml`` first, so that the files left by a kill can be read."""
    from limber.recordings.recording import GraspEntry, PullEntry, entry_text
    from limber.robot.recorder import known_errors, known_noise
    from limber.stages.pulls.record_path import GRASP_RADIUS_M

    rest, noise = observers.at_rest()
    entry = PullEntry(
        observation=observers.kind, grasp=GraspEntry(
            point_m=tuple(map(float, point)), radius_m=GRASP_RADIUS_M),
        sensor=known_noise(cell, noise),
        calibration=known_errors(cell, seconds, tare_sigma=tared["sigma"]),
        rest_points_m=rest, recorded=datetime.now().astimezone().isoformat(timespec="seconds"),
        source=f"limber record, {cell.arm.name}, {cell.sensor.kind}; tare within "
        f"{max(tared['sigma'][:3]):.2g} N")
    for line in entry_text(entry).splitlines():
        lines.append(line)


def _finish(branch: Branch, asked: RecordPull, ended: dict[str, Any]) -> dict[str, Any]:
    """Import the streams into the branch folder."""
    from limber.recordings.time_series import read_stream

    name = asked.name
    prefix = f"pulls/{name}/"
    left = [file for file in branch.streams() if file.startswith(prefix)]
    if f"{prefix}robot.csv" not in left or f"{prefix}pull.toml" not in left:
        raise InputError(f"There is no interrupted recording {name}.",
                         f"Interrupted recordings: {', '.join(branch.streams()) or 'none'}.",
                         "Give the name of one of those.")
    with branch.stage(f"record:{name}", asked) as stage:
        for file in left:
            stage.adopt(file)
        samples = read_stream(stage.path(f"{prefix}robot.csv"))
        force = np.linalg.norm(samples.values[:, 6:9], axis=1)
        markers = 0
        if f"{prefix}markers.csv" in left:
            markers = len(read_stream(stage.path(f"{prefix}markers.csv")))
        images = sum(file.startswith(f"{prefix}depth/") for file in left)
        if images < _FEWEST_IMAGES:
            entry = stage.path(f"{prefix}pull.toml")
            entry.write_text(entry.read_text(encoding="utf-8").replace(
                'observation = "depth"', 'observation = "none"'), encoding="utf-8")
        stage.result.update(
            {"pull": name, "sample_count": len(samples), "marker_frames": markers,
             "depth_images": images or None,
             "seconds": float(samples.times[-1]), "peak_force_n": float(force.max())} | ended)
    return stage.result
