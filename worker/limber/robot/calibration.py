"""Where the robot stands: its base in the branch's frame, from points that it has touched."""

from dataclasses import dataclass

import numpy as np

from limber.errors import InputError
from limber.robot.kinematics import pose_vectors

_LEAST_SPREAD = 0.02  # m, of the second principal direction


@dataclass(frozen=True)
class BaseFit:
    """The base's pose and how well the touched points agree.

    Attributes:
        pose: Of the robot's base in the branch's frame [m, rad], shape [6].
        residuals: Distance of each point after the fit [m], shape [n].
        position_sigma: Standard error of the base's position where the points are [m].
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


def fit_base(touched: np.ndarray, on_branch: np.ndarray, *, largest_residual: float = 0.01,
             ) -> BaseFit:
    """Fit the rigid transform from the robot's base to the branch's frame (Kabsch 1976).

    Args:
        touched: Points as the robot's tip touched them, base frame [m], shape [n, 3].
        on_branch: The same points in the branch's frame [m], shape [n, 3].
        largest_residual: A point that is farther off than this [m] was mixed up or mistouched.

    Raises:
        InputError: fewer than three points, points in a line, or a point far off.
    """
    touched, on_branch = np.asarray(touched, float), np.asarray(on_branch, float)
    if touched.shape != on_branch.shape or touched.ndim != 2 or touched.shape[1] != 3 \
            or len(touched) < 3:
        raise InputError(f"{len(touched)} touched points for {len(on_branch)} on the branch.",
                         "Three or more pairs fix a frame.", "Touch more points.")
    if not (np.isfinite(touched).all() and np.isfinite(on_branch).all()):
        raise InputError("A point that is no number.", "", "Touch it again.")
    middle_a, middle_b = touched.mean(axis=0), on_branch.mean(axis=0)
    a, b = touched - middle_a, on_branch - middle_b
    spread = np.linalg.svd(b, compute_uv=False) / np.sqrt(len(b))
    if spread[1] < _LEAST_SPREAD:
        raise InputError(f"The points spread by {1000 * spread[1]:.0f} mm across their line.",
                         "The frame could turn about it.",
                         "Touch points that lie beside it, such as twigs and the pot's rim.")
    left, _, right = np.linalg.svd(b.T @ a)
    turn = left @ np.diag([1.0, 1.0, np.sign(np.linalg.det(left @ right))]) @ right
    frame = np.eye(4)
    frame[:3, :3], frame[:3, 3] = turn, middle_b - turn @ middle_a
    residuals = np.linalg.norm(touched @ turn.T + frame[:3, 3] - on_branch, axis=1)
    if residuals.max() > largest_residual:
        worst = int(residuals.argmax())
        raise InputError(f"Point {worst + 1} is off by {1000 * residuals[worst]:.1f} mm.",
                         "It was taken for another one, or the units differ.",
                         "Touch it again, or leave it out.")
    # Six unknowns come out of 3 n numbers.
    sigma = float(np.sqrt((residuals**2).sum() / max(3 * len(a) - 6, 1)))
    return BaseFit(pose_vectors(frame), residuals, sigma / np.sqrt(len(a)),
                   sigma / (np.sqrt(len(a)) * spread[1]))
