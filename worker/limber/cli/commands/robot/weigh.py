"""Test the force sensor by the gripper's weight: `limber robot weigh`."""

from __future__ import annotations

import time
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.cli.cell_tool import ArmedTool, confirmed_by
from limber.cli.commands.robot.moves import log_move, require_empty, stands
from limber.core.errors import SafetyStop
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
        from limber.robot.driver.link import RobotLink
        from limber.robot.motion.joint_path import to_joints
        from limber.robot.operator_decisions import require_confirmation
        from limber.robot.robot_state import require_tilts, tilted_joints, weighed_as

        cell = self.cell()
        require_empty(cell, progress)
        sample, _ = stands(cell)
        tilted = tilted_joints(sample.joints, cell.tool.mass_kg or 0.0)
        require_tilts(-cell.arm.forward(tilted)[:, 2, :3], cell.tool.mass_kg or 0.0)
        around = ArmSurroundings(cell, cell_obstacles(cell, self.cell_file.parent), None)
        moves = [to_joints(cell, first, second, around) for first, second in pairwise(tilted)]
        result: dict[str, Any] = {"armed": self.arm,
                                  "duration_s": sum(move.duration for move in moves)}
        if not self.arm:
            return result
        require_confirmation("weigh", self.confirm, cell, progress)
        rows: list[np.ndarray] = []
        with RobotLink(weightless(cell), rows.append) as link:
            found = weighed(cell, link, moves, rows)
        result |= {"mass_kg": found.mass, "mass_sigma_kg": found.sigma,
                   "faults": list(found.faults)}
        log_move(self, result | weighed_as(cell))
        if found.faults:
            raise SafetyStop(f"{'; '.join(found.faults)}.", "The guard would feel another force "
                             "than the branch's.", "Correct [sensor] or tool.mass_kg in the cell "
                             "file.", result=result)
        return result


def weightless(cell: Cell) -> Cell:
    """The cell as if nothing hung at the flange: neither the controller nor we correct for it."""
    return cell.model_copy(update={"tool": cell.tool.model_copy(update={"mass_kg": 0.0})})


def weighed(cell: Cell, link: RobotLink, moves: list[Trajectory], rows: list[np.ndarray]) -> Any:
    """Read the sensor at each end of ``moves``, and compare; ``rows`` grows as samples come."""
    from limber.robot.robot_state import weigh as weigh_readings

    link.wait_for_samples()
    link.tare(_TARE_SECONDS)
    read = [_reading(cell, rows)]
    for move in moves:
        try:
            event = link.follow(move)
        except KeyboardInterrupt:
            # Ctrl-C stops the arm before anything else.
            link.stop()
            raise
        if event["event"] != "reached":
            raise SafetyStop(f"The robot was stopped: {event['reason']}.", "It was tilting the "
                             "empty gripper, whose weight changes by 2 N at most.",
                             "Check the sensor and what the gripper met.")
        read.append(_reading(cell, rows))
    downs, forces, times = (np.array(part) for part in zip(*read, strict=True))
    return weigh_readings(downs, forces, times, cell.tool.mass_kg or 0.0)


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
