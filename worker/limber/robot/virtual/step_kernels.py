"""Computations of every step: tool state, servo and the held branch's wrench."""

import numpy as np

from limber.geometry.rigid_kernels import small_kernel

_servo_step = small_kernel("servo_step", "joints[n]", "speeds[n]", "target[n]", "gain", "lookahead",
                          "step", "largest")
tool_state = small_kernel("tool_state", "flange[4, 4]", "slopes[6, n]", "speeds[n]", "tool[4, 4]",
                         shape=(2, 6))
"""Return the tool's pose [6] and speed [6] in the base's frame, by the flange's frame, the
Jacobian, joint speeds [rad/s], and the tool's frame in the flange's."""

steer = small_kernel("steered", "frame[4, 4]", "wrench[6]", "stiffness[6, 6]", "directions[k, 3]",
                    "bends[k, 6, 6]", "patch[4, 4]", "compliance", shape=(6,))
"""Return the wrench of a held branch near a solution's ``frame``, by its wrench, stiffness, and
changes of that over displacements [m], of which earlier ones take precedence; ``patch``: the held
one's frame without ``compliance`` [m/N], which lets it lag."""


def servo_step(joints: np.ndarray, speeds: np.ndarray, target: np.ndarray, gain: float,
               lookahead: float, step: float, largest: float) -> tuple[np.ndarray, np.ndarray]:
    """One step of servoj, as new joints and speeds [n] with accelerations up to ``largest``
    [rad/s^2]: a spring of ``gain`` [1/s^2] to the target, damped by ``lookahead`` [s]. The
    controller's law is not published; this has its known properties: it lags ``lookahead`` behind a
    steady target, more gain follows more closely, and a short lookahead with a high gain
    overshoots."""
    moved = _servo_step(joints, speeds, target, gain, lookahead, step, largest,
                        out=np.empty((2, len(joints))))
    return moved[0], moved[1]
