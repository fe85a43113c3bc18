"""Interface of all forward simulations of a pull."""

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from scipy import sparse

from limber.core.numerics.rigid import rotation_matrix
from limber.estimation.parameters import Values, YoungField
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.dynamics.motion import NewmarkSettings, subspace_round
from limber.mechanics.grasp import Grasp
from limber.mechanics.loads.loaded_branch import is_stable
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.sensitivities import refined_solve
from limber.mechanics.statics.solve import StaticSettings, solve_static
from limber.recordings.recording import GraspEntry, PullEntry, calibration_of, grasp_on
from limber.recordings.synchronisation import Frames

# Direction of the branch at its observed points, at rest and in a deformed state.
#
# An observed point may be off its control point along the branch: the scan's tip is short, or a
# camera follows another place. It then moves with the branch at that place. To first order the
# measurements show the simulated point plus the distance times the direction of the branch there.

SLENDER = 3.0
"""Extent along the axis over that across it at which nearby tetrahedra show the axis: to 0.1
degrees on the paper's branches, meshed coarsely and finely; with 2 to 0.6.
"""
FEWEST_TETS = 12
GROWTH = 1.25
STEP = 0.25
"""Distance to both sides over which the change of the direction is measured, over that extent."""


@dataclass(frozen=True)
class PointDirections:
    """Directions of the branch at m points: unit vectors [m, 3] at rest, away from the base, and
    their change by nodal displacements [3 m, 3 n]."""

    rest: np.ndarray
    operator: sparse.csr_matrix

    @classmethod
    def at(cls, mesh: TetMesh, points: np.ndarray) -> "PointDirections":
        """Return the directions at points [m], shape [m, 3]."""
        base = mesh.nodes[mesh.point_data["fixed"].astype(bool)].mean(axis=0)
        found = [_axis(mesh, point, base) for point in points]
        rest = np.array([axis for axis, _ in found]).reshape(-1, 3)
        step = STEP * np.array([extent for _, extent in found])[:, None]
        ahead, behind = (point_operator(mesh, points + sign * step * rest) for sign in (1, -1))
        scale = sparse.diags(np.repeat(0.5 / step[:, 0], 3))
        return cls(rest, sparse.csr_matrix(scale @ (ahead - behind)))

    def changed(self, change: np.ndarray) -> np.ndarray:
        """Return unit vectors after a change, as ``operator`` gives it, shape [3 m]."""
        moved = self.rest + change.reshape(-1, 3)
        return moved / np.linalg.norm(moved, axis=1, keepdims=True)

    def bent(self, displacement: np.ndarray) -> np.ndarray:
        """Return unit vectors under nodal displacements [m], shape [n, 3]."""
        return self.changed(self.operator @ displacement.ravel())


def _axis(mesh: TetMesh, point: np.ndarray, base: np.ndarray) -> tuple[np.ndarray, float]:
    """Return the direction of the branch near a point, and the radius [m] of the ball that shows
    it: it grows until its tetrahedra extend more along than across. They count less at its edge:
    cut sharply, a coarse mesh tilted it by up to 15 degrees."""
    centres, volumes = mesh.centroids, np.abs(mesh.volumes)
    away = np.linalg.norm(centres - point, axis=1)
    extent = float(np.sort(away)[min(FEWEST_TETS, len(away) - 1)])
    while True:
        near = away <= extent
        weights = volumes[near] * (1 - (away[near] / extent)**2)**2
        middle = weights @ centres[near] / weights.sum()
        spread = (centres[near] - middle) * np.sqrt(weights)[:, None]
        _, sizes, axes = np.linalg.svd(spread, full_matrices=False)
        if sizes[0] > SLENDER * sizes[1] or near.all():
            break
        extent *= GROWTH
    return axes[0] * (np.sign(axes[0] @ (middle - base)) or 1.0), extent


# Effect of errors of a measured force on the motion that it drives.
#
# A motion changes with a small change of its force like a linear system. The slowest modes carry
# nearly all of the change; the others follow quasi-statically. The modes are those of the
# undeformed branch, which suffices because the change is only used as a weight.

MODES = 16
"""Number of modes for the change of a motion; the remainder is static. Chosen, not measured."""
SPARE = 8
ITERATIONS = 8
"""Subspace iteration: extra vectors, and number of iterations."""


def motion_response(model: BranchModel, loads: np.ndarray, observed: object, times: np.ndarray,
                    ) -> np.ndarray:
    """Return the change [f, m, 3, f c] [m per N] of observed points by nodal forces [c, node_count,
    3] at each frame, linear between frames; columns by frame, then component."""
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
    """Each mode's motion [modes, f, f] at each frame, from equilibrium, under a unit force at one
    frame that falls linearly to zero at its neighbours. By Newmark, in the simulation's steps."""
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


# Simulate a few frames of a slow pull and interpolate the others.
#
# Without inertia a branch's state is a smooth function of the gripper's pose (or force) alone. A
# few states along the path and a cubic spline through them give the others at a small fraction of
# the cost. Every observed frame still counts in the fit, so no measurement is discarded.

ROTATION_LENGTH_M = 0.1
"""Travel equivalent to a rotation of one radian. Chosen; the model checks the spline."""


def travel(poses: np.ndarray, step_m: float = 5e-4) -> np.ndarray:
    """Return the path's length up to each pose, shape [n], without jitter below ``step_m``."""
    scaled = poses * np.r_[np.ones(3), np.full(3, ROTATION_LENGTH_M)]
    length = np.zeros(len(poses))
    last = 0
    for index in range(1, len(poses)):
        moved = float(np.linalg.norm(scaled[index] - scaled[last]))
        if moved >= step_m:
            since = np.linalg.norm(scaled[last:index + 1] - scaled[last], axis=1)
            length[last:index + 1] = length[last] + np.maximum.accumulate(since) * (
                moved / since.max())
            last = index
        else:
            length[index] = length[last]
    return length


def key_frames(along: np.ndarray, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Choose at most ``count`` key frames [k] by a parameter that increases along the path [n], and
    S [n, k] with values at all frames = S @ those at key frames."""
    distances, first = np.unique(along, return_index=True)
    if len(distances) > count:
        targets = np.linspace(distances[0], distances[-1], count)
        near = np.unique(np.abs(distances[:, None] - targets).argmin(axis=0))
        distances, first = distances[near], first[near]
    if len(distances) == 1:
        return first, np.ones((len(along), 1))
    if len(distances) < 4:
        spread = np.column_stack([np.interp(along, distances, row) for row
                                  in np.eye(len(distances))])
        return first, spread
    return first, scipy.interpolate.CubicSpline(distances, np.eye(len(distances)))(along)


def smoothed(times: np.ndarray, values: np.ndarray, keys: np.ndarray) -> np.ndarray:
    """Return noisy values [n, c] at given instants [k] [s], each by a local quadratic fit; rows
    with NaN are left out."""
    known = np.isfinite(values).all(axis=1)
    times, values = times[known], values[known]
    width = max(2.0 * np.ptp(times) / max(len(keys) - 1, 1), 1e-9)
    result = np.empty((len(keys), values.shape[1]))
    for row, key in enumerate(keys):
        near = np.abs(times - key) <= width / 2
        if near.sum() < 6:
            result[row] = [np.interp(key, times, column) for column in values.T]
        else:
            result[row] = np.polynomial.polynomial.polyfit(times[near] - key, values[near], 2)[0]
    return result


# Errors of the measured force that drives a simulation, as unknowns of the fit.
#
# If it is taken as exact, an error of the force becomes an error of all points of its frame at
# once, many times their own noise and in one direction; a fit then distorts the moduli to follow
# it. Here the true force is a smooth course through the key frames. Its values there are unknowns
# in addition to the moduli, and each reading is an observation of the course. Points are nearly
# linear in so small a change of force, so the unknowns can be eliminated: residuals and their
# derivatives are projected onto the complement of what a change of force could explain. That equals
# weighting the points by their noise plus the force's, carried through the compliance (the
# effective variance), with all correlations between the points of a frame. After each fit, its
# estimate of the force updates the course, and the compliance with it, until both settle (Fuller,
# Measurement Error Models, 1987, ch. 3).

COURSE_MISFIT = 1.5
"""Mean squared deviation of readings or places from their course, over the stated one, above which
the course gets more key frames. Chosen, not measured.
"""
CLIPPED = 4.0
"""Deviations beyond which a reading is an outlier rather than curvature of the force."""


@dataclass(frozen=True)
class Course:
    """Force over time, with torque if clamped: values [k, c] [N, N m] at key frames, spread to all
    by [f, k]. ``exact``: a stated load without unknowns, not a reading."""

    keys: np.ndarray
    spread: np.ndarray
    values: np.ndarray
    exact: bool = False


def course_of(frames: Frames, sigma: np.ndarray, count: int, components: int,
              pose_sigma: float) -> Course:
    """Fit a smooth course to readings of deviation [f, c] [N, N m], some missing; c is 3, or 6 with
    the torque. A noisy force defines no path, so frames are ordered by time; there are over
    ``count`` key frames if they cannot follow the readings, or the gripper's places of deviation
    ``pose_sigma`` [m], within the noise."""
    readings = frames.wrenches[:, :components]
    known = np.isfinite(readings).all(axis=1)
    if np.ptp(readings[known], axis=0).max() == 0.0:
        return Course(np.flatnonzero(known)[:1], np.ones((len(frames), 1)),
                      readings[known][:1], exact=True)
    along, path = frames.times - frames.times[0], frames.poses[:, :3] / pose_sigma
    while True:
        keys, spread = key_frames(along, count)
        # Averaged readings count more; force and torque are apart.
        weight = 1 / sigma[known]
        values = smoothed(frames.times, readings, frames.times[keys])
        values += np.linalg.lstsq(weight[:, :1] * spread[known], weight[:, :1] * (
            readings[known] - spread[known] @ values), rcond=1e-3)[0]
        beside = ((readings[known] - spread[known] @ values) * weight,
                  path - spread @ np.linalg.lstsq(spread, path, rcond=None)[0])
        if len(keys) >= min(len(frames), known.sum()) or all(
                np.mean(np.clip(each, -CLIPPED, CLIPPED)**2) < COURSE_MISFIT * max(
                    1 - len(keys) / len(each), 1 / len(each)) for each in beside):
            return Course(keys, spread, values)
        count = len(keys) + len(keys) // 4 + 1


def nodal_loads(grasp: Grasp, entry: GraspEntry, pose: np.ndarray, rest: np.ndarray,
                components: int) -> np.ndarray:
    """Nodal forces [c, node_count, 3] of a wrench: force at the patch's weighted centre; a clamped
    one's torque, about the recorded point, by couples with arms at the recorded rotation."""
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


def response_of(spread: np.ndarray, at_keys: np.ndarray) -> "Simulated":
    """Return a pull's change at f frames by its force at k key frames [per N], from the points'
    [k, c, m, 3] there, by spread [f, k]."""
    points = np.einsum("fk,kcmi->fmikc", spread, at_keys)
    wrenches = np.einsum("fk,cd->fckd", spread, np.eye(at_keys.shape[1]))
    wrenches = wrenches.reshape(*wrenches.shape[:2], -1)
    return Simulated(points.reshape(*points.shape[:3], -1), wrenches[:, :3],
                     wrenches[:, 3:] if wrenches.shape[1] > 3 else None)


def wrench_sigma(entry: PullEntry, frames: Frames, components: int) -> np.ndarray:
    """Return the standard deviation of the readings [N, N m], shape [f, components]."""
    sensor = entry.sensor
    each = [sensor.force_sigma_n] * 3 + [sensor.torque_sigma_nm] * (components - 3)
    return np.array(each, float) / np.sqrt(np.maximum(frames.wrench_counts, 1))[:, None]


@dataclass(frozen=True)
class Simulated:
    """What is measured of a pull at all frames: points [f, m, 3], forces on the branch [f, 3],
    torques about the grasp point (None: not known), grasp points (None: not compared). Or the
    changes of all that by P unknowns, [..., P]; a simulation's ``slopes`` (None: not asked for) are
    those by log E_1..log E_K and the extra parameters of the space."""

    positions: np.ndarray
    forces: np.ndarray
    torques: np.ndarray | None = None
    grasps: np.ndarray | None = None
    slopes: "Simulated | None" = None

    @classmethod
    def empty(cls, frames: int, points: int, torque: bool, *parameters: int) -> "Simulated":
        """Return arrays to fill, [..., P] by as many ``parameters``."""
        at_frames = (frames, 3, *parameters)
        return cls(np.empty((frames, points, 3, *parameters)), np.empty(at_frames),
                   np.empty(at_frames) if torque else None)

    @classmethod
    def none(cls, frames: int, points: int, unknowns: int) -> "Simulated":
        """Return no change of any measurement by some unknowns."""
        force, torque, grasp = np.zeros((3, frames, 3, unknowns))
        return cls(np.zeros((frames, points, 3, unknowns)), force, torque, grasp)

    def each(self, changed: Callable[[np.ndarray], np.ndarray]) -> "Simulated":
        """Return all of it, and its slopes, changed."""
        kept: dict[str, Any] = {
            name: values.each(changed) if isinstance(values, Simulated) else changed(values)
            for name, values in vars(self).items() if values is not None}
        return Simulated(**kept)

    def moved(self, slopes: "Simulated", step: np.ndarray) -> "Simulated":
        """Return the pull after a small change [P] of the unknowns of these slopes, to first
        order; it has none."""
        kept: dict[str, Any] = {name: values + getattr(slopes, name) @ step for name, values
                                in vars(self).items() if isinstance(values, np.ndarray)}
        return Simulated(**kept)


def under_its_weight(model: BranchModel, entry: PullEntry) -> BranchModel:
    """Return the model with the weight that acted in a pull: usually the shape is prestressed, a
    drawn shape is bent by it, and a simulated pull may have none."""
    if entry.gravity_m_s2 is not None:
        return model.with_parameters(gravity=entry.gravity_m_s2)
    return model.with_parameters(gravity=(0.0, 0.0, 0.0)) if entry.weightless else model


class Forward(ABC):
    """Simulates one pull. ``uses_force``: measured in any frame, and compared there. ``response``:
    to errors of a measured force that drives, once derivatives were asked. ``grasp_tangent`` [f, 3]
    and ``point_directions`` [f, m, 3] are of the last simulation, if path or points may be off."""

    is_dynamic = False
    """Whether inertia acts; a frame then depends on all earlier ones."""

    point_shifts: np.ndarray | float = 0.0
    """Distances along the branch by which ``rest_points`` have been moved from the stated ones [m],
    shape [m].
    """

    skeleton: Skeleton | None = None
    """Axes of the branch, if known: a fit starts from a beam along them."""

    work = 0.0
    """What the last simulation took, in tetrahedra times linear systems."""

    creep_time: float | None = None
    """Time constant of the branch's creep [s], if its share is an unknown of the fit."""

    def __init__(self, name: str, model: BranchModel, weights: np.ndarray, entry: PullEntry,
                 frames: Frames, rest_points: np.ndarray, field: YoungField | None):
        self.name, self.entry, self.frames = name, entry, frames
        self.rest_points = np.asarray(rest_points, float)
        self.uses_force = bool(np.isfinite(frames.wrenches[:, :3]).all(axis=1).any())
        self.response: Simulated | None = None
        self.uses_torque = False
        self.grasp_tangent: np.ndarray | None = None
        self.point_directions: np.ndarray | None = None
        self.weights, self.field = weights, field or YoungField(weights)
        self.grasp = grasp_on(model.mesh, entry.grasp)
        self._model = under_its_weight(model, entry).gripped(self.grasp)
        self._operator = point_operator(model.mesh, self.rest_points)
        self._directions = (PointDirections.at(model.mesh, self.rest_points)
                            if self.may_be_off_along else None)

    def model_with(self, values: Values) -> BranchModel:
        """Return the branch with these parameters."""
        return self._model.with_parameters(
            young=self.field.young(values), poisson=values.poisson, density=values.density,
            damping=RayleighDamping(*values.damping))

    @abstractmethod
    def simulate(self, values: Values, extra: tuple[str, ...], sensitivities: bool,
                 ) -> Simulated | None:
        """Return the pull under ``values``, with derivatives to Young's modulus and ``extra`` if
        asked. None: no equilibrium or motion."""

    @property
    def may_be_off_along(self) -> bool:
        """Whether observed points may be off along the branch."""
        return len(self.rest_points) > 0 and calibration_of(self.entry).point_sigma_m > 0

    @property
    def drive(self) -> str:
        """The prescribed quantity: ``pose`` or ``force``."""
        return self.entry.drive

    @property
    def watches_pose(self) -> bool:
        """Whether the gripper's recorded path is observed and the force is an unknown."""
        return False

    @property
    def pose_sigma(self) -> float:
        """Standard deviation of a recorded gripper position, without the common error [m]."""
        return calibration_of(self.entry).pose_noise_m

    @property
    def force_is_stated(self) -> bool:
        """Whether the force is a known load, not a sensor's reading."""
        return False

    @property
    def has_force_unknowns(self) -> bool:
        """Whether a measured force with errors is prescribed."""
        return False

    @abstractmethod
    def shift_force(self, change: np.ndarray) -> None:
        """Change the force's unknowns [L], in the order of the response's columns, and linearise
        there."""

    def under_readings(self, simulated: Simulated) -> Simulated:
        """Predict a pull from its force readings alone, without its observed points."""
        if self.watches_pose or self.response is None:
            return simulated
        away = self.response.positions @ self._off_readings()
        return replace(simulated, positions=simulated.positions + away,
                       forces=np.full_like(simulated.forces, np.nan))

    @abstractmethod
    def _off_readings(self) -> np.ndarray:
        """The readings less the force's unknowns [L], in the order of the response's columns."""

    def stands(self, values: Values) -> bool:
        """Whether the branch is stable under its weight with these values, in the scanned shape or
        sagging from it."""
        model = self.model_with(values)
        if not model.gravity.any():
            return True
        return is_stable(model) if model.prestress is not None else solve_static(
            model, settings=StaticSettings(snap=False)).converged

    def thinning_error(self, values: Values) -> float:
        """Largest distance [m] between simulated and interpolated frames."""
        return 0.0

    def refine(self) -> None:
        """From now on simulate twice as many frames, if not all of them are simulated already."""
        return  # all of them are here

    @abstractmethod
    def with_prescribed_poses(self, poses: np.ndarray) -> "Forward":
        """Return the same pull, on the full model, with other recorded poses [m, rad], [f, 6]; a
        slow one at few key frames, enough to show a difference."""

    def until(self, count: int) -> "Forward":
        """Return the part of a pull used by the first of several fits: the first ``count`` frames
        of a dynamic pull, all of a slow one."""
        return self
