"""A wind with gusts on a branch: their spectrum or a record, and the load at their peak."""

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
"""Rows that a record of the wind has at least."""
FASTEST = 150.0
"""Winds [m/s] from which on a unit is wrong."""
_MOST_STEPS = 2e6


@dataclass(frozen=True)
class WindRecord:
    """A wind as it was measured.

    Attributes:
        times: [s], ascending, shape [n].
        speeds: Along its mean direction [m/s], shape [n].
    """

    times: np.ndarray
    speeds: np.ndarray

    @classmethod
    def read(cls, path: Path) -> "WindRecord":
        """Read a CSV file with ``time_s`` and ``speed_m_s``.

        Raises:
            InputError: it cannot be read, is too short, or does not blow forward on average.
        """
        columns = read_columns(path, ("time_s", "speed_m_s"), "a wind record")
        return cls.checked(columns["time_s"], columns["speed_m_s"], str(path))

    @classmethod
    def checked(cls, times: np.ndarray, speeds: np.ndarray, what: str) -> "WindRecord":
        """Make a record of numbers from outside; ``what`` they are, for errors.

        Raises:
            InputError: as :meth:`read`.
        """
        if len(times) != len(speeds) or len(times) < LEAST_RECORD or not (
                np.diff(times) > 0).all() or not speeds.mean() > 0 or (
                not np.abs(speeds).max() < FASTEST):
            raise InputError(
                f"{what} is not a wind record.", f"A wind record has at least {LEAST_RECORD} "
                f"rows, ascending times, and a wind below {FASTEST:g} m/s that blows along --wind "
                "on average.", "Give another record.")
        if not (times[-1] - times[0]) / np.median(np.diff(times)) < _MOST_STEPS:
            raise InputError(f"{what} has gaps that are much longer than its time steps.",
                             "The record must have even time steps.",
                             "Give a part of the record without gaps.")
        return cls(times, speeds)

    def even_wind(self, direction: tuple[float, float, float]) -> tuple[float, float, float]:
        """Return the even wind [m/s] that pushes as hard as this one does on average.

        Args:
            direction: Of the wind; its length counts no more.

        Raises:
            InputError: it pushes backwards.
        """
        push = float((self.speeds * np.abs(self.speeds)).mean())
        if not push > 0:
            raise InputError("On average the recorded wind blows against --wind.", "",
                             "Reverse --wind.")
        x, y, z = map(float, np.sqrt(push) * np.array(direction) / np.linalg.norm(direction))
        return x, y, z


@dataclass(frozen=True)
class Turbulence:
    """Gusts by their spectrum; see :func:`~limber.mechanics.loads.gust_response.turbulent`.

    Attributes:
        intensity: Standard deviation of the speed over its mean.
        length: Turbulent length scale [m].
        seconds: For which the peak is expected.
    """

    intensity: float
    length: float = 27.0
    seconds: float = 600.0


Gusts = WindRecord | Turbulence


def blown(direction: tuple[float, float, float], gusts: Gusts | None,
          ) -> tuple[float, float, float]:
    """Return the even wind [m/s] about which gusts swing: of a record its own.

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
    """Return the loads at the peak of gusts, by how the tip sways, and what is told of them.

    Args:
        outdoors: The branch under the even wind, see :func:`blown`.
        gusts: Of that wind.
        damping: Of the wood.

    Returns:
        The loads, and ``factor`` (peak load over mean load), ``deviation``, ``peak_factor``,
        ``crossing_hz``, ``dynamic`` (over a branch that follows at once), ``damping`` of the
        first mode, ``first_frequency_hz``, ``mean_speed_m_s`` and ``mean_tip_displacement_m``.

    Raises:
        WorkError: the branch finds no rest under the even wind.
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
