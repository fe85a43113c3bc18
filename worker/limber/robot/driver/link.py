"""The parent's side of the driver's pipe: used by `record`, `execute` and the session."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError, LimberError, SafetyStop, WorkError
from limber.core.files.atomic import owned_name
from limber.core.processes.child import Child
from limber.robot.driver.controls import stop_from_outside
from limber.robot.driver.real_time import CALL_SECONDS, ended_by_deadline
from limber.robot.motion.trajectory import Trajectory

_START_SECONDS, _CONNECT_SECONDS = 120.0, 25.0
_BEAT_SECONDS = 0.2
_STANDS_SECONDS = 0.3
_DASHBOARD_SECONDS = 0.5
_ERRORS: dict[int, type[LimberError]] = {2: InputError, 4: SafetyStop}

COLUMNS = ("t_s", "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad",
           "fx_n", "fy_n", "fz_n", "tx_nm", "ty_nm", "tz_nm",
           "smooth_fx_n", "smooth_fy_n", "smooth_fz_n",
           "smooth_tx_nm", "smooth_ty_nm", "smooth_tz_nm",
           "q1_rad", "q2_rad", "q3_rad", "q4_rad", "q5_rad", "q6_rad",
           "expected_fx_n", "expected_fy_n", "expected_fz_n",
           "expected_tx_nm", "expected_ty_nm", "expected_tz_nm",
           "expected_xx_n2", "expected_xy_n2", "expected_xz_n2",
           "expected_yy_n2", "expected_yz_n2", "expected_zz_n2")
"""Columns of a row of samples: grasp pose and wrench on the branch, in the branch's frame; the last
six are the covariance of the expected force."""


class RobotLink:
    """A robot in a driver process; a context manager. ``on_samples`` is called with each batch,
    shape [n, 37] as in :data:`COLUMNS`, from its own thread. LimberError with the driver's reason
    if no robot answers, or it cannot be moved now."""

    def __init__(self, cell: Cell, on_samples: Callable[[np.ndarray], None] | None = None):
        self._on_samples = on_samples
        self._fresh: np.ndarray | None = None
        self.warnings: list[str] = []
        self._cell = cell
        self._closing = threading.Event()
        command = [sys.executable, "-m", "limber.robot.driver.driver"]
        self._child = Child(command, self._hear, self._ended, stderr=subprocess.DEVNULL)
        self.process = self._child.process
        self._write(cell.model_dump_json())
        try:
            # The robot is not asked before that: on a busy computer it may take its time.
            if self._child.wait(lambda: self._taken(("starting",)), _START_SECONDS) is None:
                raise WorkError(f"The robot's driver did not start within {_START_SECONDS:.0f} s; "
                                "the robot was not asked yet.", "This computer is too busy, or its "
                                "disk is slow: loading the driver takes about two seconds.",
                                "End other programs and try again.")
            self.facts = self.wait("connected", seconds=_CONNECT_SECONDS)
        except BaseException:
            self.close()
            raise
        threading.Thread(target=self._beat, name="robot keep-alive", daemon=True).start()

    @property
    def has_ended(self) -> bool:
        """Whether its process has ended; another link can then replace it."""
        return self._child.has_ended

    def __enter__(self) -> RobotLink:
        return self

    def __exit__(self, *_exception: object) -> None:
        self.close()

    def wait_for_samples(self, seconds: float = 5.0) -> np.ndarray:
        """Return the latest of the next samples, shape [37] as in :data:`COLUMNS`; WorkError if
        none arrives."""
        self._fresh = None
        sample = self._child.wait(lambda: self._fresh, seconds)
        if sample is None:
            raise WorkError(f"The robot's driver sent no samples within {seconds:.0f} s.",
                            "The connection may be silent.", "Check the robot.")
        return sample

    def tare(self, seconds: float = 0.5) -> dict[str, Any]:
        """Tare the present force; the gripper hangs free and still."""
        self._order(order="tare", seconds=seconds)
        return self.wait("tared", seconds=seconds + 5.0)

    def start(self, trajectory: Trajectory) -> None:
        """Begin to follow a trajectory; SafetyStop if the guard or the driver refuses."""
        expected = trajectory.expected
        self._order(order="follow", times=trajectory.times.tolist(),
                    poses=trajectory.poses.tolist(),
                    joints=None if trajectory.joints is None else trajectory.joints.tolist(),
                    by_joints=trajectory.by_joints,
                    expected=None if expected is None else {
                        name: value.tolist() for name, value in vars(expected).items()})
        self.wait("started", seconds=5.0)

    def follow(self, trajectory: Trajectory) -> dict[str, Any]:
        """Follow a trajectory to its end; return the event that ended it: ``reached``, ``stopped``
        or ``paused``, with its reason. SafetyStop if it was refused; WorkError if the driver has
        ended."""
        self.start(trajectory)
        return self._until_ended(10 * trajectory.duration + 30.0)

    def retreat(self, seconds: float = 600.0) -> dict[str, Any]:
        """Retreat along its path, slower, as a person asked; return ``reached``, or ``stopped``
        with its reason, for example that the force does not fall. SafetyStop if there is no path
        back, or the arm left it; WorkError if the driver has ended, or not in ``seconds`` [s]."""
        # Until the arm is at rest, and the smoothed force is that of its position.
        time.sleep(_STANDS_SECONDS)
        self._order(order="retreat")
        self.wait("started", seconds=5.0)
        return self._until_ended(seconds)

    def acknowledge(self) -> None:
        """A person has seen the stop."""
        self._order(order="acknowledge")
        self.wait("acknowledged", seconds=5.0)

    def resume(self) -> dict[str, Any]:
        """Continue after a pause, to the end of the trajectory."""
        self._order(order="resume")
        self.wait("resumed", seconds=5.0)
        return self._until_ended(600.0)

    def _until_ended(self, seconds: float) -> dict[str, Any]:
        try:
            return self.wait("reached", "stopped", "paused", seconds=seconds)
        except KeyboardInterrupt:
            # Ctrl-C stops the arm before anything else.
            self.stop()
            raise

    def gripper(self, close: bool) -> None:
        """Close or open the gripper."""
        self._order(order="gripper", close=close)
        self.wait("gripper", seconds=10.0)

    def stop(self) -> None:
        """Stop now."""
        self._order(order="stop")

    def wait(self, *kinds: str, seconds: float) -> dict[str, Any]:
        """Return the next event of one of ``kinds``; LimberError if the driver refused or failed,
        or ended."""
        event = self._child.wait(lambda: self._taken(kinds), seconds)
        if event is not None:
            return event
        if self._child.has_ended:
            raise self._why_it_ended()
        raise WorkError(f"The robot's driver reported neither {' nor '.join(kinds)} within "
                        f"{seconds:.0f} s.", "The connection may be silent.", "Check the robot.")

    def _taken(self, kinds: Sequence[str]) -> dict[str, Any] | None:
        """The next event of one of ``kinds``; those before it are heeded."""
        while (event := self._child.first()) is not None:
            kind = event["event"]
            if kind in kinds:
                return event
            if kind == "refused":
                raise SafetyStop(event["reason"])
            if kind == "failed":
                raise _ERRORS.get(event.get("code", 3), WorkError)(event["reason"])
            if kind in ("warning", "second_channel"):
                self.warnings.append(event.get("text") or event["reason"])
        return None

    def _why_it_ended(self) -> LimberError:
        try:
            code = self.process.wait(1.0)
        except subprocess.TimeoutExpired:
            code = None
        if ended_by_deadline(code):
            return SafetyStop("The robot was stopped: the controller did not answer its driver "
                              f"for {CALL_SECONDS:g} s, so the driver was ended.", "Its connection "
                              "works in one direction only, or not at all.", "Check the robot, "
                              "which its own watchdog has stopped. Check cable and network before "
                              "connecting again.")
        return WorkError("The robot's driver has ended.", "Its connection broke.",
                         "Check the robot; its own watchdog has stopped it.")

    def abandon(self) -> None:
        """Close the pipe without a message, as a killed program does."""
        self._closing.set()
        self._child.close_input()

    def close(self) -> None:
        """Stop the motion and end the process; its last warnings are kept."""
        self._closing.set()
        self._child.close()
        with self._child.news:
            self.warnings += [event["text"] for event in self._child.objects
                              if event["event"] == "warning"]

    def _order(self, **content: Any) -> None:
        self._write(content)

    def _write(self, content: dict[str, Any] | str) -> None:
        try:
            self._child.send(content)
        except ConnectionError as error:
            raise WorkError(f"The robot's driver has ended ({error}).") from error

    def _beat(self) -> None:
        while not self._closing.wait(_BEAT_SECONDS):
            try:
                self._order(order="alive")
            except WorkError:
                return

    def _hear(self, content: dict[str, Any]) -> bool:
        if "samples" not in content:
            return False
        rows = np.array([[np.nan if x is None else x for x in row]
                         for row in content["samples"]], float)
        if self._on_samples is not None:
            self._on_samples(rows)
        self._fresh = rows[-1]
        return True

    def _ended(self) -> None:
        """If the driver got no answer it could send no stop: try the dashboard again."""
        if not ended_by_deadline(self._child.process.wait()):
            return
        sent = stop_from_outside(self._cell, _DASHBOARD_SECONDS)
        self.warnings.append("The driver got no answer from the controller. The dashboard was "
                             "asked to stop the arm as well." if sent else
                             "The driver got no answer from the controller, and the dashboard "
                             "does not answer either: the arm's own watchdog has stopped it.")


# The force while a robot moves, for observers: a small file that exists meanwhile.
#
# It is rewritten ten times a second and read by the add-on. It orders nothing, and nothing depends
# on its being read.

FILE = ".robot-live.json"
"""In the branch folder, beside the lock of the program that moves the robot."""
FORMAT = 1
_INTERVAL_SECONDS = 0.1
_KEPT = 150
"""Number of forces in the file, those of the last quarter of a minute."""
_FORCE, _SMOOTH, _EXPECTED = (slice(COLUMNS.index(name), COLUMNS.index(name) + 3)
                              for name in ("fx_n", "smooth_fx_n", "expected_fx_n"))


class LiveForce:
    """Writes the gripper's force into the branch folder and removes the file at its end; a context
    manager. ``title`` names the motion for a person, ``limit`` is the force at which the guard
    pauses [N]."""

    def __init__(self, folder: Path, title: str, limit: float):
        self._path = Path(folder) / FILE
        self._title, self._limit = title, limit
        self._step, self._peak, self._written = "", 0.0, 0.0
        self._recent: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        self._force = self._expected = float("nan")

    def __enter__(self) -> LiveForce:
        return self

    def __exit__(self, *_exception: object) -> None:
        self._path.unlink(missing_ok=True)

    def at(self, step: str) -> None:
        """State the robot's current action."""
        self._step = step

    def take(self, samples: np.ndarray) -> None:
        """Take a batch of samples [n, 37], as in :data:`limber.robot.driver.link.COLUMNS`."""
        forces = np.linalg.norm(samples[:, _SMOOTH], axis=1)
        forces = np.where(np.isfinite(forces), forces, np.linalg.norm(samples[:, _FORCE], axis=1))
        if np.isfinite(forces).any():
            self._peak = max(self._peak, float(np.nanmax(forces)))
        self._force = float(forces[-1])
        self._expected = float(np.linalg.norm(samples[-1, _EXPECTED]))
        now = time.monotonic()
        if now - self._written >= _INTERVAL_SECONDS:
            self._written = now
            if np.isfinite(self._force):
                self._recent.append((round(float(samples[-1, 0]), 3), round(self._force, 3)))
            self._write()

    def _write(self) -> None:
        """Without waiting for the disk: samples arrive meanwhile, and the file is short-lived."""
        content = {"format": FORMAT, "title": self._title, "step": self._step,
                   "force_n": _finite_or_none(self._force),
                   "expected_n": _finite_or_none(self._expected),
                   "peak_n": _finite_or_none(self._peak), "limit_n": self._limit, "at": time.time(),
                   "recent": list(self._recent)}
        temporary = self._path.with_name(owned_name(self._path.name))
        try:
            temporary.write_text(json.dumps(content), encoding="utf-8")
            os.replace(temporary, self._path)
        except OSError:
            # A full disk, or a reader that holds it on Windows: the samples continue, and the
            # recording reports the disk's error.
            temporary.unlink(missing_ok=True)


def _finite_or_none(value: float) -> float | None:
    return round(value, 4) if np.isfinite(value) else None
