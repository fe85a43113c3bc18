"""A force sensor tested by the weight of the gripper: sign, unit, axes and stated mass.

The gripper is tilted a little about two axes. The change of its weight is known from the stated
mass; a sensor with another sign, unit or other axes shows another change.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError
from limber.core.json_values import json_objects
from limber.robot.motion.followed_path import log_path

GRAVITY = 9.81
_LEAST_TILT = 0.03  # sine of the angle of gravity's change
_MOST_TILT = 0.5  # rad
_CHANGE_N = 2.0  # N of the weight; the guard stops at limits.unexpected_force_n, 3 N by default
_SECOND_TILT = 0.4  # fraction of the first, about the second axis
_ALIKE = 0.8  # cosine of the angle between measured and expected change
_UNITS = {0.1019: "kilograms-force", 0.2248: "pounds-force", 0.001: "kilonewtons",
          1000.0: "millinewtons"}
_NEAR = 0.15  # relative
_FEEL_NO_WEIGHT = ("none", "replay")
_LOOPBACK = "127."


@dataclass(frozen=True)
class Weighing:
    """A sensor's readings of a tilted gripper.

    Attributes:
        mass: Mass that explains the changes [kg], by the sensor.
        sigma: Its standard error [kg].
        faults: Errors of the sensor or the stated mass, in words.
    """

    mass: float
    sigma: float
    faults: tuple[str, ...]


def weighed_as(cell: Cell) -> dict[str, Any]:
    """Return what a weighing depends on, as its line of the log of motions states it."""
    return {"address": cell.robot.address, "stated_kg": cell.tool.mass_kg,
            "sensor": cell.sensor.kind, "sensor_pose": list(cell.sensor.pose)}


def unweighed(cell: Cell) -> str | None:
    """Return why the last weighing does not confirm sensor and stated mass; None if it does.

    A sensor that feels no weight needs none, nor does a bare flange that was never weighed or is
    the virtual robot's, whose gripper is another at each start.
    """
    stated, last = cell.tool.mass_kg or 0.0, _last_weighing(cell)
    is_bare = not stated and (last is None or cell.robot.address.startswith(_LOOPBACK))
    if is_bare or cell.sensor.kind in _FEEL_NO_WEIGHT:
        return None
    if last is None:
        return (f"The gripper of {stated:g} kg was never weighed with this sensor, so a wrong "
                "mass, unit, sign or axis would go unnoticed")
    mass = float(last.get("mass_kg", np.nan))
    off = _mass_off(mass, float(last.get("mass_sigma_kg", 0.0)), stated)
    if off or not np.isfinite(mass):
        return (f"The sensor weighed {mass:.3f} kg at the last weighing, but tool.mass_kg is "
                f"{stated:g}")
    if last.get("faults"):
        return f"The last weighing found that {'; '.join(last['faults'])}"
    return None


def require_weighed(cell: Cell) -> None:
    """Refuse a motion with the branch whose sensor and gripper no weighing confirms.

    Raises:
        InputError: states what the last weighing found, with both masses.
    """
    if reason := unweighed(cell):
        raise InputError(f"{reason}.", "The guard would feel another force than the branch's, and "
                         "the branch's moduli would be wrong.",
                         "Correct [sensor] or tool.mass_kg in the cell file, and weigh the empty "
                         "gripper away from the branch: limber robot weigh.")


def _last_weighing(cell: Cell) -> dict[str, Any] | None:
    """The last line of the log of motions that is a weighing by this sensor."""
    wanted, path = weighed_as(cell), log_path()
    del wanted["stated_kg"]
    if not path.is_file():
        return None
    with open(path, encoding="utf-8") as stream:
        found = [line for line in json_objects(stream) if line.get("command") == "weigh"
                 and all(line.get(key) == value for key, value in wanted.items())]
    return found[-1] if found else None


def tilted_joints(joints: np.ndarray, mass: float) -> np.ndarray:
    """Return joint angles [6, n] from ``joints`` [n] and back, tilted by the two middle wrists.

    So small that the weight of ``mass`` [kg] changes by no more than the guard allows.
    """
    tilt = min(_MOST_TILT, float(np.arcsin(min(1.0, _CHANGE_N / max(GRAVITY * mass, 1e-9)))))
    offs = np.zeros((6, len(joints)))
    offs[[1, 2], 3] = tilt, -tilt
    offs[[3, 4], 4] = tilt, -tilt
    return joints + offs


def require_tilts(downs: np.ndarray, stated: float) -> np.ndarray:
    """Return the axes [3, 3] along which directions of gravity [n, 3] differ, most first.

    Raises:
        InputError: too few directions, about one axis only, or no mass [kg] is stated.
    """
    if not stated > 0.0:
        raise InputError("The cell file states no tool.mass_kg above 0.", "Without a weight there "
                         "is nothing to compare the sensor with.", "State the gripper's mass.")
    _, sizes, axes = np.linalg.svd(downs - downs[0], full_matrices=False)
    if len(downs) < 6 or sizes[1] < max(_LEAST_TILT, _SECOND_TILT * sizes[0]):
        raise InputError("The gripper is not tilted about two axes.", "A wrong axis of the sensor "
                         "would not show.", "Turn the wrist so that its joints 4 and 5 tilt the "
                         "gripper against the vertical.")
    return axes


def weigh(downs: np.ndarray, forces: np.ndarray, times: np.ndarray, stated: float) -> Weighing:
    """Compare readings at some tilts with the weight of the stated mass.

    Bias and a linear drift in time are fitted with them.

    Args:
        downs: Direction of gravity in the flange's axes at each tilt, shape [n, 3].
        forces: Mean readings there, of the surroundings on the tool, flange axes [N], shape
            [n, 3], not corrected for any payload.
        times: Times [s], shape [n].
        stated: Mass in the cell file [kg].

    Raises:
        InputError: too few tilts, or about one axis only; or no mass is stated.
    """
    axes = require_tilts(downs, stated)
    away = downs - downs[0]
    # Along gravity itself bias and weight are nearly indistinguishable: only the two tilts separate
    # them.
    tilts = away @ axes[:2].T
    columns = np.column_stack([away @ axes.T, np.ones(len(downs)), times - times.mean()])
    found, *_ = np.linalg.lstsq(columns, forces, rcond=None)
    left = forces - columns @ found
    free = max(left.size - found.size, 1)
    spread = float(np.sqrt((left**2).sum() / free))
    changes, regressors = found[:2] / GRAVITY, axes[:2]
    along = float((changes * regressors).sum() / 2)
    size = float(np.sqrt((changes**2).sum() / 2))
    sigma = spread / GRAVITY / np.sqrt((tilts**2).sum())
    return Weighing(along, sigma, tuple(_faults(along, size, sigma, stated)))


def _faults(along: float, size: float, sigma: float, stated: float) -> list[str]:
    message = f"the sensor shows {along:.3f} kg for {stated:.3f} kg"
    if size < 4 * sigma or size < 0.02 * stated:
        return [f"the sensor does not notice the gripper's weight ({message})"]
    if along < -_ALIKE * size:
        return [f"the sensor's sign is wrong ({message})"]
    if along < _ALIKE * size:
        return ["the sensor's axes are wrong: the weight changes it in another direction. Check "
                f"sensor.pose ({message})"]
    factor = along / stated
    for unit, name in _UNITS.items():
        if abs(factor / unit - 1.0) < _NEAR:
            return [f"the sensor's unit seems to be {name} ({message})"]
    if _mass_off(along, sigma, stated):
        return [f"tool.mass_kg or the sensor's scale is wrong ({message})"]
    return []


def _mass_off(mass: float, sigma: float, stated: float) -> bool:
    """Whether a weighed mass [kg], known to ``sigma``, is not the stated one."""
    return abs(mass - stated) > max(0.05, 0.1 * stated, 4 * sigma)
