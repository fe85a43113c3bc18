"""Slips in hand-made tables of a pull: exchanged tables or titles, units, frames, no force."""

from itertools import permutations

import numpy as np

from limber.core.alignment import Alignment
from limber.core.errors import InputError
from limber.recordings.recording import Pull

_FASTEST_M_S, _LONGEST_S = 5.0, 3600.0
"""Of a robot's tool; of a pull."""
_THOUSAND = (300.0, 3000.0)
"""Ratios of two durations that show milliseconds beside seconds."""


def require_no_slip(pull: Pull) -> Pull:
    """Return the pull, with a warning if it has no force.

    Raises:
        InputError: times, positions, rotations or forces cannot be those of a robot; the message
            names the likely slip.
    """
    name, times, poses = pull.name, pull.times, pull.poses
    length = float(np.ptp(times))
    seen = None if pull.observations is None else float(np.ptp(pull.observations.times))
    for what, one, other in (() if not seen or not length else (
            ("gripper", length, seen), ("markers", seen, length))):
        if _THOUSAND[0] < one / other < _THOUSAND[1]:
            raise InputError(f"{name}: the times of the {what} span {one:.4g} s, those of the "
                             f"other table {other:.4g} s.", "They are likely milliseconds.",
                             "Name the unit in the title of that column, such as t_ms.")
    if length > _LONGEST_S:
        raise InputError(f"{name}: the times of the gripper span {length:.4g} s.",
                         "No pull lasts longer than an hour. They are likely milliseconds.",
                         "Name the unit in the title of the column, such as t_ms.")
    turn = float(np.nanmax(np.linalg.norm(poses[:, 3:], axis=1), initial=0.0))
    if turn > 2 * np.pi:
        raise InputError(f"{name}: the gripper's rotation vector has a length of {turn:.4g} rad.",
                         "A rotation has at most 6.28 rad. The columns are likely in degrees.",
                         "Name the unit in their titles: rx_deg, ry_deg, rz_deg.")
    speed = float(np.nanmax(np.linalg.norm(np.diff(poses[:, :3], axis=0), axis=1) / np.diff(times),
                            initial=0.0))
    if speed > _FASTEST_M_S:
        raise InputError(f"{name}: the gripper moves at up to {speed:.3g} m/s.",
                         f"No robot's tool moves faster than {_FASTEST_M_S:g} m/s. The positions "
                         "are likely in millimetres, or the times in another unit.",
                         "Name the units in the titles, such as x_mm and t_ms.")
    force = pull.wrenches[:, :3]
    if not np.isfinite(force).any():
        return pull.warned(
            f"{name}: the table has no force (columns fx_n, fy_n, fz_n). Without it a pull does "
            "not determine the modulus, only its course along the branch.")
    if not np.nan_to_num(force).any():
        raise InputError(f"{name}: the force is zero in all {len(force)} rows.",
                         "A sensor that was read has noise. It was not connected, or not recorded.",
                         "Record it again with the force; or, if there was no sensor, remove the "
                         "columns of the force and torque.")
    return pull


def likely_slip(points: np.ndarray, nodes: np.ndarray, alignment: Alignment, near: float) -> str:
    """Return which slip explains points off the branch, as a sentence; "" if none does.

    Args:
        points: [m], shape [n, 3].
        nodes: Nodes of the branch [m], shape [k, 3].
        alignment: From the scan's coordinates to the branch's.
        near: Distance from the branch within which all of them should lie [m].
    """
    def fits(moved: np.ndarray) -> bool:
        return all(np.linalg.norm(nodes - point, axis=1).min() <= near for point in moved)

    for factor, unit in ((1e-3, "millimetres"), (1e-2, "centimetres")):
        if fits(factor * points):
            return f"They fit as {unit}: name the unit in the titles, such as x_{unit[0]}m."
    if fits(alignment.apply_metres(points)):
        return ("They fit in the frame of the scan: state it with --coordinates scan and "
                "--frame-pose 0 0 0 0 0 0 for the gripper, --marker-frame 0 0 0 0 0 0 for markers.")
    for order in permutations(range(3)):
        if order != (0, 1, 2) and fits(points[:, order]):
            return (f"They fit with the titles x, y, z exchanged: the columns titled x, y, z are "
                    f"likely {', '.join('xyz'[order.index(k)] for k in range(3))}.")
    return ""
