"""Around a fit: its initial modulus, errors too large for their squares, pulls it leaves out."""

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from limber.core.errors import WorkError
from limber.core.not_none import present
from limber.core.numerics.rigid import rotated
from limber.estimation.fitting.nuisances import nuisance_records
from limber.estimation.fitting.objective import Evaluation, Objective, seen_in
from limber.estimation.fitting.optimise import gauss_newton
from limber.estimation.forward.forward_model import Forward
from limber.estimation.forward.observed_path import ObservedPathForward, is_path_observed
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.parameters import YOUNG_BOUNDS_PA, ParameterSpace, Values
from limber.recordings.recording import Pull

# Initial values of a fit: the uniform modulus that explains the measured force best.

PARTS = (0.25, 0.45, 0.7)
"""Fractions of a fast pull's frames that are fitted first: over a quarter the simulation cannot be
a whole period off. The fractions between are chosen, not measured.
"""
ROUGH_KEYS = 5
"""Simulated frames of a first fit by force alone. Chosen: it only has to come near."""
ROUGH_STEP = 0.3
"""Standard deviations from its solution at which such a fit ends."""
FEWEST_FRAMES = 6
"""Fewest frames that describe a motion."""
FALL = 0.9
"""Decrease of log E between neighbouring control points of a start, as in the paper's branches."""
RAN_OFF = 4.0
"""Mean squared residual of a first fit by force alone above which it has failed. Of drawn branches,
fits that led to the solution ended at 0.9 to 1.8, diverged ones at 11 to 16, with moduli up to
fiftyfold wrong, under which a branch folds up and each simulation takes long.
"""
STIFFER = 2.0
"""Factor by which a branch that does not carry its own weight is stiffened at a time."""
MOST_DECADES = 6.0
"""Farthest search for the scale of the moduli where no force gives it."""
WORSE = 2.0
"""Increase of the objective by which following the force counts as misled by its linearisation: 20
times in the one fit seen, where a branch folded up; otherwise it decreases.
"""


def scaled_start(objective: Objective, values: Values) -> Values:
    """Scale all moduli to the measurements, so that the branch stands: by the linear response at
    rest, as displacement depends on force over modulus. Without a force some decades are tried."""
    if any(forward.is_dynamic for forward in objective.forwards):
        return _step_by_step(objective, values)
    return _scaled(objective, values)


def set_rough_keys(objective: Objective) -> None:
    """Simulate few frames of pulls with an observed path, until a fit is near its solution."""
    for forward in objective.forwards:
        if is_path_observed(forward):
            forward.set_key_count(min(ROUGH_KEYS, forward.key_count))


def set_all_keys(objective: Objective, count: int) -> None:
    """Simulate at most ``count`` frames of these pulls, from the states found so far."""
    for forward in objective.forwards:
        if is_path_observed(forward):
            forward.set_key_count(count)
    objective.forget()


def prescribed_start(objective: Objective, values: Values) -> tuple[Values, bool]:
    """Fit pulls with an observed path by force alone first, and say whether it explains them. Far
    from the solution no force explains path and points; near it both are fitted together."""
    observed = [forward for forward in objective.forwards if is_path_observed(forward)]
    if not observed:
        return values, True
    space = objective.space
    likely = space.linked(tuple((k, k - 1) for k in range(1, space.group_count)))
    counts = [forward.key_count for forward in observed]
    for forward, count in zip(observed, counts, strict=True):
        forward.is_watching = False
        forward.set_key_count(min(ROUGH_KEYS, count))
    try:
        rough = objective.with_forwards(objective.forwards).with_space(likely)
        found = gauss_newton(rough, likely.pack(values), evaluation_limit=12, tolerance=3e-2,
                             force_rounds=0, shortest=ROUGH_STEP).evaluation
        explains = found.mean_square < RAN_OFF and not _is_unbounded(found, likely)
        for forward in observed:
            forward.keep()
        if explains:
            found = _followed(rough, found, observed)
    except WorkError:
        return values, True
    finally:
        for forward, count in zip(observed, counts, strict=True):
            forward.is_watching = True
            forward.set_key_count(count)
    objective.forward_count = rough.forward_count
    return likely.unpack(found.free), explains


def _is_unbounded(found: Evaluation, space: ParameterSpace) -> bool:
    """Whether no modulus is too stiff, or too soft, for the pulls: their force may be all zero."""
    return bool(set(space.on_bound(found.free)) - {name for name, _, _ in space.priors})


def _followed(
    rough: Objective, found: Evaluation, observed: list[ObservedPathForward]
) -> Evaluation:
    """Continue the fit at the forces from a first fit, unless that is worse."""
    rough.follow_forces(found)
    at_end = rough.evaluate(found.free, jacobian=True)
    if at_end is None or at_end.objective > WORSE * found.objective:
        for forward in observed:
            forward.step_back()
        return found
    fit = gauss_newton(rough, found.free, evaluation_limit=12, tolerance=3e-2, is_near=True,
                       force_rounds=0, shortest=ROUGH_STEP)
    for forward in observed:
        forward.keep()
    return fit.evaluation


def _scaled(objective: Objective, values: Values) -> Values:
    factors = [factor for forward in objective.forwards if forward.uses_force
               and (factor := forward.force_ratio(values)) is not None]
    if factors:
        young = values.young * float(np.exp(np.mean(np.log(factors))))
        return standing(objective, replace(values, young=np.clip(young, *YOUNG_BOUNDS_PA)))
    return _scanned(objective, standing(objective, values))


def standing(objective: Objective, values: Values) -> Values:
    """Return the values with all moduli so much stiffer that the branch carries its own weight."""
    while not all(forward.stands(values) for forward in objective.forwards):
        if values.young.max() >= YOUNG_BOUNDS_PA[1]:
            break
        values = replace(values, young=np.clip(STIFFER * values.young, *YOUNG_BOUNDS_PA))
    return values


def _step_by_step(objective: Objective, values: Values) -> Values:
    """Fit the beginning of fast pulls first, then growing parts. A branch with wrong moduli
    oscillates at other frequencies, and later its phase is arbitrary. In a quarter of the frames it
    cannot be a whole period off; the result predicts the next part."""
    space = objective.space
    likely = space.linked(tuple((k, k - 1) for k in range(1, space.group_count)))
    for number, part in enumerate(PARTS):
        forwards = [forward.until(max(int(part * len(forward.frames)), FEWEST_FRAMES))
                    for forward in objective.forwards]
        short = objective.with_forwards(forwards).with_space(likely)
        if number == 0:
            values = _scaled(short, values)
        fit = gauss_newton(short, likely.pack(values), evaluation_limit=12, tolerance=1e-2,
                           force_rounds=1)
        values = likely.unpack(fit.evaluation.free)
        objective.forward_count = short.forward_count
    return values


def _scanned(objective: Objective, values: Values) -> Values:
    """Descend over decades, then halve the step: the objective has one valley along the scale.
    Moduli without equilibrium are too soft: the search begins at the first with one."""
    tried: dict[float, float | None] = {}

    def scaled(shift: float) -> Values:
        return replace(values, young=np.clip(values.young * 10**shift, *YOUNG_BOUNDS_PA))

    def cost(shift: float) -> float | None:
        if shift not in tried:
            found = objective.evaluate(objective.space.pack(scaled(shift)))
            tried[shift] = None if found is None else found.objective
        return tried[shift]

    centre, step = 0.0, 1.0
    while cost(centre) is None:
        if scaled(centre).young.max() >= YOUNG_BOUNDS_PA[1]:
            return values
        centre += step
    while step >= 0.25 and abs(centre) <= MOST_DECADES:
        best = min((known, shift) for shift in (centre, centre - step, centre + step)
                   if (known := cost(shift)) is not None)[1]
        step, centre = step / 2 if best == centre else step, best
    return scaled(centre)


def standing_start(objective: Objective, start: Values, uniform: Values, *, explains: bool = True,
                   ) -> tuple[Values, Evaluation] | None:
    """Return values near the start that have an equilibrium, and their evaluation, or None. If the
    start does not explain the pulls, it and the uniform modulus are led along the path, and the
    better is taken. At last uniform and outward softer moduli are tried under the force."""
    if explains:
        found = objective.evaluate(objective.space.pack(start), jacobian=True)
        if found is not None:
            return start, found
    found_along = [each for values in (uniform, start)
                   if (each := _along_recorded_path(objective, values)) is not None]
    if found_along:
        best = min(found_along, key=lambda each: each[1].objective)
        # Simulations continue from their last state.
        return best if best is found_along[-1] else _along_recorded_path(objective, best[0])
    index = np.arange(len(uniform.young))
    falling = np.exp(FALL * (index.mean() - index))
    return _first_standing(objective, [
        replace(uniform, young=uniform.young * factor * course)
        for factor in (1.0, 3.0, 0.3, 10.0, 0.1) for course in (falling, 1.0)])


def _along_recorded_path(objective: Objective, values: Values) -> tuple[Values, Evaluation] | None:
    """Evaluate with pulls led along their recorded paths; None: no path or no equilibrium."""
    observed = [forward for forward in objective.forwards if is_path_observed(forward)]
    if not observed or not all(forward.lead_along_path(values) for forward in observed):
        return None
    objective.forget()
    found = objective.evaluate(objective.space.pack(values), jacobian=True)
    return None if found is None else (values, found)


def _first_standing(objective: Objective, trials: list[Values],
                    ) -> tuple[Values, Evaluation] | None:
    """Return the first that has an equilibrium; the force is the measured one."""
    for trial in trials:
        for forward in objective.forwards:
            if is_path_observed(forward):
                forward.forget()
        found = objective.evaluate(objective.space.pack(trial), jacobian=True)
        if found is not None:
            return trial, found
    return None


# Errors so large that their squares matter: put right by what was fitted, then fitted again.
#
# The errors of a fit are linear. A frame of the observed points that is turned by several degrees
# is turned back, and a point that is a centimetre off along a bent branch is moved there.

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
    """Return each pull's fitted distances of its points along the branch [m]; None if they are near
    those simulated, ``known`` by the pull's name (absent: zero)."""
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


# Pulls that a fit leaves out, and how well it predicts them.


def held_out(objective: Objective, free: np.ndarray, index: int) -> tuple[float, float]:
    """RMS distance [m] of points and RMS force error [N] of one pull that was not used in a fit.
    WorkError if the pull has no equilibrium under these values."""
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
