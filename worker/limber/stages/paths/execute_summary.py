"""What an execution reports: the summary, its preview file, and the lines of its result."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np

from limber.core.files.tables import write_table
from limber.core.settings import Settings
from limber.store import Branch

if TYPE_CHECKING:
    from limber.cell.cell_file import Cell
    from limber.robot.motion.execution import RobotMotion
    from limber.stages.pulls.record_nudge import Nudge


def execution_summary(cell: Cell, motion: RobotMotion, across: Nudge | None) -> dict[str, Any]:
    """Return what is known of a motion, and of the nudge before it, for the result."""
    steps = np.concatenate([motion.approach.times,
                            motion.approach.duration + motion.path.times[1:]])
    felt = motion.path.expected
    assert felt is not None
    largest = np.linalg.eigvalsh(felt.covariance[:, :3, :3])[:, -1].max()
    return {
        "robot": cell.arm.name, "duration_s": 2 * (motion.approach.duration + motion.path.duration),
        "pose_count": len(motion.path.times),
        "predicted_peak_force_n": float(np.linalg.norm(felt.wrenches[:, :3], axis=1).max()),
        "predicted_force_sigma_n": float(np.sqrt(max(largest, 0.0))),
        "singularity_distance": motion.joints.singularity,
        "joint_limit_margin_rad": motion.joints.limit_margin,
        "joint_speed_share": motion.joints.speed_share(cell.arm, steps),
        "gripper_rotation": motion.rotation, "start_pose_base": motion.approach.poses[0],
        "start_joints_rad": motion.joints.joints[0],
        "nudge_m": None if across is None else float(across.check.predicted.travels[-1]),
        "nudge_force_n": None if across is None else float(
            np.linalg.norm(across.check.predicted.forces[-1]))}


def write_preview(branch: Branch, name: str, settings: Settings, cell: Cell,
                  motion: RobotMotion) -> None:
    """Write the robot's motion for the viewport: poses in the branch's frame, joints, forces."""
    from limber.cell.reach_and_collision import drawn_gripper
    from limber.core.numerics.rigid import matrices, pose_vectors

    base = matrices(np.array(cell.base.pose))
    rows = []
    begin = 0.0
    first = len(motion.approach.times)
    for trajectory, joints in ((motion.approach, motion.joints.joints[:first]),
                               (motion.path, motion.joints.joints[first - 1:])):
        poses = pose_vectors(base @ matrices(trajectory.poses))
        assert trajectory.expected is not None
        rows.append(np.column_stack([begin + trajectory.times, poses, joints,
                                     trajectory.expected.wrenches[:, :3]]))
        begin += trajectory.duration + 0.5
    header = ["t_s", "x_m", "y_m", "z_m", "rx_rad", "ry_rad", "rz_rad",
              *(f"q{number + 1}_rad" for number in range(motion.joints.joints.shape[1])),
              "fx_n", "fy_n", "fz_n"]
    with branch.stage(f"execute-preview:{name}", settings, reads=[f"plans/{name}.csv"]) as stage:
        write_table(stage.path(f"executions/{name}-preview.csv"), header, np.vstack(rows), digits=7)
        held = drawn_gripper(cell, np.eye(4)[None])
        stage.result.update(
            model=cell.robot.model, base_pose=list(cell.base.pose),
            gripper_rods=np.column_stack([held.starts[0], held.ends[0], held.radii]).tolist())


def outcome_line(result: Mapping[str, Any]) -> str:
    """Return whether the robot followed the path, or could."""
    if not result["armed"]:
        return (f"Dry run: a {result['robot']} can follow the path, there and back in "
                f"{result['duration_s']:.0f} s, with up to "
                f"{result['predicted_peak_force_n']:.3g} N. Nothing was moved.")
    return ("The robot followed the path and returned." if result["reached"]
            else f"The robot stopped: {result['stop_reason']}.")


def arm_line(result: Mapping[str, Any]) -> str:
    """Return how the peak force compares with what the arm bears; empty if not known."""
    from limber.results.findings import force_remark

    remark = force_remark(max(result["predicted_peak_force_n"], result.get("peak_force_n") or 0.0),
                          result["robot"])
    return f"The peak force is {remark}." if remark else ""


def noticed_lines(result: Mapping[str, Any]) -> str:
    """Return the table of what the guard would notice on the path, and after how many mm."""
    return "\n".join(["What the guard would notice on this path, after which way:", *(
        f"  {each['fault'] + ', ' + each['begins']:<52}"
        + ("not on this path" if each["after_m"] is None else f"{1e3 * each['after_m']:.1f} mm")
        for each in result["noticed"])])
