"""The stored state of the branch at one grasp position, and samples from such states."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from limber.mechanics import StaticResult
from limber.mechanics.solve_status import Status
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.field.grasp_samples import GraspSamples
from limber.planning.field.reduced_grasp import CorrectedResult


@dataclass(frozen=True)
class Solved:
    """A solution; ``target`` is the number of the requested position, -1 if there was none.

    The others as in :class:`~.energy_field.GraspSamples`, for one sample; ``trouble`` is why it
    cannot be trusted, ``displacement`` [node_count, 3] that of all nodes [m], ``tangents`` [3,
    node_count, 3] its change with the grasp's position, in single precision; ``reduced`` whether
    the reduced model found it.
    """

    target: int
    pose: np.ndarray
    energy: float
    force: np.ndarray
    tip: np.ndarray
    min_det_f: float
    trouble: Status | None
    targets: np.ndarray
    torque: np.ndarray
    strain: float
    strain_place: np.ndarray
    stress: float
    shape_slopes: np.ndarray
    axial_force: float
    displacement: np.ndarray
    tangents: np.ndarray
    reduced: bool = False

    @property
    def shape(self) -> np.ndarray:
        """Natural rotation [rad], tip and targets [m] in one row, [6 + 3 targets]."""
        return np.concatenate([self.pose[3:], self.tip, self.targets.ravel()])

    @property
    def has_tangents(self) -> bool:
        """Whether they are known; at a snap they are not."""
        return bool(np.isfinite(self.tangents[0, 0, 0]))

    def extrapolated(self, position: np.ndarray) -> np.ndarray | None:
        """Return the displacement by the tangents with the grasp at ``position`` [3], if known."""
        if not self.has_tangents:
            return None
        return self.displacement + self.moved(position - self.pose[:3])

    def moved(self, step: np.ndarray) -> np.ndarray:
        """Return the tangents' displacement for a ``step`` [3] of the grasp, [node_count, 3]."""
        # Not by BLAS, whose last digit may differ between processes.
        return step[0] * self.tangents[0] + step[1] * self.tangents[1] + step[2] * self.tangents[2]


def taken(grasp_model: GraspModel, result: StaticResult, target: int = -1) -> Solved:
    """Return the stored state of a solution."""
    moved, at_rest = result.displacement, result is grasp_model.rest
    strain, position, stress = grasp_model.peak_load(moved)
    tangents = grasp_model.tangents(moved)
    force = np.zeros(3) if at_rest else result.reaction_force
    return Solved(
        target, grasp_model.pose(moved), 0.0 if at_rest else grasp_model.energy(result),
        force, grasp_model.tip(moved),
        float(result.min_det_f), refusal(result), grasp_model.branch.target_positions(moved),
        np.zeros(3) if at_rest else result.reaction_torque, strain, position, stress,
        grasp_model.shape_slopes(moved, tangents), grasp_model.axial_force(moved, force), moved,
        tangents.astype(np.float32), isinstance(result, CorrectedResult))


def samples_of(good: Sequence[Solved], rejected: np.ndarray) -> GraspSamples:
    """Return samples of solutions, the rest state first; ``rejected`` positions [m], [q, 3]."""
    def column(name: str) -> np.ndarray:
        return np.array([getattr(one, name) for one in good])

    return GraspSamples(
        poses=column("pose"), energies=column("energy"), forces=column("force"),
        tips=column("tip"), min_det_f=column("min_det_f"),
        rejected_poses=np.hstack([rejected, np.zeros_like(rejected)]), strains=column("strain"),
        targets=column("targets"), torques=column("torque"),
        strain_places=column("strain_place"), stresses=column("stress"),
        shape_slopes=column("shape_slopes"), axial_forces=column("axial_force"),
        reduced=column("reduced"))
