"""A task for the branch, in sizes that suit the estimated branch."""

from dataclasses import dataclass

import numpy as np

from limber.cell.cell_file import Cell, LimitsEntry
from limber.estimation.forward.gripper_path import force_for_travel
from limber.mechanics import solve_static
from limber.store import Branch
from limber.store.loading import load_grasp_model

_FORCE_MARGIN = 2.0
"""Ratio of the largest force of a path to the force that holds the flower at its goal."""
_SOFT_MARGIN, _HARD_MARGIN = 1.3, 1.5
"""Ratio of the guard's pause force to a path's force, and of its stop force to the pause force: the
measured force of a stiff branch differs from its prediction.
"""
_BEYOND = 1.5
"""Reach of the sampled energy field as a multiple of the distance to the goal."""


@dataclass(frozen=True)
class TaskSizes:
    """A goal for the flower, and the effort to hold it there by the branch's model.

    Attributes:
        target: Position of the flower, branch frame [m], shape [3].
        holding_force: [N] of the gripper.
        deflection: Displacement of the grasp, as a fraction of the branch's length up to it.
    """

    target: np.ndarray
    holding_force: float
    deflection: float

    @property
    def max_force(self) -> float:
        """Largest force of a path to it [N]."""
        return _FORCE_MARGIN * self.holding_force

    @property
    def sampled_deflection(self) -> float:
        """Required reach of the energy field, as a fraction of the length up to the grasp."""
        return min(_BEYOND * self.deflection, 1.0)

    def limited(self, cell: Cell) -> Cell:
        """Return a cell whose force limits suit the path."""
        soft = _SOFT_MARGIN * self.max_force
        limits = cell.limits.model_dump() | {"soft_force_n": soft,
                                             "hard_force_n": _HARD_MARGIN * soft}
        return cell.model_copy(update={"limits": LimitsEntry.model_validate(limits)})


def wish_for(branch: Branch, direction: np.ndarray, travel: float) -> TaskSizes:
    """Return a position for the branch's first target in which the branch can be held.

    A force along ``direction`` [3] that moves the grasp by ``travel`` [m] takes the target there;
    the branch is then bent, and neither stretched nor compressed.

    Raises:
        WorkError: no such force moves it so far.
    """
    model = load_grasp_model(branch, gravity=True)
    size = force_for_travel(model.model, model.grasp, direction, travel)
    state = solve_static(model.model, grasp=model.grasp, grasp_force=size * direction).require()
    gone = np.linalg.norm(model.pose(state.displacement)[:3] - model.rest_position)
    return TaskSizes(model.branch.target_positions(state.displacement)[0],
                     float(size * np.linalg.norm(direction)), float(gone / model.reach.arc_length))
