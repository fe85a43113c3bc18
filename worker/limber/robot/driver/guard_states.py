"""States, decisions and settings of the guard."""

from dataclasses import dataclass, field
from enum import Enum
from typing import Any

import numpy as np

from limber.cell.cell_file import Cell, LimitsEntry, WorkspaceEntry
from limber.robot.driver.expected_force import ForceErrors, kept_share


class State(Enum):
    """What the guard currently allows."""

    IDLE = "idle"
    MOVING = "moving"
    PAUSED = "paused"
    STOPPED = "stopped"


class Verdict(Enum):
    """Action to take after a sample."""

    GO = "go"
    PAUSE = "pause"
    STOP = "stop"


@dataclass(frozen=True)
class Decision:
    """A verdict and its reason."""

    verdict: Verdict
    reason: str = ""
    value: float = 0.0
    limit: float = 0.0

    def __str__(self) -> str:
        if self.limit:
            return f"{self.reason} ({self.value:.3g}, allowed {self.limit:.3g})"
        return self.reason

GO = Decision(Verdict.GO)


@dataclass(frozen=True)
class GuardSettings:
    """Limits of the guard.

    Attributes:
        limits: Limits of the cell. The guard reduces them to what the arm's table allows.
        workspace: Box that contains the grasp, branch frame, or None.
        joint_limits: [rad], shape [6, 2].
        longest_silence: Age at which data is lost [s].
        frozen_time: Longest time for which a wrench may repeat to the last digit [s]; a working
            sensor's noise never does.
        filter_time: Time constant of the force that is compared with the predicted one [s]. The
            hard limits apply to every single reading.
        off_path: Largest distance from the target [m].
        errors: Errors of the measured force; its noise until that is measured at rest.
        loss_time: Time in which such a loss counts as sudden [s].
        largest_torque_error: Largest difference between the torque and the predicted one [N m].
        relief_distance: Path of a retreat over which a force above the soft limit falls by more
            than its noise [m].
        relief_time: The same for a slow retreat [s].
    """

    limits: LimitsEntry
    joint_limits: np.ndarray
    workspace: WorkspaceEntry | None = None
    errors: ForceErrors = field(
        default_factory=lambda: ForceErrors(noise=0.05, drift=0.8 / 60.0, inertia=0.0))
    longest_silence: float = 0.05
    frozen_time: float = 0.05
    filter_time: float = 0.01
    off_path: float = 0.01
    loss_time: float = 0.5
    largest_torque_error: float = 1.0
    relief_distance: float = 0.02
    relief_time: float = 10.0

    @classmethod
    def of_cell(cls, cell: Cell, rate: float, **others: Any) -> "GuardSettings":
        """Return the settings for a cell whose arm sends ``rate`` samples a second."""
        kept = kept_share(1.0 / rate, cls.filter_time)
        return cls(cell.limits, cell.joint_limits, cell.workspace, ForceErrors.of_cell(cell, kept),
                   **others)


@dataclass
class Relief:
    """Progress of a retreat in reducing the values that exceeded their limits.

    Attributes:
        force, torque: Least values since it began [N], [N m].
        excess: Least excess over each limit of the arm's position.
        marked_force, marked_clock, marked_grasp: Start of the next measurement of a fall.
    """

    force: float
    torque: float
    excess: dict[str, float] = field(default_factory=dict)
    marked_force: float = np.inf
    marked_clock: float = -np.inf
    marked_grasp: np.ndarray | None = None


@dataclass
class GuardMemory:
    """The guard's record of the last samples."""

    clock: float | None = None
    raw: np.ndarray | None = None
    frozen_since: float = 0.0
    filtered: np.ndarray | None = None
    peak: float = 0.0
    largest_expected: float = 0.0
    usual_off: np.ndarray | None = None
    grasp: np.ndarray | None = None
    travel: np.ndarray | None = None
    relief: Relief | None = None
    by_joints: bool = False


SAFETY_MODES = {
    2: "reduced mode: the controller holds other limits", 3: "protective stop", 4: "recovery mode",
    5: "safeguard stop", 6: "emergency stop", 7: "emergency stop", 8: "safety violation",
    9: "safety fault", 10: "joints to be identified", 11: "undefined safety mode",
    12: "safeguard stop of the automatic mode", 13: "three-position enabling stop"}
"""Names of the controller's safety modes in which nothing may move."""
