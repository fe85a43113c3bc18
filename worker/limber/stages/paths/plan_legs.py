"""The legs of a plan's whole motion, each with its own check: times, loads and distances."""

from typing import Any

import numpy as np

from limber.cell.cell_file import Cell
from limber.cell.obstacles import Obstacle
from limber.cell.reach_and_collision import ArmSurroundings
from limber.core.errors import Command
from limber.core.not_none import present
from limber.core.progress import Progress
from limber.geometry.tets.tet_mesh import TetMesh
from limber.planning.cost import arc_lengths
from limber.planning.plan_file import PlanPath
from limber.robot.motion.execution import HELD, Leg, RobotMotion, described, legs_of

_MOST_POSES = 60  # of a leg whose distances are computed
_MOST_POINTS = 800  # of the branch's surface


def surface_points(mesh: TetMesh, displacements: np.ndarray) -> np.ndarray:
    """Return points [n, k, 3] of the branch's surface [m] at ``displacements`` [n, nodes, 3]."""
    vertices = np.unique(mesh.surface_faces())
    some = vertices[::-(-len(vertices) // _MOST_POINTS)]
    return mesh.nodes[some] + displacements[:, some]


def legs_without_cell(motion: PlanPath, hold: float) -> list[dict[str, Any]]:
    """Return the legs of a plan without a robot: path, hold and return, as plain data."""
    times = present(motion.times, "time of the motion")
    phases = present(motion.phases, "phase of the motion")
    torques = np.linalg.norm(present(motion.torques, "torque of the motion"), axis=1)
    end = len(phases) - phases.count("return") - 1
    found = []
    for name, first, last in (("path", 0, end), ("hold", end, end),
                              ("return", end, len(phases) - 1)):
        rows = slice(first, last + 1)
        steps = np.linalg.norm(np.diff(motion.poses[rows, :3], axis=0), axis=1)
        taken = np.maximum(np.diff(times[rows]), 1e-9)
        after = hold if name == "return" else 0.0
        found.append({
            "name": name, "start_s": float(times[first]) + after,
            "duration_s": hold if name == "hold" else float(times[last] - times[first]),
            "length_m": float(steps.sum()),
            "peak_speed_m_s": float((steps / taken).max(initial=0.0)),
            "peak_force_n": float(motion.force_sizes[rows].max()),
            "peak_torque_nm": float(torques[rows].max())})
    return found


def legs_in_cell(cell: Cell, obstacles: tuple[Obstacle, ...], motion: RobotMotion,
                 places: np.ndarray, surfaces: np.ndarray, hold: float, progress: Progress,
                 ) -> list[dict[str, Any]]:
    """Return the legs of a robot's motion as plain data, each checked for collisions, and warn
    where a link of the arm would be in the branch, or in another; positions of the grasp from rest
    to the path's end [m], [n, 3], and points of the surface there, branch frame [m], [n, k, 3]."""
    around, along = ArmSurroundings(cell, obstacles, None), arc_lengths(places)
    legs = legs_of(cell, motion, hold)
    found = [row | _distances(around, leg, along, surfaces)
             for leg, row in zip(legs, described(legs, cell), strict=True)]
    for row in found:
        for key, what in (("branch_distance_m", "the branch"), ("self_distance_m", "itself")):
            if (row[key] or 0.0) < 0.0:
                progress.warn(
                    f"During {row['name']} a link of the arm would be {-1e3 * row[key]:.1f} mm "
                    f"inside {what}, by its rough shape. Look at the motion in a scene (",
                    Command("scene"), ") before the arm moves.")
    return found


def _distances(around: ArmSurroundings, leg: Leg, along: np.ndarray, surfaces: np.ndarray,
               ) -> dict[str, float | None]:
    """Return the least distances of a leg [m], with the branch's ``surfaces`` [n, k, 3] after
    lengths ``along`` [n] of the path; None where nothing moves or is."""
    moved = leg.trajectory
    if moved is None or moved.joints is None:
        return dict.fromkeys(("self_distance_m", "obstacle_distance_m", "branch_distance_m"))
    some = _spread(len(moved.times), _MOST_POSES)
    gone = arc_lengths(moved.poses[:, :3])[some] if leg.name in HELD else np.zeros(len(some))
    gone = along[-1] - gone if leg.name == "return" else gone
    shapes = surfaces[np.abs(gone[:, None] - along).argmin(axis=1)]
    joints = moved.joints[some]
    return around.least_distances(joints) | {
        "branch_distance_m": float(around.links_from(joints, shapes).min())}


def _spread(count: int, most: int) -> np.ndarray:
    """Return at most ``most`` of ``count`` rows, the first and the last among them."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(int))
