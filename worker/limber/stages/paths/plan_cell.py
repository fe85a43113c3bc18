"""A plan in a robot's cell: workspace, obstacles, the arm's reach, the legs of the motion, and the
gripper's rotation where the arm cannot follow the branch's own."""

from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from limber.cell.cell_file import CameraEntry, Cell, check_branch, read_cell
from limber.cell.known_arms import arm_named
from limber.cell.obstacles import Obstacle, cell_obstacles, closest
from limber.cell.reach_and_collision import ArmSurroundings, clearance_in, outer_reach, untaken
from limber.core.errors import Command, NoPathError, Option
from limber.core.not_none import present
from limber.core.numerics.rigid import matrices
from limber.core.progress import Progress
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics import BranchModel, Grasp, StaticResult, follow_poses
from limber.mechanics.sensitivities import grasp_slopes
from limber.planning.constraints.limits import Limits
from limber.planning.cost import arc_lengths
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.field.stored_states import States
from limber.planning.goals.goal import CellPlace
from limber.planning.goals.region import Ball, View, position_text
from limber.planning.plan_file import PlanPath
from limber.robot.depth_camera import LiveView
from limber.robot.motion.execution import (
    HELD,
    Leg,
    RobotMotion,
    TurnCost,
    Turned,
    described,
    legs_of,
    turned,
    turned_motion,
)
from limber.robot.motion.trajectory import Predicted
from limber.stages.pulls.record_path import GRASP_RADIUS_M
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


# The legs of a plan's whole motion, each with its own check: times, loads and distances.

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


# The gripper's rotation of a plan where the arm cannot follow the branch's own, and its torque.

_OF_HARD = 0.8  # of the torque at which the guard stops the arm, that an offset may need
_STATES = 6  # along the path, of which the stiffness is computed, and the turned ones solved


@dataclass(frozen=True)
class Clamped:
    """The branch clamped by a rigid gripper (``firm``, ``grasp``) at the states ``rows`` [k] of a
    plan, at its natural rotations: poses [m, rad], [k, 6], displacements [m], [nodes, 3] each,
    wrenches and stiffness (``cost``)."""

    firm: BranchModel
    grasp: Grasp
    rows: np.ndarray
    poses: np.ndarray
    displacements: list[np.ndarray]
    cost: TurnCost

    @classmethod
    def of(cls, grasp_model: GraspModel, states: States) -> "Clamped":
        """Solve the clamped branch at some of a plan's states; NoPathError if one has no
        solution."""
        grasp = Grasp.gripping(grasp_model.mesh, grasp_model.grasp.centre, GRASP_RADIUS_M)
        firm = grasp_model.model.gripped(grasp)
        rows = np.unique(np.linspace(0, len(states.poses) - 1, _STATES).astype(int))
        solved = [_solved(firm, grasp, states.poses[row], states.displacements[row])
                  for row in rows]
        wrenches = np.array([np.r_[one.reaction_force, one.reaction_torque] for one in solved])
        slopes = np.array([grasp_slopes(firm, grasp, one.displacement).wrench[:, 3:]
                           for one in solved])
        return cls(firm, grasp, rows, states.poses[rows], [one.displacement for one in solved],
                   TurnCost(arc_lengths(states.poses[:, :3])[rows], wrenches, slopes))

    def checked(self, offsets: np.ndarray, limits: Limits) -> dict[str, float]:
        """Return the largest torque and force on the full model with ``offsets`` [k, 3] at these
        states, and the error of the second-order function, as plain data. NoPathError if a state
        has no solution, or breaks a limit."""
        wrenches = []
        for pose, begin in zip(turned(self.poses, offsets), self.displacements, strict=True):
            one = _solved(self.firm, self.grasp, pose, begin)
            wrenches.append(np.r_[one.reaction_force, one.reaction_torque])
        found = np.array(wrenches)
        force, torque = (np.linalg.norm(part, axis=1) for part in (found[:, :3], found[:, 3:]))
        for size, limit, what in ((force, limits.force, "force [N]"),
                                  (torque, limits.torque, "torque [N m]")):
            if size.max() > limit:
                raise NoPathError(
                    f"With the gripper turned beyond the branch's own rotation the {what} is "
                    f"{size.max():.3g} on the full model, and the limit is {limit:.3g}.",
                    "The arm cannot follow the branch without that rotation.",
                    "Move the robot's base, raise the limit, or reduce ", Option("turn_slack"), ".")
        off = np.linalg.norm((found - self.cost.wrench(offsets))[:, 3:], axis=1)
        return {"peak_torque_nm": float(torque.max()), "peak_force_n": float(force.max()),
                "torque_error_nm": float(off.max())}


def _solved(firm: BranchModel, grasp: Grasp, pose: np.ndarray, begin: np.ndarray) -> StaticResult:
    found = follow_poses(firm, grasp, pose[None], start=begin)[0]
    if (reason := refusal(found)) is not None:
        place = ", ".join(f"{x:.3f}" for x in pose[:3])
        raise NoPathError(f"The branch has no reliable state with the gripper turned at ({place}) "
                          f"m ({reason}).", "The arm cannot follow it without turning it.",
                          "Move the robot's base, or reduce ", Option("turn_slack"), ".")
    return found


def turned_by(cell: Cell, predicted: Predicted, grasp_model: GraspModel, states: States,
              slack: float, limits: Limits, **asked: Any) -> tuple[Turned, dict[str, Any]]:
    """Return the robot's motion with the gripper turned by at most ``slack`` [rad] beyond the
    branch's own rotation, checked on the full model, its torque below the guard's stop, and a
    plan's entry about it. NoPathError if no such rotation helps, or it breaks a limit."""
    limits = replace(limits, torque=min(limits.torque, _OF_HARD * cell.limits.hard_torque_nm))
    clamped = Clamped.of(grasp_model, states)
    along = arc_lengths(states.poses[:, :3])
    found = turned_motion(cell, predicted, grasp_model.reach.axis, clamped.cost.at(along), slack,
                          (limits.force, limits.torque), **asked)
    return found, {
        "slack_rad": slack, "along_m": along, "offsets_rad": found.offsets,
        "largest_rad": float(np.linalg.norm(found.offsets, axis=1).max()),
        "peak_energy_j": float(found.energies.max()),
        "peak_torque_nm": float(found.torques.max()),
        "full_model": clamped.checked(found.offsets[clamped.rows], limits)}
