"""A cell whose virtual robot has its gripper on a branch, and that robot."""

from pathlib import Path

import numpy as np

from benchmarks.robot_stepped import BranchHere, SteppedRobot
from limber.cell.cell_file import Cell, write_cell
from limber.cell.known_arms import arm_named
from limber.core.numerics.rigid import inverted, matrices, pose_vectors
from limber.estimation.simulated_pull import PullSpec
from limber.robot.motion.execution import across
from limber.robot.virtual.branch_solver import BranchSetting
from limber.robot.virtual.controller import Controller
from limber.robot.virtual.launch import VirtualRobot
from limber.stages.pulls.virtual_pull import load_truth
from limber.store import Branch
from limber.store.loading import load_skeleton

GRASP_POSE = (0.0, 0.0, 0.15, 0.0, 0.0, 0.0)


def standing_at(branch: Branch, address: str, *, model: str = "ur5e", fraction: float = 0.92,
                back: float = 0.0, grip_seconds: float = 1.0, **limits: float) -> Cell:
    """Return a cell in which the home pose has the gripper at a position on the branch.

    It is ``back`` [m] before it, against its direction of approach.
    """
    skeleton = load_skeleton(branch)
    point = skeleton.point_at(fraction)
    axis = point - skeleton.point_at(fraction - 0.05)
    gripper = matrices(np.r_[point, across(axis)[0]])
    gripper[:3, 3] -= back * gripper[:3, 2]
    arm = arm_named(model)
    tool = arm.forward(arm.home) @ matrices(np.array(GRASP_POSE))
    base = pose_vectors(gripper @ inverted(tool))
    return Cell(
        branch=branch.uuid, base={"pose": tuple(map(float, base)), "position_sigma_m": 1e-3,
              "rotation_sigma_rad": 2e-3},
        robot={"model": model, "address": address},
        tool={"grasp_pose": GRASP_POSE, "gripper": "digital_output", "mass_kg": 0.0,
              "grip_seconds": grip_seconds},
        sensor={"kind": "controller" if arm.measures_force else "ft300"},
        # The virtual cell has nothing stiffer than the branch across its axis.
        limits={"soft_force_n": 30.0, "hard_force_n": 40.0, "hard_torque_nm": 8.0,
                "contact_n_per_m": 1000.0, **limits})


def sideways(branch: Branch, fraction: float = 0.92) -> np.ndarray:
    """Return a direction across all of the branch up to the grasp, shape [3]."""
    skeleton = load_skeleton(branch)
    line = np.array([skeleton.point_at(part) for part in np.linspace(0.05, fraction, 12)])
    return np.linalg.svd(line - line.mean(axis=0))[2][2]


def true_branch(branch: Branch, cell: Cell, folder: Path, young: tuple[float, ...] = (),
                 ) -> BranchSetting:
    truth = load_truth(branch, PullSpec(young=young))
    return BranchSetting.of_truth(truth, cell, folder / "truth.vtu")


def stepped_robot_holding(branch: Branch, cell: Cell, folder: Path) -> SteppedRobot:
    """Return the robot of :func:`robot_holding` without its process, in its own time."""
    load = BranchHere(true_branch(branch, cell, folder))
    return SteppedRobot(Controller(cell.robot.model, load=load), cell.robot.address)


def robot_holding(branch: Branch, cell: Cell, folder: Path, *, seed: int = 0,
                  young: tuple[float, ...] = ()) -> VirtualRobot:
    """Return a virtual robot with the true branch of a folder in its gripper."""
    setting = true_branch(branch, cell, folder, young)
    return VirtualRobot(cell.robot.model, cell.robot.address, setting, seed=seed,
                        ft300=cell.sensor.kind == "ft300", robotiq=cell.tool.gripper == "robotiq")


def cell_file(cell: Cell, folder: Path) -> Path:
    """Write a cell and return its path."""
    path = folder / "cell.toml"
    write_cell(path, cell)
    return path
