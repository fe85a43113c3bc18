"""The robot's table: kinematics, stop times, faults, the stream, paths; all on the virtual robot.

No real robot was measured. Times are those of this computer under its load at the moment; the
virtual controller and the driver share it.
"""

import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.held_up import Voided, Witness
from benchmarks.robot_branches import FAULTS_OF_BRANCHES, followed_paths, lost_branches
from benchmarks.robot_faults import (
    ENDS_ROBOT,
    FAULTS,
    Outcome,
    cell_for,
    new_robot,
    provoke,
    restored,
    straight,
)
from benchmarks.robot_loop import closed_loops
from benchmarks.robot_stream import recorded_stream
from benchmarks.table import Row
from limber.errors import LimberError
from limber.progress import Progress
from limber.robot.arms import ARMS
from limber.robot.expected import ExpectedWrench
from limber.robot.kinematics import forward, inverse
from limber.robot.link import RobotLink
from limber.robot.trajectory import Trajectory, along, densely
from limber.robot.virtual.launch import VirtualRobot

_ADDRESS = "127.0.0.71"


@dataclass(frozen=True)
class Setting:
    """How much is measured: ``quick`` does each fault once, takes one branch, records for 8 s."""

    quick: bool
    seed: int
    out: Path | None
    voided: Voided


def rows(quick: bool, progress: Progress, out: Path | None, seed: int = 0,
         only: tuple[str, ...] = ()) -> list[Row]:
    """Measure the parts named in ``only``, or all."""
    table: list[Row] = []
    chosen = only or WHOLE
    with Witness() as witness:
        for number, name in enumerate(chosen):
            share = progress.part(number / len(chosen), (number + 1) / len(chosen))
            share(0.0, name)
            table += PARTS[name](Setting(quick, seed, out, Voided(witness)), share)
    return table


def _kinematics(setting: Setting, _progress: Progress) -> list[Row]:
    rng = np.random.default_rng(setting.seed)
    worst, missing, count = 0.0, 0, 10_000 // len(ARMS) + 1
    for arm in ARMS.values():
        joints = rng.uniform(-np.pi, np.pi, (count, 6))
        frames = forward(arm, joints)
        solutions = inverse(arm, frames)
        exist = np.isfinite(solutions).all(axis=-1)
        again = forward(arm, np.nan_to_num(solutions))
        worst = max(worst, float(np.linalg.norm(
            (again - frames[:, None])[..., :3, 3], axis=-1)[exist].max()))
        apart = np.abs((solutions - joints[:, None] + np.pi) % (2 * np.pi) - np.pi).max(axis=-1)
        missing += int(np.sum(~(np.nanmin(apart, axis=1) < 1e-6)))
    found = [Row("kinematics: position of every inverse solution, 10,000 poses, 7 arms",
                 "1e-9 m", f"{worst:.1e} m", worst < 1e-9),
             Row("kinematics: poses whose own joints are not among the solutions", "0",
                 str(missing), missing == 0)]
    try:
        import ur_analytic_ik
    except ImportError:
        return [*found, Row("kinematics against an independent library", "1e-9 m",
                            "library not installed", None)]
    off, lacking = 0.0, 0
    for name, arm in ARMS.items():
        library = getattr(ur_analytic_ik, name)
        joints = rng.uniform(-np.pi, np.pi, (count, 6))
        frames = forward(arm, joints)
        theirs = np.array([library.forward_kinematics(*row) for row in joints])
        off = max(off, float(np.abs(frames - theirs)[:, :3, 3].max()))
        ours = np.isfinite(inverse(arm, frames)).all(axis=-1).sum(axis=1)
        lacking += sum(len(library.inverse_kinematics(frame)) != number
                       for frame, number in zip(frames, ours, strict=True))
    return [*found, Row("kinematics against an independent library: position", "1e-9 m",
                        f"{off:.1e} m", off < 1e-9),
            Row("poses with another number of inverse solutions than the library's", "0",
                str(lacking), lacking == 0)]


@dataclass(frozen=True)
class _Stop:
    """One stop for a force: when it came and how far the arm went on.

    ``since`` and ``until`` [s, monotonic clock]: between them the force came and the stop.
    """

    latency: float
    way: float
    since: float
    until: float


def _stop_time(setting: Setting, _progress: Progress, model: str) -> list[Row]:
    """From the step at which the force goes over the limit until the stop command has come.

    An FT300 tells its force every 10 ms, which is part of it. A stop that was late by no more
    than the machine stood still meanwhile is done again, and told with its time.
    """
    rate, asked = (125, 0.012) if model == "ur5" else (500, 0.006)
    stops, late = [], []
    runs = 2 if setting.quick else 20
    with new_robot(_ADDRESS, model, setting.seed) as robot:
        while len(stops) < runs:
            stop = setting.voided.again(partial(_one_stop, robot, model, 1.0 / rate),
                                        f"stop at {rate} Hz")
            over = stop.latency - asked
            if over > 1e-6 and len(late) < runs and setting.voided.explains(
                    stop.since, stop.until, over, f"stop at {rate} Hz"):
                late.append(stop)
                continue
            stops.append(stop)
    worst = max(stop.latency for stop in stops)
    median = np.median([stop.latency for stop in stops])
    held_up = "" if not late else (f"; {len(late)} done again, the machine stood still: to "
                                   f"{1000 * max(stop.latency for stop in late):.1f} ms")
    return [Row(f"force over the hard limit until the stop command, {rate} Hz, worst of {runs}",
                f"{1000 * asked:.0f} ms",
                f"{1000 * worst:.1f} ms (median {1000 * median:.1f}){held_up}",
                worst <= asked + 1e-6),
            Row(f"way after the limit at 50 mm/s, {rate} Hz, worst", "reported",
                f"{1000 * max(stop.way for stop in stops + late):.1f} mm", None)]


def _one_stop(robot: VirtualRobot, model: str, step: float) -> _Stop:
    """Add a force over the limit to a moving arm and wait for the stop.

    Raises:
        AssertionError: something else stopped it.
    """
    restored(robot)
    with RobotLink(cell_for(_ADDRESS, model)) as link:
        time.sleep(0.2)
        link.tare()
        link.start(straight(robot, (0.0, 0.2, 0.0)))
        time.sleep(1.0)
        since = time.monotonic()
        before = robot.ask("added_wrench", wrench=[0, 0, 60.0, 0, 0, 0])
        came = time.monotonic()
        event = link.wait("stopped", seconds=5)
        assert event["reason"].startswith("hard force limit"), event["reason"]
        time.sleep(0.3)
        after = robot.state
    # The force acts from the next step on.
    acts = before["clock"] + step
    stopped = min(moment for line in after["log"] if line.endswith(("came", "dashboard"))
                  and (moment := float(line.split()[0])) > before["clock"])
    way = float(np.linalg.norm(np.subtract(after["pose"][:3], before["pose"][:3])))
    return _Stop(stopped - acts, way, since, came + stopped - acts)


def _path(setting: Setting, _progress: Progress) -> list[Row]:
    collected: list[np.ndarray] = []
    with new_robot(_ADDRESS, "ur5e", setting.seed) as robot:
        start = np.array(robot.state["pose"])
        corners = start + np.array([[0, 0, 0, 0, 0, 0], [0, 0.08, 0, 0, 0, 0],
                                    [0, 0.08, 0.05, 0, 0.1, 0], [0.03, 0.02, 0.05, 0, 0, 0]])
        poses = densely(corners, spacing=0.0005)
        path = Trajectory(along(poses, 0.03, 0.2), poses, ExpectedWrench.nothing(poses))
        with RobotLink(cell_for(_ADDRESS), collected.append) as link:
            time.sleep(0.2)
            link.tare()
            link.follow(path)
    samples = np.concatenate(collected)
    distance = max(float(np.linalg.norm(poses[:, :3] - row, axis=1).min())
                   for row in samples[:, 1:4])
    return [Row("following a path at 30 mm/s: distance from it, worst", "1 mm",
                f"{1000 * distance:.2f} mm", distance < 1e-3)]


def _faults(setting: Setting, progress: Progress, names: tuple[str, ...] = tuple(FAULTS),
            ) -> list[Row]:
    failed, total, slowest, runs = [], 0, 0.0, 1 if setting.quick else 20
    for number, name in enumerate(names):
        progress(number / len(names), name)
        seed = setting.seed + list(FAULTS).index(name)
        robot = new_robot(_ADDRESS, "ur5e", seed)

        def run(name: str = name, seed: int = seed) -> Outcome:
            nonlocal robot
            if robot.process.poll() is not None:
                robot.close()
                robot = new_robot(_ADDRESS, "ur5e", seed)
            restored(robot)
            return provoke(name, robot, cell_for(_ADDRESS))
        try:
            for _ in range(runs):
                total += 1
                try:
                    outcome = setting.voided.again(run, name)
                except (AssertionError, LimberError) as error:
                    failed.append(f"{name}: {error}")
                    print(failed[-1], flush=True)
                    continue
                if name not in ENDS_ROBOT:
                    slowest = max(slowest, outcome.standstill_s)
        finally:
            robot.close()
        print(f"{name}: {runs} runs, {len(failed)} failed so far", flush=True)
    told = f"{len(names)} faults" if len(names) > 1 else names[0]
    return [Row(f"{told} while moving, {runs} runs each: standstill and a report", "every one",
                f"{total - len(failed)} of {total}; slowest standstill {slowest:.2f} s"
                f"{setting.voided}", not failed)]


def _followed(setting: Setting, _progress: Progress) -> list[Row]:
    return followed_paths(setting.seed, 1 if setting.quick else 10, _ADDRESS, setting.voided)


def _lost(setting: Setting, _progress: Progress) -> list[Row]:
    return [lost_branches(setting.seed, 1 if setting.quick else 20, _ADDRESS,
                          FAULTS_OF_BRANCHES[:1] if setting.quick else FAULTS_OF_BRANCHES,
                          setting.voided)]


def _stream(setting: Setting, _progress: Progress) -> list[Row]:
    return recorded_stream(setting.seed, 8.0 if setting.quick else 600.0, _ADDRESS)


def _loops(setting: Setting, progress: Progress) -> list[Row]:
    return closed_loops(setting.seed, 1 if setting.quick else 10, _ADDRESS, progress, setting.out,
                        setting.voided)


WHOLE: dict[str, Callable[[Setting, Progress], list[Row]]] = {
    "kinematics": _kinematics, "stop-125": partial(_stop_time, model="ur5"),
    "stop-500": partial(_stop_time, model="ur5e"), "path": _path, "faults": _faults,
    "branches": _followed, "lost": _lost, "stream": _stream, "loops": _loops}
"""The table's parts, in its order."""
PARTS = WHOLE | {f"fault:{name}".replace(" ", "-"): partial(_faults, names=(name,))
                 for name in FAULTS}
"""What ``--only`` knows: those, and each fault by itself."""
