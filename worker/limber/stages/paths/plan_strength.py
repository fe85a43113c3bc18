"""Data of a plan on the strain that breaks the branch."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError, Option, Text
from limber.core.progress import Progress
from limber.mechanics.materials.materials import SAFETY
from limber.planning.constraints.damage import (
    ASSUMED_SOURCE,
    Strength,
    assumed,
    assumed_strain,
    read_break_tests,
)
from limber.planning.constraints.limits import Limits
from limber.planning.path_on_full_model import ResolvedPath
from limber.planning.settings import PlanSettings
from limber.store import Branch


def strength_for(branch: Branch, settings: PlanSettings, break_tests: Path | None,
                 ) -> Strength | None:
    """Return the strength from the user's break tests, else from --wood, else None; InputError if
    the tests cannot be used, or --max-damage is given without a strength."""
    deviation = _radius_deviation(branch)
    if break_tests is not None:
        return Strength.of_tests(read_break_tests(break_tests), str(break_tests), deviation)
    if settings.wood is not None:
        return Strength.of_species(settings.wood, deviation)
    if settings.max_damage is not None:
        raise InputError(
            Text(Option("max_damage"), " is given, but the branch's strength is not known."), "It "
            "is the probability that the largest strain breaks the branch.", "Also give ",
            Option("break_tests"), ", a CSV of strains at break, or ", Option("wood"), ".")
    return None


def with_damage(limits: Limits, settings: PlanSettings, strength: Strength | None,
                young: float = 0.0) -> Limits:
    """Return the limits, the strain's reduced to the allowed probability of damage; where neither
    is limited, to half of the strain at which half of such branches break, known or assumed by the
    branch's median modulus ``young`` [Pa]."""
    if settings.max_damage is not None and strength is not None:
        most = strength.strain_limit(settings.max_damage)
    elif np.isfinite(limits.strain):
        return limits
    else:
        most = (strength.median if strength else assumed_strain(young) or np.inf) / SAFETY
    return replace(limits, strain=min(limits.strain, most))


def default_limit(limits: Limits, settings: PlanSettings, strength: Strength | None) -> str:
    """Return what limits the strain where the user gave no limit; empty if nothing does."""
    if not np.isfinite(limits.strain) or settings.max_strain or settings.max_damage or (
            settings.wood):
        return ""
    source = ASSUMED_SOURCE if strength is None else strength.source
    return Text(f"The strain is limited to {100 * limits.strain:.2g} %, half of that at which half "
                f"of such branches break ({source}). ", Option("max_strain"), " sets another "
                "limit.")


def strength_of_plan(strength: Strength | None, plan: ResolvedPath,
                     in_motion: dict[str, Any] | None, progress: Progress) -> dict[str, Any]:
    """Return the assessment of a plan's largest strain by a known strength, or that of green wood;
    warn if it exceeds a known one."""
    states = plan.ahead
    at = int(states.strains.argmax())
    peak = float(states.strains[at])
    moving = ((in_motion or {}).get("peaks") or {}).get("strain")
    peak = max(peak, float(moving["moving"])) if moving else peak
    assessment = assumed(peak) if strength is None else strength.describe(peak)
    assessment |= {"place_m": states.strain_places[at], "grasp_m": states.poses[at, :3],
                   "over": peak > assessment["median_strain"]}
    if assessment["over"] and strength is not None:
        progress.warn(f"The largest strain along the plan is {peak:.2g}, "
                      f"{peak / assessment['median_strain']:.1f} times that at which half of such "
                      f"branches break ({assessment['median_strain']:.2g}, "
                      f"{assessment['source']}). Lower it with ", Option("max_damage"), ".")
    return assessment


def _radius_deviation(branch: Branch) -> float:
    """Return the relative deviation of the branch's radius by its reconstruction; 0 if unknown."""
    stage = branch.manifest.stages.get("reconstruct")
    result = {} if stage is None else stage.result
    sigma = result.get("radius_sigma_median_m")
    if not sigma:
        return 0.0
    return float(sigma) / (0.5 * (float(result["radius_min_m"]) + float(result["radius_max_m"])))
