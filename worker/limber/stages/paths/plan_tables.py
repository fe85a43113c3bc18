"""The CSV tables of a plan: paths, motion, set-points and search trees."""

import csv
import io
from collections.abc import Mapping

import numpy as np

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
    return _csv(_COLUMNS, np.column_stack(
        [along, path.poses, path.energies, path.force_sizes, path.strains]))


def motion_table(motion: PlanPath) -> str:
    """Return the whole motion with its times, wrenches, targets and phases."""
    targets = [f"{name}_{axis}_m" for name in motion.targets for axis in "xyz"]
    times = present(motion.times, "time of the motion")
    forces = present(motion.forces, "force of the motion")
    torques = present(motion.torques, "torque of the motion")
    rows = np.column_stack([times, motion.poses, forces, torques,
                            motion.energies, motion.strains, *motion.targets.values()])
    return _csv((*_MOTION_COLUMNS, *targets), rows, motion.phases)


def setpoints(motion: PlanPath, pace: Pace, rate: float) -> str:
    """Return the grasp's poses every 1 / ``rate`` [s], and at the motion's end."""
    phases = present(motion.phases, "phase of the motion")
    end = phases.count("approach") + phases.count("path") - 1
    law = time_law(motion.poses[:, :3], pace, (end,))
    instants = np.arange(int(np.ceil(law.duration * rate)) + 1) / rate
    return _csv(_MOTION_COLUMNS[:7], np.column_stack(
        [instants, poses_at(motion.poses, law, instants, (end,))]))


def trees_table(trees: Mapping[str, SearchTree]) -> str:
    """One row per node: its tree, its position, and the row of its parent in that tree (-1: none).
    """
    lines = ["planner,x_m,y_m,z_m,parent"]
    for planner, tree in trees.items():
        small = tree.pruned(_MOST_NODES)
        lines += [f"{planner},{x:.6g},{y:.6g},{z:.6g},{parent}"
                  for (x, y, z), parent in zip(small.nodes, small.parents, strict=True)]
    return "\n".join(lines) + "\n"


def _csv(columns: tuple[str, ...], rows: np.ndarray, phases: tuple[str, ...] | None = None) -> str:
    text = io.StringIO()
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow((*columns, *(() if phases is None else ("phase",))))
    for number, row in enumerate(rows):
        writer.writerow([*(f"{value:.9g}" for value in row),
                         *(() if phases is None else (phases[number],))])
    return text.getvalue()
