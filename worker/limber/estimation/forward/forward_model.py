"""Interface of all forward simulations of a pull."""

from abc import ABC, abstractmethod
from dataclasses import dataclass

import numpy as np

from limber.estimation.forward.input_force import Response
from limber.estimation.forward.point_directions import PointDirections
from limber.estimation.parameters import Values
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.loads.loaded_branch import is_stable
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.solve import StaticSettings, solve_static
from limber.recordings.cell_errors import calibration_of
from limber.recordings.recording import PullEntry
from limber.recordings.synchronisation import Frames


@dataclass(frozen=True)
class Simulated:
    """A simulated pull at all frames, and its derivative to the physical parameters.

    Attributes:
        positions: Observed points [m], shape [f, m, 3].
        forces: Forces of the gripper on the branch [N], shape [f, 3].
        d_positions: Shape [f, m, 3, P], or None; P parameters in the order log E_1..log E_K and
            the extra ones of the parameter space.
        d_forces: Shape [f, 3, P], or None.
        torques: About the grasp point [N m], shape [f, 3]; None: not known.
        d_torques: Shape [f, 3, P], or None.
        grasps: The grasp point [m], shape [f, 3], if it is compared; else None.
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

    @classmethod
    def empty(cls, frames: int, points: int, torque: bool, parameters: int) -> "Simulated":
        """Return arrays to fill, with derivatives to as many ``parameters``; 0: without."""
        shape = (frames, points, 3)
        return cls(np.empty(shape), np.empty((frames, 3)),
                   np.empty((*shape, parameters)) if parameters else None,
                   np.empty((frames, 3, parameters)) if parameters else None,
                   np.empty((frames, 3)) if torque else None,
                   np.empty((frames, 3, parameters)) if torque and parameters else None)


    def moved(self, step: np.ndarray) -> "Simulated":
        """Return the pull after a small change of its P parameters, shape [P], to first order."""
        def changed(name: str) -> np.ndarray | None:
            value, slope = getattr(self, name), getattr(self, f"d_{name}")
            return None if value is None else value + slope @ step

        return Simulated(self.positions + self.d_positions @ step,
                         self.forces + self.d_forces @ step,
                         torques=changed("torques"), grasps=changed("grasps"))


def under_its_weight(model: BranchModel, entry: PullEntry) -> BranchModel:
    """Return the model with the weight that acted in a pull.

    Usually the scanned shape is prestressed by gravity, as in ``model``. The gravity of the pull
    bends a shape that was drawn. A simulated pull may have no gravity.
    """
    if entry.gravity_m_s2 is not None:
        return model.with_parameters(gravity=entry.gravity_m_s2)
    return model.with_parameters(gravity=(0.0, 0.0, 0.0)) if entry.weightless else model


def carries_its_weight(model: BranchModel) -> bool:
    """Whether a branch is stable under its weight, in the scanned shape or sagging from it."""
    if not model.gravity.any():
        return True
    if model.prestress is not None:
        return is_stable(model)
    return solve_static(model, settings=StaticSettings(snap=False)).converged


class Forward(ABC):
    """Simulates one pull for given values.

    Attributes:
        name: The pull's name.
        entry: Its settings.
        frames: Its aligned frames.
        rest_points: Observed points at rest [m], shape [m, 3].
        uses_force: Whether the force was measured in any frame, and is compared there.
        response: Response of the pull to errors of the measured force that drives it, once
            derivatives have been requested; None: no such force, or not yet.
        uses_torque: Whether the torque is compared too.
        grasp_tangent: Direction of the branch at the grasp, at all frames of the last simulation,
            shape [f, 3], if the gripper's path is an observation.
        point_directions: Direction of the branch at the observed points, at all frames of the last
            simulation, shape [f, m, 3], if these points may be off along the branch.
    """

    is_dynamic = False
    """Whether inertia acts; a frame then depends on all earlier ones."""

    point_shifts: np.ndarray | float = 0.0
    """Distances along the branch by which ``rest_points`` have been moved from the stated ones [m],
    shape [m].
    """

    creep_time: float | None = None
    """Time constant of the branch's creep [s], if its share is an unknown of the fit."""

    def __init__(self, name: str, entry: PullEntry, frames: Frames, rest_points: np.ndarray):
        self.name, self.entry, self.frames = name, entry, frames
        self.rest_points = np.asarray(rest_points, float)
        self.uses_force = bool(np.isfinite(frames.wrenches[:, :3]).all(axis=1).any())
        self.response: Response | None = None
        self.uses_torque = False
        self.grasp_tangent: np.ndarray | None = None
        self.point_directions: np.ndarray | None = None

    @abstractmethod
    def simulate(self, values: Values, extra: tuple[str, ...], sensitivities: bool,
                 ) -> Simulated | None:
        """Return the pull under ``values``. None: it finds no equilibrium or motion.

        Args:
            values: The physical parameters.
            extra: Parameters of the derivatives in addition to Young's modulus.
            sensitivities: Whether to compute derivatives.
        """

    @property
    def may_be_off_along(self) -> bool:
        """Whether observed points may be off along the branch."""
        return len(self.rest_points) > 0 and calibration_of(self.entry).point_sigma_m > 0

    def _directions_on(self, mesh: TetMesh) -> PointDirections | None:
        """Return the directions of the branch at the observed points, if they are needed."""
        return PointDirections.at(mesh, self.rest_points) if self.may_be_off_along else None

    @property
    def drive(self) -> str:
        """The prescribed quantity: ``pose`` or ``force``."""
        return self.entry.drive

    @property
    def watches_pose(self) -> bool:
        """Whether the gripper's recorded path is observed and the force is an unknown."""
        return False

    @property
    def compares_grasp(self) -> bool:
        """Whether the simulated grasp point is compared with the recorded path."""
        return self.watches_pose

    @property
    def pose_sigma(self) -> float:
        """Standard deviation of a recorded gripper position, without the common error [m]."""
        return calibration_of(self.entry).pose_noise_m

    @property
    def force_is_stated(self) -> bool:
        """Whether the force is a known load, not a sensor's reading."""
        return False

    @property
    def full(self) -> "Forward":
        """The corresponding forward simulation with the full model."""
        return self

    @property
    def has_force_unknowns(self) -> bool:
        """Whether a measured force with errors is prescribed."""
        return False

    @property
    def reduction_error(self) -> tuple[float, float] | None:
        """Largest error of the reduced model relative to the full one, in position [m] and in force
        over the largest force; None if the full model itself is simulated, or could not be.
        """
        return None

    def shift_force(self, change: np.ndarray) -> None:
        """Change the force by the fitted amount, and linearise at the new force.

        Args:
            change: Change of the unknowns, in the order of the response's columns, shape [L].
        """
        raise NotImplementedError(f"{type(self).__name__} is not driven by a measured force.")

    def under_readings(self, simulated: Simulated) -> Simulated:
        """Predict a pull from its force readings alone, without its observed points."""
        return simulated

    def force_ratio(self, values: Values) -> float | None:
        """Measured force over the force that moves a branch of these ``values`` equally far, by
        its linear response at rest; None if the pull does not determine it.
        """
        return None

    def stands(self, values: Values) -> bool:
        """Whether the branch carries its own weight under these values."""
        return True

    def thinning_error(self, values: Values) -> float:
        """Largest distance [m] between simulated and interpolated frames."""
        return 0.0

    def refine(self) -> None:
        """From now on simulate twice as many frames, if not all of them are simulated already."""
        return  # all of them are here

    def with_prescribed_poses(self, poses: np.ndarray) -> "Forward":
        """Return the same pull, on the full model, with other recorded poses [m, rad], [f, 6]; a
        slow one at few key frames, enough to show a difference.
        """
        raise NotImplementedError(f"{type(self).__name__} cannot be simulated with other recorded "
                                  "poses.")

    def until(self, count: int) -> "Forward":
        """Return the part of a pull used by the first of several fits: the first ``count`` frames
        of a dynamic pull, all of a slow one.
        """
        return self
