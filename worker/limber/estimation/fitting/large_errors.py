"""Errors so large that their squares matter: put right by what was fitted, then fitted again.

The errors of a fit are linear. A frame of the observed points that is turned by several degrees is
turned back, and a point that is a centimetre off along a bent branch is moved there.
"""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from limber.core.not_none import present
from limber.core.numerics.rigid import rotated
from limber.estimation.fitting.nuisances import nuisance_records
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.forward.forward_model import Forward
from limber.estimation.forward.quasi_static import QuasiStaticForward
from limber.estimation.parameters import Values
from limber.recordings.recording import Pull

ROUNDS = 4
"""Most fits. 20 degrees need three."""
SMALL_RAD = 5e-3
"""Turn below which its square no longer matters: 0.01 mm at half a metre."""
FAR_M = 4e-3
"""Distance along the branch beyond which a point is moved: with a radius of curvature of 15 cm its
square is 0.05 mm.
"""


def far_points(cell_errors: Sequence[dict], known: Mapping[str, np.ndarray],
               ) -> dict[str, np.ndarray] | None:
    """Return each pull's fitted distances of its points along the branch [m], shape [m].

    None: they are near those at which the pulls were simulated.

    Args:
        known: These, by the pull's name; zero where it has none.
    """
    found: dict[str, list[float]] = {}
    for each in cell_errors:
        if re.fullmatch("position of point [0-9]+ along the branch", each["name"]):
            found.setdefault(each["pull"], []).append(each["value"])
    fitted = {name: np.array(values) for name, values in found.items()}
    is_far = any(np.abs(values - known.get(name, 0.0)).max() > FAR_M
                 for name, values in fitted.items())
    return fitted if is_far else None


def fitted_frame(cell_errors: Sequence[dict]) -> tuple[np.ndarray, np.ndarray]:
    """Return the fitted shift [m] and turn [rad] of the observer's frame, shape [3] each."""
    def vector(start: str) -> np.ndarray:
        return np.array([each["value"] for each in cell_errors
                         if each["name"].startswith(start)] or np.zeros(3))

    return vector("camera position"), vector("camera rotation")


def put_right(pull: Pull, shift: np.ndarray, turn: np.ndarray) -> Pull:
    """Return the pull with its points in the branch's frame, turned back about their middle."""
    seen = present(pull.observations, "observed points")
    points = seen.positions - shift
    middle = np.nanmean(points, axis=(0, 1))
    back = rotated(-turn, (points - middle).reshape(-1, 3)).reshape(points.shape)
    return replace(pull, observations=replace(seen, positions=middle + back))


class FarPointsError(Exception):
    """Points are far from where they were simulated: the pulls are fitted again there."""

    def __init__(self, shifts: dict[str, np.ndarray], values: Values, forwards: list[Forward]):
        super().__init__()
        self.shifts, self.values, self.forwards = shifts, values, forwards

    def begin(self, forwards: list[Forward]) -> None:
        """Let simulations of the same pulls start from the states found so far."""
        for forward, known in zip(forwards, self.forwards, strict=True):
            if isinstance(forward, QuasiStaticForward) and isinstance(known, QuasiStaticForward):
                forward.begin_at(known)


@dataclass(frozen=True)
class FarPoints:
    """Looks whether a fit has moved points far along the branch from ``shifts`` [m]."""

    shifts: dict[str, np.ndarray]

    def look(self, evaluation: Evaluation, objective: Objective) -> None:
        """Raise FarPointsError if it has."""
        if evaluation.errors is None:
            return
        size = objective.space.size
        listed = nuisance_records(objective.cell_errors.nuisances, evaluation.errors,
                                  np.zeros((size, size)))
        far = far_points(listed, self.shifts)
        if far is not None:
            raise FarPointsError(far, objective.space.unpack(evaluation.free),
                                 objective.forwards)
