"""Plausible sizes of a branch: outside them the user is asked; impossible sizes are refused."""

import numpy as np

from limber.core.errors import InputError

LONGEST, SHORTEST = 30.0, 0.01
"""Largest and smallest size [m] without a question about the unit."""
_POSSIBLE = (1e-5, 1e4)  # m


def size_doubts(points: np.ndarray, what: str) -> list[str]:
    """Return a question about the unit of positions [m], shape [n, 3], of unusual extent.

    Args:
        what: "surface"; for messages.

    Raises:
        InputError: a body that bends under its weight cannot have this size.
    """
    extent = float(np.ptp(points, axis=0).max())
    if not _POSSIBLE[0] <= extent <= _POSSIBLE[1]:
        raise InputError(f"The {what} is {extent:.3g} m long.", "No branch has this size.",
                         "Check its numbers, and give its unit with --unit (m, cm, mm, in).")
    if extent > LONGEST:
        return [f"The {what} is {extent:.0f} m long. Is its unit millimetres (--unit mm)?"]
    if extent < SHORTEST:
        return [f"The {what} is {1000 * extent:.2g} mm long. Is its unit correct (--unit m, cm, "
                "mm, in)?"]
    return []
