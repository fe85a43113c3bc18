"""The branch model as planning asks it: put the grasp there, and what does the branch say?

The grasp is pinned: its position is imposed and the branch turns freely in it. Energy is then a
field over three coordinates that a hundred solutions describe well, where six would take
thousands. And it is the least energy over all rotations: a gripper that holds firmly reaches it
by turning as the branch would, so each pose carries that natural rotation for the robot. A firm
gripper that turns otherwise bends the branch more than planned here.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np

from limber.errors import WorkError
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics import (
    BranchModel,
    Grasp,
    PointMass,
    StaticResult,
    StaticSettings,
    follow_poses,
    solve_static,
)
from limber.mechanics.status import Status
from limber.mechanics.strain import strain_state

_PARTS = ("mesh", "reach", "gravity", "point_masses")
# A pose that needs finer steps than this lies beyond a snap: it is rejected, and soon.
_SETTINGS = StaticSettings(min_step=1 / 64)


@dataclass(frozen=True)
class Reach:
    """Where the grasp may be taken: the paper's hemisphere, bounded by the branch's length.

    Attributes:
        base: Where the branch is rooted [m], shape [3].
        arc_length: Length of branch between base and grasp [m].
        chord: Straight distance between them at rest [m].
        tip: Position of the main path's tip [m], shape [3].
    """

    base: np.ndarray
    arc_length: float
    chord: float
    tip: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, centre: np.ndarray) -> "Reach":
        """Measure along the skeleton's main path up to the grasp's ``centre`` [3]."""
        path = skeleton.main_path()
        nearest = path[np.argmin(np.linalg.norm(skeleton.nodes[path] - centre, axis=1))]
        base = skeleton.nodes[path[0]]
        chord = float(np.linalg.norm(centre - base))
        return cls(base, max(float(skeleton.arc_length[nearest]), chord), chord,
                   skeleton.nodes[path[-1]])


@dataclass(frozen=True)
class GraspModel:
    """A branch, its grasp and its own weight; picklable, so that processes can each have one.

    Attributes:
        mesh: Tetrahedra with material and grasp, free of stress as they are.
        reach: Where the grasp may go.
        gravity: Acceleration [m/s^2], or None for a branch without weight.
        point_masses: Masses that hang on the branch.
    """

    mesh: TetMesh
    reach: Reach
    gravity: tuple[float, float, float] | None
    point_masses: tuple[PointMass, ...] = ()

    @cached_property
    def model(self) -> BranchModel:
        data = self.mesh.cell_data
        return BranchModel(self.mesh, young=data["young"], poisson=data["poisson"],
                           density=data["density"], gravity=self.gravity,
                           point_masses=self.point_masses)

    @cached_property
    def grasp(self) -> Grasp:
        return Grasp.from_mesh(self.mesh, mode="pinned")

    @cached_property
    def rest(self) -> StaticResult:
        """The rest state: the branch with the gripper open, under its weight if it has any.

        Raises:
            ConvergenceError: there is none, as when the branch cannot bear its weight.
        """
        return solve_static(self.model).require()

    @property
    def rest_position(self) -> np.ndarray:
        """Where the grasp is at rest [m], shape [3]."""
        return self.pose(self.rest.displacement)[:3]

    def follow(self, positions: np.ndarray, start: np.ndarray) -> list[StaticResult]:
        """Take the grasp through ``positions`` [m, 3] slowly, from displacement ``start``."""
        poses = np.hstack([positions, np.zeros_like(positions)])
        return follow_poses(self.model, self.grasp, poses, start=start, settings=_SETTINGS)

    def pose(self, displacement: np.ndarray) -> np.ndarray:
        """Return position and natural rotation of the grasped piece, shape [6]."""
        return self.grasp.pose_of(self.mesh.nodes, displacement)

    def energy(self, result: StaticResult) -> float:
        """Return the strain energy above that of the rest state [J]."""
        return result.strain_energy - self.rest.strain_energy

    def work(self, result: StaticResult) -> float:
        """Return what the gripper has done from rest [J]: strain energy and weight lifted."""
        return self.energy(result) - self._weight_done(result) + self._weight_done(self.rest)

    def tip(self, displacement: np.ndarray) -> np.ndarray:
        """Return the position of the branch's tip [m], shape [3]."""
        return self.mesh.nodes[self._tip_node] + displacement[self._tip_node]

    def peak_strain(self, displacement: np.ndarray) -> float:
        """Return the largest principal Green-Lagrange strain of any tetrahedron, by magnitude."""
        return float(np.abs(strain_state(self.model, displacement).principal_strain).max())

    def _weight_done(self, result: StaticResult) -> float:
        return float(np.sum(self._weight_force * result.displacement))

    @cached_property
    def _weight_force(self) -> np.ndarray:
        return self.model.weight_force

    @cached_property
    def _tip_node(self) -> int:
        return int(np.argmin(np.linalg.norm(self.mesh.nodes - self.reach.tip, axis=1)))

    def __getstate__(self) -> dict[str, Any]:
        # Only what it is made of goes to another process; models hold compiled factors.
        return {name: getattr(self, name) for name in _PARTS}

    def __setstate__(self, state: dict[str, Any]) -> None:
        for name, value in state.items():
            object.__setattr__(self, name, value)


def refusal(result: StaticResult) -> Status | None:
    """Return why a solution cannot be believed, or None."""
    if not result.converged:
        return result.status
    return None if result.min_det_f > 0.0 else Status.inverted


def grasp_model_of(mesh: TetMesh, skeleton: Skeleton, gravity: tuple[float, float, float] | None,
                   masses: tuple[PointMass, ...] = ()) -> GraspModel:
    """Return the model of a scanned branch.

    Without ``gravity`` [m/s^2] the scanned shape is the rest state and free of stress. With it
    the scanned shape is the one that the branch hangs in under its own weight: the shape that it
    would have without weight is computed first, so that the rest state is the scan again.

    Raises:
        WorkError: the mesh marks no material, or the branch cannot bear its weight.
    """
    missing = {"young", "poisson", "density"} - set(mesh.cell_data)
    if missing:
        raise WorkError(f"The mesh has no {', '.join(sorted(missing))}.",
                        "Its energy cannot be computed.", "Reconstruct the branch again.")
    reach = Reach.of(skeleton, Grasp.from_mesh(mesh).centre)
    if gravity is None:
        return GraspModel(mesh, reach, None)
    from limber.mechanics.statics.rest_shape import unloaded_rest_shape

    hanging = GraspModel(mesh, reach, gravity, masses)
    return replace(hanging, mesh=unloaded_rest_shape(hanging.model))
