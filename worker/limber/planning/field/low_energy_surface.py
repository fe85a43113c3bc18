"""The low-energy surface: the sphere on which a free grasp moves.

A branch yields easily across and hardly along. Under forces across, its grasp stays within a tenth
of a millimetre on a sphere about a pivot at a fifth to a quarter of its height (the pseudo-rigid
body of a cantilever: Howell, Compliant Mechanisms, 2001, 5.1; measured on four branches, 40 %
deflection). Inside it the branch is pushed together and bends; beyond it the branch is drawn taut,
and the force grows a hundred times as fast. Gentle paths run along the shell. So samples follow it,
and some are drawn a little beyond: no path is best at the border of the sampled region.
"""

from dataclasses import dataclass

import numpy as np
import scipy

from limber.core.progress import SILENT, Progress
from limber.mechanics import StaticResult
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.field.solver_pool import SolverPool
from limber.planning.field.stored_states import Solved, taken

_STEP = 1e-4  # [m] displacement that measures the stiffness at rest
_RIM = 1.1  # factor on the force of linear bending at the largest deflection
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
_WORST = 0.02  # rms deviation of the states from the sphere, over the radius
_SHARE_DIRECTIONS = 3
"""Directions of one task; must not depend on the number of processes."""


@dataclass(frozen=True)
class LowEnergySurface:
    """A sphere: ``pivot`` [m] of shape [3] and ``radius`` [m]."""

    pivot: np.ndarray
    radius: float


def walk_energy_surface(solvers: SolverPool, count: int, *, deflection: float, seed: int = 0,
                progress: Progress = SILENT) -> tuple[LowEnergySurface, list[Solved]]:
    """Return the shell, and states of the branch on it and a little beyond.

    Args:
        count: Number of directions; each gives two states, one under a force across and one also
            drawn outward, as strongly as the branch is bent at the largest deflection.
        deflection: Largest distance from rest, as a fraction of the arc length.
        seed: Rotates the directions.

    A branch that is not a cantilever (its states are not on a sphere) gets the sphere about its
    base.
    """
    grasp_model = solvers.grasp_model
    reach = grasp_model.reach
    stiffness, axes = _stiffness(grasp_model)
    force = float(np.sqrt(max(stiffness[0] * stiffness[1], 0.0))) * deflection * reach.arc_length
    turn = float(np.random.default_rng([seed, 11]).uniform(0.0, 2.0 * np.pi))
    angles = turn + _GOLDEN * np.arange(count)
    across = _RIM * force * np.sqrt((np.arange(count) + 0.5) / count)[:, None] * (
        np.cos(angles)[:, None] * axes[:, 0] + np.sin(angles)[:, None] * axes[:, 1])
    across = np.concatenate([np.zeros((1, 3)), across])
    # In turn: the farther from rest, the longer it takes.
    shares = max(2, -(-len(across) // _SHARE_DIRECTIONS))
    found = solvers.run(_walk, [(across[k::shares], force) for k in range(shares)],
                     progress=progress, message="finding the low-energy surface")
    pairs = [found[k % shares][k // shares] for k in range(len(across))]
    slack = [pair[0] for pair in pairs[1:] if pair[0] is not None]
    positions = np.array([grasp_model.rest_position, *(state.pose[:3] for state in slack)])
    return _sphere(positions, reach.base, grasp_model.rest_position), [
        *slack, *(pair[1] for pair in pairs if pair[1] is not None)]


def _walk(grasp_model: GraspModel, across: np.ndarray, outward: float,
          progress: Progress = SILENT) -> list[tuple[Solved | None, Solved | None]]:
    """Return the states under each force [n, 3], also drawn ``outward`` [N]."""
    pairs = []
    for number, force in enumerate(across):
        progress(number / len(across), "finding the low-energy surface")
        slack = _under(grasp_model, force, grasp_model.rest) if force.any() else grasp_model.rest
        if slack is None:
            pairs.append((None, None))
            continue
        kept = taken(grasp_model, slack)
        drawn = _under(grasp_model, force + outward * _unit(kept.pose[:3] - grasp_model.reach.base),
                       slack)
        pairs.append((kept, None if drawn is None else taken(grasp_model, drawn)))
    return pairs


def _stiffness(grasp_model: GraspModel) -> tuple[np.ndarray, np.ndarray]:
    """Return stiffnesses of the grasp at rest [N/m], ascending, and their axes as columns."""
    moved = [grasp_model.follow((grasp_model.rest_position + _STEP * axis)[None],
                                grasp_model.rest.displacement)[0].require().reaction_force / _STEP
             for axis in np.eye(3)]
    whole = np.array(moved)
    return np.linalg.eigh(0.5 * (whole + whole.T))


def _under(grasp_model: GraspModel, force: np.ndarray, start: StaticResult) -> StaticResult | None:
    """Return the state under a force [3] on the grasp, held there; None if there is none."""
    held = grasp_model.pulled(force, start.displacement)
    return None if refusal(held) else held


def _sphere(positions: np.ndarray, base: np.ndarray, rest: np.ndarray) -> LowEnergySurface:
    arm = rest - base
    chord = float(np.linalg.norm(arm))

    def missed(unknown: np.ndarray) -> np.ndarray:
        return np.linalg.norm(positions - unknown[:3], axis=1) - unknown[3]

    if len(positions) >= 8:
        start = np.r_[base + 0.2 * arm, 0.8 * chord]
        found = scipy.optimize.least_squares(missed, start, x_scale=chord)
        pivot, radius = found.x[:3], float(found.x[3])
        close = np.sqrt(np.mean(found.fun**2)) < _WORST * radius
        if close and 0.2 * chord < radius < 3.0 * chord and (rest - pivot) @ arm > 0.0:
            return LowEnergySurface(pivot, radius)
    return LowEnergySurface(np.asarray(base, float), chord)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)
