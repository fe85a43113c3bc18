"""Position of the robot's base in the branch's frame, from points that the robot touched."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError
from limber.core.numerics.rigid import inverted, matrices, pose_vectors, rigid_fit, spreads
from limber.robot.cell.controller_settings import in_millimetres, is_tool, tool_in_controller
from limber.robot.interface import Sample

_FEWEST = 4
_LEAST_SPREAD = 0.02  # m, of the second principal direction
_LEAST_OUT_OF_PLANE = 0.005  # m, of the third


@dataclass(frozen=True)
class BaseFit:
    """The base's pose and how well the touched points agree.

    Attributes:
        pose: Pose of the robot's base in the branch's frame [m, rad], shape [6].
        residuals: Distance of each point after the fit [m], shape [n].
        position_sigma: Standard error of the base's position at the points [m].
        rotation_sigma: Standard error of its rotation about its worst axis [rad].
    """

    pose: np.ndarray
    residuals: np.ndarray
    position_sigma: float
    rotation_sigma: float

    @property
    def residual(self) -> float:
        """Root mean square of the residuals [m]."""
        return float(np.sqrt(np.mean(self.residuals**2)))


def least_depth(largest_residual: float) -> float:
    """Return how far out of plane points must spread [m] to reveal a mirrored fit.

    A mirrored fit has residuals of twice that spread, which must exceed the allowed residual.
    """
    return max(_LEAST_OUT_OF_PLANE, 0.5 * largest_residual)


def require_frame(points: np.ndarray, names: Sequence[str], which: str,
                  largest_residual: float = 0.01) -> None:
    """Refuse points that do not determine the frame, or its handedness.

    Three points, or any number in a plane, fit a mirrored frame without a residual.

    Args:
        points: Positions [m], shape [n, 3].
        names: Names of the points.
        which: Description for the message: ``on the branch`` or ``as they were touched``.
        largest_residual: Largest residual that :func:`fit_base` allows [m].

    Raises:
        InputError: too few, no numbers, too close to each other, in a line or in a plane.
    """
    if len(points) < _FEWEST:
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
            f"across their line (root mean square), and {1000 * _LEAST_SPREAD:.0f} mm are "
            "needed.", "The frame could rotate about "
                                                                   "that line.",
            "Touch points beside it, such as twigs and the rim of the pot.")
    needed = least_depth(largest_residual)
    if spread[2] < needed:
        raise InputError(
            f"The points {which} lie in a plane: they spread by {1000 * spread[2]:.1f} mm out of "
            f"it (root mean square), and {1000 * needed:.0f} mm are needed.",
            "A mirrored frame would fit equally well.",
            "Touch points above and below it, such as the rim of the pot and the tip of the "
            "branch.")


def touched_point(cell: Cell, sample: Sample) -> np.ndarray:
    """Return the position of the gripper's middle by :func:`gripper_pose` [m], shape [3]."""
    return gripper_pose(cell, sample)[:3]


def gripper_pose(cell: Cell, sample: Sample) -> np.ndarray:
    """Return the pose of the gripper's middle by the controller's own pose, base frame [m, rad, 6].

    The controller knows the arm's true dimensions. Its pose is that of the tool set there, and
    newer controllers report that tool. With others the nominal dimensions show which tool it is,
    the cell's ``tool.grasp_pose`` or none. They are not used for the position.

    Raises:
        InputError: another tool is set.
    """
    grasp = np.array(cell.tool.grasp_pose)
    if sample.tool is not None:
        return _carried(sample.pose, sample.tool, grasp)
    for tool in (grasp, np.zeros(6)):
        if is_tool(cell, sample, tool):
            return _carried(sample.pose, tool, grasp)
    raise InputError(
        "The tool centre point in the controller is at about "
        f"{in_millimetres(tool_in_controller(cell, sample))} in the "
        f"flange's frame, but the cell's tool.grasp_pose is at {in_millimetres(grasp)}.",
        "So the controller's pose is not the pose of the gripper's centre.",
        "Set the tool centre point to tool.grasp_pose on the pendant, or correct the cell file.")


def _carried(pose: np.ndarray, tool: np.ndarray, grasp: np.ndarray) -> np.ndarray:
    return pose_vectors(matrices(pose) @ inverted(matrices(tool)) @ matrices(grasp))


def fit_base(touched: np.ndarray, on_branch: np.ndarray, *, largest_residual: float = 0.01,
             names: Sequence[str] | None = None) -> BaseFit:
    """Fit the rigid transform from the robot's base to the branch's frame (Kabsch 1976).

    Args:
        touched: Points touched by the robot's tip, base frame [m], shape [n, 3].
        on_branch: The same points in the branch's frame [m], shape [n, 3].
        largest_residual: A point farther away than this [m] was mixed up or touched wrongly.
        names: Names of the points, for messages; by default their numbers from 1 on.

    Raises:
        InputError: fewer than four points, points in a plane or too close to each other, mirrored
            points, or an outlier.
    """
    touched, on_branch = np.asarray(touched, float), np.asarray(on_branch, float)
    if touched.shape != on_branch.shape or touched.ndim != 2 or touched.shape[1] != 3:
        raise InputError(f"{len(touched)} points were touched, but {len(on_branch)} are given on "
                         "the branch.",
                         "Each point needs its counterpart.", "Correct the list.")
    names = [str(number + 1) for number in range(len(touched))] if names is None else names
    require_frame(on_branch, names, "on the branch", largest_residual)
    require_frame(touched, names, "as they were touched", largest_residual)
    frame, residuals = _registered(touched, on_branch)
    if residuals.max() > largest_residual:
        raise _off(residuals, touched, on_branch, names, largest_residual)
    # Six unknowns are fitted to 3 n numbers.
    sigma = float(np.sqrt((residuals**2).sum() / (3 * len(touched) - 6)))
    return BaseFit(pose_vectors(frame), residuals, sigma / np.sqrt(len(touched)),
                   sigma / (np.sqrt(len(touched)) * float(spreads(on_branch)[1])))


def _registered(touched: np.ndarray, on_branch: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the frame [4, 4] that best fits points [n, 3], and the residuals [m, n]."""
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = rigid_fit(touched, on_branch)
    return frame, np.linalg.norm(touched @ frame[:3, :3].T + frame[:3, 3] - on_branch, axis=1)


def _off(residuals: np.ndarray, touched: np.ndarray, on_branch: np.ndarray,
         names: Sequence[str], largest_residual: float) -> InputError:
    """Return why points [n, 3] do not fit: the change that would make them fit."""
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
    worst = int(residuals.argmax())
    return InputError(f"Point {names[worst]} has a residual of {1000 * residuals[worst]:.1f} mm; "
                      f"all residuals [mm]: {off}.", "It was confused with another point, or "
                      "touched beside its place.", "Touch it again, or omit it.")


def _size(points: np.ndarray) -> float:
    """Root mean square distance of points [n, 3] from their middle."""
    return float(np.sqrt(((points - points.mean(axis=0))**2).sum(axis=1).mean()))
