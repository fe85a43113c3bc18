"""Plausible sizes of a plant: outside them the unit is asked for; impossible sizes are refused."""

import numpy as np

from limber.core.constants import UNIT_METRES
from limber.core.errors import InputError

LONGEST, SHORTEST = 30.0, 0.01
"""Largest and smallest size [m] without a question about the unit; the add-on reads the largest."""
_POSSIBLE = (0.003, 100.0)  # m
_UNUSUAL = 10.0  # m


def size_doubts(points: np.ndarray, what: str, unit: str, *, is_stated: bool) -> list[str]:
    """Return a question about the unit of positions [m], shape [n, 3], of unusual extent.

    Args:
        points: The positions.
        what: "surface"; for messages.
        unit: The unit in which they were read.
        is_stated: Whether the user or the file stated it.

    Raises:
        InputError: a plant of this size needs a stated unit, or none has it.
    """
    extent = float(np.ptp(points, axis=0).max())
    is_possible = _POSSIBLE[0] <= extent <= _POSSIBLE[1]
    if is_possible and (is_stated or SHORTEST <= extent <= _UNUSUAL):
        return []
    number = extent / UNIT_METRES[unit]
    other = [f"--unit {name} ({size:.3g} m)" for name in ("m", "cm", "mm", "in")
             if name != unit and SHORTEST <= (size := number * UNIT_METRES[name]) <= _UNUSUAL]
    seen = f"The {what} is {extent:.4g} m long, read in {unit}."
    if SHORTEST <= extent <= LONGEST:
        return [f"{seen} Is its unit another: {' or '.join(other)}?"]
    if is_possible:
        raise InputError(seen, "Neither the file nor --unit states the unit, and this would be an "
                         "unusual size.", f"State it: {', '.join([*other, f'--unit {unit}'])}.")
    raise InputError(seen, f"No plant that a robot moves has this size ({_POSSIBLE[0]:g} to "
                     f"{_POSSIBLE[1]:g} m).", f"State the unit of its numbers: {', '.join(other)}."
                     if other else "Check its numbers and its unit (--unit).")
