"""The gentlest path by an independent method: many sine bulges, many starts, fine quadrature.

It shares only the field with the planner: no polyline, no penalty rounds, no grid.
"""

import numpy as np
from scipy.optimize import minimize

from limber.planning.path_problem import GentleProblem

_MODES = 7
_POINTS = 121  # of the quadrature; Simpson's rule
_PENALTY = 3e3  # on squared height above the sampled region, relative to the path's length


def best_cost(problem: GentleProblem, starts: int, seed: int) -> float:
    """Return the least cost found; infinite if every path ends outside the allowed region."""
    rng = np.random.default_rng([seed, 3])
    centre = problem.goal.centre(problem.energy_field)
    span = float(np.linalg.norm(centre - problem.start))
    best = np.inf
    for number in range(starts):
        bulge = np.zeros((_MODES, 3))
        bulge[0] = 0.0 if number == 0 else 0.2 * span * rng.normal(size=3)
        found = minimize(_cost, np.concatenate([bulge.ravel(), np.zeros(3)]), jac=True,
                         args=(problem, centre), method="L-BFGS-B",
                         options={"maxiter": 200, "maxcor": 20})
        best = min(best, problem.cost(_path(found.x, problem, centre)[0]))
    return best


def _path(unknown: np.ndarray, problem: GentleProblem, centre: np.ndarray, count: int = 400,
          ) -> tuple[np.ndarray, ...]:
    """Points [n, 3] of a path, its velocity, and the functions that they are linear in."""
    s = np.linspace(0.0, 1.0, count)
    modes = np.arange(1, _MODES + 1) * np.pi
    shape, slope = np.sin(s[:, None] * modes), modes * np.cos(s[:, None] * modes)
    bulge, end = unknown[:-3].reshape(_MODES, 3), unknown[-3:]
    size = float(np.linalg.norm(end))
    # Anywhere in the goal's ball: the last three unknowns, squashed.
    reach = problem.goal.tolerance * (1.0 - 1e-6)
    place = centre + reach * end / np.sqrt(1.0 + size**2)
    line = place - problem.start
    return (problem.start + s[:, None] * line + shape @ bulge, line + slope @ bulge, s, shape,
            slope, reach * (np.eye(3) - np.outer(end, end) / (1.0 + size**2))
            / np.sqrt(1.0 + size**2))


def _cost(unknown: np.ndarray, problem: GentleProblem, centre: np.ndarray,
          ) -> tuple[float, np.ndarray]:
    points, velocity, s, shape, slope, squash = _path(unknown, problem, centre, _POINTS)
    weights, field = problem.weights, problem.energy_field
    rule = np.ones(_POINTS)
    rule[1:-1:2], rule[2:-1:2] = 4.0, 2.0
    rule /= 3.0 * (_POINTS - 1)
    speed = np.sqrt((velocity**2).sum(axis=1) + 1e-16)
    height, upward = field.region.height_and_slope(points)
    over = np.maximum(height + 2e-5, 0.0)
    rate = weights.length + weights.energy * field.energy(points)
    scale = _PENALTY * weights.length**2
    value = float(rule @ (rate * speed + scale * over**2))
    to_point = rule[:, None] * (weights.energy * speed[:, None] * field.energy_gradient(points)
                                + 2.0 * scale * over[:, None] * upward)
    to_velocity = (rule * rate / speed)[:, None] * velocity
    to_bulge = shape.T @ to_point + slope.T @ to_velocity
    to_place = s @ to_point + to_velocity.sum(axis=0)
    return value, np.concatenate([to_bulge.ravel(), squash @ to_place])
