"""Speed at which a contact stays below the hard limit until the arm is at rest."""

import numpy as np

from limber.core.errors import InputError
from limber.robot.cell.cell import Cell

OVER_HARD = 1.1
"""Largest contact force as a multiple of the hard limit."""

# Time from a force to the brake: half of the sensor's own smoothing, the loop's time, and two steps
# of the controller. Measured with the virtual one: 4 ms at 500 Hz, 14 ms at 125 Hz.
_LOOP_SECONDS = 0.002
_STEPS = 2.0
_FT300_SECONDS = {"ft300": 0.010, "ft300_usb": 0.022}  # between two of its readings, at most
# The joints brake at 8 rad/s^2; the joint that moves a gripper is rarely nearer than this.
_BRAKING_M_S2 = 8.0 * 0.3
_SLOWEST_M_S = 1e-3


def reaction_seconds(cell: Cell) -> float:
    """Return the longest time from a force to the brake [s]."""
    sensor = _FT300_SECONDS.get(cell.sensor.kind, 0.0)
    return _LOOP_SECONDS + _STEPS / cell.arm.rate + sensor


def contact_speed(cell: Cell, stiffness: float) -> float:
    """Return the greatest speed [m/s] at which a contact stays below the hard limit plus a tenth.

    The arm brakes from the soft limit on. The path v t + v^2 / 2a times the stiffness may add no
    more than the difference between the two.

    Args:
        stiffness: Stiffness of the contact [N/m].

    Raises:
        InputError: not even a millimetre a second is slow enough.
    """
    limits = cell.limits
    distance = (OVER_HARD * limits.hard_force_n - limits.soft_force_n) / stiffness
    lost = _BRAKING_M_S2 * reaction_seconds(cell)
    speed = float(np.sqrt(lost**2 + 2 * _BRAKING_M_S2 * distance) - lost)
    if speed < _SLOWEST_M_S:
        raise InputError(
            f"A contact of {stiffness:g} N/m adds more than the force between limits.soft_force_n "
            f"and limits.hard_force_n even at {1e3 * _SLOWEST_M_S:g} mm/s.",
            f"The arm needs {1e3 * reaction_seconds(cell):.0f} ms to brake.",
            "Lower limits.soft_force_n, or state a softer limits.contact_n_per_m.")
    return speed


def speed_within(cell: Cell, speed: float) -> float:
    """Return ``speed`` [m/s], or less if the cell states a contact that requires it.

    Raises:
        InputError: as :func:`contact_speed`.
    """
    stiffness = cell.limits.contact_n_per_m
    return speed if stiffness is None else min(speed, contact_speed(cell, stiffness))
