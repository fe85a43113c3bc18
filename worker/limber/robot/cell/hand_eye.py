"""Pose of a camera, fixed or on the robot, from a board seen in several poses.

Either the camera is fixed and the gripper holds the board, or the gripper carries the camera and
the board is fixed. Both are one problem: X o_i = M_i Y with the camera's frame X, the board's frame
Y, the camera's observation o_i and the robot's pose M_i or its inverse (Dornaika and Horaud 1998,
"Simultaneous robot-world and hand-eye calibration"). For a marker of which only the position is
seen, Y has no rotation.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy
from scipy.spatial.transform import Rotation

from limber.core.errors import InputError, Option
from limber.core.numerics.rigid import inverted, matrices, pose_vectors, rotation_vector, spreads
from limber.robot.cell.base_calibration import least_depth

CameraOn = Literal["stand", "gripper"]

_LEVER_M = 0.1  # m; converts a turn of the board to a length
_FEWEST = {6: 3, 3: 5}  # fewest views of a board and of a marker
_LEAST_TURN = 0.15  # rad, rms about the second axis
_STARTS, _REFINED = 400, 4  # rotations of the camera from which the fit begins
_STEP = 1e-6


@dataclass(frozen=True)
class CameraFit:
    """The camera, the board, and how well the views agree.

    Attributes:
        camera: Pose of the camera, in the base's frame if it is fixed, else in the gripper's [m,
            rad], shape [6].
        board: Its pose in the other of the two, shape [6]; of a marker the turn is zero.
        residuals: Distance of each view's board from where it should be seen [m], shape [n].
        covariance: Covariance of the fitted parameters, shape [k, k].
    """

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
        """Return standard errors of a frame composed of both: of its image of ``point`` [m, 3], and
        of its rotation about the worst axis [rad].

        Args:
            frame: Computes it, shape [4, 4], from the frames of camera and board.
        """
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
    """Fit the frames of camera and board.

    Args:
        robot: Poses of the gripper's middle in the base's frame [m, rad], shape [n, 6].
        seen: The board's poses in the camera's frame, shape [n, 6]; or positions of a marker, [n,
        3].
        camera_on: What carries the camera.
        largest_residual: A view with a larger residual than this [m] was mixed up.

    Raises:
        InputError: too few views, the arm rotated about one axis only, or an outlier.
    """
    robot, seen = np.asarray(robot, float), np.asarray(seen, float)
    if not (np.isfinite(robot).all() and np.isfinite(seen).all()):
        raise InputError("A view contains a number that is not finite.", "", "Omit it.")
    what = "board" if seen.shape[1] == 6 else "marker"
    fewest = _FEWEST[seen.shape[1]]
    if len(robot) < fewest:
        raise InputError(f"Only {len(robot)} views of a {what} are "
                         "given.", f"At least {fewest} views are needed "
                         f"to determine camera and {what}, and ten to determine the "
                         "accuracy.", "Move the arm to more poses.")
    moves = matrices(robot) if camera_on == "stand" else inverted(matrices(robot))
    _require_turns(moves, what)
    if what == "marker":
        _require_depth(seen, largest_residual)
    starts = sorted((_started(turn, moves, seen) for turn in Rotation.random(
        _STARTS, rng=np.random.default_rng(0)).as_matrix()), key=lambda start: start[0])
    found = min((scipy.optimize.least_squares(_off, start, args=(moves, seen), x_scale="jac",
                                              xtol=1e-13, ftol=1e-13)
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
        raise InputError(
            f"The arm was turned by {np.degrees(spread[1]):.1f} degrees about a second axis.",
            f"Camera and {what} could be shifted along the first axis without a visible "
            "difference.",
            "Tilt the gripper about two axes, by at least 20 degrees in each direction.")


def _require_depth(positions: np.ndarray, largest_residual: float) -> None:
    """Refuse positions [n, 3] in a plane: they fit equally well with mirrored camera axes."""
    spread = spreads(positions)[2]
    needed = least_depth(largest_residual)
    if spread < needed:
        raise InputError(
            f"The marker positions lie in a plane: they spread by {1000 * spread:.1f} mm out of "
            f"it (root mean square), and {1000 * needed:.0f} mm are needed.",
            "A mirrored frame would fit equally well.",
            "Move the marker to poses in front of and behind that plane.")


def _started(turn: np.ndarray, moves: np.ndarray, seen: np.ndarray) -> tuple[float, np.ndarray]:
    """Return the squared error of the best frames with this camera rotation [3, 3], and them.

    With that rotation given the positions are a linear problem: R x_i + x = R_i y + t_i for the
    observations x_i.
    """
    count = len(moves)
    left = np.hstack([np.tile(-np.eye(3), (count, 1)), moves[:, :3, :3].reshape(-1, 3)])
    right = (seen[:, :3] @ turn.T - moves[:, :3, 3]).ravel()
    translations = np.linalg.lstsq(left, right, rcond=None)[0]
    start = np.r_[translations[:3], rotation_vector(turn), translations[3:]]
    if seen.shape[1] == 6:
        boards = moves[:, :3, :3].transpose(0, 2, 1) @ turn @ matrices(seen)[:, :3, :3]
        start = np.r_[start, Rotation.from_matrix(boards).mean().as_rotvec()]
    return float(np.sum(_off(start, moves, seen)**2)), start


def _off(values: np.ndarray, moves: np.ndarray, seen: np.ndarray) -> np.ndarray:
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
    position [m] and rotation [rad] at the branch.

    Args:
        scan: Transform from the scan's coordinates [m] to the branch's, shape [4, 4]. The scan's
            coordinates are those of the fixed camera; or of the carried one while the gripper was
            at ``scan_pose`` [6]; without that, of the fixed board.
        near: Position of the branch, branch frame [m], shape [3].

    Raises:
        InputError: the scan is in the frame of a marker, which has no rotation.
    """
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
