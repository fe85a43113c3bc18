"""The way a gripper goes in a virtual pull: out in a spiral, within the branch's reach."""

import numpy as np


def spiral_path(base: np.ndarray, grasp_point: np.ndarray, arc: float, *, reach: float,
                frame_count: int, turn: float = 2.4, phase: float = 0.0) -> np.ndarray:
    """Return poses [m, rad] of a grasp that bends a branch in changing directions, shape [n, 6].

    The grasp moves sideways by up to ``reach`` times its arc length and falls back towards the
    base as a bent cantilever of fixed length does, so that it bends the branch but does not
    stretch it. Speed is zero at both ends.

    Args:
        base: Root of the branch [m], shape [3].
        grasp_point: [m], shape [3].
        arc: Length of the branch from base to grasp [m].
        reach: Largest sideways travel over ``arc``.
        frame_count: Number of poses; the first is the branch at rest.
        turn: How far the direction turns on the way [rad].
        phase: Its start [rad].
    """
    axis = grasp_point - base
    axis = axis / np.linalg.norm(axis)
    helper = np.eye(3)[int(np.argmin(np.abs(axis)))]
    first = np.cross(axis, helper)
    first /= np.linalg.norm(first)
    second = np.cross(axis, first)
    share = np.linspace(0.0, 1.0, frame_count)
    eased = share * share * (3 - 2 * share)
    sideways = reach * arc * eased
    angle = phase + turn * eased
    # The shortening of a cantilever under a tip load, 3/5 w^2 / L, and a little slack.
    back = 0.66 * sideways**2 / arc
    offset = (sideways * np.cos(angle))[:, None] * first + (
        sideways * np.sin(angle))[:, None] * second - back[:, None] * axis
    slope = 1.3 * sideways / arc
    direction = np.cos(angle)[:, None] * first + np.sin(angle)[:, None] * second
    # Turning the axis towards the direction of travel: about axis x direction.
    rotation = slope[:, None] * np.cross(np.broadcast_to(axis, direction.shape), direction)
    return np.hstack([grasp_point + offset, rotation])
