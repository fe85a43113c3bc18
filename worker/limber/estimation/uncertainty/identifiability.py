"""What a pull can determine; computed before the fit."""

import copy
from dataclasses import dataclass

import numpy as np

from limber.core.errors import InputError, Option
from limber.estimation.fitting.objective import Evaluation, Objective, inverse_information
from limber.estimation.parameters import ParameterSpace
from limber.recordings.recording import calibration_of

# Why a measured force does not determine the scale of Young's modulus.

POORER = ((1.0, 0.1), (0.1, 1.0), (0.1, 0.1), (1.0, 0.01), (0.01, 1.0), (0.01, 0.01))
"""Factors on the stated noise, and on zero and drift, that are tried."""

def too_little_said(objective: Objective, evaluation: Evaluation, limit: float) -> InputError:
    """Return why recorded forces leave the scale of the moduli open: the deviation of log E must be
    below ``limit``."""
    forwards = [forward for forward in objective.forwards if forward.uses_force]
    peaks = [float(np.nanmax(np.linalg.norm(forward.frames.wrenches[:, :3], axis=1)))
             for forward in forwards]
    largest = int(np.argmax(peaks))
    forward = forwards[largest]
    if peaks[largest] == 0:
        return InputError(f"{forward.name}: the recorded force is zero in all frames.",
                          "Then the branch would not have moved.",
                          "Record the gripper's force, and import the recording again.")
    known, noise = calibration_of(forward.entry), forward.entry.sensor.force_sigma_n
    seen = (f"{forward.name}: the force was recorded, up to {peaks[largest]:.3g} N, but it does "
            "not determine the overall scale of Young's modulus.")
    for by_noise, by_zero in POORER:
        deviation = _scale_deviation(objective, evaluation, by_noise, by_zero)
        if deviation > limit:
            continue
        errors = f"noise {noise:g} N, zero {known.force_bias_sigma_n:.3g} N, drift " \
                 f"{known.force_drift_sigma_n:.3g} N"
        better = [f"the noise to {by_noise * noise:.2g} N (force_sigma_n under [sensor])"
                  ] * (by_noise < 1) + [
                      f"zero and drift to {by_zero * known.force_bias_sigma_n:.2g} N "
                      "(force_bias_sigma_n and force_drift_sigma_n under [calibration])"
                      ] * (by_zero < 1)
        return InputError(
            seen, f"It is small against its assumed errors (standard deviations: {errors}). If you "
            f"know {' and '.join(better)}, the scale is known to {100 * deviation:.0f} %.",
            f"State the true ones in pulls/{forward.name}/pull.toml, or import the recording with ",
            Option("force_sigma"), " and ", Option("pull_toml"), ". Or pull farther.")
    return InputError(
        seen, "Even with a hundredth of its assumed errors it would not: in the simulation the "
        "force hardly depends on the modulus.",
        "Check the columns and the unit of the force, and the grasp point. Then import the "
        "recording again.")


def _scale_deviation(objective: Objective, evaluation: Evaluation, by_noise: float,
                     by_zero: float) -> float:
    """Standard deviation of the common log E with other errors of the force."""
    forwards, sigmas = [], []
    for forward, sigma in zip(objective.forwards, objective.force_sigma, strict=True):
        other, known = copy.copy(forward), calibration_of(forward.entry)
        other.entry = forward.entry.model_copy(update={
            "calibration": known.model_copy(update={
                "force_bias_sigma_n": by_zero * known.force_bias_sigma_n,
                "force_drift_sigma_n": by_zero * known.force_drift_sigma_n}),
            "sensor": forward.entry.sensor.model_copy(update={
                "force_sigma_n": by_noise * forward.entry.sensor.force_sigma_n})})
        forwards.append(other)
        sigmas.append(by_noise * sigma)
    again = Objective(forwards, objective.space, force_sigma=sigmas).compare(
        evaluation.free, list(evaluation.pulls))
    along = again.slopes[:, :objective.space.group_count].sum(axis=1)
    information = float(along @ along)
    return information**-0.5 if information > 0 else np.inf


UNRESOLVED_DEVIATION = 0.5
"""Deviation of a log E above which the modulus is linked to its neighbour. Chosen."""
SCALE_DEVIATION = 0.7
"""Largest deviation of the common scale of all moduli (in its logarithm) from the data: a factor of
two. Chosen, not measured.
"""


@dataclass(frozen=True)
class Identifiability:
    """Singular values [p], largest first, of standardised residuals to free values, deviations [p],
    and that of the moduli's common scale."""

    singular_values: np.ndarray
    deviations: np.ndarray
    scale_deviation: float


def identifiability(evaluation: Evaluation, space: ParameterSpace) -> Identifiability:
    """Compute the identifiability at an evaluation with derivatives."""
    jacobian = evaluation.slopes
    values = np.linalg.svd(jacobian, compute_uv=False)
    together = np.r_[np.ones(space.group_count), np.zeros(space.size - space.group_count)]
    # Deviation of the scale if the ratios are known: the best possible from the data.
    information = float(np.sum((jacobian @ together)**2))
    return Identifiability(values, evaluation.deviations,
                           float(information**-0.5) if information > 0 else np.inf)


def require_scale(found: Identifiability, objective: Objective, evaluation: Evaluation) -> None:
    """Reject data that do not determine the moduli's scale. InputError says why."""
    if found.scale_deviation <= SCALE_DEVIATION:
        return
    if any(forward.uses_force for forward in objective.forwards):
        raise too_little_said(objective, evaluation, SCALE_DEVIATION)
    raise InputError("These pulls do not determine the overall scale of Young's modulus: twice as "
                     "large moduli would change the measurements by only "
                     f"{0.7 / found.scale_deviation:.1g} standard deviations.", "Without measured "
                     "force, weight or inertia, a branch that moves slowly takes the same shape "
                     "whether it is soft or stiff. A fit would look perfect with every modulus "
                     "wrong.", "Record the gripper's force, or let gravity or inertia act "
                     "(gravity_m_s2 in pull.toml, ", Option("motion", "dynamic"), ").")


def link_unresolved(evaluation: Evaluation, space: ParameterSpace,
                    ) -> tuple[ParameterSpace, list[str]]:
    """Link the moduli that the data leave open to better-known neighbours, the worst first, until
    all others are resolved; a sentence for each link. The two may differ tenfold: as equal, both
    would be wrong, with intervals too narrow."""
    rows = evaluation.slopes[:len(evaluation.slopes) - len(space.links)]
    links: list[tuple[int, int]] = []
    messages = []
    while len(links) < space.group_count - 1:
        own = space.linked(tuple(links)).link_rows()
        deviations = np.diag(inverse_information(np.vstack([rows, own])))[:space.group_count]**0.5
        open_ones = deviations.copy()
        open_ones[[group for group, _ in links]] = 0.0
        worst = int(np.argmax(open_ones))
        if open_ones[worst] <= UNRESOLVED_DEVIATION:
            break
        beside = [k for k in (worst - 1, worst + 1)
                  if 0 <= k < space.group_count and (k, worst) not in links]
        if not beside:
            break
        partner = min(beside, key=lambda k: deviations[k])
        links.append((worst, partner))
        messages.append(
            f"These pulls do not determine {space.names[worst]} well: the standard deviation of "
            f"its logarithm is {min(deviations[worst], 99.0):.1f}. The fit therefore assumes that "
            f"it is within a factor of ten of {space.names[partner]}. To determine it, pull at a "
            "point farther out, prescribe the pose, or let gravity bend the tip.")
    return space.linked(tuple(links)), messages


def force_is_measured(objective: Objective) -> bool:
    """Whether the measured force is well above its noise: it determines the scale wherever a fit
    starts. Sensitivities at a start that is far too soft would not show that."""
    for forward, sigma in zip(objective.forwards, objective.force_sigma, strict=True):
        force = forward.frames.wrenches[:, :3]
        if forward.uses_force and np.nanmax(np.abs(force), initial=0.0) > 5 * sigma:
            return True
    return False
