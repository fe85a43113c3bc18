"""The CSV tables of a plan: paths, motion, set-points and search trees."""

from collections.abc import Mapping

import numpy as np

from limber.core.files.tables import table_text
from limber.core.not_none import present
from limber.planning.cost import arc_lengths
from limber.planning.plan_file import PlanPath
from limber.planning.planners.rrt_star import SearchTree
from limber.planning.timing import Pace, poses_at, time_law

_MOST_NODES = 2000  # of a search tree in its file; those that carry the most others stay
SETPOINT_RATE = 125.0  # [Hz] of poses in time, where no robot says its own
_COLUMNS = ("s_m", "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "energy_j", "force_n",
            "strain")
_MOTION_COLUMNS = ("t_s", "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad", "fx_n", "fy_n", "fz_n",
                   "tx_nm", "ty_nm", "tz_nm", "energy_j", "strain")


def path_table(path: PlanPath) -> str:
    """Return a path, one row per pose."""
    along = arc_lengths(path.poses[:, :3])
    return table_text(_COLUMNS, np.column_stack(
        [along, path.poses, path.energies, path.force_sizes, path.strains]))


def motion_table(motion: PlanPath) -> str:
    """Return the whole motion with its times, wrenches, targets and phases."""
    targets = [f"{name}_{axis}_m" for name in motion.targets for axis in "xyz"]
    times = present(motion.times, "time of the motion")
    forces = present(motion.forces, "force of the motion")
    torques = present(motion.torques, "torque of the motion")
    rows = np.column_stack([times, motion.poses, forces, torques,
                            motion.energies, motion.strains, *motion.targets.values()])
    phases = present(motion.phases, "phase of the motion")
    return table_text((*_MOTION_COLUMNS, *targets, "phase"), (
        (*row, phase) for row, phase in zip(rows, phases, strict=True)))


def setpoints(motion: PlanPath, pace: Pace, rate: float) -> str:
    """Return the grasp's poses every 1 / ``rate`` [s], and at the motion's end."""
    phases = present(motion.phases, "phase of the motion")
    end = phases.count("approach") + phases.count("path") - 1
    law = time_law(motion.poses[:, :3], pace, (end,))
    instants = np.arange(int(np.ceil(law.duration * rate)) + 1) / rate
    return table_text(_MOTION_COLUMNS[:7], np.column_stack(
        [instants, poses_at(motion.poses, law, instants, (end,))]))


def trees_table(trees: Mapping[str, SearchTree]) -> str:
    """One row per node: its tree, its position, and the row of its parent in that tree (-1: none).
    """
    pruned = {planner: tree.pruned(_MOST_NODES) for planner, tree in trees.items()}
    return table_text(("planner", "x_m", "y_m", "z_m", "parent"), (
        (planner, *node, parent) for planner, tree in pruned.items()
        for node, parent in zip(tree.nodes, tree.parents, strict=True)), digits=6)
