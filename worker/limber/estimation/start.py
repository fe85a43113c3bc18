"""Where a fit starts: the uniform modulus that explains the measured force best."""

from dataclasses import replace

import numpy as np

from limber.estimation.objective import Forward, Objective
from limber.estimation.parameters import YOUNG_BOUNDS_PA, Values


def scaled_start(objective: Objective, values: Values) -> Values:
    """Return ``values`` with all moduli scaled to the measurements.

    At given poses the reaction is proportional to the scale of Young's modulus: one simulation
    gives it. Where a force or gravity drives, a few decades are tried instead.
    """
    factors = [factor for forward in objective.forwards
               if (factor := _force_ratio(forward, values)) is not None]
    if factors:
        young = values.young * float(np.exp(np.mean(np.log(factors))))
        return replace(values, young=np.clip(young, *YOUNG_BOUNDS_PA))
    return _scanned(objective, values)


def _force_ratio(forward: Forward, values: Values) -> float | None:
    if not forward.uses_force or forward.entry.motion == "dynamic":
        return None
    simulated = forward.simulate(values, (), False)
    if simulated is None:
        return None
    measured = forward.frames.wrenches[:, :3]
    known = np.isfinite(measured).all(axis=1)
    # A uniform branch would not go where this one went: far out it is stretched, and its force
    # says nothing. Near rest both only bend.
    travel = np.linalg.norm(forward.frames.poses[:, :3] - forward.frames.poses[0, :3], axis=1)
    near = known & (travel > 0.05 * travel.max()) & (travel < 0.4 * travel.max())
    chosen = near if near.sum() >= 3 else known
    # Along the measured force: what stretches points across it.
    own = float(np.sum(measured[chosen]**2))
    across = float(np.sum(measured[chosen] * simulated.forces[chosen]))
    return own / across if own > 0 and across > 0 else None


def _scanned(objective: Objective, values: Values) -> Values:
    """Descend over decades, then halve the step: the objective has one valley along the scale."""
    best = (np.inf, 0.0)
    tried: dict[float, float] = {}

    def cost(shift: float) -> float:
        if shift not in tried:
            scaled = replace(values, young=np.clip(values.young * 10**shift, *YOUNG_BOUNDS_PA))
            found = objective.evaluate(objective.space.pack(scaled))
            tried[shift] = np.inf if found is None else found.objective
        return tried[shift]

    centre, step = 0.0, 1.0
    while step >= 0.25:
        around = [(cost(shift), shift) for shift in (centre, centre - step, centre + step)]
        best = min(around)
        if best[1] == centre:
            step /= 2
        centre = best[1]
        if abs(centre) > 6:
            break
    return replace(values, young=np.clip(values.young * 10**centre, *YOUNG_BOUNDS_PA))
