"""What stands before a fixed camera now, for goals in its view (``limber plan --in-view``)."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial import KDTree

from limber.cell.cell_file import Cell
from limber.core.errors import LimberError
from limber.core.progress import Progress
from limber.geometry.cloud.camera import Camera, project
from limber.robot.realsense import RealSense, camera_differences, placed_image

_BRANCH_M = 0.02  # from the branch's nodes at rest: its own points, with their noise
_BEFORE_M = 0.01  # nearer than the target; less is the depth's noise
_PIXELS = 1  # around the target's own, for errors of the camera's pose


@dataclass(frozen=True)
class LiveView:
    """One image of what is neither the branch nor out of range.

    Attributes:
        camera: Intrinsics as the device reports them; its pose in the branch's frame.
        depth: [m], NaN where nothing of that kind was seen, shape [height, width].
    """

    camera: Camera
    depth: np.ndarray

    @classmethod
    def taken(cls, cell: Cell, device: RealSense, branch: np.ndarray) -> "LiveView":
        """Take an image with the camera at the cell's [camera], which is fixed.

        Args:
            branch: Its nodes at rest, branch frame [m], shape [n, 3].
        """
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

    Args:
        branch: As :meth:`LiveView.taken` takes it.
    """
    device: Any
    try:
        with RealSense() as device:
            differences = camera_differences(cell, device.camera)
            seen = LiveView.taken(cell, device, branch)
    except LimberError as error:
        progress.warn(f"No connected camera was asked ({error.seen.rstrip('.')}): the view is "
                      "that of [camera] in the cell file, and what else stands in it now is not "
                      "known.")
        return None
    for each in differences:
        progress.warn(f"{each}. The connected camera's own view is taken.")
    return seen
