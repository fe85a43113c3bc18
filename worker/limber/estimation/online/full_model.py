"""The full model for an online estimate: single frames, solved in another process.

The reduced model answers within a frame's time, but outside its training range its error exceeds
the sensors' noise. The full model needs longer than a frame but not longer than a pull: its
solutions at some frames correct the reduced model at all of them.
"""

from concurrent.futures import Future
from dataclasses import dataclass

import numpy as np

from limber.core.processes import Pool
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.added_masses import PointMass
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.sensitivities import static_sensitivities
from limber.mechanics.statics.solve import solve_static
from limber.recordings.recording import GraspEntry, grasp_on, pose_on
from limber.reduced.model_cache import reduce_snapshots
from limber.reduced.reduced_model import ReducedModel, ReducedSettings
from limber.reduced.training import Trainer, sample_young

REFRESH_STATES = 24
"""Full solutions of a basis that is made during a pull."""
REFRESH_SPREAD = 1.5
"""Factor in Young's modulus within which they are sampled. Chosen, not measured, as for a fit."""


@dataclass(frozen=True)
class ExactFrame:
    """A frame of the full model at log E [K]: points' displacement [m, 3] [m], the gripper's force
    on the branch [3] [N], and derivatives [m, 3, K] and [3, K]."""

    log_young: np.ndarray
    moved: np.ndarray
    force: np.ndarray
    d_moved: np.ndarray
    d_force: np.ndarray


@dataclass(frozen=True)
class FullBranch:
    """The full model at a recorded grasp, as data for a process; ``weights`` [tet_count, K] are
    from control points to tetrahedra. ``hangs``: the mesh includes bending by weight."""

    mesh: TetMesh
    weights: np.ndarray
    entry: GraspEntry
    rest_points: np.ndarray
    poisson: float
    density: float
    gravity: tuple[float, float, float]
    point_masses: tuple[PointMass, ...] = ()
    hangs: bool = False

    def model(self, young: np.ndarray) -> BranchModel:
        """Return the branch with these moduli at the control points [Pa]."""
        model = BranchModel(self.mesh, young=self.weights @ young, poisson=self.poisson,
                            density=self.density, gravity=self.gravity,
                            point_masses=self.point_masses)
        return model.as_scanned() if self.hangs else model


class ExactSolver:
    """Solves frames of the full model, and makes bases of them."""

    def __init__(self, branch: FullBranch):
        self.branch = branch
        self.grasp = grasp_on(branch.mesh, branch.entry)
        self._model = branch.model(np.ones(branch.weights.shape[1])).gripped(self.grasp)
        self._operator = point_operator(branch.mesh, branch.rest_points)

    def frame(self, pose: np.ndarray, log_young: np.ndarray,
              start: np.ndarray) -> ExactFrame | None:
        """Solve a recorded pose [m, rad] from displacements [m]; None without equilibrium."""
        young = np.exp(log_young)
        model = self._model.with_young(self.branch.weights @ young)
        result = solve_static(model, grasp=self.grasp, start=start,
                              pose=pose_on(self.grasp, self.branch.entry, pose))
        if not result.converged:
            return None
        slopes = static_sensitivities(model, result, self.grasp, self.branch.weights,
                                      control_young=young)
        count = len(young)
        return ExactFrame(
            log_young.copy(), (self._operator @ result.displacement.ravel()).reshape(-1, 3),
            result.reaction_force,
            (self._operator @ slopes.displacement.reshape(-1, count)).reshape(-1, 3, count),
            slopes.reaction_force)

    def basis(self, poses: np.ndarray, log_young: np.ndarray) -> ReducedModel:
        """Make a reduced model from full solutions at recorded poses, around ``log_young``."""
        young = np.exp(log_young)
        model = self._model.with_young(self.branch.weights @ young)
        poses = np.resize(poses, (max(len(poses), REFRESH_STATES), 6))
        held = np.array([pose_on(self.grasp, self.branch.entry, pose) for pose in poses])
        trainer = Trainer(model, self.grasp, self.branch.weights, young)
        sampled = sample_young(young, len(held), np.random.default_rng(0), REFRESH_SPREAD)
        snapshots = trainer.take(held, sampled)
        return reduce_snapshots(model, self.grasp, self.branch.weights, young, snapshots,
                                ReducedSettings())


class Beside:
    """Runs an :class:`ExactSolver` in a separate process; close it, or use it in a ``with``."""

    def __init__(self, branch: FullBranch):
        self._pool = Pool(1, begin=_begin, begin_arguments=(branch,),
                          name="the full model beside an online estimate")

    def frame(self, *arguments: np.ndarray) -> "Future[ExactFrame | None]":
        return self._pool.submit(_frame, *arguments)

    def basis(self, *arguments: np.ndarray) -> "Future[ReducedModel]":
        return self._pool.submit(_basis, *arguments)

    def close(self) -> None:
        self._pool.close()

    def __enter__(self) -> "Beside":
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


class Here:
    """The same in this process: the result is available when the call returns."""

    def __init__(self, branch: FullBranch):
        self._solver = ExactSolver(branch)

    def frame(self, *arguments: np.ndarray) -> "Future[ExactFrame | None]":
        return _done(self._solver.frame(*arguments))

    def basis(self, *arguments: np.ndarray) -> "Future[ReducedModel]":
        return _done(self._solver.basis(*arguments))

    def close(self) -> None:
        """Nothing is held."""


def _done(value: object) -> Future:
    future: Future = Future()
    future.set_result(value)
    return future


_solver: list[ExactSolver] = []


def _begin(branch: FullBranch) -> None:
    _solver[:] = [ExactSolver(branch)]


def _frame(*arguments: np.ndarray) -> ExactFrame | None:
    return _solver[0].frame(*arguments)


def _basis(*arguments: np.ndarray) -> ReducedModel:
    return _solver[0].basis(*arguments)
