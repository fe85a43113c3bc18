"""Who watches the branch during a recorded pull: a tracker's points, or a RealSense camera."""

from __future__ import annotations

from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from limber.core.errors import InputError, Option, Text
from limber.core.files.tables import table_line
from limber.core.progress import Progress
from limber.robot.recorder import MarkerStream, PullRecorder
from limber.store import Branch

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.depth_camera import DepthRecorder
    from limber.store import Stream


class Observers:
    """Writes what is seen beside ``robot.csv``; a context manager. ``folder`` gets the depth images
    of the connected camera (``realsense``), ``markers`` is the port of a tracker at the robot's
    address, ``lines`` its stream; ``kind`` goes into ``pull.toml``. InputError for both, or a
    camera not fixed; WorkError if either does not answer."""

    def __init__(self, branch: Branch, cell: Cell, name: str, folder: Path, markers: int | None,
                 realsense: bool):
        self.kind: Literal["markers", "depth", "none"] = (
            "markers" if markers else "depth" if realsense else "none")
        self._branch, self._cell, self._name, self._folder = branch, cell, name, folder
        self._port, self._realsense = markers, realsense
        self._tracker: MarkerStream | None = None
        self._depth: DepthRecorder | None = None
        self.lines: Stream | None = None
        self._joints: np.ndarray | None = None
        self._around = ExitStack()

    def __enter__(self) -> Observers:
        if self._port and self._realsense:
            raise InputError(Text("Both ", Option("markers"), " and ", Option("realsense"), " are "
                                  "given."), "A pull has one kind of "
                             "observation.", "Give one.")
        with ExitStack() as around:
            if self._port:
                self._tracker = MarkerStream(self._cell.robot.address, self._port,
                                             np.array(self._cell.base.pose))
                around.callback(self._tracker.close)
                self.lines = self._branch.stream(f"pulls/{self._name}/markers.csv")
            if self._realsense:
                self._depth = self._with_camera(around)
                around.callback(self._depth.stop)
            self._around = around.pop_all()
        return self

    def _with_camera(self, around: ExitStack) -> DepthRecorder:
        from limber.robot.depth_camera import DepthRecorder, RealSense
        from limber.store.loading import load_skeleton

        camera = around.enter_context(RealSense())
        return DepthRecorder(self._cell, camera, self._folder, load_skeleton(self._branch),
                             lambda: self._joints)

    def __exit__(self, *exception: Any) -> None:
        self._around.__exit__(*exception)

    def at_rest(self) -> tuple[tuple[Any, ...] | None, float | None]:
        """Return the tracker's points of the resting branch [m], and the noise of one [m];
        WorkError as of :meth:`.MarkerStream.at_rest`."""
        if self._tracker is None or self.lines is None:
            return None, None
        points, noise = self._tracker.at_rest()
        names = (f"m{k}_{axis}_m" for k in range(len(points)) for axis in "xyz")
        self.lines.append(table_line(("t_s", *names)))
        return tuple(tuple(map(float, point)) for point in points), noise

    def heard(self, rows: np.ndarray) -> None:
        """Samples of the robot have just come, shape [n, 37]."""
        self._joints = rows[-1, 19:25]
        if self._depth is not None:
            self._depth.heard(float(rows[-1, 0]))

    def write(self, recorder: PullRecorder) -> None:
        """Write what has come since the last call; images begin with the recorder's rows."""
        if recorder.first is None:
            return
        if self._depth is not None:
            self._depth.start(recorder.first)
        if self._tracker is None or self.lines is None:
            return
        for clock, points in self._tracker.read():
            if clock >= recorder.first:
                self.lines.append(table_line(
                    (f"{clock - recorder.first:.6f}", *points.ravel()), digits=6))

    def end(self, recorder: PullRecorder, progress: Progress) -> None:
        """Write the last observations, and warn of what is missing."""
        self.write(recorder)
        if self._depth is None:
            return
        self._depth.stop()
        if self._depth.error is not None:
            progress.warn(f"The depth images end early, after {self._depth.count}: "
                          f"{self._depth.error}")
        elif self._depth.empty_count:
            progress.warn(f"{self._depth.empty_count} depth images did not show the branch and "
                          f"were left out; {self._depth.count} were written. Check [camera].")
