"""Live depth images of an Intel RealSense camera, by its maker's package pyrealsense2.

The package is large and not needed by anything else, so it belongs to no extra of Limber.
"""

import time
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import MissingDependencyError, WorkError
from limber.core.numerics.rigid import matrices, pose_vectors
from limber.core.optional import pip_install
from limber.geometry.cloud.camera import Camera, depth_to_cloud

_FRAMES = 15
"""Frames of one image: their median has less noise, and half of them may miss a pixel."""
_SETTLE_FRAMES = 15  # until the exposure is steady
_WAIT_MS = 2000
_SAME_FOCAL, _SAME_PX = 0.01, 2.0  # fraction of the focal length; pixels of the centre
_OLDEST_SECONDS = 0.5  # of a frame; more is another clock


class RealSense:
    """The first camera that is connected; a context manager.

    Attributes:
        camera: Its intrinsics, as it reports them.

    Raises:
        MissingDependencyError: pyrealsense2 is not installed. WorkError: no camera answers.
    """

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
        """Return a depth image [m], shape [height, width]; NaN without a reading.

        Raises:
            WorkError: it sends no frames.
        """
        frames = np.array([self._frame() for _ in range(_FRAMES)])
        is_seen = (frames > 0).sum(axis=0) > _FRAMES // 2
        median = np.ma.median(np.ma.masked_equal(frames, 0), axis=0).filled(0)
        return np.where(is_seen, self._scale * median, np.nan)

    def frame(self) -> tuple[np.ndarray, float]:
        """Return the next image [m], NaN without a reading, and when it was taken [s, monotonic].

        Raises:
            WorkError: it sends no frames.
        """
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
    """Return the points that a camera sees within its range [m], branch frame, shape [n, 3].

    Args:
        cell: Its [camera] states pose and mount.
        flange: The flange's frame in the robot's base, for a camera on it, shape [4, 4].
    """
    return placed_image(cell, camera, flange)[2]


def placed_image(cell: Cell, camera: RealSense, flange: np.ndarray | None,
                 ) -> tuple[Camera, np.ndarray, np.ndarray]:
    """Return the camera at its pose in the branch's frame; a depth image [m], shape [height,
    width], NaN outside the range; and its points by rows [m], branch frame, shape [n, 3].

    Args:
        cell, flange: As :func:`seen_points` takes them.
    """
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
