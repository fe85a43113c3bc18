"""Goals of a plan, and the description of a kind of goal.

Each kind has its own file beside this one; :mod:`limber.planning.goals.goal_kinds` has the list.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from limber.core.errors import NoPathError
from limber.planning.field.energy_field import EnergyField, FieldArrays
from limber.planning.field.grasp_model import GraspModel
from limber.planning.goals.regions import Region, position_text
from limber.planning.path_on_full_model import SolvedPoses
from limber.planning.settings import PlanSettings

NEARER = "Choose a goal nearer to this region, raise --goal-tolerance"
"""Advice for a ball that nothing reaches."""


class Goal(Protocol):
    """A region of grasp positions.

    Attributes:
        tolerance: Largest ``distance`` at which the branch is in the goal [m].
        what: The part of the branch to be brought there, in words.
        where: Where it is brought, in words, after "brings it".
        advice: What a user may change if nothing reaches it, a clause.
    """

    @property
    def tolerance(self) -> float: ...

    @property
    def what(self) -> str: ...

    @property
    def where(self) -> str: ...

    @property
    def advice(self) -> str: ...

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        """Return the branch's distance from the goal with its grasp at ``points`` [m], [n]."""
        ...

    def uncertainty(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        """Return how much nearer than its ``distance`` the branch may be at most with its grasp at
        ``points`` [m], shape [n]; infinite if the field's error is not known.
        """
        ...

    def guess(self, field: EnergyField, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return grasp positions that are probably in the region, shape [n, 3]."""
        ...

    def centre(self, field: EnergyField) -> np.ndarray:
        """Return one representative grasp position of the region, the same for any seed, [3]."""
        ...

    def missed_by(self, states: SolvedPoses) -> float:
        """Return how far outside the goal the last state is [m]; inside: 0 or below."""
        ...

    def drawn_in(self, states: SolvedPoses) -> "Goal":
        """Return the goal to plan for next if the last state was the end of a plan."""
        ...

    def require_end(self, grasp_model: GraspModel, states: SolvedPoses) -> None:
        """Raise NoPathError if the last state is in the region and is not valid."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the goal as plain data: its ``kind``, and for pictures ``position_m`` [3] and
        ``tolerance_m``, a ball in it."""
        ...

    def describe_end(self, states: SolvedPoses) -> dict[str, Any]:
        """Return the plan summary's entries about the last state, as plain data."""
        ...


@dataclass(frozen=True)
class CellPlace:
    """A region given by a robot's cell.

    Attributes:
        region: Contains every valid position.
        blocked: Why a position [3] in it is not valid while the branch's surface is at triangles
            [f, 3, 3] (None: not known), as a clause; empty if it is valid.
        of_surface: Whether that surface counts.
        words: The region in words, after "within".
        refusal: Sentence without full stop if no position is valid, with ``{what}``.
        advice: What a user may change then, a clause.
    """

    region: Region
    blocked: Callable[[np.ndarray, np.ndarray | None], str]
    of_surface: bool
    words: str
    refusal: str
    advice: str

    def require(self, what: str, position: np.ndarray, surface: np.ndarray | None) -> None:
        """Raise NoPathError if ``position`` [3] is not valid for something, given in words."""
        if cause := self.blocked(position, surface):
            raise NoPathError(
                f"{self.refusal.format(what=what)} at the end of the path: {cause}.",
                f"{what[0].upper()}{what[1:]} is at {position_text(position)} m there.",
                f"{self.advice}.")


@dataclass(frozen=True)
class GoalRequest:
    """Inputs from which a goal is made.

    Attributes:
        field, grasp_model: Field and model of the branch.
        settings: Settings of the plan.
        limits: Those settings' limits on the field.
        cell: Data of a robot's cell, by the names of settings.
    """

    field: EnergyField
    grasp_model: GraspModel
    settings: PlanSettings
    limits: FieldArrays
    cell: Mapping[str, CellPlace]


@dataclass(frozen=True)
class GoalKind:
    """A kind of goal.

    Attributes:
        name: Name of the setting that requests it, if neither None nor False. An external kind
            brings settings of its own, a class that inherits from ``PlanSettings``.
        make: Makes the goal, given the setting's value; raises InputError or NoPathError if it
            cannot.
        is_of_target: Whether it is a position of the tip or of ``--target``.
        is_place: Whether the setting's value is a position [m], which no obstacle may cover.
    """

    name: str
    make: Callable[[GoalRequest, Any], Goal]
    is_of_target: bool = False
    is_place: bool = False

    @property
    def option(self) -> str:
        return "--" + self.name.replace("_", "-")

    def is_asked(self, settings: PlanSettings) -> bool:
        """Whether the settings request it."""
        value = getattr(settings, self.name, None)
        return value is not None and value is not False
