"""The target where the cell's second arm can take it: ``--second-arm``."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from limber.core.errors import InputError
from limber.planning.field.grasp_model import GraspModel
from limber.planning.goals.goal import GoalKind, GoalRequest
from limber.planning.goals.target import TargetGoal, target_of
from limber.planning.path_on_full_model import SolvedPoses


@dataclass(frozen=True, kw_only=True)
class TakenGoal(TargetGoal):
    """A target in the arm's reach; ``require`` raises NoPathError where it cannot take one."""

    require: Callable[[np.ndarray], None]

    def require_end(self, grasp_model: GraspModel, states: SolvedPoses) -> None:
        self.require(self.place(states))


def _taken(asked: GoalRequest) -> TakenGoal:
    if "second_arm" not in asked.cell:
        raise InputError("--second-arm is given, but no cell with a [second_arm].",
                         "The cell file says where it stands.", "Give --cell with one.")
    place = asked.cell["second_arm"]
    return TakenGoal(place.region, *target_of(asked), require=place.require)


SECOND_ARM = GoalKind("second_arm", _taken, is_of_target=True)
