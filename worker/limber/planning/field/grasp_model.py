"""The branch model as planning uses it: the state of the branch for a grasp position.

The grasp is pinned: its position is imposed and the branch rotates freely in it. The energy is then
a field over three coordinates that a hundred solutions describe well, where six would take
thousands. It is also the least energy over all rotations: a firm gripper reaches it by rotating as
the branch would, so each pose includes that natural rotation for the robot. A firm gripper that
rotates otherwise bends the branch more than planned here.
"""

import contextlib
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from limber.core.numerics.rigid import rotated
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics import (
    BranchModel,
    Grasp,
    StaticResult,
    StaticSettings,
    follow_poses,
)
from limber.mechanics.loads.loaded_branch import LoadedBranch
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.statics.result import Status
from limber.mechanics.strain import peak_load
from limber.planning.field.rod import Guess, Rod, RodState

# A pose that needs finer steps than this is beyond a snap. It is rejected early.
_FULL_SETTINGS = StaticSettings(min_step=1 / 64, tolerance=1e-6, way_back=False, keeps_factor=True)
_DIFFERENCE = 1e-6  # [m] displacement of the grasp for differences of rotations


@dataclass(frozen=True)
class Reach:
    """Positions of the grasp, the paper's hemisphere: base [3], length along the branch and chord
    at rest, tip [3], all [m], and the axis at the grasp, unit, towards the tip."""

    base: np.ndarray
    arc_length: float
    chord: float
    tip: np.ndarray
    axis: np.ndarray = field(default_factory=lambda: np.array([0.0, 0.0, 1.0]))

    @classmethod
    def of(cls, skeleton: Skeleton, centre: np.ndarray) -> "Reach":
        """Measure along the skeleton's main path up to the grasp's ``centre`` [3]."""
        path = skeleton.main_path()
        index = int(np.argmin(np.linalg.norm(skeleton.nodes[path] - centre, axis=1)))
        nearest = path[index]
        along = skeleton.nodes[path[min(index + 1, len(path) - 1)]] - skeleton.nodes[
            path[max(index - 1, 0)]]
        base = skeleton.nodes[path[0]]
        chord = float(np.linalg.norm(centre - base))
        return cls(base, max(float(skeleton.arc_length[nearest]), chord), chord,
                   skeleton.nodes[path[-1]], along / np.linalg.norm(along))


@dataclass(frozen=True)
class GraspModel:
    """The loaded branch and its grasp; picklable, so that each process can have one.

    Attributes:
        branch: As it hangs, or without weight.
        grasp: Pinned.
        reach: Allowed positions of the grasp.
        skeleton: Its main path is the axis of :attr:`rod`.
    """

    branch: LoadedBranch
    grasp: Grasp
    reach: Reach
    skeleton: Skeleton

    @property
    def model(self) -> BranchModel:
        return self.branch.model

    @property
    def mesh(self) -> TetMesh:
        """The hanging branch."""
        return self.branch.mesh

    def damped(self, damping: RayleighDamping) -> "GraspModel":
        """Return the branch with another damping, for motion in time."""
        model = self.model.with_parameters(damping=damping)
        return replace(self, branch=replace(self.branch, model=model))

    @cached_property
    def rest(self) -> StaticResult:
        """The hanging state: the branch as scanned, the gripper open; its energy is 0.

        Raises:
            ConvergenceError: there is none, for example if the branch cannot bear its weight.
        """
        return self.branch.equilibrium(None, None).require()

    @cached_property
    def rod(self) -> Rod:
        """The branch up to its grasp as a rod, for states in milliseconds."""
        return Rod(self.model, self.grasp, self.skeleton)

    @property
    def rest_position(self) -> np.ndarray:
        """Position of the grasp at rest [m], shape [3]."""
        return self.pose(self.rest.displacement)[:3]

    def follow(self, positions: np.ndarray, start: np.ndarray, guess: Guess | None = None,
               *, snap: bool = True) -> list[StaticResult]:
        """Take the grasp through ``positions`` [m, 3] slowly, from displacement ``start``.

        Args:
            guess: Guess of the branch's shape at the first of them.
            snap: Whether the branch may snap on the path; else the path ends there.
        """
        poses = np.hstack([positions, np.zeros_like(positions)])
        known = {} if guess is None else {"guess": guess.displacement, "guess_strain": guess.strain}
        return follow_poses(self.model, self.grasp, poses, start=start,
                            settings=replace(_FULL_SETTINGS, snap=snap), **known)

    def confirm(self, state: RodState) -> StaticResult:
        """Return the state near one of the rod, where its grasp is."""
        guess = self.rod.lifted(state)
        return self.follow(state.places[-1:], guess.displacement, guess, snap=False)[0]

    def pose(self, displacement: np.ndarray) -> np.ndarray:
        """Return position and natural rotation of the grasped piece, shape [6]."""
        return self.grasp.pose_of(self.mesh.nodes, displacement)

    def energy(self, result: StaticResult) -> float:
        """Return the potential of strain and weight above the hanging state [J].

        That is the work of a gripper that brings the branch there slowly. Its gradient to the
        grasp's position is the gripper's force.
        """
        return result.energy

    def axial_force(self, displacement: np.ndarray, force: np.ndarray) -> float:
        """Return the component of a force [3] on the grasp along the branch there, outward [N]."""
        return float(rotated(self.pose(displacement)[3:], self.reach.axis) @ force)

    def tip(self, displacement: np.ndarray) -> np.ndarray:
        """Return the position of the branch's tip [m], shape [3]."""
        return self.mesh.nodes[self._tip_node] + displacement[self._tip_node]

    def peak_load(self, displacement: np.ndarray) -> tuple[float, np.ndarray, float]:
        """Return the largest principal strain by magnitude, its position [m] at rest, shape [3],
        and the largest principal Cauchy stress by magnitude [Pa].
        """
        strain, tet, stress = peak_load(self.model, displacement)
        return strain, self.mesh.nodes[self.mesh.tets[tet, :4]].mean(axis=0), stress

    def shape(self, displacement: np.ndarray) -> np.ndarray:
        """Return natural rotation [rad], tip and named targets [m] in one row, [6 + 3 targets]."""
        return np.concatenate([self.pose(displacement)[3:], self.tip(displacement),
                               self.branch.target_positions(displacement).ravel()])

    def shape_slopes(self, displacement: np.ndarray) -> np.ndarray:
        """Return how :meth:`shape` changes with the grasp's position, [3, 6 + 3 targets].

        By the tangent stiffness with the pin moved. It is not positive definite at a snap; the
        result is then NaN.
        """
        at, tangent = self.shape(displacement), None
        with contextlib.suppress(NotPositiveDefiniteError):
            tangent = self.model.equations((self.grasp,)).exact_tangent(self.model, displacement)
        if tangent is None or not tangent.is_positive_definite:
            return np.full((3, len(at)), np.nan)
        return np.stack([(self.shape(displacement + _DIFFERENCE * moved) - at) / _DIFFERENCE
                         for moved in tangent.solve_all(3 * [np.zeros_like(displacement)],
                                                        np.eye(3))])

    @cached_property
    def _tip_node(self) -> int:
        return int(np.argmin(np.linalg.norm(self.mesh.nodes - self.reach.tip, axis=1)))


def refusal(result: StaticResult) -> Status | None:
    """Return why a solution is not acceptable, or None."""
    if not result.converged:
        return result.status
    return None if result.min_det_f > 0.0 else Status.inverted


def grasp_model_of(branch: LoadedBranch, skeleton: Skeleton) -> GraspModel:
    """Return the planning model of a branch that hangs as it was scanned.

    Raises:
        InputError: the mesh marks no grasp.
    """
    grasp = branch.marked_grasp("point")
    return GraspModel(branch, grasp, Reach.of(skeleton, grasp.centre), skeleton)
