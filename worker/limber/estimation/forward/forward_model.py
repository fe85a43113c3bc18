"""What every forward simulation of a pull has, whatever model it runs on."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from limber.estimation.forward.input_force import Response
from limber.estimation.parameters import Values
from limber.mechanics.model import BranchModel
from limber.recordings.cell_errors import calibration_of
from limber.recordings.recording import PullEntry
from limber.recordings.synchronisation import Frames


@dataclass(frozen=True)
class Simulated:
    """A simulated pull at all frames, and its derivative to the physical parameters.

    Attributes:
        positions: Observed points [m], shape [f, m, 3].
        forces: Of the gripper on the branch [N], shape [f, 3].
        d_positions: Shape [f, m, 3, P], or None; P parameters in the order log E_1..log E_K and
            the extra ones of the parameter space.
        d_forces: Shape [f, 3, P], or None.
        torques: About the grasp point [N m], shape [f, 3]; None: not known.
        d_torques: Shape [f, 3, P], or None.
        grasps: The grasp point [m], shape [f, 3], where it is compared; else None.
        d_grasps: Shape [f, 3, P], or None.
    """

    positions: np.ndarray
    forces: np.ndarray
    d_positions: np.ndarray | None = None
    d_forces: np.ndarray | None = None
    torques: np.ndarray | None = None
    d_torques: np.ndarray | None = None
    grasps: np.ndarray | None = None
    d_grasps: np.ndarray | None = None


def under_its_weight(model: BranchModel, entry: PullEntry) -> BranchModel:
    """Return the model with the weight that acted in a pull.

    As a rule the branch hung as it was scanned, and ``model`` does so already. A shape that was
    drawn, not scanned, is bent by the pull's own gravity; a simulated pull may have had none.
    """
    if entry.gravity_m_s2 is not None:
        return model.with_parameters(gravity=entry.gravity_m_s2)
    return model.with_parameters(gravity=(0.0, 0.0, 0.0)) if entry.weightless else model


class Forward(ABC):
    """Simulates one pull for given values.

    Attributes:
        name: The pull's name.
        entry: Its settings.
        frames: Its aligned frames.
        rest_points: Observed points at rest [m], shape [m, 3].
        uses_force: Whether the force was measured in some frame, and is compared there.
        response: How the pull answers to errors of the measured force that drives it, once
            derivatives have been asked for; None: no such force, or not yet.
        uses_torque: Whether the torque counts too.
        grasp_tangent: Of the branch at the grasp, at all frames of the last simulation, shape
            [f, 3]; where the gripper's path is an observation.
    """

    is_dynamic = False
    """Whether inertia acts; what happens in a frame then depends on all before it."""

    def __init__(self, name: str, entry: PullEntry, frames: Frames, rest_points: np.ndarray):
        self.name, self.entry, self.frames = name, entry, frames
        self.rest_points = np.asarray(rest_points, float)
        self.uses_force = bool(np.isfinite(frames.wrenches[:, :3]).all(axis=1).any())
        self.response: Response | None = None
        self.uses_torque = False
        self.grasp_tangent: np.ndarray | None = None

    @abstractmethod
    def simulate(self, values: Values, extra: tuple[str, ...], sensitivities: bool,
                 ) -> Simulated | None:
        """Return the pull under ``values``; None where it finds no equilibrium or motion.

        Args:
            values: The physical parameters.
            extra: Which parameters beside Young's modulus derivatives are wanted to.
            sensitivities: Whether derivatives are wanted at all.
        """

    @property
    def drive(self) -> str:
        """What leads the simulation: ``pose`` or ``force``."""
        return self.entry.drive

    @property
    def watches_pose(self) -> bool:
        """Whether the gripper's recorded path is an observation, and the force an unknown."""
        return False

    @property
    def compares_grasp(self) -> bool:
        """Whether the simulated grasp point is compared with the recorded path."""
        return self.watches_pose

    @property
    def pose_sigma(self) -> float:
        """Of a recorded place of the gripper, beside what all of them have in common [m]."""
        return calibration_of(self.entry).pose_noise_m

    @property
    def force_is_stated(self) -> bool:
        """Whether the force is a known load, not a sensor's reading."""
        return False

    @property
    def full(self) -> "Forward":
        """The forward on the full model that this one stands for."""
        return self

    @property
    def has_force_unknowns(self) -> bool:
        """Whether a measured force, with its errors, drives."""
        return False

    @property
    def reduction_error(self) -> tuple[float, float] | None:
        """Largest error of a reduced model against the full one, in position [m] and in force
        over the largest force; None where the full model is simulated itself.
        """
        return None

    def shift_force(self, change: np.ndarray) -> None:
        """Move the force by what a fit says of it; linearise anew from there on.

        Args:
            change: Of the unknowns, in the order of the response's columns, shape [L].
        """
        raise NotImplementedError(f"{type(self).__name__} is not driven by a measured force.")

    def under_readings(self, simulated: Simulated) -> Simulated:
        """Foretell a pull from its force's readings alone, without what its points say of it."""
        return simulated

    def force_ratio(self, values: Values) -> float | None:
        """Measured force over the one that moves a branch of these ``values`` as far; None where
        the pull does not tell it, or not by one solution.
        """
        return None

    def thinning_error(self, values: Values) -> float:
        """Largest distance [m] between what is simulated and what is interpolated in between."""
        return 0.0

    def refine(self) -> None:
        """Simulate twice as many frames from now on, where not all of them are simulated."""
        return  # Here all of them are.

    def led_elsewhere(self, poses: np.ndarray) -> "Forward":
        """Return the same pull, on the full model, with other recorded poses [m, rad], [f, 6]; a
        slow one at few key frames, enough to see a difference.
        """
        raise NotImplementedError(f"{type(self).__name__} cannot be simulated with other recorded "
                                  "poses.")

    def until(self, count: int) -> "Forward":
        """Return what a first fit is to see of a pull that is fitted part by part: the first
        ``count`` frames of a dynamic pull, all of a slow one.
        """
        return self
