"""Settings, states and results of a motion."""

from dataclasses import dataclass, field

import numpy as np
from scipy.linalg import eigh

from limber.core.errors import ConvergenceError, InputError, Text
from limber.mechanics.linear.equations import Tangent
from limber.mechanics.model import BranchModel, MotionState
from limber.mechanics.statics.result import Status

# Lowest natural frequencies and modes about an equilibrium.

_SPARE = 4
_ITERATIONS = 60
_TOLERANCE = 1e-6


@dataclass(frozen=True)
class Modes:
    """Small undamped free vibrations: ascending frequencies [k] [Hz], and shapes [k, node_count, 3]
    of unit modal mass [kg^-1/2]."""

    frequencies: np.ndarray
    shapes: np.ndarray


def lowest_modes(model: BranchModel, count: int, displacement: np.ndarray | None = None) -> Modes:
    """Return the lowest modes about an equilibrium (None: the mesh's shape), by subspace iteration
    (Bathe). NotPositiveDefiniteError if unstable, ConvergenceError if it does not converge."""
    at = np.zeros_like(model.mesh.nodes) if displacement is None else displacement
    tangent = model.equations(()).tangent(model, at)
    vectors = np.random.default_rng(0).standard_normal((count + _SPARE, *model.mesh.nodes.shape))
    vectors[:, model.fixed] = 0.0
    before = np.zeros(count)
    for _ in range(_ITERATIONS):
        squares, vectors = subspace_round(model, tangent, vectors)
        if np.abs(squares[:count] - before).max() <= _TOLERANCE * squares[:count].max():
            return Modes(np.sqrt(squares[:count]) / (2 * np.pi), vectors[:count])
        before = squares[:count]
    raise ConvergenceError(f"The {count} lowest modes did not converge in {_ITERATIONS} "
                           "iterations.",
                           "They may lie very close together.", "Request fewer modes.")


def subspace_round(model: BranchModel, tangent: Tangent, vectors: np.ndarray,
                   ) -> tuple[np.ndarray, np.ndarray]:
    """Iterate the subspace [k, node_count, 3] once (Bathe, Rayleigh-Ritz): squared angular
    frequencies [1/s^2], ascending, and their modes of unit modal mass."""
    pushed = np.array([model.mass_times(vector) for vector in vectors])
    vectors = np.array([tangent.solve(force) for force in pushed])
    flat = vectors.reshape(len(vectors), -1)
    stiffness = flat @ pushed.reshape(len(vectors), -1).T
    mass = flat @ np.array([model.mass_times(vector).ravel() for vector in vectors]).T
    squares, mix = eigh((stiffness + stiffness.T) / 2, (mass + mass.T) / 2)
    return squares, np.tensordot(mix.T, vectors, axes=1)


@dataclass(frozen=True)
class MotionSettings:
    """Settings of a motion, common to all schemes.

    Attributes:
        max_step: Longest time step [s]; longer intervals between frames are divided evenly.
        min_step: Shortest step [s] tried before the solve is abandoned.
        tolerance: Residual force relative to loads, reactions and inertia.
        max_iterations: Most iterations of a step.
        stretch_limit: Principal stretch above which the branch counts as torn.
    """

    max_step: float = 1 / 60
    min_step: float = 1 / 60 / 256
    tolerance: float = 1e-5
    max_iterations: int = 20
    stretch_limit: float = 2.0

    def __post_init__(self) -> None:
        if not self.max_step > 0:
            raise InputError(f"The time step is {self.max_step} s.", "It must be positive.",
                             "Use a hundredth of the slowest vibration's period, or less.")


@dataclass(frozen=True)
class EnergyMomentumSettings(MotionSettings):
    """The energy-momentum scheme: it creates no energy at any amplitude and step.

    The residual of a step does work, so the tolerance is stricter than Newmark's.
    """

    tolerance: float = 1e-6


@dataclass(frozen=True)
class NewmarkSettings(MotionSettings):
    """The paper's scheme: exact in energy for small motion; large swings can diverge.

    Attributes:
        beta, gamma: Newmark's parameters; gamma above 1/2 damps high frequencies.
        keep_factor: Relative residual below which the last factorisation is reused, also in the
            first solve of the next step; 0 factorises each time.
    """

    beta: float = 0.25
    gamma: float = 0.5
    keep_factor: float = 0.01

    def __post_init__(self) -> None:
        super().__post_init__()
        if not (0 < self.beta <= 0.5 and 0.5 <= self.gamma <= 1):
            raise InputError(
                f"Newmark's beta is {self.beta} and gamma is {self.gamma}.",
                "beta must be in (0, 1/2], gamma in [1/2, 1].",
                "Keep 1/4 and 1/2 unless you want to damp high frequencies.")


@dataclass(frozen=True)
class DynamicSensitivities:
    """Derivatives along a motion by the p parameters of ``labels``: of the followed nodes [frames,
    nodes, 3, p] [m], and of forces [frames, 3, p] ([frames, g, 3, p] for several) [N]."""

    labels: list[str]
    displacement: np.ndarray
    reaction_force: np.ndarray


@dataclass(frozen=True)
class DynamicResult:
    """A motion.

    Attributes:
        status: Status at the end. If not converged, the arrays end with the last good frame.
        times: [s], shape [frames].
        displacement: [m], shape [frames, node_count, 3].
        strain_energy, kinetic_energy: [J], shape [frames].
        energy: Potential of strain and weight, as in StaticResult [J], shape [frames].
        load_energy: Potential [J] of gravity and nodal forces, shape [frames].
        reaction_force, reaction_torque: Force and torque of the gripper on the branch [N, Nm], the
            torque about the pose's position, shape [frames, 3] ([frames, g, 3] for several grasps).
        base_force: Force of the base on the branch [N], shape [frames, 3].
        min_det_f: Shape [frames].
        last: The last state, from which a motion can be continued.
        step_count, iteration_count, factorisation_count: Cost of the motion.
        sensitivities: Derivatives, if asked for.
    """

    status: Status
    times: np.ndarray
    displacement: np.ndarray
    strain_energy: np.ndarray
    energy: np.ndarray
    kinetic_energy: np.ndarray
    load_energy: np.ndarray
    reaction_force: np.ndarray
    reaction_torque: np.ndarray
    base_force: np.ndarray
    min_det_f: np.ndarray
    last: MotionState
    step_count: int
    iteration_count: int
    factorisation_count: int
    seconds: float
    message: str = ""
    warnings: list[str] = field(default_factory=list)
    sensitivities: DynamicSensitivities | None = None

    @property
    def converged(self) -> bool:
        """Whether all frames were reached."""
        return self.status is Status.converged

    def require(self) -> "DynamicResult":
        """Return the result itself.

        Raises:
            ConvergenceError: the result has not converged.
        """
        if not self.converged:
            raise ConvergenceError(
                Text(f"The motion stopped at {self.last.time:.4g} s: ", self.message),
                f"The {len(self.times)} frames before it are valid.",
                "Use a slower or smaller motion, or check units and Young's modulus.", result=self)
        return self
