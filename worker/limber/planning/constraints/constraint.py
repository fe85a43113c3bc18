"""Constraints on a plan in addition to the limits on energy, force and loads.

A constraint says what it is on in a state of the full model. The energy field learns that at its
samples (:func:`~limber.planning.field.energy_field.knowing`), and with it the gradient and the
error that margins and proofs count on. One from outside is made from settings by a function in
:data:`~limber.planning.constraints.limits.CONSTRAINTS`.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Broken:
    """A limit that a state of the full model breaks.

    Attributes:
        name: Which, with its unit.
        value, limit: The state's and what was asked.
        position: Of the grasp there [m], shape [3].
    """

    name: str
    value: float
    limit: float
    position: np.ndarray

    def __str__(self) -> str:
        place = ", ".join(f"{x:.3f}" for x in self.position)
        return f"{self.name} {self.value:.4g} exceeds the limit {self.limit:.4g} at ({place}) m"


class Constraint(Protocol):
    """A limit on the grasp's place and the branch's shape.

    Attributes:
        name: No other's, in small letters and underscores.
        limit: What its value may not exceed, above 0.
    """

    name: str
    limit: float

    def values(self, grasps: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return what is limited in states with the grasp at ``grasps`` [k, 3] and the nodes at
        ``nodes`` [k, n, 3], both in m: never below 0, and smooth, shape [k]."""
        ...

    def tightened(self, factor: float) -> "Constraint":
        """Return it with its limit divided by ``factor``."""
        ...

    def broken(self, grasps: np.ndarray, nodes: np.ndarray) -> str | None:
        """Describe where states break it most; None where they keep it."""
        values = self.values(grasps, nodes)
        worst = int(values.argmax())
        return str(Broken(self.name.replace("_", " "), float(values[worst]), self.limit,
                          grasps[worst])) if values[worst] > self.limit else None
