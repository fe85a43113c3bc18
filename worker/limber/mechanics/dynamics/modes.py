"""Lowest natural frequencies and modes about an equilibrium."""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import eigh

from limber.core.errors import ConvergenceError
from limber.mechanics.linear.equations import Tangent
from limber.mechanics.model import BranchModel

_SPARE = 4
_ITERATIONS = 60
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Modes:
    """Small undamped free vibrations: ascending frequencies [k] [Hz], and shapes [k, node_count, 3]
    of unit modal mass [kg^-1/2]."""

    frequencies: np.ndarray
    shapes: np.ndarray


def lowest_modes(model: BranchModel, count: int, displacement: np.ndarray | None = None) -> Modes:
    """Return the lowest modes about an equilibrium (None: the mesh's shape), by subspace iteration
    (Bathe). NotPositiveDefiniteError if unstable, ConvergenceError if it does not converge."""
    at = np.zeros_like(model.mesh.nodes) if displacement is None else displacement
    tangent = model.equations(()).tangent(model, at)
    vectors = np.random.default_rng(0).standard_normal((count + _SPARE, *model.mesh.nodes.shape))
    vectors[:, model.fixed] = 0.0
    before = np.zeros(count)
    for _ in range(_ITERATIONS):
        squares, vectors = subspace_round(model, tangent, vectors)
        if np.abs(squares[:count] - before).max() <= _TOLERANCE * squares[:count].max():
            return Modes(np.sqrt(squares[:count]) / (2 * np.pi), vectors[:count])
        before = squares[:count]
    raise ConvergenceError(f"The {count} lowest modes did not converge in {_ITERATIONS} "
                           "iterations.",
                           "They may lie very close together.", "Request fewer modes.")


def subspace_round(model: BranchModel, tangent: Tangent, vectors: np.ndarray,
                   ) -> tuple[np.ndarray, np.ndarray]:
    """Iterate the subspace [k, node_count, 3] once (Bathe, Rayleigh-Ritz): squared angular
    frequencies [1/s^2], ascending, and their modes of unit modal mass."""
    pushed = np.array([model.mass_times(vector) for vector in vectors])
    vectors = np.array([tangent.solve(force) for force in pushed])
    flat = vectors.reshape(len(vectors), -1)
    stiffness = flat @ pushed.reshape(len(vectors), -1).T
    mass = flat @ np.array([model.mass_times(vector).ravel() for vector in vectors]).T
    squares, mix = eigh((stiffness + stiffness.T) / 2, (mass + mass.T) / 2)
    return squares, np.tensordot(mix.T, vectors, axes=1)
