"""Settings and result of a static solve."""

from dataclasses import dataclass, field

import numpy as np

from limber.core.errors import ConvergenceError
from limber.mechanics.solve_status import Status


@dataclass(frozen=True)
class StaticSettings:
    """Settings of the search for equilibrium.

    Attributes:
        tolerance: Residual force relative to the loads and reactions. The floor that round-off
            sets is respected.
        max_iterations: Newton iterations a step.
        max_step: Longest predicted motion a step, as part of the branch's extent.
        min_step: Smallest part of the whole way that is tried before giving up.
        total_iterations: Newton iterations in all before giving up.
        stretch_limit: Principal stretch at which the branch is taken as torn.
        mixed: Mixed-integration-point Newton (St. Venant-Kirchhoff only); else Newton with
            line search.
        verify: Solve again from rest in small steps and compare energies; a difference is
            reported as a false equilibrium.
        snap: Where a path of stable equilibria ends, let the branch snap to another one.
        way_back: Where it snapped, walk back and say whether it ends elsewhere.
        keeps_factor: Take further steps with a factor that is at hand, as long as each takes off
            most of the imbalance; every state that is passed is then asked whether it is stable.
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
        status: How the solve ended. If not converged, the state is the last good one on the way.
        displacement: [m], shape [node_count, 3].
        pose: Pose of the grasp in this state [m, rad], shape [6] ([g, 6] for several), or None.
        strain_energy: Of the strain since the model's mesh [J].
        energy: Potential of strain and weight above the model's mesh [J]: above the hanging state
            of a branch that hangs as it was scanned (BranchModel.as_scanned). Its gradient to the
            pose is what the gripper exerts.
        reaction_force, reaction_torque: What the gripper exerts on the branch [N, Nm], the
            torque about the pose's position; shape [3] ([g, 3] for several grasps).
        base_force, base_torque: What the base exerts on the branch; the torque about the origin.
        min_det_f: Smallest determinant of the deformation gradient.
        iterations, residual_history: Newton iterations in all, relative residuals.
        reached: Part of the way that was covered.
        snapped_at: Parts of the way at which no stable equilibrium was near and the branch
            snapped to another one.
        message: What happened, where.
        warnings: What a user should know.
        doubt: Why it may not be the only stable state of its hold, empty where nothing speaks for
            that; found by walking the way back where the branch snapped.
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
        """Whether it is a stable equilibrium under the wanted loads, with no element inverted."""
        return self.status is Status.converged

    def require(self) -> "StaticResult":
        """Return the result itself.

        Raises:
            ConvergenceError: it has not converged.
        """
        if not self.converged:
            raise ConvergenceError(
                f"No equilibrium: {self.message}",
                f"The last valid state is at {100 * self.reached:.0f} % of the path.",
                "Use a smaller motion or load, or check units and Young's modulus.",
                result=self)
        return self
