"""Goals of a plan, and the description of a kind of goal.

A kind stands in a file of its own beside this one; :mod:`limber.planning.goals.goal_kinds` has the
list.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from limber.planning.field.energy_field import EnergyField, FieldArrays
from limber.planning.field.grasp_model import GraspModel
from limber.planning.goals.regions import Region
from limber.planning.path_on_full_model import SolvedPoses
from limber.planning.settings import PlanSettings


class Goal(Protocol):
    """A region of grasp positions.

    Attributes:
        tolerance: The ``distance`` up to which the branch is in the goal [m].
        what: The part of the branch that is brought there, in words.
    """

    @property
    def tolerance(self) -> float: ...

    @property
    def what(self) -> str: ...

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        """Return how far off the goal the branch is with its grasp at ``points`` [m], [n]."""
        ...

    def uncertainty(self, field: EnergyField) -> float:
        """Return how much nearer than its ``distance`` the branch may be at most [m]; infinite
        where the field's error is not known."""
        ...

    def guess(self, field: EnergyField, count: int, generator: np.random.Generator) -> np.ndarray:
        """Return grasp positions likely to be in the region, shape [n, 3]."""
        ...

    def centre(self, field: EnergyField) -> np.ndarray:
        """Return one grasp position that stands for the region, the same for any seed, [3]."""
        ...

    def missed_by(self, states: SolvedPoses) -> float:
        """Return how far outside the goal the last of the states is [m]; inside: 0 or below."""
        ...

    def drawn_in(self, states: SolvedPoses) -> "Goal":
        """Return the goal to plan for where the last of the states was the end of a plan."""
        ...

    def require_end(self, grasp_model: GraspModel, states: SolvedPoses) -> None:
        """Raise NoPathError where the last of the states is in the region and does not do."""
        ...

    def describe(self) -> dict[str, Any]:
        """Return the goal as plain data: its ``kind``, and for pictures ``position_m`` [3] and
        ``tolerance_m``, a ball in it."""
        ...

    def describe_end(self, states: SolvedPoses) -> dict[str, Any]:
        """Return what a plan's summary says of where the last of the states is, as plain data."""
        ...


@dataclass(frozen=True)
class CellPlace:
    """A region given by a robot's cell.

    Attributes:
        region: Holds every place that does.
        require: Raises NoPathError where a place [3] in it does not do for something, said in
            words, while the branch's surface is where triangles [f, 3, 3] are; None: not known.
        of_surface: Whether that surface counts.
        refusal: What is said where no place does, with ``{what}``.
    """

    region: Region
    require: Callable[[str, np.ndarray, np.ndarray | None], None]
    of_surface: bool
    refusal: str


@dataclass(frozen=True)
class GoalRequest:
    """What a goal is made from.

    Attributes:
        field, grasp_model: Of the branch.
        settings: Of the plan.
        limits: Those settings' limits on the field.
        cell: What a robot's cell gives, by the names of settings.
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
        name: Of the setting that asks for it, where it is neither None nor False. A kind from
            outside brings settings of its own, a class that inherits from ``PlanSettings``.
        make: Makes the goal, given the setting's value; raises InputError or NoPathError where
            that cannot be.
        is_of_target: It is a place of the tip or of ``--target``.
        is_place: The setting's value is a place [m], which no obstacle may cover.
    """

    name: str
    make: Callable[[GoalRequest, Any], Goal]
    is_of_target: bool = False
    is_place: bool = False

    @property
    def option(self) -> str:
        return "--" + self.name.replace("_", "-")

    def is_asked(self, settings: PlanSettings) -> bool:
        """Whether the settings ask for it."""
        value = getattr(settings, self.name, None)
        return value is not None and value is not False
