"""Differences between the measured wrench and the predicted one: their bound and their name."""

import numpy as np

from limber.core.numerics.rigid_kernels import length

DEVIATIONS = 2.0
"""Standard deviations of a prediction that are allowed."""

_MOSTLY = 0.8  # cosine of the angle to the predicted force that a difference opposes
_MOSTLY_AT_ONCE = 0.5  # the same for a sudden change: a sliding piece pulls sideways
_UNLIKE = "the force differs from the predicted one [N]"
_SHORT = "less force than predicted: the branch slipped, broke or is softer [N]"
_FELL = "the predicted force dropped suddenly: the branch slipped, broke or came loose [N]"


def difference_name(off: np.ndarray, expected: np.ndarray, before: np.ndarray, least: float,
                    ) -> str:
    """Return the most probable name of a difference to the expected force.

    Args:
        off: The difference [N], shape [3].
        expected: The expected force [N], shape [3].
        before: The usual difference so far [N], shape [3].
        least: Expected force [N] up to which a difference has no direction.
    """
    expected_size, missing = length(expected), -float(off @ expected)
    if expected_size <= least:
        return _UNLIKE
    size = length(off)
    at_once = length(off - before) > 0.5 * size
    if at_once and missing > _MOSTLY_AT_ONCE * expected_size * size:
        return _FELL
    return _SHORT if missing > _MOSTLY * expected_size * size else _UNLIKE


def allowed_difference(off: np.ndarray, covariance: np.ndarray, least: float, most: float,
                       ) -> float:
    """Return the largest allowed difference in the direction of ``off`` [3], which is not 0.

    The bound is an ellipsoid: ``least``, widened by standard deviations of the prediction up to
    ``most``.
    """
    squares, axes = np.linalg.eigh(covariance)
    radii = least**2 + np.minimum(DEVIATIONS**2 * np.maximum(squares, 0.0), most**2)
    along = axes.T @ (off / length(off))
    return float(1.0 / np.sqrt((along**2 / radii).sum()))
