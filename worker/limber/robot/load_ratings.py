"""Greatest loads of an arm on a branch, by its own table and regardless of the cell file."""

from typing import TYPE_CHECKING

from limber.core.constants import STANDARD_GRAVITY
from limber.robot.interface import Arm

if TYPE_CHECKING:
    from limber.robot.cell.cell import LimitsEntry

MOST_FORCE = 140.0
"""[N], also for an arm without a known payload: about the force that a clamped hand bears without
harm.
"""
MOST_SPEED = 0.25
"""[m/s], the reduced speed of industrial arms with people beside them."""
MOST_TURN_SPEED = 1.5
"""[rad/s]"""
_PAYLOADS = 2.0  # payload weights that an arm exerts: it moves its payload too
_LEVER = 0.15  # m beyond the flange at which arms still carry their payload


def greatest_force(arm: Arm) -> float:
    """Return the greatest force [N] that a limit of this arm may be set to."""
    return min(MOST_FORCE, _PAYLOADS * arm.payload * STANDARD_GRAVITY)


def greatest_torque(arm: Arm) -> float:
    """Return the greatest torque [N m] that a limit of this arm may be set to."""
    return _LEVER * greatest_force(arm)


def within_ratings(arm: Arm, limits: "LimitsEntry") -> "LimitsEntry":
    """Return the limits, each within the arm's table."""
    force = greatest_force(arm)
    return limits.model_copy(update={
        name: min(getattr(limits, name), most) for name, most in (
            ("hard_force_n", force), ("soft_force_n", force), ("unexpected_force_n", force),
            ("hard_torque_nm", greatest_torque(arm)), ("speed_m_s", MOST_SPEED),
            ("turn_speed_rad_s", MOST_TURN_SPEED))})
