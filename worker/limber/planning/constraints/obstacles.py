"""Obstacles to branch and gripper: boxes and closed surfaces."""

from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np

from limber.cell.obstacles import Obstacle, closest

# Constraints on a plan in addition to the limits on energy, force and loads.
#
# A constraint returns its limited quantity for a state of the full model. The energy field learns
# it at its samples (:func:`~limber.planning.field.energy_field.knowing`), and with it the gradient
# and the error that margins and proofs use. An external constraint is made from settings by a
# function in :data:`~limber.planning.constraints.limits.CONSTRAINTS`.


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


_SCALE = 0.1  # [m] in which closeness falls to a third


@dataclass(frozen=True)
class Obstacles(Constraint):
    """Bodies that the branch must not touch.

    The limited quantity is the closeness, ``exp(-d / 0.1 m)`` of the clearance d: 1 where the
    branch touches a body, more inside; smooth for a planner's field.
    """

    @classmethod
    def keeping(cls, bodies: tuple[Obstacle, ...], clearance: float) -> "Obstacles":
        """Return the constraint to stay ``clearance`` [m] away from bodies."""
        return cls(bodies, float(np.exp(-clearance / _SCALE)))

    @property
    def clearance(self) -> float:
        """Clearance kept from the bodies [m]."""
        return -_SCALE * float(np.log(self.limit))

    bodies: tuple[Obstacle, ...]
    limit: float = 1.0
    name = "closeness"

    def values(self, grasps: np.ndarray, nodes: np.ndarray) -> np.ndarray:
        return np.array([np.exp(-min(float(body.clearance(each).min()) for body in self.bodies)
                                / _SCALE) for each in nodes])

    def tightened(self, factor: float) -> "Obstacles":
        return replace(self, limit=self.limit / factor)

    def broken(self, grasps: np.ndarray, nodes: np.ndarray) -> str | None:
        kept = self.clearance
        if (hit := closest(self.bodies, nodes.reshape(-1, 3), kept)) is None:
            return None
        name, depth, where = hit
        position = ", ".join(f"{x:.3f}" for x in where)
        if depth < kept:
            return (f"the branch is {1e3 * (kept - depth):.1f} mm away from {name} at ({position}) "
                    f"m, less than the clearance of {1e3 * kept:.1f} mm")
        return f"the branch is {1e3 * (depth - kept):.1f} mm inside {name} at ({position}) m"


