"""What the virtual controller computes at every step, compiled: flange pose and speed, servo."""

import numpy as np

from limber.compiled import compiled
from limber.robot.frames import rotation_vector
from limber.robot.kinematics import _forward, _jacobian


@compiled
def tool_state(table: np.ndarray, joints: np.ndarray, speeds: np.ndarray, tool: np.ndarray,
               ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the tool's pose [6], its speed [6] (base frame) and the flange's frame [4, 4].

    Args:
        table: Denavit-Hartenberg table, shape [6, 3].
        joints, speeds: [rad], [rad/s], shape [6].
        tool: Frame of the tool in the flange's, shape [4, 4].
    """
    row = joints.reshape(1, 6)
    flange = _forward(table, row)[0]
    slopes = _jacobian(table, row)[0]
    tip = flange @ tool
    motion = slopes @ speeds
    lever = tip[:3, 3] - flange[:3, 3]
    motion[0] += motion[4] * lever[2] - motion[5] * lever[1]
    motion[1] += motion[5] * lever[0] - motion[3] * lever[2]
    motion[2] += motion[3] * lever[1] - motion[4] * lever[0]
    pose = np.empty(6)
    pose[:3] = tip[:3, 3]
    pose[3:] = rotation_vector(tip)
    return pose, motion, flange


@compiled
def servo_step(joints: np.ndarray, speeds: np.ndarray, target: np.ndarray, gain: float,
               lookahead: float, step: float, largest: float) -> tuple[np.ndarray, np.ndarray]:
    """One step of servoj: a spring of ``gain`` [1/s^2] to the target, damped by ``lookahead`` [s].

    The controller's own law is not published. This one has its known traits: a target that moves
    steadily is followed ``lookahead`` seconds behind, more gain follows more closely, and a short
    lookahead with a high gain overshoots.

    Returns:
        New joints [6] and speeds [6]; accelerations stay within ``largest`` [rad/s^2].
    """
    new_speeds = np.empty(6)
    new_joints = np.empty(6)
    # Implicit in the speed, so that any gain is stable at 125 Hz as well.
    damping = 1.0 + step * gain * lookahead + step * step * gain
    for k in range(6):
        wanted = (speeds[k] + step * gain * (target[k] - joints[k])) / damping
        change = min(max(wanted - speeds[k], -largest * step), largest * step)
        new_speeds[k] = speeds[k] + change
        new_joints[k] = joints[k] + step * new_speeds[k]
    return new_joints, new_speeds
