"""The loaded branch: the one state of a branch on which all computations are based.

It hangs as scanned, under its own weight and added masses, with named targets (a flower, a fruit)
that are followed wherever it moves. ::

    branch = hang(model, targets)
    state = branch.equilibrium(grasp, pose)
    state.energy, state.reaction_force, branch.target_positions(state.displacement)

Energies are potentials of strain and weight above the hanging state, which has energy 0. They are
the work of a gripper that moves the branch there slowly. The gradient to the pose is the force that
the gripper exerts; that of the strain energy alone is not, since the gripper also lifts. How
weight acts: :mod:`limber.mechanics.model`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.sparse as sp

from limber.core.errors import InputError, Option, Text
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.core.progress import SILENT, Progress
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.added_masses import PointMass
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.points import point_operator
from limber.mechanics.statics.result import StaticResult
from limber.mechanics.statics.solve import solve_static


@dataclass(frozen=True)
class NamedTarget:
    """A point of interest on the hanging branch [m]: a flower, a fruit, a leaf. Its mass [kg] adds
    to the scan's, and hung there when it was scanned."""

    name: str
    position: tuple[float, float, float]
    mass: float = 0.0


def target_masses(targets: tuple[NamedTarget, ...]) -> tuple[PointMass, ...]:
    """Return the masses of targets."""
    return tuple(PointMass(target.position, target.mass) for target in targets if target.mass > 0)


@dataclass(frozen=True)
class LoadedBranch:
    """A branch as it hangs; see the module's docstring. The model includes the bending by its
    weight, unless weightless; ``grasp_point`` [m] is None at the patch's centre."""

    model: BranchModel
    targets: tuple[NamedTarget, ...] = ()
    grasp_point: tuple[float, float, float] | None = None

    @property
    def mesh(self) -> TetMesh:
        """The hanging branch."""
        return self.model.mesh

    def with_young(self, young: float | np.ndarray) -> "LoadedBranch":
        """Return it with other moduli [Pa]; the hanging shape is unchanged."""
        return replace(self, model=self.model.with_young(young))

    def marked_grasp(self, mode: Literal["rigid", "point"]) -> Grasp:
        """Return the grasp that the mesh marks. InputError if none is marked."""
        return Grasp.from_mesh(self.mesh, mode, self.grasp_point)

    def equilibrium(self, grasp: Grasp | None, pose: np.ndarray | None, *,
                    start: StaticResult | np.ndarray | None = None) -> StaticResult:
        """Return the state with the grasp at a pose [m, rad]; without one the hanging state. Energy
        and force are those of the module's docstring. It does not raise if it does not converge."""
        return solve_static(self.model, grasp=grasp, pose=pose, start=start)

    def target_positions(self, displacement: np.ndarray) -> np.ndarray:
        """Return the targets' positions [targets, 3] [m] at a displacement from the hanging
        state."""
        if not self.targets:
            return np.zeros((0, 3))
        moved = (self._operator @ displacement.ravel()).reshape(-1, 3)
        return np.array([target.position for target in self.targets]) + moved

    @cached_property
    def _operator(self) -> sp.csr_matrix:
        return point_operator(self.mesh, np.array([t.position for t in self.targets]))


def hang(model: BranchModel, targets: tuple[NamedTarget, ...] = (), *, loaded: bool = False,
         progress: Progress = SILENT) -> LoadedBranch:
    """Return a model's branch as it hangs in its mesh's shape. If it is too soft to be stable so,
    its weight is left out with a warning; InputError if it is ``loaded`` with more weights."""
    if not model.gravity.any():
        return LoadedBranch(model, targets)
    hanging = model.as_scanned()
    if is_stable(hanging):
        return LoadedBranch(hanging, targets)
    seen, advice = _too_soft(model, targets)
    if loaded:
        raise InputError(seen, "Without weight, further loads would have no effect.", advice)
    progress.warn(f"{seen} Its weight is neglected. {advice}")
    return LoadedBranch(model.with_parameters(gravity=(0.0, 0.0, 0.0)), targets)


def _too_soft(model: BranchModel, targets: tuple[NamedTarget, ...]) -> tuple[str, str]:
    """What a branch cannot carry in the scanned shape, and what to do."""
    bare = model.without_point_masses()
    heavy = [f"{target.name} ({target.mass:g} kg)" for target in targets if target.mass > 0]
    if not (model.point_masses and is_stable(bare.as_scanned())):
        return ("The branch is too soft to carry its own weight in the scanned shape.",
                "Check Young's modulus, density and gravity.")
    hung = sum(one.mass for one in model.point_masses)
    named = f", with {', '.join(heavy)} among it" if heavy else ""
    return (f"The branch is too soft to carry the {hung:.3g} kg that hang on it in the scanned "
            f"shape{named}. It can carry its own wood.",
            Text("A target's mass hung there when the branch was scanned. If it did not, remove it "
                 "from the target and give it as a load (", Option("fruit"), "). Else check "
                 "Young's modulus."))


def is_stable(model: BranchModel) -> bool:
    """Whether a branch that hangs in its mesh's shape is stable there."""
    try:
        tangent = model.equations().tangent(model, np.zeros_like(model.mesh.nodes))
    except NotPositiveDefiniteError:
        return False
    return tangent.is_positive_definite
