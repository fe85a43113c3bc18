"""The limited quantities of the field, one by one."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from limber.planning.field.energy_field import EnergyField, FieldArrays

UNITS = {"energy": "J", "force": "N", "strain": "", "stress": "Pa", "axial_force": "N",
         "torque": "Nm", "closeness": ""}
"""Built-in limited quantities; a plan's constraints bring their own."""


@dataclass(frozen=True)
class Limited:
    """A quantity of poses on the field, and its limit."""

    field: EnergyField
    name: str
    limit: float

    @property
    def words(self) -> str:
        return self.name.replace("_", " ")

    def size(self, points: np.ndarray) -> np.ndarray:
        """Return the limited quantity at ``points`` [n, 3], shape [n]."""
        if self.name == "energy":
            return self.field.energy(points)
        if self.name == "force":
            return np.linalg.norm(self.field.force(points), axis=1)
        return np.abs(self.field.load(points, self.name))

    def with_unit(self, value: float) -> str:
        """Return a value of it in words."""
        return f"{value:.3g} {UNITS.get(self.name, '')}".rstrip()


def limited(field: EnergyField, limits: FieldArrays) -> Iterator[Limited]:
    """Yield the quantities with a finite limit: energy, force, and loads."""
    of_loads = zip(field.load_names, limits.max_loads, strict=True)
    for name, limit in (("energy", limits.max_energy), ("force", limits.max_force), *of_loads):
        if limit < np.inf:
            yield Limited(field, name, float(limit))
