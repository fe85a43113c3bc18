"""Pulls that a fit leaves out, and how well it predicts them."""

import numpy as np

from limber.core.errors import WorkError
from limber.estimation.fitting.objective import Objective
from limber.estimation.fitting.residuals import seen_in


def held_out(objective: Objective, free: np.ndarray, index: int) -> tuple[float, float]:
    """RMS distance [m] of points and RMS force error [N] of one pull that was not used in a fit.

    Raises:
        WorkError: the pull has no equilibrium under these values.
    """
    forward = objective.forwards[index]
    simulated = forward.simulate(objective.space.unpack(free), (), False)
    if simulated is None:
        raise WorkError(f"{forward.name} cannot be predicted: the simulation finds no equilibrium.",
                        "The moduli of the other pulls do not carry its forces.",
                        "Check this pull's grasp point, frame of reference and units.")
    simulated = forward.under_readings(simulated)
    off = (simulated.positions - forward.frames.positions)[seen_in(forward.frames)]
    force = simulated.forces - forward.frames.wrenches[:, :3]
    force = force[np.isfinite(force).all(axis=1)]
    return (float(np.sqrt(np.mean(np.sum(off**2, axis=1)))) if len(off) else np.nan,
            float(np.sqrt(np.mean(np.sum(force**2, axis=1)))) if len(force) else np.nan)


def without(objective: Objective, index: int) -> Objective:
    """Return the objective on all pulls but one; it keeps no log."""
    kept = [k for k in range(len(objective.forwards)) if k != index]
    return Objective([objective.forwards[k] for k in kept], objective.space,
                     force_sigma=[objective.force_sigma[k] for k in kept])
