"""Requirements of a robot's cell on a plan: workspace, obstacles, and the arm's reach."""

from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from limber.cell.cell_file import (
    CameraEntry,
    Cell,
    check_branch,
    read_cell,
)
from limber.cell.known_arms import arm_named
from limber.cell.obstacles import Obstacle, cell_obstacles, closest
from limber.cell.reach_and_collision import clearance_in, outer_reach, untaken
from limber.core.errors import NoPathError
from limber.core.not_none import present
from limber.core.numerics.rigid import matrices
from limber.core.progress import Progress
from limber.geometry.tets.tet_mesh import TetMesh
from limber.planning.constraints.limits import Limits
from limber.planning.field.grasp_model import GraspModel
from limber.planning.goals.goal import Ball, CellPlace, position_text
from limber.planning.goals.goal_kinds import View
from limber.planning.plan_file import PlanPath
from limber.robot.depth_camera import LiveView
from limber.robot.motion.execution import RobotMotion
from limber.robot.motion.trajectory import Predicted
from limber.stages.paths.plan_legs import surface_points
from limber.store import Branch

_SIGHT_SPACING = 0.005  # [m] between points on a line of sight
_OWN_SURFACE = 0.003  # [m] of surface around a target that does not hide it at least
_OWN_WOOD = 1.5  # times the distance of the surface next to a target: the wood that it sits on
_NEXT = 36  # corners of triangles that are next to a target
_CLAMPED = 0.001  # [m] by which a piece that is clamped, not only held, moves the branch at most


def cell_for(branch: Branch, path: Path, progress: Progress) -> Cell:
    """Return the cell of a file; InputError if it cannot be read, or belongs to another branch."""
    cell = read_cell(path)
    if warning := check_branch(cell, branch.uuid, branch.folder):
        progress.warn(warning)
    return cell


def cell_positions(cell: Cell, obstacles: tuple[Obstacle, ...] = (),
                   live: LiveView | None = None) -> dict[str, CellPlace]:
    """Return the cell's constraints on goals: its camera's view, whose intrinsics are those of
    ``live``, what the connected camera sees now, and its second arm's reach."""
    found = {}
    if (view := _view_of(cell, live)) is not None:
        found["view"] = CellPlace(
            view, partial(hiding, view, obstacles, live=live), True, view.words,
            "The camera does not see {what}",
            "Move the camera in the cell file to a side without branch or obstacles")
    if cell.second_arm is not None:
        arm = arm_named(cell.second_arm.model)
        shoulder = matrices(np.array(cell.second_arm.base_pose)) @ np.r_[arm.shoulder, 1.0]
        x, y, z = map(float, shoulder[:3])
        reach = outer_reach(arm, cell.second_arm)
        found["second_arm"] = CellPlace(
            Ball((x, y, z), reach), partial(untaken, cell.second_arm), False,
            f"{reach:.3f} m of the shoulder of the second arm ({arm.name}) at "
            f"{position_text((x, y, z))} m", f"The second arm ({arm.name}) cannot take {{what}}",
            "Move the second arm in the cell file")
    return found


def hiding(view: View, obstacles: tuple[Obstacle, ...], point: np.ndarray,
           surface: np.ndarray | None, live: LiveView | None = None) -> str:
    """Return in words that the branch's surface, an obstacle or what the camera sees now hides a
    target at ``point`` [3], else "". The wood that it sits on does not: a tip, on the axis, would
    be seen from ahead only."""
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


@dataclass
class KeptClear:
    """Check of the clearance [m] from obstacles, branch frame, that branch, gripper and arm keep in
    a plan, when it is executed; ``least``: the branch's least distance so far [m], infinite without
    obstacles, ``surfaces``: points of its surface at each state [m], shape [k, 3]."""

    obstacles: tuple[Obstacle, ...]
    clearance: float
    least: float = np.inf
    surfaces: list[np.ndarray] = field(default_factory=list)

    @classmethod
    def of(cls, cell: Cell, folder: Path, grasp_model: GraspModel, planned: float | None,
           ) -> "KeptClear":
        """Return the check with the clearance ``planned`` [m]; None: the one of a plan of today."""
        obstacles = cell_obstacles(cell, folder)
        nodes = grasp_model.mesh.nodes + grasp_model.rest.displacement
        return cls(obstacles, clearance_in(cell, planned, obstacles, grasp_model.rest_position,
                                           nodes))

    def require(self, grasp: np.ndarray, mesh: TetMesh, moved: np.ndarray) -> None:
        """Check the branch with its grasp at ``grasp`` [3], nodes displaced by ``moved`` [n, 3]:
        NoPathError if it is nearer to an obstacle than the plan allows."""
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
                "made.", "Plan again with this cell.").at(grasp)

    def describe(self) -> dict[str, Any]:
        """Return the clearance, and the least distance of the branch, as plain data."""
        return {"clearance_m": self.clearance,
                "branch_clearance_m": self.least if np.isfinite(self.least) else None}


def limits_in(cell: Cell, limits: Limits, obstacles: tuple[Obstacle, ...], clearance: float = 0.0,
              ) -> Limits:
    """Return limits that include the cell's workspace, force and obstacles; InputError if the
    workspaces do not intersect."""
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
