"""The path of a recorded pull: straight, along the arc of the branch, or through given positions.
"""

from pathlib import Path

import numpy as np

from limber.cell.cell_file import Cell
from limber.core.errors import InputError, SafetyStop
from limber.core.files.reading import read_json_as
from limber.core.files.tables import read_columns
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.core.progress import Progress
from limber.recordings.recording import POSE_COLUMNS
from limber.robot.motion.execution import Blocked
from limber.robot.motion.joint_path import joint_path
from limber.robot.motion.retreat import different_joints, in_degrees
from limber.robot.motion.trajectory import Trajectory, along, densely, speed_within
from limber.store import Branch

GRASP_RADIUS_M = 0.012
"""Half the length that a gripper holds along the branch."""

_SAME_PLACE_M = 0.01  # from the position where a suggested pull holds the branch
_STATES = 12  # of an arc: a chord of 4 mm on a bend of 0.3 m stretches a branch by 7 micrometres
_NEAR_M = 0.005  # from the gripper to the first given pose


def grasp_point(branch: Branch, gripper: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the place on the branch's axis nearest to the gripper's middle [3], branch frame [m],
    and how far away it is [m]; InputError if too far."""
    from limber.store.loading import load_skeleton

    skeleton = load_skeleton(branch)
    nearest, distance = skeleton.nodes[0], np.inf
    for child, parent in enumerate(skeleton.parent):
        if parent < 0:
            continue
        start, vectors = skeleton.nodes[parent], skeleton.nodes[child] - skeleton.nodes[parent]
        part = np.clip((gripper - start) @ vectors / max(vectors @ vectors, 1e-18), 0, 1)
        off = float(np.linalg.norm(gripper - start - part * vectors))
        if off < distance:
            nearest, distance = start + part * vectors, off
    if distance > 0.03:
        raise InputError(f"The gripper is {1000 * distance:.0f} mm away from the branch's axis.",
                         "It would close on nothing, or the calibration is wrong.",
                         "Move it onto the branch, or calibrate again.")
    return nearest, distance


def arc_path(branch: Branch, point: np.ndarray, direction: np.ndarray, distance: float,
             progress: Progress) -> np.ndarray:
    """Return frames [n, 4, 4], branch frame, from the identity on, to apply to the gripper's pose:
    they move the held piece at ``point`` [m, 3] along its arc up to ``distance`` [m], the model's
    path and rotation under a growing force along ``direction`` [3]. The level of stiffness does not
    affect it, its course along the branch a little; without an estimate the modulus is one.
    WorkError if no force moves it so far."""
    from limber.estimation.forward.observed_path import force_for_travel
    from limber.mechanics import Grasp, solve_static
    from limber.store.loading import load_branch

    progress(0.0, "the arc of the branch")
    model = load_branch(branch, progress=progress).model
    grasp = Grasp.at(model.mesh, point, GRASP_RADIUS_M, "point")
    unit = np.asarray(direction, float) / np.linalg.norm(direction)
    size = force_for_travel(model, grasp, unit, distance)
    poses, state = [grasp.rest_pose], None
    for number, part in enumerate(np.linspace(0, 1, _STATES + 1)[1:]):
        state = solve_static(model, grasp=grasp, grasp_force=part * size * unit,
                             start=state).require()
        poses.append(grasp.pose_of(model.mesh.nodes, state.displacement))
        progress((number + 1) / _STATES, "the arc of the branch")
    # The force is accurate to some percent; a slightly longer bend has the same shape.
    frames = matrices(np.array(poses))
    return frames @ inverted(frames[0])


def suggested_pull(branch: Branch, point: np.ndarray) -> tuple[np.ndarray, float]:
    """Return direction [3] across the branch and distance [m] of the suggested pull, for a gripper
    at ``point``, branch frame [m, 3]. BranchFolderError if none was suggested; InputError if its
    grasp is elsewhere."""
    from limber.stages.pulls.suggest_pull import SuggestedPulls

    path = branch.require("suggested_pull.json", "suggest-pull")
    found = read_json_as(path, SuggestedPulls, "a suggested pull").best
    grasp = found.grasp_point
    away = float(np.linalg.norm(grasp - point))
    if away > _SAME_PLACE_M:
        raise InputError(
            f"The gripper is {1000 * away:.0f} mm from where the suggested pull holds the branch, "
            f"({', '.join(f'{x:.3f}' for x in grasp)}) m.", "The same motion at another grasp "
            "gives other information and other strains.", "Move the gripper there.")
    # The end is on the arc, closer to the root, which is the origin: the pull is across.
    travel, out = found.end - grasp, grasp / max(float(np.linalg.norm(grasp)), 1e-9)
    return travel - (travel @ out) * out, found.travel


def waypoint_path(path: Path, gripper: np.ndarray) -> np.ndarray:
    """Return frames [n, 4, 4] of the gripper through the positions of a CSV file, branch frame, not
    rotated without columns of rotation. InputError if it cannot be read, has only one position, or
    starts too far from ``gripper`` [6]."""
    table = read_columns(path, POSE_COLUMNS[:3], "a table of way-points (x_m, y_m, z_m, and "
                         "rx_rad, ry_rad, rz_rad if the gripper turns)")
    poses = np.tile(gripper, (len(table["x_m"]), 1))
    for column, name in enumerate(POSE_COLUMNS):
        if name in table:
            poses[:, column] = table[name]
    if len(poses) < 2:
        raise InputError(f"{path} has only one way-point.", "A path needs two.", "Give two or more "
                                                                          "way-points.")
    away = float(np.linalg.norm(poses[0, :3] - gripper[:3]))
    if away > _NEAR_M:
        raise InputError(f"The first way-point is {1000 * away:.1f} mm away from the gripper.",
                         f"At most {1000 * _NEAR_M:.0f} mm are allowed.",
                         "Start at the gripper's position, in the branch's frame.")
    return matrices(np.vstack([gripper, poses[1:]]))


def there_and_back(cell: Cell, frames: np.ndarray, *, speed: float, cycles: int, pause: float,
                   start: np.ndarray | None = None, blocked: Blocked | None = None) -> Trajectory:
    """Return the motion through frames of the gripper [n, 4, 4], branch frame, out and back at
    ``speed`` [m/s], standing for ``pause`` [s] at each end, from joint angles ``start`` [rad].
    NoPathError, where and why, if the arm cannot follow it, or is blocked; SafetyStop if only from
    another configuration."""
    out = densely(pose_vectors(inverted(matrices(np.array(cell.base.pose))) @ frames))
    flange = matrices(out) @ inverted(matrices(np.array(cell.tool.grasp_pose)))
    taken = joint_path(cell.arm, flange, start=start, joint_limits=cell.joint_limits,
                       singularity_margin=cell.limits.singularity,
                       joint_margin=cell.limits.joint_margin_rad)
    differences = [] if start is None else different_joints(start, taken.joints[0],
                                                            cell.arm.joint_names)
    if differences:
        raise SafetyStop("The arm cannot follow this path from its configuration: "
                         f"{'; '.join(differences)}.",
                         "In this configuration it would reach a joint limit or a singularity.",
                         f"Move the joints to {in_degrees(taken.joints[0])} degrees, or choose "
                         "another path.")
    met = None if blocked is None else blocked(flange, taken.joints)
    if met is not None:
        raise met
    passed = along(out, speed_within(cell, speed), cell.limits.acceleration_m_s2,
                   turn_speed=0.8 * cell.limits.turn_speed_rad_s)
    # The return also reverses the outward motion in time, so that speeds match at the turning
    # point.
    legs = ((passed, out, taken.joints),
            (passed[-1] - passed[::-1], out[::-1], taken.joints[::-1]))
    times, poses, joints, begin = [], [], [], 0.0
    for _ in range(cycles):
        for leg_times, leg, leg_joints in legs:
            times.append(begin + leg_times)
            poses.append(leg)
            joints.append(leg_joints)
            # The last pose of a leg is the first of the next, after the pause.
            begin += float(leg_times[-1]) + max(pause, 0.02)
    return Trajectory(np.concatenate(times), np.concatenate(poses), joints=np.concatenate(joints))
