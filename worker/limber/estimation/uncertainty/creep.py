"""Creep of the branch, by a standard linear solid, where the record shows it.

Under a sudden pull the force of a viscoelastic branch falls by a share g of itself, with a time
constant. With the same course in all of the branch, the force is that of an elastic branch less g
times its relaxed part; the shape under prescribed motion is the elastic one. The share is one more
unknown of the fit beside the errors of the cell. It is added only if the residuals make it likely:
a pull one way at constant speed hardly shows it.
"""

from collections.abc import Mapping
from typing import Any

import numpy as np

from limber.estimation.fitting.nuisances import CREEP_SIGMA, relaxed
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.fitting.optimise import Fit, gauss_newton
from limber.estimation.forward.forward_model import Forward, Simulated
from limber.estimation.uncertainty.covariance import repeated

TIME_SHARES = (0.03, 0.1, 0.3, 1.0)
"""Tested time constants over the duration of the longest pull."""
LIKELIER = 3.0
"""Log of the ratio of evidences above which creep is added."""
LEAST_NOISE = 0.05
"""Smallest variance of the residuals over the stated one: below it errors of the model count."""
FEWEST = 12
"""Fewest frames of a pull that can show it."""


def with_creep(fit: Fit, objective: Objective) -> tuple[Fit, Objective]:
    """Fit again with the branch's creep as an unknown, if the residuals show it."""
    seconds = shown_creep(fit.evaluation, objective)
    if seconds is None:
        return fit, objective
    for forward in objective.forwards:
        forward.creep_time = seconds
    objective = objective.with_space(objective.space)
    return gauss_newton(objective, fit.evaluation.free, is_near=True), objective


def shown_creep(evaluation: Evaluation, objective: Objective) -> float | None:
    """Return the time constant of creep [s] that residuals show, or None: evidence of one more
    direction, linear in the share with a normal prior, divided among those tried."""
    lasting = [float(np.ptp(each.frames.times)) for each in objective.forwards if _may_show(each)]
    if not lasting:
        return None
    basis = np.linalg.qr(evaluation.slopes)[0]
    kinds = [np.array(each.kinds) for each in objective.raw_slopes(evaluation)]
    found = []
    for seconds in max(lasting) * np.array(TIME_SHARES):
        changes = [_change(pull.forces, forward, float(seconds))
                   for pull, forward in zip(evaluation.pulls, objective.forwards, strict=True)]
        column = objective.residual_slopes(evaluation, changes)[:, 0]
        column = column - basis @ (basis.T @ column)
        square, along = float(column @ column), -float(column @ evaluation.residual)
        share = along / (square + 1)
        scale = _noise(evaluation.residual + share * column, kinds, objective)
        square, along = square / scale, along / scale
        likelier = 0.5 * along**2 / (square + 1) - 0.5 * np.log1p(square)
        if share > 0:
            found.append((likelier - np.log(len(TIME_SHARES)), float(seconds)))
    best, seconds = max(found, default=(-np.inf, 0.0))
    return seconds if best > LIKELIER else None


def _noise(residual: np.ndarray, kinds: list[np.ndarray], objective: Objective) -> float:
    """Variance of forces' residuals over the stated one, times that of correlated ones; ``kinds``
    by pull."""
    start, series, fitted = 0, [], 0
    for each, forward in zip(kinds, objective.forwards, strict=True):
        forces = residual[start:start + len(each)][each == "noise of the force"]
        series.append(forces.reshape(-1, 3))
        fitted += 0 if forward.response is None else forward.response.forces.shape[-1]
        start += len(each)
    count = sum(each.size for each in series)
    variance = sum(float(np.sum(each**2)) for each in series) / max(count - fitted, 1)
    return max(variance, LEAST_NOISE) * repeated(
        [(np.zeros((len(each), 0, 3)), each) for each in series])


def _may_show(forward: Forward) -> bool:
    return (forward.uses_force and not forward.force_is_stated and not forward.is_dynamic
            and len(forward.frames) >= FEWEST)


def _change(forces: np.ndarray, forward: Forward, seconds: float) -> Simulated:
    """Change of a pull's measurements by one prior deviation of the share."""
    found = Simulated.none(len(forces), forward.frames.positions.shape[1], 1)
    if _may_show(forward):
        found.forces[..., 0] = -CREEP_SIGMA * relaxed(forward.frames.times, forces, seconds)
    return found


def creep_sentence(creep: Mapping[str, Any]) -> str:
    """Return what creep means for the moduli; ``share``, ``interval`` and ``time_s`` [s]."""
    low, high = (100 * end for end in creep["interval"])
    return (f"The branch creeps: under a lasting bend its force falls by {100 * creep['share']:.2g}"
            f" % ({low:.2g} to {high:.2g} %) with a time constant of about {creep['time_s']:.2g} "
            "s. The moduli are those under a quick load. Under a lasting load they are lower by "
            "this share.")
