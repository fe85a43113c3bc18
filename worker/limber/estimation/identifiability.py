"""What a pull can tell and what not, before anything is fitted to it."""

from dataclasses import dataclass

import numpy as np

from limber.errors import InputError
from limber.estimation.objective import Evaluation
from limber.estimation.parameters import ParameterSpace

TIE_DEVIATION = 1.0
"""A modulus whose logarithm would have a larger standard deviation is tied to its neighbour."""
SCALE_DEVIATION = 0.7
"""The data must give the scale of all moduli together better than this (in its logarithm)."""


@dataclass(frozen=True)
class Identifiability:
    """Singular values of the sensitivity matrix, and what follows from them.

    Attributes:
        singular_values: Of the derivative of the standardised residuals to the free vector,
            largest first, shape [p].
        deviations: Standard deviation that each free value would have, shape [p].
        scale_deviation: That of the common scale of all moduli.
    """

    singular_values: np.ndarray
    deviations: np.ndarray
    scale_deviation: float


def identifiability(evaluation: Evaluation, space: ParameterSpace) -> Identifiability:
    """Judge the data at an evaluation with derivatives."""
    jacobian = evaluation.jacobian
    _, values, rows = np.linalg.svd(jacobian, full_matrices=False)
    spread = rows.T / np.maximum(values, 1e-12 * max(values[0], 1e-300))
    covariance = spread @ spread.T
    together = np.r_[np.ones(space.group_count), np.zeros(space.size - space.group_count)]
    # Of the scale with the ratios known: the best that the data can do for it.
    information = float(np.sum((jacobian @ together)**2))
    return Identifiability(values, np.sqrt(np.diag(covariance)),
                           float(information**-0.5) if information > 0 else np.inf)


def require_scale(found: Identifiability) -> None:
    """Refuse data that leave the overall scale of Young's modulus open.

    Raises:
        InputError: with the reason.
    """
    if found.scale_deviation <= SCALE_DEVIATION:
        return
    raise InputError(
        "These pulls do not determine the overall scale of Young's modulus: multiplying every "
        f"modulus by 2 would change what was measured by {0.7 / found.scale_deviation:.1g} "
        "standard deviations.",
        "A branch that is moved slowly, without measured force and without weight or inertia in "
        "play, takes the same shape whether it is soft or stiff: a fit would look perfect with "
        "every modulus wrong.",
        "Record the gripper's force, or let gravity or inertia act (gravity_m_s2 in pull.toml, "
        "--motion dynamic).")


def tie_unresolved(evaluation: Evaluation, space: ParameterSpace,
                   ) -> tuple[ParameterSpace, list[str]]:
    """Let control points share a modulus until the data resolve all that are left.

    The worst-determined modulus joins the neighbour whose sensitivity is most like its own.
    Returns the space, with a sentence for each tie.
    """
    messages = []
    columns, others = np.split(evaluation.jacobian.copy(), [space.group_count], axis=1)
    while space.group_count > 1:
        deviations = _deviations(np.hstack([columns, others]))[:space.group_count]
        worst = int(np.argmax(deviations))
        if deviations[worst] <= TIE_DEVIATION:
            break
        last = space.group_count - 1
        partner = worst - 1 if worst == last or (
            worst > 0 and deviations[worst - 1] >= deviations[worst + 1]) else worst + 1
        low, high = sorted((worst, partner))
        names = space.names
        messages.append(
            f"{names[worst]} cannot be told from these pulls (its logarithm only to within "
            f"{deviations[worst]:.1f}); it was tied to {names[partner]}. Pull at a point farther "
            "out, or let gravity bend the tip, to tell them apart.")
        # A common change of two logarithms acts as the sum of both.
        columns[:, low] += columns[:, high]
        columns = np.delete(columns, high, axis=1)
        space = space.tied(tuple(low if group == high else group for group in space.groups))
    return space, messages


def _deviations(jacobian: np.ndarray) -> np.ndarray:
    _, values, rows = np.linalg.svd(jacobian, full_matrices=False)
    spread = rows.T / np.maximum(values, 1e-12 * max(values[0], 1e-300))
    return np.linalg.norm(spread, axis=1)
