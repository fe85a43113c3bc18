"""Effects of outdoor loads on a branch and their uncertainty from its moduli: sag, strain over
strength, frequencies, and the factor on these loads that it bears.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError, Option, Text, WorkError
from limber.core.files.tables import read_columns
from limber.core.progress import SILENT, Progress
from limber.mechanics.loads.outdoor import Bent, LoadedOutdoors, recorded, turbulent
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.statics.result import StaticResult

_NORMAL_95 = 1.96
_BISECTIONS = 7
_STEP = 1.3
"""Factor around the estimated limit within which that of a softer or stiffer branch is sought."""
_LEAST = 1e-3
"""Fraction of the loads below which the limit is not refined."""
_NOT_KNOWN = {"sag_interval_m": None, "greatest_strain_interval": None,
              "first_frequency_interval_hz": None, "bears_times_interval": None}


def tip_node(outdoors: LoadedOutdoors) -> int:
    """Return the mesh's node at the end of the main path that is not cut off."""
    skeleton, nodes = outdoors.skeleton, outdoors.unloaded.mesh.nodes
    path = [node for node in skeleton.main_path() if not outdoors.gone[node]]
    return int(np.linalg.norm(nodes - skeleton.nodes[path[-1]], axis=1).argmin())


def required_rest(outdoors: LoadedOutdoors) -> StaticResult:
    """Return the equilibrium of the branch under all of its loads. WorkError if no equilibrium was
    found."""
    found = outdoors.rest()
    if not found.converged:
        raise WorkError(Text("The branch has no equilibrium under these loads (", found.message,
                             ")."), f"It could carry {100 * found.reached:.0f} % of them.",
                        "The loads may exceed what it can carry. Use ", Option("limit_load", True),
                        " with smaller loads.")
    return found


def load_effects(outdoors: LoadedOutdoors, *, strain_limit: float, deviation: float | None,
                 most: float | None = None, progress: Progress = SILENT,
                 ) -> tuple[Bent, dict[str, Any]]:
    """Return the equilibrium under the loads, and the stage's values, with 95 % intervals of a
    branch that is softer or stiffer throughout (``deviation`` of log E; None: none). ``most`` is
    the largest factor on the loads that is tried. WorkError if there is no equilibrium."""
    gravity = outdoors.unloaded.gravity
    down = gravity / max(float(np.linalg.norm(gravity)), 1e-300)
    tip = tip_node(outdoors)

    def figures(bent: Bent) -> dict[str, float]:
        return {"sag_m": float(bent.displacement[tip] @ down),
                "greatest_strain": float(bent.strains.max()),
                "first_frequency_hz": float(bent.frequencies[0])}
    progress(0.0, "equilibrium under the loads")
    bent = outdoors.bent(required_rest(outdoors))
    own = figures(bent)
    result: dict[str, Any] = _NOT_KNOWN | {
        "tip_displacement_m": bent.displacement[tip], "sag_m": own["sag_m"],
        "greatest_strain": own["greatest_strain"],
        "strain_over_limit": own["greatest_strain"] / strain_limit,
        "along": outdoors.along(bent.strains), "frequencies_hz": bent.frequencies,
        "wind_force_n": outdoors.wind_force, "cut_mass_kg": outdoors.cut_mass,
        "added_mass_kg": outdoors.added_mass, "young_deviation": deviation}
    others = {} if deviation is None else {
        factor: outdoors.with_young(factor)
        for factor in np.exp(np.array([-_NORMAL_95, _NORMAL_95]) * deviation).tolist()}
    progress(0.3, "interval")
    rests = [(other, other.rest()) for other in others.values()]
    if rests and all(found.converged for _, found in rests):
        ends = [figures(other.bent(found)) for other, found in rests]
        result |= {name: sorted(end[key] for end in ends) for name, key in (
            ("sag_interval_m", "sag_m"), ("greatest_strain_interval", "greatest_strain"),
            ("first_frequency_interval_hz", "first_frequency_hz"))}
    if most is not None:
        result |= _limits(outdoors, others, strain_limit, most, progress.part(0.5, 1.0))
    return bent, result


def _limits(outdoors: LoadedOutdoors, others: dict[float, LoadedOutdoors], strain_limit: float,
            most: float, progress: Progress) -> dict[str, Any]:
    """The factor on the loads that the branch bears, and that of a softer and a stiffer one."""
    def trouble_of(loaded: LoadedOutdoors) -> Callable[[float], str]:
        def trouble(share: float) -> str:
            progress(0.5, "limit load")
            found = loaded.rest(share)
            if not found.converged:
                return "equilibrium"
            return "strain" if loaded.greatest_strain(found) > strain_limit else ""
        return trouble
    times, why = _limit(trouble_of(outdoors), 1.0, 2.0, most)
    result: dict[str, Any] = {"bears_times": times, "held_by": why or "nothing"}
    if others:
        # At the same fraction of the loads, strain is about proportional to 1/E.
        result["bears_times_interval"] = sorted(
            _limit(trouble_of(other), min(times * factor, most), _STEP, most)[0]
            for factor, other in others.items())
    return result


def _limit(trouble: Callable[[float], str], guess: float, step: float, most: float,
           ) -> tuple[float, str]:
    """Bisect the fraction of the loads at which failure begins, and return its kind; below ``most``
    there may be none."""
    low = high = guess
    why = trouble(guess)
    if why:
        low = guess / step
        while low > _LEAST and (found := trouble(low)):
            low, high, why = low / step, low, found
        low = low if low > _LEAST else 0.0
    while not why and high < most:
        low, high = high, min(step * high, most)
        why = trouble(high)
    if not why:
        return most, ""
    for _ in range(_BISECTIONS):
        middle = (low + high) / 2
        if found := trouble(middle):
            high, why = middle, found
        else:
            low = middle
    return low, why


# A gusty wind on a branch: a spectrum or a record, and the load at the peak of the gusts.

LEAST_RECORD = 16
"""Fewest rows of a wind record."""
FASTEST = 150.0
"""Winds [m/s] above this indicate a wrong unit."""
_MOST_STEPS = 2e6
_LEAST_STEP = 1e-5  # [s]; hot wires take 1e5 readings a second at most
_CALM = 0.01  # [m/s]


@dataclass(frozen=True)
class WindRecord:
    """A measured wind: speeds [n] [m/s] along the mean direction at ascending times [s]."""

    times: np.ndarray
    speeds: np.ndarray

    @classmethod
    def read(cls, path: Path) -> "WindRecord":
        """Read a CSV file with ``time_s`` and ``speed_m_s``. InputError if it cannot be read, is
        too short, or has no forward mean speed."""
        columns = read_columns(path, ("time_s", "speed_m_s"), "a wind record")
        return cls.checked(columns["time_s"], columns["speed_m_s"], str(path))

    @classmethod
    def checked(cls, times: np.ndarray, speeds: np.ndarray, what: str) -> "WindRecord":
        """Make a record of external numbers; ``what`` names them in error messages. InputError as
        for :meth:`read`."""
        if len(times) != len(speeds) or len(times) < LEAST_RECORD or not (
                np.diff(times) >= _LEAST_STEP).all() or not speeds.mean() >= _CALM or (
                not np.abs(speeds).max() < FASTEST):
            raise InputError(
                f"{what} is not a wind record.",
                Text(f"A wind record has at least {LEAST_RECORD} rows, ascending times at least "
                     f"{_LEAST_STEP:g} s apart, and a wind below {FASTEST:g} m/s that blows along ",
                     Option("wind"), f" with {_CALM:g} m/s or more on average."),
                "Give another record.")
        if not (times[-1] - times[0]) / np.median(np.diff(times)) < _MOST_STEPS:
            raise InputError(f"{what} has gaps that are much longer than its time steps.",
                             "The record must have even time steps.",
                             "Give a part of the record without gaps.")
        return cls(times, speeds)

    def even_wind(self, direction: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return the steady wind [m/s] of the same mean pressure along a direction of any length.
        InputError if the mean pressure is backwards."""
        push = float((self.speeds * np.abs(self.speeds)).mean())
        if not push > 0:
            raise InputError(
                Text("On average the recorded wind blows against ", Option("wind"), "."), "",
                "Reverse ", Option("wind"), ".")
        x, y, z = map(float, np.sqrt(push) * np.array(direction) / np.linalg.norm(direction))
        return x, y, z


@dataclass(frozen=True)
class Turbulence:
    """Gusts by their spectrum: deviation over mean of the speed, length scale [m] (default: EN
    1991-1-4, 2 m above open land; among trees about their height), and time of the peak [s]."""

    intensity: float
    length: float = 27.0
    seconds: float = 600.0


Gusts = WindRecord | Turbulence


def blown(direction: tuple[float, float, float], gusts: Gusts | None,
          ) -> tuple[float, float, float]:
    """Return the steady wind [m/s] about which the gusts vary; a record has its own. InputError if
    there are gusts without a wind, or a record is against it."""
    if gusts is not None and not np.any(direction):
        raise InputError("Gusts are given without a wind.", "Gusts need a wind with a direction.",
                         "Give ", Option("wind"), " X Y Z.")
    return gusts.even_wind(direction) if isinstance(gusts, WindRecord) else direction


def with_peak(outdoors: LoadedOutdoors, gusts: Gusts, damping: RayleighDamping,
              ) -> tuple[LoadedOutdoors, dict[str, Any]]:
    """Return the loads at the peak of gusts of the steady wind, from the sway of the tip, and the
    reported values. WorkError if there is no equilibrium under the steady wind."""
    mean, tip = required_rest(outdoors), tip_node(outdoors)
    sway = outdoors.sways(mean, tip, damping)
    if isinstance(gusts, WindRecord):
        speed = float(gusts.speeds.mean())
        found = recorded(sway, gusts.times, gusts.speeds)
    else:
        speed = float(np.linalg.norm(outdoors.wind))
        found = turbulent(sway, speed, gusts.intensity, gusts.length, gusts.seconds)
    return outdoors.with_gusts(found.factor), {
        "factor": found.factor, "deviation": found.deviation, "peak_factor": found.peak_factor,
        "crossing_hz": found.crossing, "dynamic": found.dynamic,
        "damping": float(sway.damping[0]), "first_frequency_hz": float(sway.frequencies[0]),
        "mean_speed_m_s": speed, "mean_tip_displacement_m": mean.displacement[tip]}
