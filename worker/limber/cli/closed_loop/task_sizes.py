"""What somebody wants of the branch, in measures that suit the branch as it is estimated."""

from dataclasses import dataclass

import numpy as np

from limber.estimation.gripper_path import force_for_travel
from limber.mechanics import solve_static
from limber.robot.cell.cell import Cell, LimitsEntry
from limber.store import Branch
from limber.store.loading import load_grasp_model

_FORCE_MARGIN = 2.0
"""So many times the force that holds the flower in its goal a path may need on the way."""
_SOFT_MARGIN, _HARD_MARGIN = 1.3, 1.5
"""The guard pauses at the first times a path's force, and stops at the second times that: what is
felt of a stiff branch differs from what is predicted."""
_BEYOND = 1.5
"""So many times as far as the goal the energy field is sampled."""


@dataclass(frozen=True)
class Wish:
    """A place for the flower, and what it takes to hold it there by the branch's model.

    Attributes:
        place: Of the flower, branch frame [m], shape [3].
        holding_force: [N] of the gripper.
        deflection: How far the grasp goes, as a share of the branch's length up to it.
    """

    place: np.ndarray
    holding_force: float
    deflection: float

    @property
    def max_force(self) -> float:
        """What a path to it may need [N]."""
        return _FORCE_MARGIN * self.holding_force

    @property
    def sampled_deflection(self) -> float:
        """How far the energy field has to reach, as a share of the length up to the grasp."""
        return min(_BEYOND * self.deflection, 1.0)

    def limited(self, cell: Cell) -> Cell:
        """Return a cell whose force limits suit the path."""
        soft = _SOFT_MARGIN * self.max_force
        limits = cell.limits.model_dump() | {"soft_force_n": soft,
                                             "hard_force_n": _HARD_MARGIN * soft}
        return cell.model_copy(update={"limits": LimitsEntry.model_validate(limits)})


def wish_for(branch: Branch, way: np.ndarray, travel: float) -> Wish:
    """Return a place for the branch's first target that the branch can be held in.

    It is where a force along ``way`` [3] takes it that moves the grasp by ``travel`` [m]: there
    the branch is bent, and neither stretched nor pushed together.

    Raises:
        WorkError: no such force moves it so far.
    """
    model = load_grasp_model(branch, gravity=True)
    size = force_for_travel(model.model, model.grasp, way, travel)
    state = solve_static(model.model, grasp=model.grasp, grasp_force=size * way).require()
    gone = np.linalg.norm(model.pose(state.displacement)[:3] - model.rest_position)
    return Wish(model.branch.target_positions(state.displacement)[0],
                float(size * np.linalg.norm(way)), float(gone / model.reach.arc_length))
