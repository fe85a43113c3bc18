"""What the virtual robot computes in every step, against the plain forms."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from limber.cell.ur_arms import ARMS
from limber.core.numerics.rigid import matrices
from limber.robot.virtual.step_kernels import servo_step, steer, tool_state


def test_the_tool_s_speed_is_the_change_of_its_pose():
    arm, tool = ARMS["ur5e"], matrices(np.array([0.1, -0.05, 0.2, 0.3, 0.2, -0.4]))
    joints, speeds = np.random.default_rng(0).uniform(-1, 1, (2, 6))
    pose, speed = tool_state(arm.forward(joints), arm.jacobian(joints), speeds, tool)
    tip = arm.forward(joints) @ tool
    assert matrices(pose) == pytest.approx(tip)
    above, below = (arm.forward(joints + sign * 1e-6 * speeds) @ tool for sign in (1, -1))
    turn = Rotation.from_matrix(above[:3, :3] @ below[:3, :3].T).as_rotvec()
    assert speed == pytest.approx(np.r_[above[:3, 3] - below[:3, 3], turn] / 2e-6, abs=1e-8)


def test_servo_s_spring_is_damped_and_held_back():
    rng = np.random.default_rng(1)
    joints, speeds, target = rng.normal(size=(3, 6))
    for largest in (5.0, 1e9):
        damping = 1 + 0.008 * 300.0 * 0.1 + 0.008**2 * 300.0
        change = (speeds + 0.008 * 300.0 * (target - joints)) / damping - speeds
        expected = speeds + np.clip(change, -largest * 0.008, largest * 0.008)
        moved, now = servo_step(joints, speeds, target, 300.0, 0.1, 0.008, largest)
        assert now == pytest.approx(expected)
        assert moved == pytest.approx(joints + 0.008 * expected)


@pytest.mark.parametrize("count", [0, 3])
@pytest.mark.parametrize("compliance", [0.0, 2e-4])
def test_a_held_branch_s_wrench(count, compliance):
    """It is that of the bent stiffness over the change that the patch's lag leaves."""
    rng = np.random.default_rng(2)
    frame, patch = matrices(np.array([[0.0, 0, 0, 0, 0, 0], [0.01, 0.02, -0.01, 0.1, 0, 0.05]]))
    wrench, stiffness = rng.normal(size=6), 50 * rng.normal(size=(6, 6))
    ways, bends = 0.02 * rng.normal(size=(count, 3)), 5 * rng.normal(size=(count, 6, 6))
    change = np.r_[patch[:3, 3], Rotation.from_matrix(patch[:3, :3]).as_rotvec()]
    at = change[:3]
    for _ in range(2 if count and compliance else 1):
        secant, left = stiffness.copy(), at.copy()
        for way, bend in zip(ways, bends, strict=True):
            most = 0.03 / np.linalg.norm(way)
            part = np.clip(left @ way / (way @ way), -most, most)
            secant, left = secant + 0.5 * part * bend, left - part * way
        lag = np.zeros((6, 6))
        lag[:, :3] = compliance * secant[:, :3]
        felt = np.linalg.solve(np.eye(6) + lag, wrench + secant @ change)
        at = change[:3] - compliance * felt[:3]
    assert steer(frame, wrench, stiffness, ways, bends, patch, compliance) == pytest.approx(felt)
