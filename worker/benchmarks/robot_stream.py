"""A recording at 500 Hz for minutes, ended by kill -9: what is recovered afterwards."""

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import psutil

from benchmarks.robot_branches import FRACTION, random_branch
from benchmarks.robot_cells import cell_file, robot_holding, sideways, standing_at
from benchmarks.table import Asked, Row, Setting
from limber.recordings.time_series import read_stream
from limber.stages.pulls.record import RecordOptions, RecordSettings, record
from limber.store import Branch

_DISTANCE_M = 0.012  # 20 times there and back with pauses take 630 s
_BEGUN_M_S, _APART = 5e-4, 20  # samples over which a speed is taken
_LONGEST_S = 120.0  # for connecting, the arc and the tare


LEAST_STREAM_S = 150.0
_ASKED_S = 600.0
_AROUND_S = 90.0  # what a measurement takes besides the recording
STREAM_ROWS = (
    Asked("500 Hz recorded for 600 s: samples lost, not ascending; memory of recorder and driver",
          "0; flat"),
    Asked("the same: lost by kill -9, at most", "1 s"))


def recorded_stream(setting: Setting, address: str) -> list[Row]:
    """Record with `limber record`, kill it, and recover the data.

    With less than the required 600 s, it records as long as it may; that can fail, but not pass.
    """
    seconds = 8.0 if setting.quick else min(_ASKED_S, setting.budget.remaining - _AROUND_S)
    seed = setting.seed
    with tempfile.TemporaryDirectory() as place:
        branch, young = random_branch(Path(place, "stream.branch"), seed)
        cell = standing_at(branch, address, fraction=FRACTION)
        path = cell_file(cell, Path(place))
        with robot_holding(branch, cell, Path(place), seed=seed, young=young) as robot:
            process = _started(branch, path)
            try:
                begin, memory, grown, killed = _watched(robot, process, seconds)
            finally:
                # A separate driver process that ends with its pipe.
                process.kill()
                process.wait()
            lost_by_robot = robot.state["lost_seconds"]
        if killed is not None:
            record(branch.folder, path, "stream", RecordSettings(), RecordOptions(recover=True))
        kept = Branch.open(branch.folder)
        rows = read_stream(kept.path("pulls/stream/robot.csv"))
        ended = kept.manifest.stages["record:stream"].result["ended"]
    times, places = rows.times, rows.values[:, :3]
    steps = np.diff(times)
    lost = int(np.round(steps / 0.002).sum() - len(steps))
    if killed is None:
        return [Row(*STREAM_ROWS[0], f"{lost} of "
                    f"{len(times)}, but stopped after {times[-1]:.0f} s: {ended} (load of the "
                    f"machine {os.getloadavg()[1]:.1f})", False)]
    # Both clocks from when it began to move.
    way = np.linalg.norm(places[_APART:] - places[:-_APART], axis=1)
    first = int(np.argmax(way > _BEGUN_M_S * (times[_APART:] - times[:-_APART])))
    missing = (killed - begin) - float(times[-1] - times[first])
    is_good = lost == 0 and bool(np.all(steps > 0)) and abs(grown) < 0.05 * memory
    return [
        Row(*STREAM_ROWS[0], f"{times[-1]:.0f} s: {lost} of {len(times)}, "
            f"{int(np.sum(steps <= 0))}; {memory / 1e6:.0f} MB {grown / 1e6:+.1f} MB (virtual "
            f"clock stood still for {lost_by_robot:.2f} s)",
            None if is_good and seconds < _ASKED_S else is_good),
        Row(*STREAM_ROWS[1], f"{max(missing, 0.0):.2f} s",
            missing <= 1.0)]


def _started(branch: Branch, path: Path) -> subprocess.Popen:
    way = [str(value) for value in sideways(branch, FRACTION)]
    return subprocess.Popen(
        [sys.executable, "-m", "limber", "record", str(branch.folder), "--cell", str(path),
         "--name", "stream", "--confirm", "stream", "--direction", *way, "--distance",
         str(_DISTANCE_M), "--speed", "0.002", "--cycles", "20", "--pause", "10"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _watched(robot, process: subprocess.Popen, seconds: float,
             ) -> tuple[float, int, int, float | None]:
    """Return the clock when it began to move, memory after a tenth of the time and its growth
    since, and the clock of the kill; None if the recording ended before.
    """
    end = time.monotonic() + _LONGEST_S
    while np.linalg.norm(robot.state["tool_speed"][:3]) < _BEGUN_M_S:
        if process.poll() is not None or time.monotonic() > end:
            raise RuntimeError("the recording did not begin")
        time.sleep(0.01)
    begin = robot.state["clock"]
    before = grown = 0
    for share in (0.1, 0.9):
        end = time.monotonic() + share * seconds
        while time.monotonic() < end:
            if process.poll() is not None:
                return begin, before, grown, None
            time.sleep(0.5)
        now = _memory(process.pid)
        before, grown = (now, 0) if share == 0.1 else (before, now - before)
    killed = robot.state["clock"]
    os.kill(process.pid, signal.SIGKILL)
    return begin, before, grown, killed


def _memory(pid: int) -> int:
    parent = psutil.Process(pid)
    return sum(each.memory_info().rss for each in (parent, *parent.children(recursive=True)))
