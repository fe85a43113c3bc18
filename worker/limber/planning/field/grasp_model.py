"""The branch model as planning uses it: the state of the branch for a grasp position.

The grasp is pinned: its position is imposed and the branch rotates freely in it. The energy is then
a field over three coordinates that a hundred solutions describe well, where six would take
thousands. It is also the least energy over all rotations: a firm gripper reaches it by rotating as
the branch would, so each pose includes that natural rotation for the robot. A firm gripper that
rotates otherwise bends the branch more than planned here.
"""

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import ClassVar

import numpy as np

from limber.core.not_none import present
from limber.core.numerics.rigid import rotated
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.core.progress import SILENT, Progress
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics import (
    BranchModel,
    Grasp,
    StaticResult,
    StaticSettings,
    follow_poses,
    solve_static,
)
from limber.mechanics.loads.loaded_branch import LoadedBranch
from limber.mechanics.materials.materials import RayleighDamping
from limber.mechanics.statics.result import Status
from limber.mechanics.strain import peak_load
from limber.reduced.model_cache import (
    SHARED,
    ReducedCache,
    as_control_points,
    default_folder,
    learnt_model,
)
from limber.reduced.reduced_model import ReducedModel, ReducedState, ReducedStaticSettings
from limber.reduced.refresh import corrected_once

# A pose that needs finer steps than this is beyond a snap. It is rejected early.
_FULL_SETTINGS = StaticSettings(min_step=1 / 64, tolerance=1e-6, way_back=False, keeps_factor=True)
_STEADY = replace(_FULL_SETTINGS, snap=False)
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
class Guess:
    """Guess of a branch's shape: ``displacement`` [m], shape [node_count, 3], and the matching
    ``strain``, [tet_count, q, 6]; None if either is not known."""

    displacement: np.ndarray | None = None
    strain: np.ndarray | None = None


@dataclass(frozen=True)
class GraspModel:
    """The loaded branch and its grasp; picklable, so that each process can have one.

    Attributes:
        branch: As it hangs, or without weight.
        grasp: Pinned.
        reach: Allowed positions of the grasp.
        needs_guess: Whether :meth:`follow` is faster with a guess.
    """

    needs_guess: ClassVar[bool] = True

    branch: LoadedBranch
    grasp: Grasp
    reach: Reach

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
        guess = guess or Guess()
        return follow_poses(self.model, self.grasp, poses, start=start, guess=guess.displacement,
                            guess_strain=guess.strain, settings=_FULL_SETTINGS if snap else _STEADY)

    def pulled(self, force: np.ndarray, start: np.ndarray) -> StaticResult:
        """Return the state under a force [3] on the grasp, from displacement ``start``, held."""
        loose = solve_static(self.model, grasp=self.grasp, grasp_force=force, start=start)
        if refusal(loose):
            return loose
        position = self.pose(loose.displacement)[:3]
        return self.follow(position[None], loose.displacement, Guess(loose.displacement))[0]

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

    def peak_strain(self, displacement: np.ndarray) -> float:
        """Return the largest principal Green-Lagrange strain of any tetrahedron, by magnitude."""
        return peak_load(self.model, displacement)[0]

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

    def tangents(self, displacement: np.ndarray) -> np.ndarray:
        """Return how a state changes with the grasp's position, shape [3, node_count, 3].

        By the tangent stiffness with the pin moved. It is not positive definite at a snap; the
        result is then NaN.
        """
        equations = self.model.equations((self.grasp,))
        try:
            tangent = equations.exact_tangent(self.model, displacement)
        except NotPositiveDefiniteError:
            return np.full((3, *displacement.shape), np.nan)
        if not tangent.is_positive_definite:
            return np.full((3, *displacement.shape), np.nan)
        return np.array(tangent.solve_all(3 * [np.zeros_like(displacement)], np.eye(3)))

    def shape_slopes(self, displacement: np.ndarray, tangents: np.ndarray | None = None,
                     ) -> np.ndarray:
        """Return how :meth:`shape` changes with the grasp's position, [3, 6 + 3 targets].

        ``tangents``: Tangents of the state, if already known. NaN if they are NaN.
        """
        tangents = self.tangents(displacement) if tangents is None else tangents
        at = self.shape(displacement)
        if not np.isfinite(tangents).all():
            return np.full((3, len(at)), np.nan)
        return np.stack([(self.shape(displacement + _DIFFERENCE * moved) - at) / _DIFFERENCE
                         for moved in tangents])

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
    return GraspModel(branch, grasp, Reach.of(skeleton, grasp.centre))


# The branch model as planning uses it, answered by a trained reduced model.
#
# The full model corrects the reduced model's result once, with the tangent at the strain that the
# reduced model assumes: its displacement alone has ten times the error in strain, all of it stiff.
# The correction measures the error. If it exceeds the error a state may have without a warning, or
# the full tangent is not positive definite, or the branch would have snapped there, the full model
# alone is used. So a field on it is as good as one on the full model, at one factorisation per pose
# instead of a dozen.

_REDUCED_SETTINGS = ReducedStaticSettings(tolerance=1e-7)  # the correction removes the rest


@dataclass(frozen=True)
class CorrectedResult(StaticResult):
    """A state of the reduced model, corrected once by the full one; ``tangents`` [3, node_count, 3]
    are its change with the grasp's position."""

    tangents: np.ndarray | None = None


@dataclass(frozen=True)
class LearntGraspModel(GraspModel):
    """A branch with a trained reduced model of this branch and grasp; also picklable."""

    needs_guess: ClassVar[bool] = False

    reduced: ReducedModel

    @classmethod
    def learnt(cls, grasp_model: GraspModel, cache: ReducedCache | None = None, *,
               progress: Progress = SILENT) -> "LearntGraspModel":
        """Return a grasp model that tries the branch's reduced model first: that of `limber session
        --mode point` in ``cache`` (None: the sessions'), or trained now, which takes minutes.
        ConvergenceError if no training grasp has an equilibrium."""
        if cache is None:
            cache = ReducedCache(default_folder(), progress=progress)
        model, grasp = grasp_model.model, grasp_model.grasp
        known = learnt_model(model, grasp, *as_control_points(model), SHARED, cache=cache,
                             progress=progress)
        return cls(grasp_model.branch, grasp, grasp_model.reach, known.reduced)

    def follow(self, positions: np.ndarray, start: np.ndarray, guess: Guess | None = None,
               *, snap: bool = True) -> list[StaticResult]:
        """As for the full model; only that needs ``guess``."""
        results, at = [], start
        for position in positions:
            pose = np.concatenate([position, np.zeros(3)])
            result = self._corrected(self.reduced.followed(self._coordinates(at), pose,
                                                           _REDUCED_SETTINGS))
            if result is None:
                result = super().follow(position[None], at, guess, snap=snap)[0]
            results.append(result)
            at, guess = result.displacement if result.converged else at, None
        return results

    def pulled(self, force: np.ndarray, start: np.ndarray) -> StaticResult:
        state = self.reduced.pulled(self._coordinates(start), force, _REDUCED_SETTINGS)
        result = None if state is None else self._corrected(state)
        return super().pulled(force, start) if result is None else result

    def tangents(self, displacement: np.ndarray) -> np.ndarray:
        known = self._last.get("result")
        if known is not None and known.displacement is displacement:
            return present(known.tangents, "tangent")
        return super().tangents(displacement)

    def _corrected(self, state: ReducedState) -> CorrectedResult | None:
        """Return a state as the full model corrects it, None if it cannot be trusted."""
        found = corrected_once(self.model, self.reduced, state) if state.converged else None
        if found is None:
            return None
        result, tangents = found
        kept = CorrectedResult(**vars(result), tangents=tangents)
        self._last["result"] = kept
        return kept

    def _coordinates(self, displacement: np.ndarray) -> np.ndarray:
        """Return the reduced coordinates nearest to a displacement [node_count, 3], [size]."""
        return self._projector @ displacement.ravel()

    @cached_property
    def _projector(self) -> np.ndarray:
        columns = self.reduced.basis.columns.reshape(self.reduced.size, -1)
        return np.linalg.solve(columns @ columns.T, columns)

    @cached_property
    def _last(self) -> dict[str, CorrectedResult]:
        """The state found last: the next queries about it are already answered."""
        return {}
