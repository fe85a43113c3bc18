"""The robot along a path: poses of its links in each frame, from the joints of a dry run."""

from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import read_columns
from limber.core.numerics.rigid import matrices
from limber.results.scene.arrays import SceneData
from limber.robot.interface import Arm
from limber.robot.known_arms import arm_named
from limber.store import Branch

_FARTHEST_M = 0.02
"""Distance to the dry run above which a frame's grasp belongs to another motion."""
_GRIPPER = 0.9  # radius of its body over that of the thinnest link
_PALM = 0.65  # extent of its body from the flange to the grasp
_FINGER = 0.3  # radius of a finger over that of the body
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
    starts, ends, radii = _arm_rods(arm, base, joints[rows])
    flange = (base @ arm.link_frames(joints[rows]))[:, -1]
    held = _gripper_rods(flange, positions[rows], _GRIPPER * float(radii.min()))
    data.arrays["robot_starts"], data.arrays["robot_ends"], data.arrays["robot_radii"] = (
        np.concatenate(parts, axis=axis) for parts, axis in zip(
            zip((starts, ends, radii), held, strict=True), (1, 1, 0), strict=True))
    data.info["robot"] = {"name": Path(arm.name).stem, "gripper_rods": len(held[2])}


def _arm_rods(arm: Arm, base: np.ndarray, joints: np.ndarray,
              ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the ends of the rods of foot and links [m], [n, rods, 3], and their radii.

    Args:
        base: Frame of the arm's base, shape [4, 4].
        joints: Angles [rad], shape [n, 6].
    """
    rods = arm.rods(joints)
    starts, ends = (points @ base[:3, :3].T + base[:3, 3] for points in (rods.starts, rods.ends))
    foot = np.broadcast_to(base[:3, 3], (len(joints), 1, 3))
    return (np.concatenate([foot, starts], axis=1), np.concatenate([starts[:, :1], ends], axis=1),
            np.r_[rods.radii[0], rods.radii])


def _gripper_rods(flange: np.ndarray, grasps: np.ndarray, radius: float,
                  ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return a body and two fingers between flange and grasp, as :func:`_arm_rods` does.

    Args:
        flange: Frames of the flange, shape [n, 4, 4].
        grasps: Middle between the fingers [m], shape [n, 3].
        radius: Radius of the body [m].
    """
    position = flange[:, :3, 3]
    vector = grasps - position
    length = np.linalg.norm(vector, axis=1, keepdims=True)
    axis = vector / np.maximum(length, 1e-9)
    side = flange[:, :3, 0] - (flange[:, :3, 0] * axis).sum(axis=1, keepdims=True) * axis
    side *= 0.8 * radius / np.maximum(np.linalg.norm(side, axis=1, keepdims=True), 1e-9)
    palm, tip = position + _PALM * vector, grasps + 0.5 * radius * axis
    return (np.stack([position, palm - side, palm + side], axis=1),
            np.stack([palm, tip - side, tip + side], axis=1),
            radius * np.array([1.0, _FINGER, _FINGER]))


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
