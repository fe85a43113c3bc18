"""Depth images of a pull while it is recorded: what they show of the branch, on the robot's clock.

The tracker that finds the control points (:mod:`limber.perception.tracking`) reads them later, with
the gripper's pose. Only pixels near the branch and outside arm and gripper are kept.
"""

import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from limber.cell.cell_file import Cell
from limber.core.errors import Command, InputError, LimberError, Option
from limber.core.numerics.rigid import inverted, matrices
from limber.geometry.cloud.camera import Camera, depth_to_cloud, write_camera
from limber.geometry.skeleton.skeleton import Skeleton
from limber.perception.observe import write_depth
from limber.robot.realsense import RealSense

_DEPTH_SCALE = 10_000.0  # steps of 0.1 mm
_AROUND_M = 0.05  # beside the axis of the branch at rest, more as the gripper moves
_SPACING_M = 0.005
_CLEAR_M = 0.02  # around arm and gripper
_ENOUGH_POINTS = 50


class DepthRecorder:
    """Writes depth images into a folder in a thread of its own, from :meth:`start` on.

    Args:
        cell: Its [camera] stands still.
        camera: Open.
        folder: Gets ``camera.toml`` and ``depth/SECONDS.png``.
        skeleton: The branch at rest.
        joints: Returns the arm's angles now [rad], or None.

    Attributes:
        count: Images written.
        empty_count: Images that did not show the branch, and were not written.
        error: Why it ended early, or None.

    Raises:
        InputError: the camera is not fixed beside the branch.
    """

    def __init__(self, cell: Cell, camera: RealSense, folder: Path, skeleton: Skeleton,
                 joints: Callable[[], np.ndarray | None]):
        self._cell, self._camera, self._folder = cell, camera, folder
        self._placed = fixed_camera(cell, camera)
        self._tree, self._joints = cKDTree(axis_points(skeleton)), joints
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="depth images", daemon=True)
        self._ahead, self._first = -np.inf, 0.0
        self.count = self.empty_count = 0
        self.error: str | None = None

    def heard(self, clock: float) -> None:
        """A sample with the robot's ``clock`` [s] has just come: the least delay counts."""
        self._ahead = max(self._ahead, clock - time.monotonic())

    def start(self, first: float) -> None:
        """Begin, once; the robot's clock was ``first`` [s] at the recording's time 0."""
        if self._thread.ident is not None:
            return
        self._first = first
        (self._folder / "depth").mkdir(parents=True, exist_ok=True)
        write_camera(self._folder / "camera.toml", self._placed)
        self._thread.start()

    def stop(self) -> None:
        """End; waits for the image under way."""
        self._over.set()
        if self._thread.is_alive():
            self._thread.join()

    def _run(self) -> None:
        try:
            while not self._over.is_set():
                depth, taken = self._camera.frame()
                if (seconds := taken + self._ahead - self._first) >= 0.0:
                    self._write(depth, seconds)
        except (LimberError, OSError) as error:
            self.error = str(error)

    def _write(self, depth: np.ndarray, seconds: float) -> None:
        kept = branch_pixels(self._cell, self._placed, depth, self._tree, self._joints())
        if kept.sum() < _ENOUGH_POINTS:
            self.empty_count += 1
            return
        target = self._folder / "depth" / f"{seconds:.4f}.png"
        beside = target.with_name(f".{target.name}")
        write_depth(beside, np.where(kept, depth, 0.0), self._placed)
        beside.replace(target)
        self.count += 1


def axis_points(skeleton: Skeleton) -> np.ndarray:
    """Return points along all axes of a branch, at most 5 mm apart [m], shape [n, 3]."""
    child = np.flatnonzero(skeleton.parent >= 0)
    starts, ends = skeleton.nodes[skeleton.parent[child]], skeleton.nodes[child]
    counts = np.ceil(np.linalg.norm(ends - starts, axis=1) / _SPACING_M).astype(int)
    return np.vstack([skeleton.nodes, *(
        np.linspace(start, end, count + 1)
        for start, end, count in zip(starts, ends, counts, strict=True))])


def fixed_camera(cell: Cell, camera: RealSense) -> Camera:
    """Return the camera at its pose in the branch's frame.

    Raises:
        InputError: the cell has no camera, or one on the flange.
    """
    if cell.camera is None or cell.camera.mount != "branch":
        raise InputError("The cell file has no [camera] with mount = \"branch\".", "During a pull "
                         "the camera has to stand still beside the branch.", "Calibrate a fixed "
                         "camera: ", Command("robot calibrate", Option("images")), ".")
    return camera.camera.model_copy(update={"pose": tuple(cell.camera.pose),
                                            "depth_scale": _DEPTH_SCALE})


def branch_pixels(cell: Cell, camera: Camera, depth: np.ndarray, axis: cKDTree,
                  joints: np.ndarray | None) -> np.ndarray:
    """Return the pixels that may show the branch, shape [height, width] of bool.

    Args:
        depth: [m], shape [height, width]; NaN or 0 without a reading.
        axis: Points on the branch's axis at rest, branch frame.
        joints: The arm's angles [rad]; None: it is not left out.
    """
    assert cell.camera is not None
    near, far = cell.camera.range_m
    kept = np.isfinite(depth) & (depth >= near) & (depth <= far)
    points = depth_to_cloud(camera, np.nan_to_num(depth), kept).points
    reach = _AROUND_M
    if joints is not None:
        frame = matrices(np.array(cell.base.pose)) @ cell.arm.forward(joints)
        held = (frame @ matrices(np.array(cell.tool.grasp_pose)))[:3, 3]
        reach += float(axis.query(held)[0])
    good = axis.query(points, distance_upper_bound=reach)[0] < np.inf
    if joints is not None and good.any():
        good[good] = _outside_arm(cell, joints, points[good])
    kept[kept] = good
    return kept


def _outside_arm(cell: Cell, joints: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Whether points [n, 3], branch frame, are clear of the arm and its gripper, shape [n]."""
    base = matrices(np.array(cell.base.pose))
    turned = inverted(base)
    local = points @ turned[:3, :3].T + turned[:3, 3]
    rods = cell.arm.rods(joints[None])
    flange = cell.arm.forward(joints)
    capsules = [*zip(rods.starts[0], rods.ends[0], map(float, rods.radii), strict=True),
                *((*(np.array([part.start_m, part.end_m]) @ flange[:3, :3].T + flange[:3, 3]),
                   part.radius_m) for part in cell.tool.parts)]
    clear = np.ones(len(points), bool)
    for start, end, radius in capsules:
        way = end - start
        share = np.clip((local - start) @ way / max(float(way @ way), 1e-18), 0.0, 1.0)
        clear &= np.linalg.norm(local - start - share[:, None] * way, axis=1) > radius + _CLEAR_M
    return clear
