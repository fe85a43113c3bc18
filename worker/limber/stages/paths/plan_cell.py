"""Requirements of a robot's cell on a plan: workspace, obstacles, and the arm's reach."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from limber.core.errors import InputError, NoPathError
from limber.core.not_none import present
from limber.core.numerics.rigid import inverted, matrices
from limber.core.progress import Progress
from limber.geometry.io.surfaces import SURFACES, usable_surface
from limber.geometry.tets.tet_mesh import TetMesh
from limber.planning.constraints.limits import Limits
from limber.planning.constraints.obstacles import Box, Obstacle, Solid, closest
from limber.planning.field.grasp_model import GraspModel
from limber.planning.goals.goal import CellPlace
from limber.planning.goals.goal_kinds import View
from limber.planning.goals.regions import Ball, position_text
from limber.planning.plan_file import PlanPath
from limber.robot.cell.cell import BoxEntry, CameraEntry, Cell, SecondArmEntry, read_cell
from limber.robot.cell.compatibility import check_branch
from limber.robot.interface import Arm
from limber.robot.known_arms import arm_named
from limber.robot.live_view import LiveView
from limber.robot.motion.execution import Blocked, RobotMotion
from limber.robot.motion.expected_wrench import Predicted
from limber.stages.paths.plan_legs import surface_points
from limber.store import Branch

_UNITS = {"m": 1.0, "cm": 0.01, "mm": 0.001}
_TURNS = 200  # directions from which a second arm may approach a target
_ROD_SPACING = 0.02  # [m] between points along a part of gripper or arm
_POSE_SPACING = 0.01  # [m] largest step of a part between checked poses
_BETWEEN = 0.006  # [m] added to the parts' radii for the motion between poses
_SIGHT_SPACING = 0.005  # [m] between points on a line of sight
_OWN_SURFACE = 0.003  # [m] of surface around a target that does not hide it at least
_OWN_WOOD = 1.5  # times the distance of the surface next to a target: the wood that it sits on
_NEXT = 36  # corners of triangles that are next to a target
_DEVIATIONS = 2.0  # standard deviations of the branch's position that a clearance covers
_AT_REST = 0.9  # fraction of the clearance at rest that is kept at most if none was requested
_CLAMPED = 0.001  # [m] by which a piece that is clamped, not only held, moves the branch at most
_LARGE = 20.0  # [m] a larger obstacle is in another unit


def cell_for(branch: Branch, path: Path, progress: Progress) -> Cell:
    """Return the cell of a file after checking that it is this branch's.

    Raises:
        InputError: it cannot be read, or belongs to another branch.
    """
    cell = read_cell(path)
    if warning := check_branch(cell, branch.uuid, branch.folder):
        progress.warn(warning)
    return cell


def cell_obstacles(cell: Cell, folder: Path) -> tuple[Obstacle, ...]:
    """Return the cell's obstacles; mesh files are in ``folder``.

    Raises:
        InputError: a mesh cannot be read, has holes, or is in another unit.
    """
    found: list[Obstacle] = []
    for number, entry in enumerate(cell.obstacles):
        name = entry.name or f"obstacle {number + 1}"
        if isinstance(entry, BoxEntry):
            frame = matrices(np.array(entry.pose))
            found.append(Box(name, 0.5 * np.array(entry.size_m), frame[:3, 3], frame[:3, :3].T))
            continue
        path = folder / entry.file
        surface, _ = usable_surface(SURFACES.read(path, scale=_UNITS[entry.unit]), path)
        size = float(np.ptp(surface.vertices, axis=0).max())
        if size > _LARGE:
            raise InputError(f"The obstacle {path} is {size:.0f} m long.",
                             "No cell is that large, so the file has another unit.",
                             "State unit = \"mm\" or \"cm\" in the cell file.")
        found.append(Solid(name, surface))
    return tuple(found)


def cell_positions(cell: Cell, obstacles: tuple[Obstacle, ...] = (),
                   live: LiveView | None = None) -> dict[str, CellPlace]:
    """Return the cell's constraints on goals: its camera's view and its second arm's reach.

    Args:
        live: What the connected camera sees now; its own intrinsics are the view then.
    """
    found = {}
    if (view := _view_of(cell, live)) is not None:
        found["in_view"] = CellPlace(
            view, partial(hiding, view, obstacles, live=live), True, view.words,
            "The camera does not see {what}",
            "Move the camera in the cell file to a side without branch or obstacles")
    if cell.second_arm is not None:
        arm = arm_named(cell.second_arm.model)
        shoulder = matrices(np.array(cell.second_arm.base_pose)) @ np.r_[arm.shoulder, 1.0]
        x, y, z = map(float, shoulder[:3])
        reach = _outer_reach(arm, cell.second_arm)
        found["second_arm"] = CellPlace(
            Ball((x, y, z), reach), partial(_untaken, cell.second_arm), False,
            f"{reach:.3f} m of the shoulder of the second arm ({arm.name}) at "
            f"{position_text((x, y, z))} m", f"The second arm ({arm.name}) cannot take {{what}}",
            "Move the second arm in the cell file")
    return found


def _outer_reach(arm: Arm, entry: SecondArmEntry) -> float:
    """Return the largest distance of an arm's grasp from its shoulder [m]: all links in line plus
    the tool's length.
    """
    joints = np.array(arm.home, float)
    points = np.vstack([arm.shoulder, arm.link_frames(joints)[:, :3, 3],
                        arm.forward(joints)[:3, 3]])
    return float(np.linalg.norm(np.diff(points, axis=0), axis=1).sum()
                 + np.linalg.norm(entry.grasp_pose[:3]))


def hiding(view: View, obstacles: tuple[Obstacle, ...], point: np.ndarray,
           surface: np.ndarray | None, live: LiveView | None = None) -> str:
    """Return in words that the branch's surface, an obstacle or what the camera sees now hides a
    target at ``point`` [3]; empty if nothing does.

    The wood that the target sits on does not: a tip, on the axis, would be seen from ahead only.
    """
    if surface is not None:
        away = np.linalg.norm(surface.reshape(-1, 3) - point, axis=1)
        own = _OWN_WOOD * float(np.median(np.sort(away)[:_NEXT]))
        if view.hidden_by(surface, point, max(own, _OWN_SURFACE)):
            return "the branch hides it"
    eye = view.frame[:3, 3]
    count = int(np.ceil(np.linalg.norm(point - eye) / _SIGHT_SPACING)) + 1
    hit = closest(obstacles, eye + np.linspace(0.0, 1.0, count)[:, None] * (point - eye))
    if hit:
        return f"{hit[0]} hides it"
    return "" if live is None else live.hiding(point)


def _untaken(entry: SecondArmEntry, place: np.ndarray, _surface: object) -> str:
    """Return in words that an arm cannot grasp a target at ``place`` [3] from any side; empty if it
    can.
    """
    arm = arm_named(entry.model)
    turns = Rotation.random(_TURNS, rng=np.random.default_rng(0)).as_matrix()
    frames = np.tile(np.eye(4), (_TURNS, 1, 1))
    frames[:, :3, :3], frames[:, :3, 3] = turns, place
    flange = inverted(matrices(np.array(entry.base_pose))) @ frames @ inverted(
        matrices(np.array(entry.grasp_pose)))
    if np.isnan(arm.inverse(flange)).any(axis=-1).all():
        return f"its inverse kinematics has no solution from any of {_TURNS} directions"
    return ""


def is_fixed(camera: CameraEntry | None) -> bool:
    """Whether there is a camera that does not move with the arm."""
    return camera is not None and camera.mount == "branch"


def _view_of(cell: Cell, live: LiveView | None) -> View | None:
    """Return the view of the cell's camera; None without a static one."""
    camera = cell.camera
    if camera is None or not is_fixed(camera):
        return None
    (fx, fy), (cx, cy), (width, height) = (
        (camera.focal_px, camera.centre_px, (camera.width, camera.height)) if live is None else
        ((live.camera.fx, live.camera.fy), (live.camera.cx, live.camera.cy),
         (live.camera.width, live.camera.height)))
    return View(matrices(np.array(camera.pose)),
                (-cx / fx, (width - cx) / fx, -cy / fy, (height - cy) / fy), camera.range_m)


def clearance_in(cell: Cell, asked: float | None, obstacles: tuple[Obstacle, ...],
                 grasp: np.ndarray, nodes: np.ndarray) -> float:
    """Return the clearance from obstacles [m]: ``asked`` if given, else a value that covers the
    uncertainty of the grasp position, limited to nearly the clearance at rest.

    Args:
        grasp, nodes: Grasp and nodes of the branch at rest, branch frame [m], shapes [3] and [n,
        3].
    """
    if asked is not None or not obstacles:
        return asked or 0.0
    base, arm = cell.base, np.linalg.norm(grasp - np.array(cell.base.pose[:3]))
    sigma = float(np.linalg.norm([base.position_sigma_m, base.rotation_sigma_rad * arm,
                                  cell.robot.pose_sigma_m]))
    own = min(float(body.clearance(nodes).min()) for body in obstacles)
    return max(min(_DEVIATIONS * sigma, _AT_REST * own), 0.0)


@dataclass
class KeptClear:
    """Check of the clearance that a plan was made with, when it is executed.

    Attributes:
        obstacles: Obstacles of the cell, branch frame.
        clearance: Distance that branch, gripper and arm keep from them [m].
        least: Least distance of the branch so far [m]; infinite without obstacles.
        surfaces: Points of the branch's surface at each state so far [m], shape [k, 3] each.
    """

    obstacles: tuple[Obstacle, ...]
    clearance: float
    least: float = np.inf
    surfaces: list[np.ndarray] = field(default_factory=list)

    @classmethod
    def of(cls, cell: Cell, folder: Path, grasp_model: GraspModel, planned: float | None,
           ) -> "KeptClear":
        """Return the check with the clearance ``planned`` [m]; None: the one of a plan of today.
        """
        obstacles = cell_obstacles(cell, folder)
        nodes = grasp_model.mesh.nodes + grasp_model.rest.displacement
        return cls(obstacles, clearance_in(cell, planned, obstacles, grasp_model.rest_position,
                                           nodes))

    def require(self, grasp: np.ndarray, mesh: TetMesh, moved: np.ndarray) -> None:
        """Check the branch with its grasp at ``grasp`` [3] and its nodes displaced by ``moved``
        [n, 3].

        Raises:
            NoPathError: it is nearer to an obstacle than the plan allows.
        """
        nodes = mesh.nodes + moved
        self.surfaces.append(surface_points(mesh, moved[None])[0])
        for obstacle in self.obstacles:
            away = float(obstacle.clearance(nodes).min())
            self.least = min(self.least, away)
            if away > max(self.clearance - _CLAMPED, 0.0):
                continue
            place = ", ".join(f"{x:.3f}" for x in grasp)
            raise NoPathError(
                f"With the grasp at ({place}) m the branch would be "
                + (f"{1e3 * away:.1f} mm from {obstacle.name}, nearer than the plan's clearance "
                   f"of {1e3 * self.clearance:.1f} mm." if away > 0.0 else
                   f"{-1e3 * away:.1f} mm inside {obstacle.name}."),
                "The obstacle, the branch or its Young's modulus has changed since the plan was "
                "made.", "Plan again with this cell.")

    def describe(self) -> dict[str, Any]:
        """Return the clearance, and the least distance of the branch, as plain data."""
        return {"clearance_m": self.clearance,
                "branch_clearance_m": self.least if np.isfinite(self.least) else None}


def limits_in(cell: Cell, limits: Limits, obstacles: tuple[Obstacle, ...], clearance: float = 0.0,
              ) -> Limits:
    """Return limits that include the cell's workspace, force and obstacles.

    Raises:
        InputError: the two workspaces do not intersect.
    """
    box = cell.workspace
    return limits.with_cell(None if box is None else np.array(box.low_m),
                            None if box is None else np.array(box.high_m),
                            cell.limits.soft_force_n, obstacles, clearance)


def predicted_ahead(motion: PlanPath) -> Predicted:
    """Return poses and wrenches of a motion along approach and path."""
    there = np.array(motion.phases) != "return"
    forces = present(motion.forces, "force of the motion")
    torques = present(motion.torques, "torque of the motion")
    return Predicted.of_forces(motion.poses[there], forces[there], torques[there])


def robot_summary(cell: Cell, found: RobotMotion) -> dict[str, Any]:
    """Return a plan's entries about its robot, as plain data."""
    return {"model": cell.arm.name, "base_pose": cell.base.pose, "branch": cell.branch,
            "gripper_rotation": found.rotation,
            "duration_s": found.approach.duration + found.path.duration,
            "singularity_distance": found.joints.singularity,
            "joint_limit_margin_rad": found.joints.limit_margin}


def blocked_by(cell: Cell, obstacles: tuple[Obstacle, ...], clearance: float = 0.0) -> Blocked:
    """Return a test of whether gripper or arm is nearer to an obstacle than ``clearance`` [m].
    """
    def blocked(flange: np.ndarray, joints: np.ndarray) -> NoPathError | None:
        return None if not obstacles else _obstructing(cell, obstacles, flange, joints, clearance)
    return blocked


def _obstructing(cell: Cell, obstacles: tuple[Obstacle, ...], flange: np.ndarray,
                 joints: np.ndarray, clearance: float) -> NoPathError | None:
    """Return the error for the deepest point in an obstacle or its ``clearance`` [m], or None.

    Args:
        flange: Flange frames in the robot's base, shape [n, 4, 4].
        joints: The same as angles [rad], shape [n, joints].
    """
    base = matrices(np.array(cell.base.pose))
    arm = cell.arm.rods(joints)
    parts = [(f"The arm's {name}", arm.starts[:, k], arm.ends[:, k], float(arm.radii[k]))
             for k, name in enumerate(arm.names)]
    parts += [("The gripper", *(flange[:, :3, :3] @ np.array(end) + flange[:, :3, 3]
                                for end in (part.start_m, part.end_m)), part.radius_m)
              for part in cell.tool.parts]
    looked = _distances(np.stack([end for part in parts for end in part[1:3]], axis=1))
    worst: tuple[float, str, str, np.ndarray] | None = None
    for what, starts, ends, radius in parts:
        length = float(np.linalg.norm(ends[0] - starts[0]))
        share = np.linspace(0.0, 1.0, int(np.ceil(length / _ROD_SPACING)) + 1)[:, None]
        points = starts[looked, None] + share * (ends - starts)[looked, None]
        points = points.reshape(-1, 3) @ base[:3, :3].T + base[:3, 3]
        hit = closest(obstacles, points, radius + _BETWEEN + clearance)
        if hit and (worst is None or hit[1] > worst[0]):
            worst = hit[1], what, hit[0], hit[2]
    if worst is None:
        return None
    depth, what, name, where = worst
    return NoPathError(
        f"{what} would be "
        + (f"inside {name}, by up to {1e3 * (depth - clearance):.1f} mm, at " if depth >= clearance
           else f"{1e3 * (clearance - depth):.1f} mm from {name}, nearer than the clearance of "
                f"{1e3 * clearance:.1f} mm, at ") +
        f"({', '.join(f'{x:.3f}' for x in where)}) m.",
        "This is the gripper direction farthest from singularities. Every other direction that "
        "was tried is blocked as well.",
        "Choose another path or another position of the robot's base, or correct the obstacle in "
        "the cell file.")


def _distances(points: np.ndarray) -> np.ndarray:
    """Return indices of poses between which points [n, k, 3] move at most the spacing."""
    steps = np.linalg.norm(np.diff(points, axis=0), axis=2).max(axis=1)
    gone = np.r_[0.0, np.cumsum(steps)]
    chosen = np.searchsorted(gone, np.arange(0.0, gone[-1], _POSE_SPACING))
    return np.unique(np.r_[0, chosen, len(points) - 1])
