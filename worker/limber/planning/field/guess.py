"""What a branch may look like with its grasp at a place, by the states about it."""

from collections.abc import Sequence

import numpy as np

from limber.planning.field.radial import RadialInterpolant
from limber.planning.field.solved import Solved

_STATES = 6  # about a place that are asked
_SURE = 0.02  # of the branch's length, that they may say otherwise than the nearest alone
_APART = 0.002  # of it, that two of them lie apart
_KERNEL = {"kernel": "cubic", "smoothing": 1e-9}


def guess_of(known: Sequence[Solved], positions: np.ndarray, place: np.ndarray, length: float,
             ) -> np.ndarray | None:
    """Return the displacement with the grasp at ``place`` [3], None where nothing is known.

    An interpolation of the nearest states with their tangents (Hermite, radial); by the nearest
    alone where the others say something else: they may have gone aside another way.

    Args:
        known: With their ``positions`` [m], shape [m, 3]. length: The branch's [m].
    """
    states: list[Solved] = []
    for k in np.argsort(np.linalg.norm(positions - place, axis=1), kind="stable")[:2 * _STATES]:
        gaps = [np.linalg.norm(one.pose[:3] - positions[k]) for one in states]
        if known[k].has_tangents and min(gaps, default=np.inf) > _APART * length:
            states.append(known[k])
        if len(states) == _STATES:
            break
    if not states:
        return None
    alone = states[0].foretold(place)
    if len(states) < _STATES:
        return alone
    together = _interpolated(states, place)
    off = float(np.linalg.norm(together - alone, axis=1).max())
    return together if off <= _SURE * length else alone


def _interpolated(states: list[Solved], place: np.ndarray) -> np.ndarray:
    points = np.array([one.pose[:3] for one in states])
    count = len(points)
    # What each value, and each slope, contributes: the interpolation of unit data.
    unit = np.eye(4 * count)
    weights = RadialInterpolant.fit(points, unit[:count], unit[count:].reshape(count, 3, -1),
                                    **_KERNEL).value(place[None])[0]
    slopes = weights[count:].reshape(count, 3)
    return sum(weights[k] * one.displacement + one.moved(slopes[k])
               for k, one in enumerate(states))
