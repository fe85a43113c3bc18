"""A gusty wind on a branch: a spectrum or a record, and the load at the peak of the gusts."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import InputError
from limber.core.files.reading import read_columns
from limber.mechanics.loads.gust_response import recorded, turbulent
from limber.mechanics.loads.load_effects import required_rest, tip_node
from limber.mechanics.loads.outdoor import LoadedOutdoors
from limber.mechanics.materials.materials import RayleighDamping

LEAST_RECORD = 16
"""Fewest rows of a wind record."""
FASTEST = 150.0
"""Winds [m/s] above this indicate a wrong unit."""
_MOST_STEPS = 2e6
_LEAST_STEP = 1e-5  # [s]; hot wires take 1e5 readings a second at most
_CALM = 0.01  # [m/s]


@dataclass(frozen=True)
class WindRecord:
    """A measured wind.

    Attributes:
        times: [s], ascending, shape [n].
        speeds: Speeds along the mean direction [m/s], shape [n].
    """

    times: np.ndarray
    speeds: np.ndarray

    @classmethod
    def read(cls, path: Path) -> "WindRecord":
        """Read a CSV file with ``time_s`` and ``speed_m_s``.

        Raises:
            InputError: it cannot be read, is too short, or has no forward mean speed.
        """
        columns = read_columns(path, ("time_s", "speed_m_s"), "a wind record")
        return cls.checked(columns["time_s"], columns["speed_m_s"], str(path))

    @classmethod
    def checked(cls, times: np.ndarray, speeds: np.ndarray, what: str) -> "WindRecord":
        """Make a record of external numbers; ``what`` names them in error messages.

        Raises:
            InputError: as for :meth:`read`.
        """
        if len(times) != len(speeds) or len(times) < LEAST_RECORD or not (
                np.diff(times) >= _LEAST_STEP).all() or not speeds.mean() >= _CALM or (
                not np.abs(speeds).max() < FASTEST):
            raise InputError(
                f"{what} is not a wind record.", f"A wind record has at least {LEAST_RECORD} "
                f"rows, ascending times at least {_LEAST_STEP:g} s apart, and a wind below "
                f"{FASTEST:g} m/s that blows along --wind with {_CALM:g} m/s or more on average.",
                "Give another record.")
        if not (times[-1] - times[0]) / np.median(np.diff(times)) < _MOST_STEPS:
            raise InputError(f"{what} has gaps that are much longer than its time steps.",
                             "The record must have even time steps.",
                             "Give a part of the record without gaps.")
        return cls(times, speeds)

    def even_wind(self, direction: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return the steady wind [m/s] with the same mean pressure as this one.

        Args:
            direction: Direction of the wind; its length is ignored.

        Raises:
            InputError: the mean pressure is backwards.
        """
        push = float((self.speeds * np.abs(self.speeds)).mean())
        if not push > 0:
            raise InputError("On average the recorded wind blows against --wind.", "",
                             "Reverse --wind.")
        x, y, z = map(float, np.sqrt(push) * np.array(direction) / np.linalg.norm(direction))
        return x, y, z


@dataclass(frozen=True)
class Turbulence:
    """Gusts given by their spectrum; see :func:`~limber.mechanics.loads.gust_response.turbulent`.

    Attributes:
        intensity: Standard deviation of the speed over its mean.
        length: Turbulent length scale [m].
        seconds: Duration for which the peak is expected.
    """

    intensity: float
    length: float = 27.0
    seconds: float = 600.0


Gusts = WindRecord | Turbulence


def blown(direction: tuple[float, float, float], gusts: Gusts | None,
          ) -> tuple[float, float, float]:
    """Return the steady wind [m/s] about which the gusts vary; a record has its own.

    Raises:
        InputError: gusts without a wind, or a record against it.
    """
    if gusts is not None and not np.any(direction):
        raise InputError("Gusts are given without a wind.",
                         "Gusts need a wind with a direction.",
                         "Give --wind X Y Z.")
    return gusts.even_wind(direction) if isinstance(gusts, WindRecord) else direction


def with_peak(outdoors: LoadedOutdoors, gusts: Gusts, damping: RayleighDamping,
              ) -> tuple[LoadedOutdoors, dict[str, Any]]:
    """Return the loads at the peak of gusts, from the sway of the tip, and the reported values.

    Args:
        outdoors: The branch under the steady wind, see :func:`blown`.
        gusts: Gusts of that wind.
        damping: Damping of the wood.

    Returns:
        The loads, and ``factor`` (peak load over mean load), ``deviation``, ``peak_factor``,
        ``crossing_hz``, ``dynamic`` (relative to a quasi-static branch), ``damping`` of the first
        mode, ``first_frequency_hz``, ``mean_speed_m_s`` and ``mean_tip_displacement_m``.

    Raises:
        WorkError: the branch finds no equilibrium under the steady wind.
    """
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
