"""The robot along a path: pose of its links in each frame, from the joints of a dry run."""

from pathlib import Path

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import read_columns
from limber.core.numerics.rigid import matrices
from limber.results.scene.arrays import SceneData
from limber.robot.known_arms import arm_named
from limber.store import Branch

_FARTHEST_M = 0.02
"""A frame whose grasp is farther from every pose of the dry run is of another motion."""
_POSE = ("x_m", "y_m", "z_m")


def add_robot(data: SceneData, branch: Branch, plan: str | None) -> None:
    """Add the arm in each frame of the plan's motion, once `limber execute` has checked it.

    Raises:
        InputError: the dry run's table is damaged.
    """
    entry = branch.manifest.stages.get(f"execute-preview:{plan}")
    name = f"executions/{plan}-preview.csv"
    grasps = data.arrays.get("grasp_motion")
    # A dry run of an older Limber does not say which arm it was.
    if entry is None or grasps is None or "model" not in entry.result or not branch.has(name):
        return
    if (data.info.get("frames") or {}).get("name") != plan:
        return
    try:
        arm = arm_named(entry.result["model"])
    except InputError:
        # The arm's file, or the package that has the arm, is on another computer.
        return
    names = tuple(f"q{number + 1}_rad" for number in range(len(arm.joint_names)))
    table = read_columns(branch.path(name), (*_POSE, *names), "the table of a dry run")
    places, joints = (np.column_stack([table[column] for column in columns])
                      for columns in (_POSE, names))
    rows = _rows(places, grasps)
    if rows is None:
        return
    base = matrices(np.asarray(entry.result["base_pose"], float))
    links = (base @ arm.link_frames(joints[rows]))[..., :3, 3]
    start = np.broadcast_to(base[:3, 3], (len(rows), 1, 3))
    data.arrays["robot_links"] = np.concatenate([start, links, places[rows][:, None]], axis=1)
    data.arrays["robot_radius"] = np.array([arm.link_radius])
    data.info["robot"] = Path(arm.name).stem


def _rows(places: np.ndarray, grasps: np.ndarray) -> np.ndarray | None:
    """Return which row of the dry run each frame is nearest to, never going back; or None.

    Args:
        places: Of the grasp in the dry run [m], shape [rows, 3].
        grasps: Of the grasp in the frames [m], shape [frames, 3].
    """
    first, rows = 0, []
    for grasp in grasps:
        distances = np.linalg.norm(places[first:] - grasp, axis=1)
        first += int(distances.argmin())
        if distances.min() > _FARTHEST_M:
            return None
        rows.append(first)
    return np.array(rows)
