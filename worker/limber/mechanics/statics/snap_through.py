"""The end of a path of stable equilibria: a column buckles, a bow turns over.

No small step continues the path there. The branch moves as in a viscous fluid until it is at rest.
If that state is a saddle (a straight column under too much load), it is perturbed along the mode of
negative tangent stiffness and moves on to the bent state.
"""

from typing import TYPE_CHECKING

import numpy as np

from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.mechanics.linear.equations import Equations
from limber.mechanics.model import BranchModel

if TYPE_CHECKING:
    from limber.mechanics.statics.equilibrium_path import Path

# Chosen on the columns and bows of tests/mechanics/statics; none was measured in a series.
_FIRST_DRAG = 1e-5
"""Drag of the first creep step, as a fraction of the mean diagonal of the stiffness."""
_CREEPS = 60
"""Most creep steps to the equilibrium."""
_CREEP_ITERATIONS = 9
"""Most Newton iterations per creep step; if it takes more, it is repeated with more drag."""
_RESTING = 1e-2
"""Imbalance relative to loads and reactions below which the branch is at rest or on a saddle."""
_PUSHES = 3
"""Most perturbations off saddles."""
_PUSH = 2e-3
"""Size of the perturbation off a saddle, as a fraction of the branch's extent."""
_MODE_ITERATIONS = 30
"""Inverse iterations for the unstable mode of a saddle."""


def settle(path: "Path", part: float) -> float | None:
    """Let the branch snap to its equilibrium at the fraction ``part`` of the path.

    Each creep step is an implicit Euler step of the gradient flow of the potential, so the
    potential only falls. Return the length of the step; None if the branch does not come to rest.
    """
    if path.model.material.is_linear:
        return None
    target, pins = path.constraint_at(part)
    load, before = path.load_at(part), (path.status, path.trouble)
    trial, drag, pushes = path.displacement, _FIRST_DRAG, 0
    for _ in range(_CREEPS):
        if path.iterations > path.settings.total_iterations:
            break
        crept = _creep(path, trial, target, pins, load, drag)
        if crept is None:
            drag *= 8
            if drag > 1:
                break
            continue
        trial, quick, error, stable, diagonal_norm = crept
        if error < _RESTING and not stable and pushes < _PUSHES:
            trial, pushed = pushed_off(path.model, path.equations, trial, load)
            pushes += pushed
        elif error < _RESTING and stable:
            taken = path.correct(trial, np.zeros_like(trial), part, diagonal_norm,
                                 stable)
            if taken is not None:
                path.snaps.append((path.reached + taken, pushes > 0))
                return taken
        drag *= 0.25 if quick else 0.7
    path.status, path.trouble = before
    return None


def _creep(path: "Path", start: np.ndarray, target: np.ndarray, pins: np.ndarray,
           load: np.ndarray, drag: float,
           ) -> tuple[np.ndarray, bool, float, bool, float] | None:
    """Return the state after one creep step, whether it converged quickly, and its imbalance.

    And whether its tangent is positive definite and the norm of its diagonal [N/m].
    """
    model, equations, held = path.model, path.equations, path.equations.held
    moved = np.where(held[:, None], target - start, 0.0)
    now = np.array([g.weights @ start[g.nodes] for g in equations.pinned]).reshape(-1, 3)
    trial, increment, honey = start, None, 0.0
    for count in range(_CREEP_ITERATIONS):
        state = model.internal(trial)
        out = load - state.force
        pull = equations.free_part(out - honey * (trial - start))
        norm = float(np.linalg.norm(pull))
        reference = float(np.linalg.norm(out - equations.free_part(out)) + np.linalg.norm(load))
        if not np.isfinite(norm):
            return None
        if increment is not None and norm <= 1e-4 * reference:
            left = float(np.linalg.norm(equations.free_part(out)))
            # Without load there is no scale for the imbalance.
            part = left / max(reference, 1e-300)
            tangent = equations.tangent(model, trial)
            return (trial, count <= 4, part, tangent.is_positive_definite,
                    tangent.diagonal_norm)
        path.iterations += 1
        try:
            tangent = equations.tangent(model, trial, increment=increment, drag=drag)
        except NotPositiveDefiniteError:
            return None
        if not tangent.is_positive_definite:
            return None
        honey = tangent.drag
        if increment is None:
            right = out - model.tangent_times(start, moved) if moved.any() else out
            increment = tangent.solve(right, pins - now) + moved
        else:
            increment = tangent.solve(pull)
        # Its memory is reused by the next one.
        del tangent
        trial = trial + increment
    return None


def pushed_off(model: BranchModel, equations: Equations, state: np.ndarray,
               load: np.ndarray) -> tuple[np.ndarray, bool]:
    """Return a state perturbed off a saddle to the side where the potential falls more.

    And whether there was a mode to push it along.
    """
    mode, curvature = lowest_mode(model, equations, state)
    if curvature >= 0:
        return state, False
    push = _PUSH * model.extent * mode / np.linalg.norm(mode, axis=1).max()
    sides = [state + push, state - push]
    potentials = [model.internal(side).energy - float((load * side).sum())
                  for side in sides]
    return sides[int(np.argmin(potentials))], True


def lowest_mode(model: BranchModel, equations: Equations, state: np.ndarray,
                ) -> tuple[np.ndarray, float]:
    """Return the mode of least tangent stiffness [node_count, 3] and its stiffness [N/m].

    Inverse iteration on the tangent whose diagonal was raised until it could be factorised: raising
    does not change the eigenvectors. The Rayleigh quotient is that of the tangent itself.
    """
    tangent = equations.tangent(model, state)
    mode = np.random.default_rng(0).normal(size=state.shape)
    for _ in range(_MODE_ITERATIONS):
        mode = tangent.solve(mode)
        mode /= np.linalg.norm(mode)
    return mode, float((mode * model.tangent_times(state, mode)).sum())
