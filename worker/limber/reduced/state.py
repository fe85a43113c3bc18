"""Settings and results of a reduced model and its solves."""

from dataclasses import dataclass

import numpy as np

from limber.reduced.training import TrainingSettings


@dataclass(frozen=True)
class ReducedSettings:
    """Settings of a reduced model.

    Attributes:
        size: Coordinates, those of the grasp and of the vibrations included.
        vibration_count: Coordinates for vibrations. Where Young's modulus is known they make
            motion in time better and cost statics little; where it changes they spoil the
            position of free ends.
        field_count: Strain fields; None: no projection, exact on the subspace and stiffer.
        training: Which full solutions it learns from.
    """

    size: int = 64
    vibration_count: int = 0
    field_count: int | None = 105
    training: TrainingSettings = TrainingSettings()  # noqa: RUF009 (frozen)


@dataclass(frozen=True)
class ReducedStaticSettings:
    """Settings of the search for a reduced equilibrium.

    Attributes:
        tolerance: Energy that a Newton step would still gain, relative to the strain energy.
        max_iterations: Most Newton iterations per step.
        max_halvings: Most halvings of the path to the pose before another start is tried.
        start_count: How many starts are tried, the given state included.
        novelty_limit: Largest coordinate relative to the training's beyond which the state is
            taken for false and sought again from other starts.
        iteration_limit: Newton iterations of the whole search; the best that was found by then
            counts.
    """

    tolerance: float = 1e-10
    max_iterations: int = 25
    max_halvings: int = 4
    start_count: int = 4
    novelty_limit: float = 1.5
    iteration_limit: int = 10_000


@dataclass(frozen=True)
class ReducedState:
    """A static state of the reduced model.

    Attributes:
        converged: Whether it is a stable equilibrium of the reduced model.
        trusted: Whether it is also within the training of the basis; see ``doubt``.
        doubt: Why it is not trusted, empty if it is.
        coordinates: q, shape [size].
        pose: [m, rad], shape [6].
        young: At the control points [Pa], shape [K].
        strain_energy: Energy of the strain relative to the model's mesh [J].
        energy: Potential of strain and weight, as in StaticResult [J].
        reaction_force, reaction_torque: Of the gripper on the branch [N, Nm], shape [3]; torque
            about the pose's position.
        novelty: Largest mode coordinate relative to the training's.
        iterations, seconds: Effort.
    """

    converged: bool
    trusted: bool
    uncertainty: str
    coordinates: np.ndarray
    pose: np.ndarray
    young: np.ndarray
    strain_energy: float
    energy: float
    reaction_force: np.ndarray
    reaction_torque: np.ndarray
    novelty: float
    iterations: int
    seconds: float


@dataclass(frozen=True)
class ReducedSensitivities:
    """Derivatives to log Young's modulus at the control points.

    Attributes:
        coordinates: Shape [size, K]; displacements by ``ReducedModel.displacement_of``.
        reaction_force, reaction_torque: [N, Nm], shape [3, K]; about the pose's position.
        strain_energy: With that of a carried weight [J], shape [K].
    """

    coordinates: np.ndarray
    reaction_force: np.ndarray
    reaction_torque: np.ndarray
    strain_energy: np.ndarray
