"""Depth images of an Intel RealSense camera: live, of a pull, and what hides a goal."""

import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import KDTree, cKDTree

from limber.cell.cell_file import Cell
from limber.core.errors import (
    Command,
    InputError,
    LimberError,
    MissingDependencyError,
    Option,
    WorkError,
)
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.core.optional import pip_install
from limber.core.progress import Progress
from limber.geometry.cloud.camera import Camera, depth_to_cloud, project, write_camera
from limber.geometry.skeleton.skeleton import Skeleton
from limber.perception.observe import write_depth

# Live depth images of an Intel RealSense camera, by its maker's package pyrealsense2.
#
# The package is large and not needed by anything else, so it belongs to no extra of Limber.

_FRAMES = 15
"""Frames of one image: their median has less noise, and half of them may miss a pixel."""
_SETTLE_FRAMES = 15  # until the exposure is steady
_WAIT_MS = 2000
_SAME_FOCAL, _SAME_PX = 0.01, 2.0  # fraction of the focal length; pixels of the centre
_OLDEST_SECONDS = 0.5  # of a frame; more is another clock


class RealSense:
    """The first camera that is connected, with the intrinsics that it reports; a context manager.
    MissingDependencyError without pyrealsense2; WorkError if no camera answers."""

    def __init__(self) -> None:
        library = _library()
        self._pipeline = library.pipeline()
        config = library.config()
        config.enable_stream(library.stream.depth)
        try:
            profile = self._pipeline.start(config)
        except RuntimeError as error:
            raise WorkError(f"No RealSense camera answers ({error}).", "",
                            "Check its USB cable, and that no other program uses it.") from error
        clocks = library.timestamp_domain
        self._host_clocks = (clocks.global_time, clocks.system_time)
        self._scale = float(profile.get_device().first_depth_sensor().get_depth_scale())
        seen = profile.get_stream(library.stream.depth).as_video_stream_profile().get_intrinsics()
        self.camera = Camera(width=seen.width, height=seen.height, fx=seen.fx, fy=seen.fy,
                             cx=seen.ppx, cy=seen.ppy)

    def __enter__(self) -> "RealSense":
        try:
            for _ in range(_SETTLE_FRAMES):
                self._frame()
        except WorkError:
            self._pipeline.stop()
            raise
        return self

    def __exit__(self, *_exception: object) -> None:
        self._pipeline.stop()

    def depth(self) -> np.ndarray:
        """Return a depth image [m], shape [height, width], NaN without a reading; WorkError if it
        sends no frames."""
        frames = np.array([self._frame() for _ in range(_FRAMES)])
        is_seen = (frames > 0).sum(axis=0) > _FRAMES // 2
        median = np.ma.median(np.ma.masked_equal(frames, 0), axis=0).filled(0)
        return np.where(is_seen, self._scale * median, np.nan)

    def frame(self) -> tuple[np.ndarray, float]:
        """Return the next image [m], NaN without a reading, and when it was taken [s, monotonic];
        WorkError if it sends no frames."""
        frame = self._next()
        age = 0.0
        if frame.get_frame_timestamp_domain() in self._host_clocks:
            age = min(max(time.time() - 1e-3 * frame.get_timestamp(), 0.0), _OLDEST_SECONDS)
        taken = time.monotonic() - age
        steps = np.asanyarray(frame.get_data())
        return np.where(steps > 0, self._scale * steps, np.nan), taken

    def _frame(self) -> np.ndarray:
        return np.asanyarray(self._next().get_data()).copy()

    def _next(self) -> Any:
        try:
            return self._pipeline.wait_for_frames(_WAIT_MS).get_depth_frame()
        except RuntimeError as error:
            raise WorkError(f"The RealSense camera sends no image ({error}).", "",
                            "Check its USB cable: depth needs USB 3.") from error


def seen_points(cell: Cell, camera: RealSense, flange: np.ndarray | None) -> np.ndarray:
    """Return the points that a camera sees within its range [m], branch frame, shape [n, 3];
    ``flange``: its frame in the robot's base, for a camera on it, shape [4, 4]."""
    return placed_image(cell, camera, flange)[2]


def placed_image(cell: Cell, camera: RealSense, flange: np.ndarray | None,
                 ) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Return the camera at its pose in the branch's frame, a depth image [m], shape [height,
    width], NaN outside the range, and its points by rows [m], branch frame, shape [n, 3]."""
    entry = cell.camera
    assert entry is not None
    frame = matrices(np.array(entry.pose))
    if flange is not None:
        frame = matrices(np.array(cell.base.pose)) @ flange @ frame
    depth = camera.depth()
    near, far = entry.range_m
    placed = camera.camera.model_copy(update={"pose": tuple(map(float, pose_vectors(frame)))})
    depth = np.where((depth >= near) & (depth <= far), depth, np.nan)
    return placed, depth, depth_to_cloud(placed, depth).points


def camera_differences(cell: Cell, camera: Camera) -> list[str]:
    """Return in words how the intrinsics of the cell's [camera] differ from the connected camera's.
    """
    entry = cell.camera
    if entry is None:
        return ["A camera is connected, but the cell file has no [camera]"]
    found = []
    for what, seen, wanted, within in (
            ("camera's size", (camera.width, camera.height), (entry.width, entry.height), 0.0),
            ("camera.focal_px", (camera.fx, camera.fy), entry.focal_px,
             _SAME_FOCAL * camera.fx),
            ("camera.centre_px", (camera.cx, camera.cy), entry.centre_px, _SAME_PX)):
        if np.abs(np.subtract(seen, wanted)).max() > within:
            found.append(f"{what}: ({seen[0]:g}, {seen[1]:g}) pixels in the connected camera, "
                         f"({wanted[0]:g}, {wanted[1]:g}) in the cell file")
    return found


def _library() -> Any:
    try:
        import pyrealsense2
    except ImportError as error:
        raise MissingDependencyError(
            "pyrealsense2 is not installed.", "A RealSense camera is read by its maker's package.",
            pip_install("pyrealsense2")) from error
    return pyrealsense2


_BRANCH_M = 0.02  # from the branch's nodes at rest: its own points, with their noise
_BEFORE_M = 0.01  # nearer than the target; less is the depth's noise
_PIXELS = 1  # around the target's own, for errors of the camera's pose


@dataclass(frozen=True)
class LiveView:
    """An image [m], shape [height, width], of what is neither the branch nor out of range (NaN),
    with the camera's intrinsics and pose in the branch's frame."""

    camera: Camera
    depth: np.ndarray

    @classmethod
    def taken(cls, cell: Cell, device: RealSense, branch: np.ndarray) -> "LiveView":
        """Take an image with the camera at the cell's [camera], which is fixed; ``branch``: its
        nodes at rest, branch frame [m], shape [n, 3]."""
        camera, depth, points = placed_image(cell, device, None)
        away, _ = KDTree(branch).query(points, distance_upper_bound=_BRANCH_M)
        other = np.full(depth.shape, np.nan)
        seen = np.isfinite(depth)
        other[seen] = np.where(np.isfinite(away), np.nan, depth[seen])
        return cls(camera, other)

    def hiding(self, point: np.ndarray) -> str:
        """Return in words what hides ``point`` [3], branch frame; empty if nothing does."""
        pixels, depths = project(self.camera, np.asarray(point, float)[None])
        if not depths[0] > 0.0:
            return ""
        column, row = np.round(pixels[0]).astype(int)
        around = self.depth[max(row - _PIXELS, 0):max(row + _PIXELS + 1, 0),
                            max(column - _PIXELS, 0):max(column + _PIXELS + 1, 0)]
        nearest = float(np.min(around, initial=np.inf, where=np.isfinite(around)))
        if nearest > depths[0] - _BEFORE_M:
            return ""
        return f"something {nearest:.2f} m before the camera, which sees it now, hides it"


def look(cell: Cell, branch: np.ndarray, progress: Progress) -> LiveView | None:
    """Return what the connected camera sees now; None, with a warning, where none answers.
    ``branch`` as of :meth:`LiveView.taken`."""
    device: Any
    try:
        with RealSense() as device:
            differences = camera_differences(cell, device.camera)
            seen = LiveView.taken(cell, device, branch)
    except LimberError as error:
        progress.warn(f"No connected camera was asked ({error.seen.rstrip('.')}): the view is that "
                      "of [camera] in the cell file, and what else stands in it now is not known.")
        return None
    for each in differences:
        progress.warn(f"{each}. The connected camera's own view is taken.")
    return seen


# Depth images of a pull while it is recorded: what they show of the branch, on the robot's clock.
#
# The tracker that finds the control points (:mod:`limber.perception.observe`) reads them later,
# with the gripper's pose. Only pixels near the branch and outside arm and gripper are kept.

_DEPTH_SCALE = 10_000.0  # steps of 0.1 mm
_AROUND_M = 0.05  # beside the axis of the branch at rest, more as the gripper moves
_SPACING_M = 0.005
_CLEAR_M = 0.02  # around arm and gripper
_ENOUGH_POINTS = 50


class DepthRecorder:
    """Writes ``camera.toml`` and ``depth/SECONDS.png`` into a folder in a thread of its own, from
    :meth:`start` on; images that do not show the branch are only counted. ``joints`` returns the
    arm's angles now [rad], or None; ``error`` is why it ended early. InputError if the camera is
    not fixed beside the branch."""

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
    """Return the camera at its pose in the branch's frame; InputError if the cell has none, or one
    on the flange."""
    if cell.camera is None or cell.camera.mount != "branch":
        raise InputError("The cell file has no [camera] with mount = \"branch\".", "During a pull "
                         "the camera has to stand still beside the branch.", "Calibrate a fixed "
                         "camera: ", Command("robot calibrate", Option("images")), ".")
    return camera.camera.model_copy(update={"pose": tuple(cell.camera.pose),
                                            "depth_scale": _DEPTH_SCALE})


def branch_pixels(cell: Cell, camera: Camera, depth: np.ndarray, axis: cKDTree,
                  joints: np.ndarray | None) -> np.ndarray:
    """Return the pixels of a depth image [m], NaN or 0 without a reading, that may show the branch,
    bool [height, width]: near ``axis`` at rest, branch frame, and not the arm at ``joints``
    [rad]."""
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
