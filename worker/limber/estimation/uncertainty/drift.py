"""Differences of the modulus between recordings, and its change from day to day.

Each pull alone gives a step of the common scale of all moduli, known to within its own noise and
errors. A branch that dries stiffens, one that grows too; the steps over the days show it.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime

import numpy as np
from typing_extensions import TypedDict

from limber.estimation.fitting.objective import Evaluation, Objective

_DAY_S = 86400.0
_WIDEST = 1.0  # half width of the interval of a stated rate: a factor of e a day


@dataclass(frozen=True)
class ScaleStep:
    """Step of the common log E by which a pull differs from all, with variance from its noise and
    own errors."""

    pull: int
    step: float
    variance: float


class PullModulus(TypedDict):
    """A pull's modulus over the joint one, with its 95 % interval, and when it was recorded."""

    pull: str
    recorded: str | None
    factor: float
    interval: tuple[float, float]


class Drift(TypedDict):
    """Relative change of all moduli per day, with its 95 % interval."""

    per_day: float
    interval: tuple[float, float]


def scale_steps(evaluation: Evaluation, objective: Objective, scale: float) -> list[ScaleStep]:
    """Return the step of each pull that determines one; ``scale`` is the measurements' variance
    over the stated one."""
    found, group_count = [], objective.space.group_count
    for number, piece in enumerate(objective.raw_slopes(evaluation)):
        others = [piece.errors] + ([] if piece.response is None else [piece.response])
        taken = np.vstack([np.hstack(others), np.eye(piece.errors.shape[1], sum(
            each.shape[1] for each in others))])
        basis = np.linalg.qr(taken)[0]
        along, off = (np.concatenate([each, np.zeros(piece.errors.shape[1])]) for each in (
            piece.free[:, :group_count].sum(axis=1), piece.residual))
        along, off = (each - basis @ (basis.T @ each) for each in (along, off))
        information = float(along @ along)
        if information > 0:
            found.append(ScaleStep(number, -float(along @ off) / information,
                                   scale / information))
    return found


def pull_moduli(steps: Sequence[ScaleStep], objective: Objective) -> list[PullModulus]:
    """Return each pull's modulus relative to that of all pulls."""
    found: list[PullModulus] = []
    for each in steps:
        entry, wide = objective.forwards[each.pull].entry, 1.96 * each.variance**0.5
        low, high = np.exp(np.clip([each.step - wide, each.step + wide], -35.0, 35.0))
        found.append({"pull": objective.forwards[each.pull].name, "recorded": entry.recorded,
                      "factor": float(np.exp(np.clip(each.step, -35.0, 35.0))),
                      "interval": (float(low), float(high))})
    return found


def drift(steps: Sequence[ScaleStep], recorded: Sequence[str | None], spread: float,
          ) -> Drift | None:
    """Return the change per day by weighted regression over times (ISO 8601); None without two, or
    if they do not determine it. ``spread`` is that of log E between recordings of one day."""
    times = [None if each is None else datetime.fromisoformat(each).timestamp() / _DAY_S
             for each in recorded]
    known = [(step, time) for step, time in zip(steps, times, strict=True) if time is not None]
    if len({time for _, time in known}) < 2:
        return None
    days = np.array([time for _, time in known]) - known[0][1]
    deviation = np.sqrt([step.variance + spread**2 for step, _ in known])
    rows = np.column_stack([np.ones(len(days)), days]) / deviation[:, None]
    rate = float(np.linalg.lstsq(rows, np.array([step.step for step, _ in known]) / deviation,
                                 rcond=None)[0][1])
    wide = 1.96 * float(np.sqrt(np.linalg.inv(rows.T @ rows)[1, 1]))
    if wide > _WIDEST:
        return None
    return {"per_day": float(np.expm1(rate)),
            "interval": (float(np.expm1(rate - wide)), float(np.expm1(rate + wide)))}
