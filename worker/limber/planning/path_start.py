"""The start of a path: at rest, at a given position, or drawn."""

import numpy as np

from limber.core.errors import InputError, NoPathError
from limber.planning.constraints.limits import Limits
from limber.planning.field.energy_field import EnergyField, FieldArrays
from limber.planning.goals.allowed_poses import allowed_points, over_limits, unit_hint
from limber.planning.goals.goal import Goal
from limber.planning.settings import PlanSettings


def start_of(field: EnergyField, goal: Goal, settings: PlanSettings) -> np.ndarray:
    """Return the requested start [m], shape [3].

    Raises:
        InputError: two are requested. NoPathError: none could be drawn.
    """
    if settings.start is not None and settings.start_seed is not None:
        raise InputError("Both --start and --start-seed are given.",
                         "A path has only one start.", "Give only one of them.")
    if settings.start is not None:
        return np.array(settings.start, float)
    if settings.start_seed is not None:
        return random_start(field, goal, settings, settings.start_seed)
    return field.rest.copy()


def random_start(field: EnergyField, goal: Goal, settings: PlanSettings, seed: int) -> np.ndarray:
    """Return a random deformed configuration far from rest and from the goal, shape [3].

    The paper's trials start from "randomized initial configurations", without stating how they were
    drawn. Here: uniform over the allowed region, at least half the largest deflection away from
    rest and from the goal's middle, and a quarter of it from its border.

    Raises:
        NoPathError: no such configuration was found.
    """
    generator = np.random.default_rng([seed, 7])
    points = field.region.draw(4000, generator)
    half = 0.5 * float(np.linalg.norm(field.samples.positions - field.rest, axis=1).max())
    fit = np.linalg.norm(points - field.rest, axis=1) >= half
    away = goal.distance(field, points)
    fit &= (away >= half) & (away >= goal.tolerance + 0.5 * half)
    fit &= allowed_points(points, Limits.of(settings).on(field))
    if not fit.any():
        raise NoPathError("No allowed deformed start is far from rest and far from the goal.",
                          f"The distance must be at least {half:.3f} m.",
                          "Give a --start, or relax the limits.")
    return points[np.flatnonzero(fit)[0]]


def check_start(field: EnergyField, start: np.ndarray, limits: FieldArrays) -> None:
    """Raise InputError if the start [3] is not allowed, with the reason."""
    if allowed_points(start[None], limits)[0]:
        return
    position = ", ".join(f"{value:.3f}" for value in start)
    if not field.region.contains(start)[0]:
        away = float(np.linalg.norm(start - field.rest))
        raise InputError(f"The start ({position}) m lies outside the sampled region"
                         f"{unit_hint(away, field)}.",
                         "The branch's energy is not known there.",
                         "Choose a start nearer to rest, or sample farther (`limber energy "
                         "--deflection`).")
    raise InputError(f"The start breaks a limit: {over_limits(field, start[None], limits)}.",
                     "A start must keep the limits.", "Raise the limit, or choose another start.")
