"""The robot along a path: poses of its links in each frame, from the joints of a dry run."""

from pathlib import Path

import numpy as np

from limber.cell.arm import Rods
from limber.cell.known_arms import arm_named
from limber.cell.reach_and_collision import GRIPPER, drawn_arm
from limber.core.errors import InputError
from limber.core.files.tables import read_columns
from limber.core.numerics.rigid import matrices
from limber.results.scene.arrays import SceneData
from limber.store import Branch

_FARTHEST_M = 0.02
"""Distance to the dry run above which a frame's grasp belongs to another motion."""
_POSE = ("x_m", "y_m", "z_m")


def add_robot(data: SceneData, branch: Branch, plan: str | None) -> None:
    """Add the arm in each frame of the plan's motion, if `limber execute` has checked it.

    Raises:
        InputError: the dry run's table is damaged.
    """
    entry = branch.manifest.stages.get(f"execute-preview:{plan}")
    name = f"executions/{plan}-preview.csv"
    grasps = data.arrays.get("grasp_motion")
    if entry is None or grasps is None or not branch.has(name):
        return
    if (data.info.get("frames") or {}).get("name") != plan:
        return
    try:
        arm = arm_named(entry.result["model"])
    except InputError:
        # The arm's file, or the package that provides the arm, is on another computer.
        return
    names = tuple(f"q{number + 1}_rad" for number in range(len(arm.joint_names)))
    table = read_columns(branch.path(name), (*_POSE, *names), "the table of a dry run")
    positions, joints = (np.column_stack([table[column] for column in columns])
                         for columns in (_POSE, names))
    rows = _rows(positions, grasps)
    if rows is None:
        return
    base = matrices(np.asarray(entry.result["base_pose"], float))
    # The gripper's rods at each flange: start, end and radius of each in the flange's frame.
    parts = np.asarray(entry.result["gripper_rods"], float).reshape(-1, 7)
    flange = (base @ arm.forward(joints[rows]))[:, None]
    starts, ends = (np.squeeze(flange[..., :3, :3] @ points[:, :, None], -1) + flange[..., :3, 3]
                    for points in (parts[:, :3], parts[:, 3:6]))
    shape = drawn_arm(arm, joints[rows], base).joined(
        Rods((GRIPPER,) * len(parts), starts, ends, parts[:, 6]))
    data.arrays |= {"robot_starts": shape.starts, "robot_ends": shape.ends,
                    "robot_radii": shape.radii}
    data.info["robot"] = {"name": Path(arm.name).stem, "gripper_rods": len(parts)}


def _rows(positions: np.ndarray, grasps: np.ndarray) -> np.ndarray | None:
    """Return the row of the dry run nearest to each frame, in ascending order; or None.

    Args:
        positions: Positions of the grasp in the dry run [m], shape [rows, 3].
        grasps: Positions of the grasp in the frames [m], shape [frames, 3].
    """
    first, rows = 0, []
    for grasp in grasps:
        distances = np.linalg.norm(positions[first:] - grasp, axis=1)
        first += int(distances.argmin())
        if distances.min() > _FARTHEST_M:
            return None
        rows.append(first)
    return np.array(rows)
