"""What a branch may look like with its grasp at a place, by the states about it.

Displacements between two states that are turned against each other are too short: they have strain
that no state has, and bending is a thousandth of what that costs. So the strain is interpolated by
itself, to first order in what each state says: from there Newton's iteration, whose stress is then
right, is half as long.
"""

from collections.abc import Sequence

import numpy as np

from limber.planning.field.grasp_model import GraspModel, Guess
from limber.planning.field.radial import RadialInterpolant
from limber.planning.field.solved import Solved

_STATES = 6  # about a place that are asked
_SURE = 0.02  # of the branch's length, that they may say otherwise than the nearest alone
_APART = 0.002  # of it, that two of them lie apart
_KERNEL = {"kernel": "cubic", "smoothing": 1e-9}
_STRAIGHT = 0.9  # cosine of the turn of a way, below which it does not go on
_DIFFERENCE = 1e-4  # of a state's change, by which that of its strain is measured

Share = tuple[float, np.ndarray, np.ndarray]
"""Of a state in a guess: its weight, its displacement, and the change of that by its tangents."""


def guess_of(grasp_model: GraspModel, known: Sequence[Solved], positions: np.ndarray,
             place: np.ndarray) -> Guess | None:
    """Return what the branch may look like with the grasp at ``place`` [3], None where nothing is
    known, nothing in it where the model needs no guess.

    An interpolation of the nearest states with their tangents (Hermite, radial); by the nearest
    alone where the others say something else: they may have gone aside another way.

    Args:
        known: With their ``positions`` [m], shape [m, 3].
    """
    if not grasp_model.needs_guess:
        return Guess()
    length, states = grasp_model.reach.arc_length, []
    for k in np.argsort(np.linalg.norm(positions - place, axis=1), kind="stable")[:2 * _STATES]:
        gaps = [np.linalg.norm(one.pose[:3] - positions[k]) for one in states]
        if known[k].has_tangents and min(gaps, default=np.inf) > _APART * length:
            states.append(known[k])
        if len(states) == _STATES:
            break
    if not states:
        return None
    if len(states) == _STATES:
        shares = _interpolated(states, place)
        off = np.linalg.norm(_displacement(shares) - states[0].foretold(place), axis=1).max()
        if off <= _SURE * length:
            return blended(grasp_model, shares)
    return foretold_by(grasp_model, states[0], place)


def foretold_by(grasp_model: GraspModel, state: Solved, place: np.ndarray) -> Guess | None:
    """Return what a state's tangents say of ``place`` [3], None where it has none."""
    if not state.has_tangents:
        return None
    return blended(grasp_model, [_share(1.0, state, place - state.pose[:3])])


def half_way(grasp_model: GraspModel, first: Solved, second: Solved, place: np.ndarray,
             ) -> Guess | None:
    """Return what values and slopes of both say near half-way, None without slopes."""
    if not (first.has_tangents and second.has_tangents):
        return None
    straight = 0.5 * (first.pose[:3] + second.pose[:3])
    return blended(grasp_model, [
        _share(0.5, one, 0.25 * (place - one.pose[:3] + place - straight))
        for one in (first, second)])


def straight_on(grasp_model: GraspModel, before: np.ndarray, now: np.ndarray, place: np.ndarray,
                ) -> Guess | None:
    """Return what two states on a way, displacements [node_count, 3], say of the next ``place``
    [3]: straight on by the tangents of the second, and bent as the way has bent from the first.

    None where the way turns, or the branch is about to snap.
    """
    here = grasp_model.pose(now)[:3]
    back, on = grasp_model.pose(before)[:3] - here, place - here
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
    """Return the sum of the states' displacements and their changes, each by its weight, and of
    their strains likewise; nothing where the model needs no guess."""
    if not grasp_model.needs_guess:
        return Guess()
    strains, strain = grasp_model.model.strains, 0.0
    for weight, displacement, change in shares:
        own = strains(displacement)
        near = strains(displacement + _DIFFERENCE * change)
        strain = strain + weight * own + (near - own) / _DIFFERENCE
    return Guess(_displacement(shares), strain)


def _share(weight: float, state: Solved, way: np.ndarray) -> Share:
    return weight, state.displacement, state.moved(way)


def _displacement(shares: Sequence[Share]) -> np.ndarray:
    return sum(weight * displacement + change for weight, displacement, change in shares)


def _interpolated(states: list[Solved], place: np.ndarray) -> list[Share]:
    points = np.array([one.pose[:3] for one in states])
    count = len(points)
    # What each value, and each slope, contributes: the interpolation of unit data.
    unit = np.eye(4 * count)
    weights = RadialInterpolant.fit(points, unit[:count], unit[count:].reshape(count, 3, -1),
                                    **_KERNEL).value(place[None])[0]
    slopes = weights[count:].reshape(count, 3)
    return [_share(weights[k], one, slopes[k]) for k, one in enumerate(states)]
