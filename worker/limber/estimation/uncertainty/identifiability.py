"""What a pull can determine; computed before the fit."""

from dataclasses import dataclass

import numpy as np

from limber.core.errors import InputError
from limber.estimation.fitting.objective import Evaluation, Objective
from limber.estimation.parameters import ParameterSpace
from limber.estimation.uncertainty.force_checks import too_little_said

UNRESOLVED_DEVIATION = 0.5
"""Deviation of a log E above which the modulus is linked to its neighbour. Chosen."""
SCALE_DEVIATION = 0.7
"""Largest deviation of the common scale of all moduli (in its logarithm) from the data: a factor of
two. Chosen, not measured.
"""


@dataclass(frozen=True)
class Identifiability:
    """Singular values of the sensitivity matrix and the resulting standard deviations.

    Attributes:
        singular_values: Singular values of the derivative of the standardised residuals to the free
            vector, largest first, shape [p].
        deviations: Standard deviation of each free value, shape [p].
        scale_deviation: Standard deviation of the common scale of all moduli.
    """

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
    """Reject data that do not determine the overall scale of Young's modulus.

    Args:
        evaluation: With derivatives.

    Raises:
        InputError: the data do not determine it; states the reason.
    """
    if found.scale_deviation <= SCALE_DEVIATION:
        return
    if any(forward.uses_force for forward in objective.forwards):
        raise too_little_said(objective, evaluation, SCALE_DEVIATION)
    raise InputError(
        "These pulls do not determine the overall scale of Young's modulus: twice as large moduli "
        f"would change the measurements by only {0.7 / found.scale_deviation:.1g} standard "
        "deviations.",
        "Without measured force, weight or inertia, a branch that moves slowly takes the same "
        "shape whether it is soft or stiff. A fit would look perfect with every modulus wrong.",
        "Record the gripper's force, or let gravity or inertia act (gravity_m_s2 in pull.toml, "
        "--motion dynamic).")


def link_unresolved(evaluation: Evaluation, space: ParameterSpace,
                    ) -> tuple[ParameterSpace, list[str]]:
    """Link control points that the data do not determine to a neighbour.

    A link is not an equality: the two may differ by a factor of ten, and the interval includes
    that. With an equality both moduli would be wrong, with intervals that are too narrow. The
    worst-determined modulus is linked to the better-known neighbour, until all others are resolved.
    Returns the space, with a sentence for each link.

    Args:
        evaluation: With derivatives; its last rows are those of the space's links.
    """
    rows = evaluation.slopes[:len(evaluation.slopes) - len(space.links)]
    links: list[tuple[int, int]] = []
    messages = []
    while len(links) < space.group_count - 1:
        own = space.linked(tuple(links)).link_rows()
        deviations = _deviations(np.vstack([rows, own]))[:space.group_count]
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
    starts.

    Sensitivities at a start that is far too soft would not show that.
    """
    for forward, sigma in zip(objective.forwards, objective.force_sigma, strict=True):
        force = forward.frames.wrenches[:, :3]
        if forward.uses_force and np.nanmax(np.abs(force), initial=0.0) > 5 * sigma:
            return True
    return False


def _deviations(jacobian: np.ndarray) -> np.ndarray:
    _, values, rows = np.linalg.svd(jacobian, full_matrices=False)
    spread = rows.T / np.maximum(values, 1e-12 * max(values[0], 1e-300))
    return np.linalg.norm(spread, axis=1)
