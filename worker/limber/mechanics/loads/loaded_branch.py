"""The loaded branch: the one state of a branch that everything computes on.

It hangs as it was scanned, under its own weight and what hangs on it, with named targets (a flower,
a fruit) that are followed wherever it is moved. ::

    branch = hang(model, targets)
    state = branch.equilibrium(grasp, pose)
    state.energy, state.reaction_force, branch.target_positions(state.displacement)

Energies are potentials of strain and weight above the hanging state, which has energy 0: what a
gripper has to do, slowly, to bring the branch there. Its gradient to the pose is the force that
the gripper exerts; that of the strain energy alone is not, since the gripper also lifts. How
weight acts: :mod:`limber.mechanics.prestress`.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Literal

import numpy as np
import scipy.sparse as sp

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
    """A place on the branch that matters: a flower, a fruit, a leaf.

    Attributes:
        name: What it is called.
        position: On the hanging branch [m].
        mass: What it weighs beside the scanned branch [kg]; it hung there when it was scanned.
    """

    name: str
    position: tuple[float, float, float]
    mass: float = 0.0


def target_masses(targets: tuple[NamedTarget, ...]) -> tuple[PointMass, ...]:
    """Return the masses of targets."""
    return tuple(PointMass(target.position, target.mass) for target in targets if target.mass > 0)


@dataclass(frozen=True)
class LoadedBranch:
    """A branch as it hangs; see the module.

    Attributes:
        model: Of the scan, which its weight has bent already; weightless where it was asked for.
        targets: Named places on it.
        grasp_point: The place of the grasp that the mesh marks [m]; None: the patch's own centre.
    """

    model: BranchModel
    targets: tuple[NamedTarget, ...] = ()
    grasp_point: tuple[float, float, float] | None = None

    @property
    def mesh(self) -> TetMesh:
        """The hanging branch."""
        return self.model.mesh

    def with_young(self, young: float | np.ndarray) -> "LoadedBranch":
        """Return it with other moduli [Pa]; it hangs as it does."""
        return replace(self, model=self.model.with_young(young))

    def marked_grasp(self, mode: Literal["clamped", "pinned"]) -> Grasp:
        """Return the grasp that the mesh marks.

        Raises:
            InputError: none is marked.
        """
        return Grasp.from_mesh(self.mesh, mode, self.grasp_point)

    def equilibrium(self, grasp: Grasp | None, pose: np.ndarray | None, *,
                    start: StaticResult | np.ndarray | None = None) -> StaticResult:
        """Return the state with the grasp at a pose [m, rad]; without one the hanging state.

        Energy and force are the module's; it never raises for want of convergence.
        """
        return solve_static(self.model, grasp=grasp, pose=pose, start=start)

    def target_positions(self, displacement: np.ndarray) -> np.ndarray:
        """Return where the targets are [m], shape [targets, 3].

        Args:
            displacement: Of all nodes from the hanging state [m], shape [node_count, 3].
        """
        if not self.targets:
            return np.zeros((0, 3))
        moved = (self._operator @ displacement.ravel()).reshape(-1, 3)
        return np.array([target.position for target in self.targets]) + moved

    @cached_property
    def _operator(self) -> sp.csr_matrix:
        return point_operator(self.mesh, np.array([t.position for t in self.targets]))


def hang(model: BranchModel, targets: tuple[NamedTarget, ...] = (), *,
         progress: Progress = SILENT) -> LoadedBranch:
    """Return a model's branch as it hangs in its mesh's shape.

    Where that shape would fall or roll over, since the branch is too soft to carry itself, its
    weight is left out, everywhere alike, and a warning says so.

    Args:
        model: Its gravity is that of the scan; zero for a branch without weight. What targets
            weigh is among its masses already.
    """
    if not model.gravity.any():
        return LoadedBranch(model, targets)
    loaded = model.as_scanned()
    if is_stable(loaded):
        return LoadedBranch(loaded, targets)
    progress.warn(
        "The branch is too soft to carry its own weight in the scanned shape. Its weight is "
        "neglected. Check Young's modulus, density and gravity.")
    return LoadedBranch(model.with_parameters(gravity=(0.0, 0.0, 0.0)), targets)


def is_stable(model: BranchModel) -> bool:
    """Whether a branch that hangs in its mesh's shape stays there by itself."""
    try:
        tangent = model.equations().tangent(model, np.zeros_like(model.mesh.nodes))
    except NotPositiveDefiniteError:
        return False
    return tangent.is_positive_definite
