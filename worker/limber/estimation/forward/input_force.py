"""Errors of the measured force that drives a simulation, as unknowns of the fit.

If it is taken as exact, an error of the force becomes an error of all points of its frame at once,
many times their own noise and in one direction; a fit then distorts the moduli to follow it. Here
the true force is a smooth course through the key frames. Its values there are unknowns in addition
to the moduli, and each reading is an observation of the course. Points are nearly linear in so
small a change of force, so the unknowns can be eliminated: residuals and their derivatives are
projected onto the complement of what a change of force could explain. That equals weighting the
points by their noise plus the force's, carried through the compliance (the effective variance),
with all correlations between the points of a frame. After each fit, its estimate of the force
updates the course, and the compliance with it, until both settle (Fuller, Measurement Error Models,
1987, ch. 3).
"""

from dataclasses import dataclass

import numpy as np

from limber.core.numerics.rigid import rotation_matrix
from limber.estimation.forward.key_frames import key_frames, smoothed
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.sensitivities import refined_solve
from limber.recordings.recording import GraspEntry, PullEntry
from limber.recordings.synchronisation import Frames

COURSE_MISFIT = 1.5
"""Mean squared deviation of readings from their course, over the stated one, above which the course
gets more key frames. Chosen, not measured.
"""
CLIPPED = 4.0
"""Deviations beyond which a reading is an outlier rather than curvature of the force."""


@dataclass(frozen=True)
class Response:
    """Response of a simulated pull to its L force unknowns, at the point of linearisation.

    Attributes:
        points: Response of the observed points [m per N], shape [f, m, 3, L].
        wrenches: Response of force, and of torque if it acts too, at the frames, shape [f, c, L]; c
            is 3 or 6.
        grasps: Response of the gripper's position [m per N], shape [f, 3, L]; None if it is not
        observed.
    """

    points: np.ndarray
    wrenches: np.ndarray
    grasps: np.ndarray | None = None


@dataclass(frozen=True)
class Course:
    """Force over time, and torque of a clamped grasp.

    Attributes:
        keys: Key frames, shape [k].
        spread: Values at all frames from those at the key frames, shape [f, k].
        values: At the key frames [N, N m], shape [k, c].
        exact: Whether it is a stated load, not a reading. It then has no unknowns.
    """

    keys: np.ndarray
    spread: np.ndarray
    values: np.ndarray
    exact: bool = False


def course_of(frames: Frames, sigma: np.ndarray, count: int, components: int) -> Course:
    """Fit a smooth course to the readings of the force.

    A noisy force does not define a path, so the frames are ordered by time. If ``count`` key frames
    cannot follow the readings to within their noise, there are more.

    Args:
        frames: Readings may be missing.
        sigma: Deviation of each reading [N, N m], shape [f, c].
        count: Requested number of key frames.
        components: c: 3 for the force, 6 with the torque.
    """
    readings = frames.wrenches[:, :components]
    known = np.isfinite(readings).all(axis=1)
    if np.ptp(readings[known], axis=0).max() == 0.0:
        return Course(np.flatnonzero(known)[:1], np.ones((len(frames), 1)),
                      readings[known][:1], exact=True)
    along = frames.times - frames.times[0]
    while True:
        keys, spread = key_frames(along, count)
        weight = 1 / sigma[known]
        values = smoothed(frames.times, readings, frames.times[keys])
        for axis in range(components):
            matrix = weight[:, axis, None] * spread[known]
            missing = weight[:, axis] * (readings[known, axis] - spread[known] @ values[:, axis])
            values[:, axis] += np.linalg.lstsq(matrix, missing, rcond=1e-3)[0]
        off = np.clip((readings[known] - spread[known] @ values) * weight, -CLIPPED, CLIPPED)
        freedom = max(known.sum() - len(keys), 1) * components
        if len(keys) >= min(len(frames), known.sum()) or (
                float(np.sum(off**2)) < COURSE_MISFIT * freedom):
            return Course(keys, spread, values)
        count = 2 * len(keys)


def nodal_loads(grasp: Grasp, entry: GraspEntry, pose: np.ndarray, rest: np.ndarray,
                components: int) -> np.ndarray:
    """Nodal forces of each component of the gripper's wrench, shape [c, node_count, 3].

    A force acts on the patch's weighted centre. A clamped gripper's torque, about the recorded
    point, rotates the patch by couples of forces on its nodes, with their arms at the recorded
    rotation.

    Args:
        pose: Recorded [m, rad], shape [6].
        rest: Nodes of the mesh [m], shape [node_count, 3].
    """
    loads = np.zeros((components, *rest.shape))
    for axis in range(3):
        loads[axis, grasp.nodes, axis] = grasp.weights
    if components == 3:
        return loads
    turn = rotation_matrix(pose[3:])
    middle = grasp.weights @ rest[grasp.nodes]
    arms = (rest[grasp.nodes] - middle) @ turn.T
    # The force acts on the middle, but the torque was measured about the recorded point.
    offset = turn @ (np.array(entry.point_m) - middle)
    inertia = np.einsum("k,kij->ij", grasp.weights, np.einsum("ki,ki->k", arms, arms)[
        :, None, None] * np.eye(3) - arms[:, :, None] * arms[:, None, :])
    for axis in range(3):
        spin = np.linalg.solve(inertia, np.eye(3)[axis])
        loads[3 + axis, grasp.nodes] = grasp.weights[:, None] * np.cross(spin, arms)
    for axis in range(3):
        loads[axis] += np.einsum("t,tni->ni", np.cross(offset, np.eye(3)[axis]), loads[3:])
    return loads


def compliance(model: BranchModel, displacement: np.ndarray, loads: np.ndarray) -> np.ndarray:
    """Change of an equilibrium by each nodal load, shape [c, node_count, 3]."""
    tangent = model.equations(()).exact_tangent(model, displacement)
    if tangent.is_positive_definite:
        return np.array(tangent.solve_all(list(loads)))

    def force(direction: np.ndarray) -> np.ndarray:
        return model.tangent_times(displacement, direction)

    return np.array([refined_solve(tangent, force, load, tolerance=1e-5) for load in loads])


def response_of(spread: np.ndarray, at_keys: np.ndarray) -> Response:
    """Return the response at all frames.

    Args:
        spread: Values at f frames from those at k key frames, shape [f, k].
        at_keys: Response of the points at the key frames [m per N], shape [k, c, m, 3].
    """
    keys, components = at_keys.shape[:2]
    points = np.einsum("fk,kcmi->fmikc", spread, at_keys)
    wrenches = np.einsum("fk,cd->fckd", spread, np.eye(components))
    return Response(points.reshape(*points.shape[:3], keys * components),
                    wrenches.reshape(len(spread), components, keys * components))


def wrench_sigma(entry: PullEntry, frames: Frames, components: int) -> np.ndarray:
    """Return the standard deviation of the readings [N, N m], shape [f, components]."""
    sensor = entry.sensor
    each = [sensor.force_sigma_n] * 3 + [sensor.torque_sigma_nm] * (components - 3)
    return np.array(each, float) / np.sqrt(np.maximum(frames.wrench_counts, 1))[:, None]
