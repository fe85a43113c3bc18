"""Compiled computations of every step: tool state, servo and the held branch's wrench."""

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.core.numerics.rigid_kernels import inverse_of, rotation_vector

_FARTHEST = 0.03  # m over which a change of the tangent is extrapolated


@compiled
def tool_state(flange: np.ndarray, slopes: np.ndarray, speeds: np.ndarray, tool: np.ndarray,
               ) -> tuple[np.ndarray, np.ndarray]:
    """Return the tool's pose [6] and speed [6] in the base's frame, by the flange's frame [4, 4],
    the Jacobian [6, n], joint speeds [rad/s], and the tool's frame in the flange's [4, 4]."""
    tip = flange @ tool
    motion = slopes @ speeds
    lever = tip[:3, 3] - flange[:3, 3]
    motion[0] += motion[4] * lever[2] - motion[5] * lever[1]
    motion[1] += motion[5] * lever[0] - motion[3] * lever[2]
    motion[2] += motion[3] * lever[1] - motion[4] * lever[0]
    pose = np.empty(6)
    pose[:3] = tip[:3, 3]
    pose[3:] = rotation_vector(tip)
    return pose, motion


@compiled
def servo_step(joints: np.ndarray, speeds: np.ndarray, target: np.ndarray, gain: float,
               lookahead: float, step: float, largest: float) -> tuple[np.ndarray, np.ndarray]:
    """One step of servoj, as new joints and speeds [n] with accelerations up to ``largest``
    [rad/s^2]: a spring of ``gain`` [1/s^2] to the target, damped by ``lookahead`` [s]. The
    controller's law is not published; this has its known properties: it lags ``lookahead`` behind a
    steady target, more gain follows more closely, and a short lookahead with a high gain
    overshoots."""
    new_speeds = np.empty_like(joints)
    new_joints = np.empty_like(joints)
    # Implicit in the speed, so that any gain is stable at 125 Hz as well.
    damping = 1.0 + step * gain * lookahead + step * step * gain
    for k in range(len(joints)):
        acceleration = (speeds[k] + step * gain * (target[k] - joints[k])) / damping
        change = min(max(acceleration - speeds[k], -largest * step), largest * step)
        new_speeds[k] = speeds[k] + change
        new_joints[k] = joints[k] + step * new_speeds[k]
    return new_joints, new_speeds


@compiled
def steer(frame: np.ndarray, wrench: np.ndarray, stiffness: np.ndarray, directions: np.ndarray,
          bends: np.ndarray, patch: np.ndarray, compliance: float) -> np.ndarray:
    """Return the wrench [6] of a held branch near a solution's frame [4, 4], by its wrench,
    stiffness [6, 6], and changes of that [n, 6, 6] over displacements [m], [n, 3], of which earlier
    ones take precedence; ``patch``: the held one's frame without compliance [m/N], which lets it
    lag."""
    change = np.empty(6)
    change[:3] = patch[:3, 3] - frame[:3, 3]
    change[3:] = rotation_vector(patch @ inverse_of(frame))
    at, felt = change.copy(), np.zeros(6)
    # The stiffness is that of the patch's displacement, which depends on the force.
    for _ in range(2 if compliance > 0.0 and len(directions) > 0 else 1):
        secant, left = stiffness.copy(), at[:3].copy()
        for direction, bend in zip(directions, bends):  # noqa: B905 (no strict in a kernel)
            square = (direction * direction).sum()
            most = _FARTHEST / np.sqrt(square)
            part = min(max((left * direction).sum() / square, -most), most)
            secant += 0.5 * part * bend
            left -= part * direction
        yielding = np.eye(6)
        yielding[:, :3] += compliance * secant[:, :3]
        felt = np.linalg.solve(yielding, wrench + secant @ change)
        at[:3] = change[:3] - compliance * felt[:3]
    return felt
