"""Effect of errors of a measured force on the motion that it drives.

A motion changes with a small change of its force like a linear system. The slowest modes carry
nearly all of the change; the others follow quasi-statically. The modes are those of the undeformed
branch, which suffices because the change is only used as a weight.
"""

import numpy as np

from limber.mechanics.dynamics.modes import subspace_round
from limber.mechanics.dynamics.motion import NewmarkSettings
from limber.mechanics.model import BranchModel

MODES = 16
"""Number of modes for the change of a motion; the remainder is static. Chosen, not measured."""
SPARE = 8
ITERATIONS = 8
"""Subspace iteration: extra vectors, and number of iterations."""


def motion_response(model: BranchModel, loads: np.ndarray, observed: object, times: np.ndarray,
                    ) -> np.ndarray:
    """Return the change of observed points during a motion by the force at each frame.

    Args:
        model: The branch, with its damping.
        loads: Nodal forces of each of the force's components, shape [c, node_count, 3].
        observed: Displacement of the points from the nodes', shape [3 m, 3 n]; sparse.
        times: Times of the frames [s], shape [f]; the force is linear between them.

    Returns:
        [m per N], shape [f, m, 3, f c]; the force's columns by frame, then component.
    """
    squares, modes, static = _modes(model, loads)
    at_points = np.array([observed @ mode.ravel() for mode in modes])
    pushed = np.einsum("qni,cni->qc", modes, loads)
    alpha, beta = model.damping.mass, model.damping.stiffness
    swing = _swing(squares, alpha + beta * squares, times)
    count, components = len(times), len(loads)
    points = np.einsum("qfj,qp,qc->fpjc", swing, at_points, pushed, optimize=True)
    stiff = np.array([observed @ field.ravel() for field in static]).T
    stiff = stiff - np.einsum("qp,qc,q->pc", at_points, pushed, 1 / squares)
    frames = np.arange(count)
    points[frames, :, frames] += stiff
    return points.reshape(count, -1, 3, count * components)


def _modes(model: BranchModel, loads: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Squared angular frequencies [1/s^2], modes of unit modal mass, and static solutions."""
    tangent = model.equations(()).tangent(model, np.zeros_like(model.mesh.nodes))
    static = np.array([tangent.solve(load) for load in loads])
    rng = np.random.default_rng(0)
    free = rng.standard_normal((MODES + SPARE - len(loads), *model.mesh.nodes.shape))
    free[:, model.fixed] = 0.0
    vectors = np.concatenate([static, free])
    for _ in range(ITERATIONS):
        squares, vectors = subspace_round(model, tangent, vectors)
    return squares[:MODES], vectors[:MODES], static


def _swing(squares: np.ndarray, damping: np.ndarray, times: np.ndarray) -> np.ndarray:
    """Each mode's motion under a unit force at one frame that falls linearly to zero at its
    neighbours.

    By Newmark's average acceleration with the steps of the simulation, starting in equilibrium.

    Returns:
        Shape [modes, f, f]: at each frame, for the force at each frame.
    """
    count = len(times)
    k, d = squares[:, None], damping[:, None]
    hats = np.eye(count)
    target = hats[0] / k
    speed, push = np.zeros_like(target), np.zeros_like(target)
    swing = np.empty((len(squares), count, count))
    swing[:, 0] = target
    for frame in range(1, count):
        gap = times[frame] - times[frame - 1]
        steps = int(np.ceil(gap / NewmarkSettings().max_step - 1e-9))
        dt = gap / steps
        for step in range(1, steps + 1):
            share = step / steps
            force = (1 - share) * hats[frame - 1] + share * hats[frame]
            predicted = target + dt * speed + dt**2 / 4 * push
            going = speed + dt / 2 * push
            push = (force - d * going - k * predicted) / (1 + dt / 2 * d + dt**2 / 4 * k)
            target, speed = predicted + dt**2 / 4 * push, going + dt / 2 * push
        swing[:, frame] = target
    return swing
