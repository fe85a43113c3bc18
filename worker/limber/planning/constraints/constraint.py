"""Constraints on a plan in addition to the limits on energy, force and loads.

A constraint returns its limited quantity for a state of the full model. The energy field learns it
at its samples (:func:`~limber.planning.field.energy_field.knowing`), and with it the gradient and
the error that margins and proofs use. An external constraint is made from settings by a function in
:data:`~limber.planning.constraints.limits.CONSTRAINTS`.
"""

from dataclasses import dataclass
from typing import Protocol

import numpy as np


@dataclass(frozen=True)
class Broken:
    """A limit that a state of the full model breaks.

    Attributes:
        name: Name of the limit, with its unit.
        value, limit: The state's value and the requested limit.
        position: Position of the grasp there [m], shape [3].
    """

    name: str
    value: float
    limit: float
    position: np.ndarray

    def __str__(self) -> str:
        position = ", ".join(f"{x:.3f}" for x in self.position)
        return f"{self.name} {self.value:.4g} exceeds the limit {self.limit:.4g} at ({position}) m"


class Constraint(Protocol):
    """A limit on the grasp's position and the branch's shape.

    Attributes:
        name: Unique, in small letters and underscores.
        limit: Largest allowed value, above 0.
    """

    name: str
    limit: float

    def values(self, grasps: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        """Return the limited quantity of states with the grasp at ``grasps`` [k, 3] and the nodes
        at ``nodes`` [k, n, 3], both in m: never below 0, and smooth, shape [k].
        """
        ...

    def tightened(self, factor: float) -> "Constraint":
        """Return it with its limit divided by ``factor``."""
        ...

    def broken(self, grasps: np.ndarray, nodes: np.ndarray) -> str | None:
        """Describe where states break it most; None if they keep it."""
        values = self.values(grasps, nodes)
        worst = int(values.argmax())
        return str(Broken(self.name.replace("_", " "), float(values[worst]), self.limit,
                          grasps[worst])) if values[worst] > self.limit else None
