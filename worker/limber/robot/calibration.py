"""Calibration of a cell: the robot's base beside the branch, and a camera, fixed or on the robot.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from typing import Any, Literal

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from limber.cell.cell_file import CameraEntry, Cell
from limber.core.errors import InputError, Option, Text
from limber.core.numerics.rigid import (
    inverted,
    matrices,
    pose_vectors,
    rigid_fit,
    rotation_vector,
    spreads,
)
from limber.core.optional import require_extra
from limber.robot.controller_settings import in_millimetres, is_tool, tool_in_controller
from limber.robot.interface import Sample

_FEWEST_POINTS = 4
_LEAST_SPREAD = 0.02  # m, of the second principal direction
_LEAST_OUT_OF_PLANE = 0.005  # m, of the third
# Expected deviation of a touched coordinate over the largest residual, so many degrees of freedom
# worth, the chance that a sound point is refused, and the difference of log likelihoods below which
# two points are named.
_TOUCHING, _TOUCHES, _DOUBTED, _EVEN = 0.1, 6, 0.02, 3.0


@dataclass(frozen=True)
class BaseFit:
    """Pose of the robot's base in the branch's frame [m, rad], shape [6], distances of the points
    after the fit [m], shape [n], and standard errors of the base's position at the points [m] and
    of its rotation about its worst axis [rad]."""

    pose: np.ndarray
    residuals: np.ndarray
    position_sigma: float
    rotation_sigma: float

    @property
    def residual(self) -> float:
        """Root mean square of the residuals [m]."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def least_depth(largest_residual: float) -> float:
    """Return how far out of plane points must spread [m] to reveal a mirrored fit: its residuals
    are twice that, and must exceed the allowed residual."""
    return max(_LEAST_OUT_OF_PLANE, 0.5 * largest_residual)


def require_frame(points: np.ndarray, names: Sequence[str], which: str,
                  largest_residual: float = 0.01) -> None:
    """Refuse points [m], shape [n, 3], that do not determine the frame or its handedness: three, or
    any number in a plane, fit a mirrored one without a residual. ``which`` is ``on the branch`` or
    ``as they were touched``. InputError if too few, no numbers, too close, in a line or in a
    plane."""
    if len(points) < _FEWEST_POINTS:
        raise InputError(f"{len(points)} points {which}.", "Four or more points that are not "
                         "coplanar are needed, because fewer also fit a mirrored "
                         "frame.", "Touch more points.")
    if not np.isfinite(points).all():
        worst = names[int((~np.isfinite(points)).any(axis=1).argmax())]
        raise InputError(f"Point {worst} {which} is not a number.", "", "Touch it again.")
    away = np.linalg.norm(points[:, None] - points[None], axis=2)
    away[np.tril_indices(len(points))] = np.inf
    first, second = np.unravel_index(away.argmin(), away.shape)
    if away[first, second] < largest_residual:
        raise InputError(
            f"Points {names[first]} and {names[second]} are {1000 * away[first, second]:.1f} mm "
            f"apart {which}.", f"At least {1000 * largest_residual:.0f} mm are needed, because "
            "closer points can be confused.", "Omit one of them, and touch another point.")
    spread = spreads(points)
    if spread[1] < _LEAST_SPREAD:
        raise InputError(
            f"The points {which} are nearly collinear: they spread by {1000 * spread[1]:.1f} mm "
            f"across their line (root mean square), and {1000 * _LEAST_SPREAD:.0f} mm are needed.",
            "The frame could rotate about that line.",
            "Touch points beside it, such as twigs and the rim of the pot.")
    needed = least_depth(largest_residual)
    if spread[2] < needed:
        raise InputError(f"The points {which} lie in a plane: they spread by "
                         f"{1000 * spread[2]:.1f} mm out of it (root mean square), and "
                         f"{1000 * needed:.0f} mm are needed.", "A mirrored frame would fit "
                         "equally well.", "Touch points above and below it, such as the rim of the "
                         "pot and the tip of the branch.")


def gripper_pose(cell: Cell, sample: Sample) -> np.ndarray:
    """Return the pose of the gripper's middle by the controller's own pose, base frame [m, rad, 6],
    as it knows the arm's true dimensions. Newer ones report the tool set there; else the nominal
    dimensions, not used for the position, show whether it is ``tool.grasp_pose`` or none.
    InputError if another is set."""
    grasp = np.array(cell.tool.grasp_pose)
    if sample.tool is not None:
        return _carried(sample.pose, sample.tool, grasp)
    for tool in (grasp, np.zeros(6)):
        if is_tool(cell, sample, tool):
            return _carried(sample.pose, tool, grasp)
    raise InputError("The tool centre point in the controller is at about "
                     f"{in_millimetres(tool_in_controller(cell, sample))} in the flange's frame, "
                     f"but the cell's tool.grasp_pose is at {in_millimetres(grasp)}.", "So the "
                     "controller's pose is not the pose of the gripper's centre.", "Set the tool "
                     "centre point to tool.grasp_pose on the pendant, or correct the cell file.")


def _carried(pose: np.ndarray, tool: np.ndarray, grasp: np.ndarray) -> np.ndarray:
    return pose_vectors(matrices(pose) @ inverted(matrices(tool)) @ matrices(grasp))


def fit_base(touched: np.ndarray, on_branch: np.ndarray, *, largest_residual: float = 0.01,
             names: Sequence[str] | None = None) -> BaseFit:
    """Fit the rigid transform from the robot's base to the branch's frame (Kabsch 1976), from
    points [m], shape [n, 3], touched by the tip and on the branch. InputError for fewer than four,
    in a plane, too close, mirrored, mixed up, or touched beside their place: off by more than
    ``largest_residual`` [m], or by much more than others that are expected to be off by a tenth of
    it."""
    touched, on_branch = np.asarray(touched, float), np.asarray(on_branch, float)
    if touched.shape != on_branch.shape or touched.ndim != 2 or touched.shape[1] != 3:
        raise InputError(f"{len(touched)} points were touched, but {len(on_branch)} are given on "
                         "the branch.", "Each point needs its counterpart.", "Correct the list.")
    names = [str(number + 1) for number in range(len(touched))] if names is None else names
    require_frame(on_branch, names, "on the branch", largest_residual)
    require_frame(touched, names, "as they were touched", largest_residual)
    frame, residuals = _registered(touched, on_branch)
    beside = _beside(touched, on_branch, names, largest_residual)
    if residuals.max() > largest_residual:
        raise _inaccurate(residuals, touched, on_branch, names, beside, largest_residual)
    if beside is not None:
        raise beside
    # Six unknowns are fitted to 3 n numbers.
    sigma = float(np.sqrt((residuals**2).sum() / (3 * len(touched) - 6)))
    return BaseFit(pose_vectors(frame), residuals, sigma / np.sqrt(len(touched)),
                   sigma / (np.sqrt(len(touched)) * float(spreads(on_branch)[1])))


def _registered(touched: np.ndarray, on_branch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the frame [4, 4] that best fits points [n, 3], and the residuals [m, n]."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rigid_fit(touched, on_branch)
    return frame, np.linalg.norm(touched @ frame[:3, :3].T + frame[:3, 3] - on_branch, axis=1)


def _beside(touched: np.ndarray, on_branch: np.ndarray, names: Sequence[str],
            largest_residual: float) -> InputError | None:
    """Return which point is not where all the others put it, by how well those agree (F test of
    each point left out), None if all are. A fit of few points bends to one that is off."""
    count = len(names)
    degrees = 3 * count - 9 + _TOUCHES
    expected = _TOUCHES * (_TOUCHING * largest_residual)**2
    left = [(frame, residuals.max(), (residuals**2).sum() + expected) for frame, residuals in (
        _registered(np.delete(touched, k, 0), np.delete(on_branch, k, 0)) for k in range(count))]
    squares = np.array([sum_ for _, _, sum_ in left])
    k = int(squares.argmin())
    whole = (_registered(touched, on_branch)[1]**2).sum() + expected
    if scipy.stats.f.sf((whole / squares[k] - 1) * degrees / 3, 3, degrees) * count >= _DOUBTED:
        return None
    frame, agreed, _ = left[k]
    away = float(np.linalg.norm(frame[:3, :3] @ touched[k] + frame[:3, 3] - on_branch[k]))
    others = [names[other] for other in np.flatnonzero(
        0.5 * degrees * np.log(squares / squares[k]) < _EVEN) if other != k]
    return InputError(
        f"Point {names[k]} is {1000 * away:.1f} mm from where the other points put it; those agree "
        f"within {1000 * agreed:.1f} mm." + "".join(f" It may also be {name}." for name in others),
        "It was touched beside its place, or the branch moved.",
        Text("Touch it again or omit it. If all points were touched roughly, give a larger value "
             "of ", Option("largest_residual"), "."))


def _inaccurate(residuals: np.ndarray, touched: np.ndarray, on_branch: np.ndarray,
                names: Sequence[str], beside: InputError | None,
                largest_residual: float) -> InputError:
    """Return why points [n, 3] do not fit: the change that would make them fit, or the one that
    is ``beside`` its place."""
    off = ", ".join(f"{name} {1000 * value:.1f}"
                    for name, value in zip(names, residuals, strict=True))

    def fits(points: np.ndarray) -> bool:
        return bool(_registered(points, on_branch)[1].max() <= largest_residual)
    if fits(-touched):
        return InputError("The points fit only when mirrored. Without mirroring, the residuals "
                          f"[mm] are: {off}.", "So one of the frames is left-handed.",
                          "Correct the signs or the order of its axes.")
    factor = _size(on_branch) / _size(touched)
    if fits(factor * touched):
        return InputError(f"The points fit only when the touched ones are multiplied by "
                          f"{factor:.4g}. As they are, the residuals [mm] are: {off}.",
                          "So one of the two lists is in another unit, or the scan has another "
                          "scale.", "Give both in metres; check the scan's scale by a length.")
    for first, second in combinations(range(len(names)), 2):
        order = np.arange(len(names))
        order[[first, second]] = second, first
        if fits(touched[order]):
            return InputError(f"The points fit only when {names[first]} and {names[second]} are "
                              f"swapped. As they are, the residuals [mm] are: {off}.",
                              "So they were touched in another order.",
                              "Swap them in the list, or touch them again.")
    return beside or InputError(
        f"The points do not fit; their residuals [mm] are: {off}.",
        "More than one was touched beside its place, or the branch moved.", "Touch them again.")


def _size(points: np.ndarray) -> float:
    """Root mean square distance of points [n, 3] from their middle."""
    return float(np.sqrt(((points - points.mean(axis=0))**2).sum(axis=1).mean()))


# Pose of a camera, fixed or on the robot, from a board seen in several poses.
#
# Either the camera is fixed and the gripper holds the board, or the gripper carries the camera and
# the board is fixed. Both are one problem: X o_i = M_i Y with the camera's frame X, the board's
# frame Y, the camera's observation o_i and the robot's pose M_i or its inverse (Dornaika and Horaud
# 1998, "Simultaneous robot-world and hand-eye calibration"). For a marker of which only the
# position is seen, Y has no rotation.

CameraOn = Literal["stand", "gripper"]

_LEVER_M = 0.1  # m; converts a turn of the board to a length
_FEWEST_VIEWS = {6: 3, 3: 5}  # fewest views of a board and of a marker
_LEAST_TURN = 0.15  # rad, rms about the second axis
_STARTS, _REFINED = 400, 4  # rotations of the camera from which the fit begins
_STEP = 1e-6


@dataclass(frozen=True)
class CameraFit:
    """Pose of the camera, in the base's frame if it is fixed, else in the gripper's [m, rad], shape
    [6]; the board's in the other of the two (of a marker without turn), each view's residual [m],
    shape [n], and the covariance of the fitted parameters [k, k]."""

    camera: np.ndarray
    board: np.ndarray
    residuals: np.ndarray
    covariance: np.ndarray

    @property
    def residual(self) -> float:
        """Root mean square of the residuals [m]."""
        return float(np.sqrt(np.mean(self.residuals**2)))

    def deviations(self, frame: Callable[[np.ndarray, np.ndarray], np.ndarray],
                   point: np.ndarray) -> tuple[float, float]:
        """Return standard errors of a frame [4, 4] that ``frame`` composes of camera and board: of
        its image of ``point`` [m, 3], and of its rotation about the worst axis [rad]."""
        known = np.r_[self.camera, self.board][:len(self.covariance)]
        middle = frame(*_frames(known))
        slopes = np.zeros((6, len(known)))
        for k in range(len(known)):
            moved = known.copy()
            moved[k] += _STEP
            moved_frame = frame(*_frames(moved))
            slopes[:3, k] = (moved_frame - middle)[:3] @ np.r_[point, 1.0] / _STEP
            slopes[3:, k] = rotation_vector(moved_frame[:3, :3] @ middle[:3, :3].T) / _STEP
        spread = slopes @ self.covariance @ slopes.T
        return (float(np.sqrt(np.linalg.eigvalsh(spread[:3, :3])[-1])),
                float(np.sqrt(np.linalg.eigvalsh(spread[3:, 3:])[-1])))


def fit_camera(robot: np.ndarray, seen: np.ndarray, camera_on: CameraOn, *,
               largest_residual: float = 0.01) -> CameraFit:
    """Fit the frames of camera and board to the gripper's poses in the base's frame [m, rad], shape
    [n, 6], and the board's in the camera's, [n, 6], or a marker's positions, [n, 3]. InputError for
    too few views, a rotation about one axis only, or a view off by more than ``largest_residual``
    [m]."""
    robot, seen = np.asarray(robot, float), np.asarray(seen, float)
    if not (np.isfinite(robot).all() and np.isfinite(seen).all()):
        raise InputError("A view contains a number that is not finite.", "", "Omit it.")
    what = "board" if seen.shape[1] == 6 else "marker"
    fewest = _FEWEST_VIEWS[seen.shape[1]]
    if len(robot) < fewest:
        raise InputError(f"Only {len(robot)} views of a {what} are given.", f"At least {fewest} "
                         f"views are needed to determine camera and {what}, and ten to determine "
                         "the accuracy.", "Move the arm to more poses.")
    moves = matrices(robot) if camera_on == "stand" else inverted(matrices(robot))
    _require_turns(moves, what)
    if what == "marker":
        _require_depth(seen, largest_residual)
    starts = sorted((_started(turn, moves, seen) for turn in Rotation.random(
        _STARTS, rng=np.random.default_rng(0)).as_matrix()), key=lambda start: start[0])
    found = min((scipy.optimize.least_squares(_view_errors, start, args=(moves, seen),
                                              x_scale="jac", xtol=1e-13, ftol=1e-13)
                 for _, start in starts[:_REFINED]), key=lambda result: result.cost)
    rows = found.fun.reshape(len(robot), -1)
    residuals = np.linalg.norm(rows, axis=1)
    if residuals.max() > largest_residual:
        worst = int(residuals.argmax())
        raise InputError(f"View {worst + 1} has a residual of {1000 * residuals[worst]:.1f} mm.",
                         "It belongs to another pose of the arm, the units differ, or the camera "
                         f"is not on the {camera_on}.", "Omit it, or correct the file.")
    free = max(rows.size - len(found.x), 1)
    covariance = np.linalg.inv(found.jac.T @ found.jac) * (2 * found.cost / free)
    board = np.r_[found.x[6:], np.zeros(12 - len(found.x))]
    return CameraFit(found.x[:6], board, residuals, covariance)


def _require_turns(moves: np.ndarray, what: str) -> None:
    spread = spreads(rotation_vector(moves[:, :3, :3] @ moves[0, :3, :3].T))
    if spread[1] < _LEAST_TURN:
        raise InputError(f"The arm was turned by {np.degrees(spread[1]):.1f} degrees about a "
                         "second axis.", f"Camera and {what} could be shifted along the first axis "
                         "without a visible difference.", "Tilt the gripper about two axes, by at "
                         "least 20 degrees in each direction.")


def _require_depth(positions: np.ndarray, largest_residual: float) -> None:
    """Refuse positions [n, 3] in a plane: they fit equally well with mirrored camera axes."""
    spread = spreads(positions)[2]
    needed = least_depth(largest_residual)
    if spread < needed:
        raise InputError(f"The marker positions lie in a plane: they spread by {1000 * spread:.1f} "
                         f"mm out of it (root mean square), and {1000 * needed:.0f} mm are needed.",
                         "A mirrored frame would fit equally well.", "Move the marker to poses in "
                         "front of and behind that plane.")


def _started(turn: np.ndarray, moves: np.ndarray, seen: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the squared error of the best frames with this camera rotation [3, 3], and them: the
    positions are then a linear problem, R x_i + x = R_i y + t_i for the observations x_i."""
    count = len(moves)
    left = np.hstack([np.tile(-np.eye(3), (count, 1)), moves[:, :3, :3].reshape(-1, 3)])
    right = (seen[:, :3] @ turn.T - moves[:, :3, 3]).ravel()
    translations = np.linalg.lstsq(left, right, rcond=None)[0]
    start = np.r_[translations[:3], rotation_vector(turn), translations[3:]]
    if seen.shape[1] == 6:
        boards = moves[:, :3, :3].transpose(0, 2, 1) @ turn @ matrices(seen)[:, :3, :3]
        start = np.r_[start, Rotation.from_matrix(boards).mean().as_rotvec()]
    return float(np.sum(_view_errors(start, moves, seen)**2)), start


def _view_errors(values: np.ndarray, moves: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Distances and rotations [m] between boards as seen and as expected, flat."""
    camera, board = _frames(values)
    predicted, expected = camera @ matrices(_whole(seen)), moves @ board
    off = predicted[:, :3, 3] - expected[:, :3, 3]
    if seen.shape[1] == 6:
        turns = rotation_vector(expected[:, :3, :3].transpose(0, 2, 1) @ predicted[:, :3, :3])
        off = np.hstack([off, _LEVER_M * turns])
    return off.ravel()


def _frames(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Frames of camera and board, [4, 4] each, of fitted values [12], or [9] with a marker."""
    return matrices(values[:6]), matrices(_whole(values[None, 6:])[0])


def _whole(poses: np.ndarray) -> np.ndarray:
    """Poses [n, 6] of poses or positions [n, 3]."""
    return np.hstack([poses, np.zeros((len(poses), 6 - poses.shape[1]))])


def base_from_camera(fit: CameraFit, scan: np.ndarray, camera_on: CameraOn,
                     scan_pose: np.ndarray | None, near: np.ndarray,
                     ) -> tuple[np.ndarray, float, float]:
    """Return the robot's base in the branch's frame [m, rad, 6], and its standard errors of
    position [m] and rotation [rad] at the branch (``near`` [m], shape [3]). ``scan`` [4, 4]
    transforms the scan's coordinates [m]: those of the fixed camera, of the carried one at
    ``scan_pose`` [6], or of the fixed board. InputError if they are a marker's, which has no
    rotation."""
    if camera_on == "gripper" and scan_pose is None and len(fit.covariance) < 12:
        raise InputError("The scan is in the board's frame, but only the position of a marker was "
                         "seen.", "A position has no axes.", "Also give the board's rotations "
                         "(seen_rx_rad and so on), or ", Option("scan_pose"), ".")

    def scanned(camera: np.ndarray, board: np.ndarray) -> np.ndarray:
        """The scan's frame in the robot's base."""
        if camera_on == "stand":
            return camera
        return board if scan_pose is None else matrices(scan_pose) @ camera
    position, turn = fit.deviations(scanned, (inverted(scan) @ np.r_[near, 1.0])[:3])
    frames = scanned(*_frames(np.r_[fit.camera, fit.board]))
    return pose_vectors(scan @ inverted(frames)), position, turn


# Boards in a camera's pictures: ChArUco boards and AprilTags, found by OpenCV, fitted in pixels.
#
# OpenCV finds corners and a first pose of the board in each picture. Camera and board are then
# fitted to all corners of all pictures at once, so that residuals are pixels and the uncertainty
# follows from them.

_FEWEST_CORNERS = 4
_LARGEST_PX = 3.0


@dataclass(frozen=True)
class Board:
    """A printed ChArUco board or tag: number of its squares along x and y, edge lengths of squares
    (or the tag) and markers [m], and the OpenCV name of its marker dictionary."""

    kind: Literal["charuco", "apriltag"]
    squares: tuple[int, int]
    square_m: float
    marker_m: float
    dictionary: str


@dataclass(frozen=True)
class View:
    """A board in one picture: its corners [m] in its own frame, [k, 3], their pixels [k, 2], and
    its pose in the camera's frame by this picture alone [m, rad], shape [6]."""

    name: str
    corners: np.ndarray
    pixels: np.ndarray
    pose: np.ndarray


def find_board(path: Path, board: Board, camera: CameraEntry) -> View | None:
    """Return the board in a picture; None if too little of it is seen. InputError if the picture
    cannot be read, or is not of the camera's size; MissingDependencyError without OpenCV."""
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
        return (np.asarray(corners, float).reshape(-1, 3), np.asarray(pixels, float).reshape(-1, 2))
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
    """Fit the frames of camera and board to all corners of all pictures, by the gripper's poses [m,
    rad], shape [n, 6]; return the fit and each picture's residual (root mean square) [px].
    InputError as :func:`.fit_camera`, or naming a picture that does not fit."""
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
