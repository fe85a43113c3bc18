"""Speed at which a contact stays below the hard limit until the arm is at rest."""

from collections.abc import Callable

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError

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


def contact_speed(cell: Cell) -> float:
    """Return the greatest speed [m/s] at which a contact stays below the hard limit plus a tenth.

    The arm brakes from the soft limit on. The path v t + v^2 / 2a times the stiffness of the
    contact (``limits.contact_n_per_m``) may add no more than the difference between the two.

    Raises:
        InputError: not even a millimetre a second is slow enough.
    """
    limits = cell.limits
    distance = (OVER_HARD * limits.hard_force_n - limits.soft_force_n) / limits.contact_n_per_m
    lost = _BRAKING_M_S2 * reaction_seconds(cell)
    speed = float(np.sqrt(lost**2 + 2 * _BRAKING_M_S2 * distance) - lost)
    if speed < _SLOWEST_M_S:
        raise InputError(
            f"A contact of {limits.contact_n_per_m:g} N/m (limits.contact_n_per_m) adds more than "
            f"the force between limits.soft_force_n ({limits.soft_force_n:g} N) and "
            f"limits.hard_force_n ({limits.hard_force_n:g} N) even at "
            f"{1e3 * _SLOWEST_M_S:g} mm/s.",
            f"The arm needs {1e3 * reaction_seconds(cell):.0f} ms to brake.",
            "Lower limits.soft_force_n, or state in limits.contact_n_per_m how stiff the stiffest "
            "thing is that the gripper can run into.")
    return speed


def speed_within(cell: Cell, speed: float, warn: Callable[[str], None] | None = None) -> float:
    """Return ``speed`` [m/s], or less where a contact requires it.

    Args:
        warn: Is told of a speed that is reduced.

    Raises:
        InputError: as :func:`contact_speed`.
    """
    most = contact_speed(cell)
    if speed > most and warn is not None:
        limits = cell.limits
        warn(f"The arm moves at {1e3 * most:.1f} mm/s instead of {1e3 * speed:.1f} mm/s, so that "
             f"running into something of {limits.contact_n_per_m:g} N/m stays below "
             f"{OVER_HARD * limits.hard_force_n:.3g} N (limits.hard_force_n plus a tenth). Where "
             "nothing is so stiff, state limits.contact_n_per_m in the cell file to go faster.")
    return min(speed, most)
