"""From any rough path to the nearest gentlest one, along limits where it meets them.

The polyline's cost is smooth and so is a penalty outside what is allowed: L-BFGS with exact
gradients minimises both, with the penalty raised in rounds. The gentlest path often runs along
the face of the sampled region: steps that are merely refused there stop far from it (5 to 11 %
above the optimum from the rest pose, where a penalty reaches 1.0001 of it).
"""

from collections.abc import Iterator

import numpy as np
from scipy.optimize import minimize

from limber.planning.cost import resample
from limber.planning.field.energy_field import LOADS, EnergyField
from limber.planning.field.trust import nearest_of
from limber.planning.planners.smoothing import smooth_cost
from limber.planning.problem import GentleProblem

_POINTS = 48  # of the polyline while it is moved
_ROUNDS = (1e2, 1e3, 1e4, 1e5)  # penalty per squared violation, relative to the path's length
_ITERATIONS = 120  # a round
_MARGINS = (2e-5, 3e-4, 2e-3)  # [m] kept from the limits; the next where the last was not enough
_STEP = 1e-5  # [m] of the two differences that are not worth a formula


def refine(path: np.ndarray, problem: GentleProblem) -> tuple[np.ndarray, float]:
    """Return the path [n, 3] moved to the nearest optimum of the cost, and its cost.

    The end may move within the goal region. The cost is infinite if no allowed path was found
    near; then the given path is returned.
    """
    best, least = path, problem.cost(path)
    for margin in _MARGINS:
        moved = _moved(path, problem, margin)
        cost = problem.cost(moved)
        if cost < least:
            best, least = moved, cost
        if np.isfinite(cost):
            break
    return best, least


def _moved(path: np.ndarray, problem: GentleProblem, margin: float) -> np.ndarray:
    points = resample(path, max(np.linalg.norm(np.diff(path, axis=0), axis=1).sum(), 1e-6)
                      / _POINTS)
    points[0] = problem.start
    scale = 1.0 / problem.weights.length if problem.weights.length > 0.0 else 1.0
    if problem.longest < np.inf:
        scale = problem.longest
    for penalty in _ROUNDS:
        points = resample(points, np.linalg.norm(np.diff(points, axis=0), axis=1).sum() / _POINTS)
        shape = points[1:].shape

        def cost(flat: np.ndarray, penalty: float = penalty,
                 shape: tuple[int, ...] = shape) -> tuple[float, np.ndarray]:
            moved = np.concatenate([problem.start[None], flat.reshape(shape)])
            value, gradient = smooth_cost(moved, problem.energy_field, problem.weights)
            broken, slope = violation(moved, problem, margin, scale)
            return value + penalty * broken, (gradient + penalty * slope)[1:].ravel()

        found = minimize(cost, points[1:].ravel(), jac=True, method="L-BFGS-B",
                         options={"maxiter": _ITERATIONS, "maxcor": 20})
        points = np.concatenate([points[:1], found.x.reshape(shape)])
    return resample(points, problem.weights.step)


def violation(points: np.ndarray, problem: GentleProblem, margin: float, scale: float,
              ) -> tuple[float, np.ndarray]:
    """Return the mean squared violation of a path [n, 3] over ``scale`` [m], and its gradient.

    Places closer than ``margin`` [m] to the limit of the trusted region violate it; so does an end
    outside the goal. Energy, force and length count relative to their limits.
    """
    total, gradient = 0.0, np.zeros_like(points)
    for excess, slope in _excesses(points, problem, margin, scale):
        over = np.maximum(excess, 0.0)
        total += float((over**2).mean())
        gradient += 2.0 / len(points) * over[:, None] * slope
    outside = (problem.goal_excess(points[-1]) + 1e-2 * problem.goal.tolerance) / scale
    if outside > 0.0:
        total += outside**2
        gradient[-1] += 2.0 * outside * _goal_slope(points[-1], problem) / scale
    if problem.longest < np.inf:
        edges = np.diff(points, axis=0)
        lengths = np.maximum(np.linalg.norm(edges, axis=1), 1e-12)
        over = (lengths.sum() + margin) / problem.longest - 1.0
        if over > 0.0:
            total += over**2
            along = 2.0 * over / problem.longest * edges / lengths[:, None]
            gradient[1:] += along
            gradient[:-1] -= along
    return total, gradient


def _excesses(points: np.ndarray, problem: GentleProblem, margin: float, scale: float,
              ) -> Iterator[tuple[np.ndarray, np.ndarray]]:
    """Yield excesses [n] and their gradients [n, 3] of each kind of limit, relative."""
    field, limits = problem.energy_field, problem.limits
    # The highest plane only, and never at the start, which may lie on it and stays.
    height, slope = field.region.height_and_slope(points)
    height += margin
    height[0] = 0.0
    yield height / scale, slope / scale
    if len(field.region.rejected):
        accepted, toward = nearest_of(points, field.region.accepted)
        rejected, away = nearest_of(points, field.region.rejected)
        beyond = accepted - rejected + margin
        beyond[0] = 0.0
        yield beyond / scale, (toward - away) / scale
    reserve = margin / scale
    if limits.max_energy < np.inf:
        yield (field.energy(points) / limits.max_energy - 1.0 + reserve,
               field.energy_gradient(points) / limits.max_energy)
    for name, limit in zip(LOADS, limits.max_loads, strict=True):
        if limit < np.inf:
            load = field.load(points, name)
            yield (np.abs(load) / limit - 1.0 + reserve,
                   np.sign(load)[:, None] * field.load_gradient(points, name) / limit)
    for axis in range(3):
        for bound, side in ((limits.low[axis], -1.0), (limits.high[axis], 1.0)):
            if np.isfinite(bound):
                yield ((side * (points[:, axis] - bound) + margin) / scale,
                       np.tile(side * np.eye(3)[axis] / scale, (len(points), 1)))
    if limits.max_force < np.inf:
        size, slope = _force_size(points, field)
        yield size / limits.max_force - 1.0 + reserve, slope / limits.max_force


def _force_size(points: np.ndarray, field: EnergyField) -> tuple[np.ndarray, np.ndarray]:
    """Return |F| and its gradient, the Hessian times F / |F|: one difference along the force."""
    force = field.force(points)
    size = np.linalg.norm(force, axis=1)
    along = force / np.maximum(size, 1e-12)[:, None]
    slope = (field.force(points + _STEP * along) - field.force(points - _STEP * along)) / (
        2.0 * _STEP)
    return size, slope


def _goal_slope(point: np.ndarray, problem: GentleProblem) -> np.ndarray:
    shifts = _STEP * np.concatenate([np.eye(3), -np.eye(3)])
    distance = problem.goal.distance(problem.energy_field, point + shifts)
    return (distance[:3] - distance[3:]) / (2.0 * _STEP)
