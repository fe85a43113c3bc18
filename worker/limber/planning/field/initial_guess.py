"""Guess of a branch's shape for a grasp position, from the nearby states.

Displacements between two states that are rotated against each other are too short: they contain
strain that neither state has, and bending costs a thousandth of that. So the strain is
interpolated by itself, to first order about each state. From there Newton's iteration, whose stress
is then right, takes half as many steps.
"""

from collections.abc import Sequence

import numpy as np

from limber.planning.field.grasp_model import GraspModel, Guess
from limber.planning.field.interpolation.radial import RadialInterpolant
from limber.planning.field.stored_states import Solved

_STATES = 6  # states around a position that are used
_SURE = 0.02  # fraction of the length by which they may differ from the nearest state
_APART = 0.002  # fraction of the length by which two states differ
_KERNEL = {"kernel": "cubic", "smoothing": 1e-9}
_STRAIGHT = 0.9  # cosine of a path's turn below which it is not continued
_DIFFERENCE = 1e-4  # fraction of a state's change by which its strain's change is measured

Share = tuple[float, np.ndarray, np.ndarray]
"""Terms of a state in a guess: weight, displacement, and its change by the tangents."""


def guess_of(grasp_model: GraspModel, known: Sequence[Solved], positions: np.ndarray,
             position: np.ndarray) -> Guess | None:
    """Return a guess of the branch's shape with the grasp at ``position`` [3], None if nothing is
    known; an empty guess if the model needs none.

    An interpolation of the nearest states with their tangents (Hermite, radial); the nearest alone
    if the others disagree: they may have buckled to another side.

    Args:
        known: With their ``positions`` [m], shape [m, 3].
    """
    if not grasp_model.needs_guess:
        return Guess()
    length, states = grasp_model.reach.arc_length, []
    for k in np.argsort(np.linalg.norm(positions - position, axis=1), kind="stable")[:2 * _STATES]:
        gaps = [np.linalg.norm(one.pose[:3] - positions[k]) for one in states]
        if known[k].has_tangents and min(gaps, default=np.inf) > _APART * length:
            states.append(known[k])
        if len(states) == _STATES:
            break
    if not states:
        return None
    if len(states) == _STATES:
        shares = _interpolated(states, position)
        off = np.linalg.norm(_displacement(shares) - states[0].extrapolated(position), axis=1).max()
        if off <= _SURE * length:
            return blended(grasp_model, shares)
    return extrapolated(grasp_model, states[0], position)


def extrapolated(grasp_model: GraspModel, state: Solved, position: np.ndarray) -> Guess | None:
    """Return the prediction of a state's tangents at ``position`` [3], None if it has none."""
    if not state.has_tangents:
        return None
    return blended(grasp_model, [_share(1.0, state, position - state.pose[:3])])


def midpoint_blend(grasp_model: GraspModel, first: Solved, second: Solved, position: np.ndarray,
                   ) -> Guess | None:
    """Return the blend of both states' values and slopes near half-way, None without slopes."""
    if not (first.has_tangents and second.has_tangents):
        return None
    straight = 0.5 * (first.pose[:3] + second.pose[:3])
    return blended(grasp_model, [
        _share(0.5, one, 0.25 * (position - one.pose[:3] + position - straight))
        for one in (first, second)])


def straight_on(grasp_model: GraspModel, before: np.ndarray, now: np.ndarray, position: np.ndarray,
                ) -> Guess | None:
    """Return the extrapolation of two states on a path, displacements [node_count, 3], to the next
    ``position`` [3]: straight on by the tangents of the second, plus the curvature of the path
    since the first.

    None if the path turns, or the branch is about to snap.
    """
    here = grasp_model.pose(now)[:3]
    back, on = grasp_model.pose(before)[:3] - here, position - here
    size = float(np.linalg.norm(back) * np.linalg.norm(on))
    if size == 0.0 or back @ on > -_STRAIGHT * size:
        return None
    tangents = grasp_model.tangents(now)
    if not np.isfinite(tangents).all():
        return None
    bend = float(on @ on / (back @ back))
    return blended(grasp_model, [
        (1.0 - bend, now, np.tensordot(on - bend * back, tangents, 1)),
        (bend, before, np.zeros_like(now))])


def blended(grasp_model: GraspModel, shares: Sequence[Share]) -> Guess:
    """Return the sum of the states' displacements and their changes, each with its weight, and
    likewise of their strains; empty if the model needs no guess.
    """
    if not grasp_model.needs_guess:
        return Guess()
    strains, strain = grasp_model.model.strains, 0.0
    for weight, displacement, change in shares:
        own = strains(displacement)
        near = strains(displacement + _DIFFERENCE * change)
        strain = strain + weight * own + (near - own) / _DIFFERENCE
    return Guess(_displacement(shares), strain)


def _share(weight: float, state: Solved, shift: np.ndarray) -> Share:
    return weight, state.displacement, state.moved(shift)


def _displacement(shares: Sequence[Share]) -> np.ndarray:
    return sum(weight * displacement + change for weight, displacement, change in shares)


def _interpolated(states: list[Solved], position: np.ndarray) -> list[Share]:
    points = np.array([one.pose[:3] for one in states])
    count = len(points)
    # Contribution of each value, and each slope: the interpolation of unit data.
    unit = np.eye(4 * count)
    weights = RadialInterpolant.fit(points, unit[:count], unit[count:].reshape(count, 3, -1),
                                    **_KERNEL).value(position[None])[0]
    slopes = weights[count:].reshape(count, 3)
    return [_share(weights[k], one, slopes[k]) for k, one in enumerate(states)]
