"""Test the force sensor by the gripper's weight: `limber robot weigh`."""

from __future__ import annotations

import time
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.cli.cell_tool import ArmedTool, confirmed_by
from limber.cli.commands.robot.moves import log_move, require_empty, stands
from limber.core.constants import STANDARD_GRAVITY
from limber.core.errors import InputError, SafetyStop
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.stages.stage import About

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.driver.link import RobotLink
    from limber.robot.motion.trajectory import Trajectory

_TARE_SECONDS = 0.5
_SETTLE_SECONDS = 0.3
_READ_SECONDS = 0.5


class Weigh(ArmedTool):
    """Tilt the empty gripper a little about two axes, and compare its weight with tool.mass_kg.

    A sensor of another sign, unit or other axes is named, and so is a mass that is off; exit code
    4. Do this away from the branch, before the first pull.
    """

    about = About("robot weigh", moves_robot="when armed")

    confirm: str | None = confirmed_by("weigh")

    def run(self, progress: Progress = SILENT) -> dict[str, Any]:
        from limber.cell.obstacles import cell_obstacles
        from limber.cell.reach_and_collision import ArmSurroundings
        from limber.robot.driver.controls import set_payload
        from limber.robot.driver.link import RobotLink
        from limber.robot.motion.joint_path import to_joints
        from limber.robot.operator_decisions import require_confirmation
        from limber.robot.robot_state import weighed_as

        cell = self.cell()
        require_empty(cell, progress)
        sample, _ = stands(cell)
        tilted = tilted_joints(sample.joints, cell.tool.mass_kg or 0.0)
        require_tilts(-cell.arm.forward(tilted)[:, 2, :3], cell.tool.mass_kg or 0.0)
        around = ArmSurroundings(cell, cell_obstacles(cell, self.cell_file.parent), None)
        moves = [_with_weight(to_joints(cell, first, second, around))
                 for first, second in pairwise(tilted)]
        result: dict[str, Any] = {"armed": self.arm,
                                  "duration_s": sum(move.duration for move in moves)}
        if not self.arm:
            return result
        require_confirmation("weigh", self.confirm, cell, progress)
        rows: list[np.ndarray] = []
        try:
            with RobotLink(weightless(cell), rows.append) as link:
                found = weighed(cell, link, moves, rows)
        finally:
            set_payload(cell)
        result |= {"mass_kg": found.mass, "mass_sigma_kg": found.sigma,
                   "faults": list(found.faults)}
        log_move(self, result | weighed_as(cell))
        if found.faults:
            raise SafetyStop(f"{'; '.join(found.faults)}.", "The guard would feel another force "
                             "than the branch's.", "Correct [sensor] or tool.mass_kg in the cell "
                             "file.", result=result)
        return result


def _with_weight(move: Trajectory) -> Trajectory:
    """A tilt on which the guard expects a weight that is not known yet."""
    expected = present(move.expected, "expected force")
    unsure = expected.covariance + np.diag([(0.5 * _CHANGE_N) ** 2] * 3 + [0.0] * 3)
    return replace(move, expected=replace(expected, covariance=unsure))


def weightless(cell: Cell) -> Cell:
    """The cell as if nothing hung at the flange: neither the controller nor we correct for it."""
    return cell.model_copy(update={"tool": cell.tool.model_copy(update={"mass_kg": 0.0})})


def weighed(cell: Cell, link: RobotLink, moves: list[Trajectory], rows: list[np.ndarray],
            ) -> Weighing:
    """Read the sensor at each end of ``moves``, and compare; ``rows`` grows as samples come."""
    link.wait_for_samples()
    link.tare(_TARE_SECONDS)
    read = [_reading(cell, rows)]
    for move in moves:
        event = link.follow(move)
        if event["event"] != "reached":
            raise SafetyStop(f"The robot was stopped: {event['reason']}.", "It was tilting the "
                             "empty gripper, whose weight changes by 2 N at most.",
                             "Check the sensor and what the gripper met.")
        read.append(_reading(cell, rows))
    downs, forces, times = (np.array(part) for part in zip(*read, strict=True))
    return compared(downs, forces, times, cell.tool.mass_kg or 0.0)


def _reading(cell: Cell, rows: list[np.ndarray]) -> tuple[np.ndarray, np.ndarray, float]:
    """Gravity's direction and the mean force in the flange's axes, and when, at rest."""
    from limber.core.numerics.rigid import inverted, matrices

    time.sleep(_SETTLE_SECONDS)
    rows.clear()
    time.sleep(_READ_SECONDS)
    samples = np.concatenate(rows)
    flange = matrices(samples[-1, 1:7]) @ inverted(matrices(np.array(cell.tool.grasp_pose)))
    down = (inverted(matrices(np.array(cell.base.pose))) @ flange)[:3, :3].T @ [0.0, 0.0, -1.0]
    # Rows have what the gripper exerts, in the branch's frame.
    force = -flange[:3, :3].T @ samples[:, 7:10].mean(axis=0)
    return down, force, float(samples[:, 0].mean())


# A force sensor tested by the weight of the gripper: sign, unit, axes and stated mass.
#
# The gripper is tilted a little about two axes. The change of its weight is known from the stated
# mass; a sensor with another sign, unit or other axes shows another change.

_LEAST_TILT = 0.03  # sine of the angle of gravity's change
_MOST_TILT = 0.5  # rad
_CHANGE_N = 2.0  # N of the weight; the guard stops at limits.unexpected_force_n, 3 N by default
_SECOND_TILT = 0.4  # fraction of the first, about the second axis
_ALIKE = 0.8  # cosine of the angle between measured and expected change
_UNITS = {0.1019: "kilograms-force", 0.2248: "pounds-force", 0.001: "kilonewtons",
          1000.0: "millinewtons"}
_NEAR = 0.15  # relative


@dataclass(frozen=True)
class Weighing:
    """A sensor's readings of a tilted gripper: the mass that explains the changes [kg], its
    standard error, and errors of the sensor or the stated mass, in words."""

    mass: float
    sigma: float
    faults: tuple[str, ...]


def tilted_joints(joints: np.ndarray, mass: float) -> np.ndarray:
    """Return joint angles [6, n] from ``joints`` [n] and back, tilted by the two middle wrists so
    little that the weight of ``mass`` [kg] changes by no more than the guard allows."""
    weight = max(STANDARD_GRAVITY * mass, 1e-9)
    tilt = min(_MOST_TILT, float(np.arcsin(min(1.0, _CHANGE_N / weight))))
    offs = np.zeros((6, len(joints)))
    offs[[1, 2], 3] = tilt, -tilt
    offs[[3, 4], 4] = tilt, -tilt
    return joints + offs


def require_tilts(downs: np.ndarray, stated: float) -> np.ndarray:
    """Return the axes [3, 3] along which directions of gravity [n, 3] differ, most first;
    InputError for too few, about one axis only, or if no mass [kg] is stated."""
    if not stated > 0.0:
        raise InputError("The cell file states no tool.mass_kg above 0.", "Without a weight there "
                         "is nothing to compare the sensor with.", "State the gripper's mass.")
    _, sizes, axes = np.linalg.svd(downs - downs[0], full_matrices=False)
    if len(downs) < 6 or sizes[1] < max(_LEAST_TILT, _SECOND_TILT * sizes[0]):
        raise InputError("The gripper is not tilted about two axes.", "A wrong axis of the sensor "
                         "would not show.", "Turn the wrist so that its joints 4 and 5 tilt the "
                         "gripper against the vertical.")
    return axes


def compared(downs: np.ndarray, forces: np.ndarray, times: np.ndarray, stated: float) -> Weighing:
    """Compare mean readings [N], [n, 3], of the surroundings on the tool, flange axes, not
    corrected for a payload, at some directions of gravity there [n, 3] and times [s], with the
    weight of the stated mass [kg]; bias and a linear drift are fitted too. InputError for too few
    tilts, about one axis only, or without a stated mass."""
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
    changes, regressors = found[:2] / STANDARD_GRAVITY, axes[:2]
    along = float((changes * regressors).sum() / 2)
    size = float(np.sqrt((changes**2).sum() / 2))
    sigma = spread / STANDARD_GRAVITY / np.sqrt((tilts**2).sum())
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
    from limber.robot.robot_state import mass_off

    if mass_off(along, sigma, stated):
        return [f"tool.mass_kg or the sensor's scale is wrong ({message})"]
    return []
