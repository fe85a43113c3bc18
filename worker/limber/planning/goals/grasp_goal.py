"""The grasp at a position: ``--goal``."""

from dataclasses import dataclass

import numpy as np

from limber.planning.field.energy_field import EnergyField
from limber.planning.field.grasp_model import GraspModel
from limber.planning.goals.goal import NEARER, GoalKind
from limber.planning.goals.regions import ball, position_text
from limber.planning.path_on_full_model import SolvedPoses


@dataclass(frozen=True)
class GraspGoal:
    """The grasp within ``tolerance`` [m] of ``position`` [m]."""

    position: tuple[float, float, float]
    tolerance: float

    what = "the grasp"
    advice = NEARER

    @property
    def where(self) -> str:
        return f"within {self.tolerance:.3f} m of {position_text(self.position)} m"

    def distance(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        return np.linalg.norm(np.asarray(points) - self.position, axis=1)

    def uncertainty(self, field: EnergyField, points: np.ndarray) -> np.ndarray:
        return np.zeros(len(points))

    def guess(self, field: EnergyField, count: int, generator: np.random.Generator) -> np.ndarray:
        inside = ball(count, generator) * self.tolerance + self.position
        inside[0] = self.position
        return inside

    def centre(self, field: EnergyField) -> np.ndarray:
        return np.array(self.position, float)

    def missed_by(self, states: SolvedPoses) -> float:
        return float(np.linalg.norm(states.poses[-1, :3] - self.position)) - self.tolerance

    def drawn_in(self, states: SolvedPoses) -> "GraspGoal":
        return self

    def require_end(self, grasp_model: GraspModel, states: SolvedPoses) -> None:
        pass

    def describe(self) -> dict:
        return {"kind": "grasp", "position_m": list(map(float, self.position)),
                "tolerance_m": self.tolerance}

    def describe_end(self, states: SolvedPoses) -> dict:
        return {}


def near(position: np.ndarray, tolerance: float) -> GraspGoal:
    """Return the goal of a grasp within ``tolerance`` [m] of ``position`` [3]."""
    x, y, z = map(float, position)
    return GraspGoal((x, y, z), tolerance)


AT_PLACE = GoalKind(
    "goal", lambda asked, place: near(place, asked.settings.goal_tolerance), is_place=True)
