"""Boards in a camera's pictures: ChArUco boards and AprilTags, found by OpenCV, fitted in pixels.

OpenCV finds corners and a first pose of the board in each picture. Camera and board are then
fitted to all corners of all pictures at once, so that residuals are pixels and the uncertainty
follows from them.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy

from limber.cell.cell_file import CameraEntry
from limber.core.errors import InputError
from limber.core.numerics.rigid import inverted, matrices
from limber.core.optional import require_extra
from limber.robot.cell.hand_eye import CameraFit, CameraOn, fit_camera

_FEWEST_CORNERS = 4
_LARGEST_PX = 3.0


@dataclass(frozen=True)
class Board:
    """A printed board or tag.

    Attributes:
        kind: Kind of print.
        squares: Number of squares of the ChArUco board along x and y.
        square_m: Edge length of its squares, or of the tag [m].
        marker_m: Edge length of its markers [m].
        dictionary: Marker dictionary by its OpenCV name.
    """

    kind: Literal["charuco", "apriltag"]
    squares: tuple[int, int]
    square_m: float
    marker_m: float
    dictionary: str


@dataclass(frozen=True)
class View:
    """A board in one picture.

    Attributes:
        name: Name of the picture.
        corners: Corners on the board [m], its frame, shape [k, 3].
        pixels: Their positions in the picture, shape [k, 2].
        pose: Pose of the board in the camera's frame from this picture alone [m, rad], shape [6].
    """

    name: str
    corners: np.ndarray
    pixels: np.ndarray
    pose: np.ndarray


def find_board(path: Path, board: Board, camera: CameraEntry) -> View | None:
    """Return the board in a picture; None if too little of it is seen.

    Raises:
        InputError: the picture cannot be read, or has another size than the camera's.
        MissingDependencyError: OpenCV is not installed.
    """
    require_extra("camera", ("cv2",), "Finding a board in pictures")
    import cv2

    picture = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
    if picture is None:
        raise InputError(f"{path} cannot be read as a picture.", "", "Give PNG or JPEG files.")
    if picture.shape != (camera.height, camera.width):
        raise InputError(f"{path} has {picture.shape[1]} x {picture.shape[0]} pixels, but the "
                         f"cell's camera has {camera.width} x {camera.height}.",
                         "Its focal length would be another.", "Correct [camera] in the cell "
                         "file, or give the pictures as they were taken.")
    corners, pixels = _corners(cv2, picture, board)
    if len(corners) < _FEWEST_CORNERS:
        return None
    found, turn, translation = cv2.solvePnP(corners, pixels, _matrix(camera), np.zeros(5))
    if not found:
        return None
    return View(path.name, corners, pixels, np.r_[translation.ravel(), turn.ravel()])


def _corners(cv2: Any, picture: np.ndarray, board: Board) -> tuple[np.ndarray, np.ndarray]:
    """Corners on the board [k, 3] and in the picture [k, 2]."""
    number = getattr(cv2.aruco, board.dictionary, None)
    if number is None:
        raise InputError(f"OpenCV has no dictionary {board.dictionary}.", "",
                         "Examples: DICT_5X5_100, DICT_APRILTAG_36h11.")
    dictionary = cv2.aruco.getPredefinedDictionary(number)
    nothing = np.zeros((0, 3)), np.zeros((0, 2))
    if board.kind == "charuco":
        printed = cv2.aruco.CharucoBoard(board.squares, board.square_m, board.marker_m, dictionary)
        seen, numbers, _, _ = cv2.aruco.CharucoDetector(printed).detectBoard(picture)
        if seen is None or len(seen) < _FEWEST_CORNERS:
            return nothing
        corners, pixels = printed.matchImagePoints(seen, numbers)
        return (np.asarray(corners, float).reshape(-1, 3),
                np.asarray(pixels, float).reshape(-1, 2))
    settings = cv2.aruco.DetectorParameters()
    settings.cornerRefinementMethod = cv2.aruco.CORNER_REFINE_SUBPIX
    tags, _, _ = cv2.aruco.ArucoDetector(dictionary, settings).detectMarkers(picture)
    if len(tags) != 1:
        return nothing
    half = 0.5 * board.square_m
    corners = np.array([[-half, half, 0], [half, half, 0], [half, -half, 0], [-half, -half, 0]])
    return corners, np.asarray(tags[0], float).reshape(-1, 2)


def _matrix(camera: CameraEntry) -> np.ndarray:
    (fx, fy), (cx, cy) = camera.focal_px, camera.centre_px
    return np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1.0]])


def fit_pictures(robot: np.ndarray, views: list[View], camera: CameraEntry, camera_on: CameraOn,
                 largest_residual: float = 0.01) -> tuple[CameraFit, np.ndarray]:
    """Fit the frames of camera and board to all corners of all pictures.

    Args:
        robot: Poses of the gripper's middle [m, rad], shape [n, 6].
        views: One per pose.
        camera_on: What carries the camera.

    Returns:
        The fit, and each picture's residual (root mean square of its corners' distances) [px].

    Raises:
        InputError: as :func:`.fit_camera`; or a picture does not fit, which is named.
    """
    first = fit_camera(robot, np.array([view.pose for view in views]), camera_on,
                       largest_residual=largest_residual)
    moves = matrices(robot) if camera_on == "stand" else inverted(matrices(robot))
    found = scipy.optimize.least_squares(
        _pixels_off, np.r_[first.camera, first.board], args=(moves, views, _matrix(camera)),
        x_scale="jac", xtol=1e-12, ftol=1e-12)
    ends = np.cumsum([len(view.corners) for view in views])[:-1]
    residuals = np.array([np.sqrt((part**2).sum(axis=1).mean())
                          for part in np.split(found.fun.reshape(-1, 2), ends)])
    if residuals.max() > _LARGEST_PX:
        worst = int(residuals.argmax())
        raise InputError(f"{views[worst].name} has a residual of {residuals[worst]:.1f} pixels.",
                         "It belongs to another pose of the arm, the printed size differs, or the "
                         "lens distorts.", "Omit it, correct the sizes, or give undistorted "
                         "pictures.")
    free = found.fun.size - len(found.x)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * (2 * found.cost / free)
    return replace(first, camera=found.x[:6], board=found.x[6:], covariance=covariance), residuals


def _pixels_off(values: np.ndarray, moves: np.ndarray, views: list[View], lens: np.ndarray,
                ) -> np.ndarray:
    """Distances of all corners from their expected positions [px], flat."""
    seen = inverted(matrices(values[:6])) @ moves @ matrices(values[6:])
    parts = []
    for frame, view in zip(seen, views, strict=True):
        projected = (view.corners @ frame[:3, :3].T + frame[:3, 3]) @ lens.T
        parts.append(projected[:, :2] / np.maximum(projected[:, 2:], 1e-6) - view.pixels)
    return np.concatenate(parts).ravel()
