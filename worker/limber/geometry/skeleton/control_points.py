"""Control points: positions along a branch where Young's modulus is estimated."""

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton

FRACTIONS = (0.2, 0.4, 0.6, 0.8)
"""The paper's: 1/5 to 4/5 of the branch."""


def control_points(skeleton: Skeleton, fractions: tuple[float, ...] = FRACTIONS) -> np.ndarray:
    """Return positions [m], shape [K, 3], at fractions of the main path's length.

    The paper samples them "linearly across the length of the branch" (section Branch Parameters
    Estimation).
    """
    return np.array([skeleton.point_at(fraction) for fraction in fractions])
