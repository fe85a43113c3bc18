"""What a tree planner is asked: start, goals, cost, and how long and how wide to search."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from limber.planning.cost import EdgeWeights
from limber.planning.field.energy_field import EnergyField, FieldArrays


@dataclass(frozen=True)
class PathProblem:
    """A start, goals and a cost.

    Attributes:
        start: Grasp position [m], shape [3].
        goals: Allowed positions in the goal region, shape [g, 3].
        in_goal: Whether positions [n, 3] are in the goal region, bool [n].
        energy_field: The energy field.
        limits: The same with limits on energy and force, for compiled loops.
        weights: The cost of an edge.
    """

    start: np.ndarray
    goals: np.ndarray
    in_goal: Callable[[np.ndarray], np.ndarray]
    energy_field: EnergyField
    limits: FieldArrays
    weights: EdgeWeights

    @property
    def low(self) -> np.ndarray:
        """Lower corner of the box to search [m], shape [3]."""
        return self.energy_field.region.low

    @property
    def high(self) -> np.ndarray:
        """Upper corner of the box to search [m], shape [3]."""
        return self.energy_field.region.high

    @property
    def diagonal(self) -> float:
        """Diagonal of that box [m]."""
        return float(np.linalg.norm(self.high - self.low))


@dataclass(frozen=True)
class Search:
    """How long and how wide to search.

    Attributes:
        iterations: Samples drawn.
        reach: Longest edge, as a fraction of the box's diagonal.
        goal_bias: Share of samples that are drawn from the goal region.
        shortcuts: Attempts to shorten the found path.
        seed: Of all that is random.
    """

    iterations: int = 5000
    reach: float = 0.25
    goal_bias: float = 0.05
    shortcuts: int = 400
    seed: int = 0
