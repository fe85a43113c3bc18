"""The target in a region that a robot's cell gives: ``--in-view``, ``--second-arm``."""

from dataclasses import dataclass

from limber.core.errors import InputError
from limber.planning.field.grasp_model import GraspModel
from limber.planning.goals.goal import CellPlace, GoalKind, GoalRequest
from limber.planning.goals.target_goal import TargetGoal, target_of
from limber.planning.path_on_full_model import SolvedPoses


@dataclass(frozen=True, kw_only=True)
class CellGoal(TargetGoal):
    """A target in a region of the cell, at a place that does for it."""

    cell_place: CellPlace

    def require_end(self, grasp_model: GraspModel, states: SolvedPoses) -> None:
        nodes = grasp_model.mesh.nodes + states.displacements[-1]
        self.cell_place.require(self.what, self.place(states),
                                nodes[grasp_model.mesh.surface_faces()])


def _kind(name: str, entry: str) -> GoalKind:
    def made(asked: GoalRequest, _value: bool) -> CellGoal:
        if name not in asked.cell:
            raise InputError(f"--{name.replace('_', '-')} is given without a cell that has a "
                             f"{entry}.",
                             "The cell file states its position.",
                             "Give --cell with such a file.")
        place = asked.cell[name]
        return CellGoal(place.region, *target_of(asked), cell_place=place)
    return GoalKind(name, made, is_of_target=True)


IN_VIEW = _kind("in_view", "[camera] at a fixed position")
SECOND_ARM = _kind("second_arm", "[second_arm]")
