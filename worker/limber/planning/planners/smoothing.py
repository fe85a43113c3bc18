"""From the corners of a tree to a path for a robot: shortcuts, then the nearest local optimum.

The same steps for the baseline and for D-RRT*, so that they differ by their costs and not by the
luck of sampling.
"""

import numpy as np
import scipy

from limber.planning.cost import EdgeWeights, arc_lengths, edge_cost, path_cost, resample
from limber.planning.field.energy_field import EnergyField, FieldArrays

_POLISH_POINTS = 40  # corners of the path while it is smoothed
_MIN_GAP = 1e-9  # [m] keeps the length's gradient finite where two corners meet


def shortcut(path: np.ndarray, field: FieldArrays, weights: EdgeWeights, *, attempts: int,
             seed: int) -> np.ndarray:
    """Return the polyline after random shortcuts that lower the cost, evenly spaced [n, 3]."""
    generator = np.random.default_rng([seed, 1])
    path = resample(path, weights.step)
    # Spans shrink: long ones straighten, short ones round the corners that the long ones leave.
    for span in np.geomspace(1.0, 0.05, max(attempts, 1))[:attempts]:
        first = int(generator.integers(len(path)))
        last = first + max(int(span * generator.uniform() * len(path)), 2)
        if last >= len(path):
            continue
        old = path_cost(path[first:last + 1], field, weights)
        new = edge_cost(path[first], path[last], field, weights)
        if new < old:
            straight = np.linspace(path[first], path[last], last - first + 1)
            path = np.concatenate([path[:first], straight, path[last + 1:]])
    return resample(path, weights.step)


def slide_end(path: np.ndarray, goals: np.ndarray, limits: FieldArrays, weights: EdgeWeights,
              ) -> np.ndarray:
    """Return the path bent to end in that one of ``goals`` [g, 3] which makes it cheapest.

    A tree ends where its samples happened to fall in the goal region; all of the region is equally
    good, but the paths to it are not.
    """
    part = (arc_lengths(path) / max(arc_lengths(path)[-1], _MIN_GAP))[:, None]
    best, least = path, path_cost(path, limits, weights)
    for goal in goals:
        bent = path + part * (goal - path[-1])
        if (cost := path_cost(bent, limits, weights)) < least:
            best, least = bent, cost
    return best


def polish(path: np.ndarray, energy_field: EnergyField, limits: FieldArrays,
           weights: EdgeWeights) -> np.ndarray:
    """Return the path moved to the nearest local optimum of its cost; ends stay, [n, 3].

    L-BFGS with the field's gradient. Trust and limits are not in the gradient: of the line from the
    old path to the optimum, the farthest tenth that is allowed and cheaper is taken.
    """
    spacing = max(weights.step, np.linalg.norm(np.diff(path, axis=0), axis=1).sum()
                  / _POLISH_POINTS)
    corners = resample(path, spacing)
    if len(corners) < 3:
        return path
    inner = corners[1:-1].shape

    def cost(flat: np.ndarray) -> tuple[float, np.ndarray]:
        moved = np.concatenate([corners[:1], flat.reshape(inner), corners[-1:]])
        value, gradient = smooth_cost(moved, energy_field, weights)
        return value, gradient[1:-1].ravel()

    best = scipy.optimize.minimize(cost, corners[1:-1].ravel(), jac=True, method="L-BFGS-B",
                                   options={"maxiter": 200}).x.reshape(inner)
    before = path_cost(path, limits, weights)
    for share in np.linspace(1.0, 0.1, 10):
        moved = corners.copy()
        moved[1:-1] += share * (best - corners[1:-1])
        moved = resample(moved, weights.step)
        if path_cost(moved, limits, weights) < before:
            return moved
    return path


def smooth_cost(path: np.ndarray, energy_field: EnergyField, weights: EdgeWeights,
                 ) -> tuple[float, np.ndarray]:
    """Return the trapezoidal cost of a polyline and its gradient to each point, [n, 3]."""
    edges = np.diff(path, axis=0)
    lengths = np.sqrt((edges**2).sum(axis=1) + _MIN_GAP**2)
    direction = edges / lengths[:, None]
    energy = slope = 0.0
    rate = np.full(len(edges), weights.length)
    gradient = np.zeros_like(path)
    if weights.energy > 0.0:
        energy = energy_field.energy(path)
        slope = energy_field.energy_gradient(path)
        rate += weights.energy * (energy[1:] + energy[:-1]) / 2
        near = np.zeros(len(path))
        near[:-1] += lengths / 2
        near[1:] += lengths / 2
        gradient += weights.energy * near[:, None] * slope
    gradient[1:] += rate[:, None] * direction
    gradient[:-1] -= rate[:, None] * direction
    return float((rate * lengths).sum()), gradient
