"""Observed points whose frame is fitted freely: exact rotation by repeated small ones.

The errors of a fit are linear. A frame that is turned by several degrees is therefore put right by
the fitted turn, and the pulls are fitted again.
"""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from limber.core.numerics.rigid import rotated
from limber.core.present import present
from limber.recordings.recording import Pull

ROUNDS = 4
"""Most fits. 20 degrees need three."""
SMALL_RAD = 5e-3
"""Turn below which its square no longer matters: 0.01 mm at half a metre."""


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
