"""What the implicit time integration schemes have in common."""

from abc import ABC, abstractmethod

import numpy as np

from limber.core.not_none import present
from limber.mechanics.dynamics.drive import Drive
from limber.mechanics.dynamics.motion import MotionSettings
from limber.mechanics.linear.equations import Tangent, Viscous
from limber.mechanics.motion_state import MotionState
from limber.mechanics.solve_status import Status


class Stepper(ABC):
    """Takes steps and keeps the tangent of the last one.

    Attributes:
        iteration_count: Iterations so far.
        status, trouble: Reason for the failure of the last step.
        tangent: Tangent of the last solve; None before the first.
    """

    def __init__(self, drive: Drive, settings: MotionSettings):
        self.drive, self.settings = drive, settings
        self.model, self.equations = drive.model, drive.equations
        self.iteration_count = 0
        self.status, self.trouble = Status.converged, ""
        self.tangent: Tangent | None = None

    def forget_tangent(self) -> None:
        """Discard the last tangent."""
        self.tangent = None

    @abstractmethod
    def viscous(self, old: MotionState, dt: float) -> Viscous | None:
        """Return the viscous part of a step of ``dt`` from ``old``; None if there is none."""

    @abstractmethod
    def step(self, old: MotionState, dt: float, viscous: Viscous | None) -> MotionState | None:
        """Return the state ``dt`` after ``old``, or None if it is not found."""

    def _is_balanced(self, norm: float, reference: float) -> bool:
        """Whether a residual is small relative to the forces or to round-off."""
        # Differences of displacements in an element carry a round-off error of about one unit each.
        tangent = present(self.tangent, "tangent")
        floor = 8 * float(np.finfo(float).eps) * tangent.diagonal_norm * self.model.mean_edge
        return norm <= max(self.settings.tolerance * reference, floor)

    def _change(self, residual: np.ndarray, moved: np.ndarray | None,
                pins: np.ndarray) -> np.ndarray:
        """Return the tangent's response to a residual and to the motion ``moved`` of held nodes."""
        change = present(self.tangent, "tangent").solve(residual, pins)
        return change if moved is None or not self.equations.held.any() else change + moved

    def _failed(self, trouble: str, status: Status = Status.stalled) -> None:
        self.trouble, self.status = trouble, status
