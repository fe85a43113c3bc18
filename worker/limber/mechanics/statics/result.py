"""Settings and result of a static solve."""

from dataclasses import dataclass, field
from enum import StrEnum

import numpy as np

from limber.core.errors import ConvergenceError, Text

# Status at the end of a static or dynamic solve.


class Status(StrEnum):
    """Each value is its own text, for files and messages; only a converged result is valid.

    converged: a stable equilibrium, or all frames of a motion, with no element inverted.
    stalled: step control gave up.
    torn: stretched over the limit.
    inverted: an element would be turned inside out.
    unstable: in equilibrium, but not stable.
    false_equilibrium: stable, but not the equilibrium that small steps from rest lead to.
    """

    converged = "converged"
    stalled = "stalled"
    torn = "torn"
    inverted = "inverted"
    unstable = "unstable"
    false_equilibrium = "false_equilibrium"


@dataclass(frozen=True)
class StaticSettings:
    """Settings of the search for equilibrium.

    Attributes:
        tolerance: Residual force relative to the loads and reactions, but not below round-off.
        max_iterations: Most Newton iterations per step.
        max_step: Longest predicted motion per step, as a fraction of the branch's extent.
        min_step: Smallest step, as a fraction of the path, before the solve fails.
        total_iterations: Most Newton iterations in all before the solve fails.
        stretch_limit: Principal stretch above which the branch counts as torn.
        mixed: Mixed-integration-point Newton (St. Venant-Kirchhoff only); else Newton with
            line search.
        verify: Solve again from rest in small steps and compare energies; a difference is
            reported as a false equilibrium.
        snap: Whether the branch snaps to another equilibrium where a path of stable ones ends.
        way_back: Whether a snapped branch is followed back, to report if it ends elsewhere.
        keeps_factor: Whether an existing factorisation is used for further steps while each removes
            most of the imbalance. The stability of every state along the path is then checked.
    """

    tolerance: float = 1e-7
    max_iterations: int = 20
    max_step: float = 0.4
    min_step: float = 1 / 512
    total_iterations: float = float("inf")
    stretch_limit: float = 2.0
    mixed: bool = True
    verify: bool = False
    snap: bool = True
    way_back: bool = True
    keeps_factor: bool = False


DEFAULT_SETTINGS = StaticSettings()


@dataclass(frozen=True)
class StaticResult:
    """A static state, and how it was found.

    Attributes:
        status: How the solve ended. If it has not converged, the state is the last equilibrium
        along the path.
        displacement: [m], shape [node_count, 3].
        pose: Pose of the grasp in this state [m, rad], shape [6] ([g, 6] for several), or None.
        strain_energy: Energy of the strain relative to the model's mesh [J].
        energy: Potential of strain and weight relative to the model's mesh [J]; for a branch
            prestressed by its weight (BranchModel.as_scanned), relative to that state. Its gradient
            with respect to the pose is the gripper's wrench.
        reaction_force, reaction_torque: Force and torque of the gripper on the branch [N, Nm], the
            torque about the pose's position; shape [3] ([g, 3] for several grasps).
        base_force, base_torque: Force and torque of the base on the branch; the torque about the
        origin.
        min_det_f: Smallest determinant of the deformation gradient.
        iterations, residual_history: Total Newton iterations, relative residuals.
        reached: Fraction of the path that was covered.
        snapped_at: Fractions of the path at which no stable equilibrium was near and the branch
            snapped to another one.
        message: What happened and where.
        warnings: Warnings for the user.
        doubt: Why the state may not be the only stable one of this grasp; empty if there is no sign
            of another. Found by following the path back after a snap.
    """

    status: Status
    displacement: np.ndarray
    pose: np.ndarray | None
    strain_energy: float
    energy: float
    reaction_force: np.ndarray
    reaction_torque: np.ndarray
    base_force: np.ndarray
    base_torque: np.ndarray
    min_det_f: float
    iterations: int
    residual_history: list[float]
    seconds: float
    reached: float = 1.0
    message: str = ""
    warnings: list[str] = field(default_factory=list)
    snapped_at: list[float] = field(default_factory=list)
    uncertainty: str = ""

    @property
    def converged(self) -> bool:
        """Whether it is a stable equilibrium under the target loads with no inverted element."""
        return self.status is Status.converged

    def require(self) -> "StaticResult":
        """Return the result itself.

        Raises:
            ConvergenceError: the result has not converged.
        """
        if not self.converged:
            raise ConvergenceError(Text("No equilibrium: ", self.message), "The last valid state "
                                   f"is at {100 * self.reached:.0f} % of the path.", "Use a "
                                   "smaller motion or load, or check units and Young's modulus.",
                                   result=self)
        return self
