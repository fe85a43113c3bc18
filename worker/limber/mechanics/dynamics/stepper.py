"""What the schemes of implicit steps in time have in common."""

from abc import ABC, abstractmethod

import numpy as np

from limber.core.present import present
from limber.mechanics.dynamics.drive import Drive
from limber.mechanics.dynamics.motion import MotionSettings
from limber.mechanics.linear.equations import Tangent, Viscous
from limber.mechanics.motion_state import MotionState
from limber.mechanics.solve_status import Status


class Stepper(ABC):
    """Takes steps, and keeps the tangent of the last.

    Attributes:
        iteration_count: So far.
        status, trouble: Why the last step failed.
        tangent: The last step was solved with; None before the first.
    """

    def __init__(self, drive: Drive, settings: MotionSettings):
        self.drive, self.settings = drive, settings
        self.model, self.equations = drive.model, drive.equations
        self.iteration_count = 0
        self.status, self.trouble = Status.converged, ""
        self.tangent: Tangent | None = None

    def forget_tangent(self) -> None:
        """Use the last tangent no more."""
        self.tangent = None

    @abstractmethod
    def viscous(self, old: MotionState, dt: float) -> Viscous | None:
        """Return the viscous part of a step of ``dt`` from ``old``; None where there is none."""

    @abstractmethod
    def step(self, old: MotionState, dt: float, viscous: Viscous | None) -> MotionState | None:
        """Return the state ``dt`` after ``old``, or None where it is not found."""

    def _is_balanced(self, norm: float, reference: float) -> bool:
        """Whether a residual is small, over the forces or beside what is round-off."""
        # Differences of displacements in an element carry round-off of about one unit each.
        tangent = present(self.tangent, "tangent")
        floor = 8 * float(np.finfo(float).eps) * tangent.diagonal_norm * self.model.mean_edge
        return norm <= max(self.settings.tolerance * reference, floor)

    def _change(self, residual: np.ndarray, moved: np.ndarray | None,
                pins: np.ndarray) -> np.ndarray:
        """Return what the tangent answers to a residual, with what held nodes are ``moved`` by."""
        change = present(self.tangent, "tangent").solve(residual, pins)
        return change if moved is None or not self.equations.held.any() else change + moved

    def _failed(self, trouble: str, status: Status = Status.stalled) -> None:
        self.trouble, self.status = trouble, status
