"""A planned path on the full model: what the branch really does along it."""

from dataclasses import dataclass

import numpy as np

from limber.errors import ConvergenceError
from limber.jobs import run_tasks
from limber.planning.cost import PathMeasures, measure_path, resample
from limber.planning.grasp_model import GraspModel, refusal
from limber.progress import SILENT, Progress

_APPROACH_STEP = 0.02  # [m] between poses on the way from rest to the start
_MOST_UNSOLVED = 0.1  # share of a path's poses


@dataclass(frozen=True)
class ResolvedPath:
    """A path solved by finite elements.

    Attributes:
        poses: Positions [m] and natural rotations [rad], shape [n, 6].
        energies: Potential of strain and weight above the hanging state [J], shape [n].
        forces: Magnitude of the gripper's force [N], shape [n].
        strains: Largest principal Green-Lagrange strain anywhere in the branch, shape [n].
        tips: Position of the branch's tip [m], shape [n, 3].
        displacements: Of all nodes [m], shape [n, node_count, 3].
        unsolved_count: Poses of the planned path that had no acceptable solution.
    """

    poses: np.ndarray
    energies: np.ndarray
    forces: np.ndarray
    strains: np.ndarray
    tips: np.ndarray
    displacements: np.ndarray
    unsolved_count: int

    @property
    def measures(self) -> PathMeasures:
        return measure_path(self.poses[:, :3], self.energies, self.forces)


def resolve_path(grasp_model: GraspModel, path: np.ndarray, approach: np.ndarray,
                 progress: Progress = SILENT) -> ResolvedPath:
    """Solve the branch at each point of ``path`` [n, 3], coming from rest by ``approach`` [k, 3].

    Raises:
        ConvergenceError: over a tenth of the poses has no acceptable solution, or the last.
    """
    state = grasp_model.rest.displacement
    for point in resample(approach, _APPROACH_STEP)[1:-1]:
        result = grasp_model.follow(point[None], state)[0]
        state = state if refusal(result) else result.displacement
    good, reasons = [], []
    for number, point in enumerate(path):
        progress(number / len(path), "path on the full model")
        result = grasp_model.follow(point[None], state)[0]
        if reason := refusal(result):
            reasons.append(reason)
        else:
            good.append(result)
            state = result.displacement
        if len(reasons) > _MOST_UNSOLVED * len(path):
            raise _unsolved(reasons, len(path))
    if reason:
        raise _unsolved(reasons, len(path))
    displacements = np.array([r.displacement for r in good])
    poses = np.array([grasp_model.pose(u) for u in displacements])
    return ResolvedPath(
        poses=poses, energies=np.array([grasp_model.energy(r) for r in good]),
        forces=np.array([np.linalg.norm(r.reaction_force) for r in good]),
        strains=np.array([grasp_model.peak_strain(u) for u in displacements]),
        tips=np.array([grasp_model.tip(u) for u in displacements]),
        displacements=displacements, unsolved_count=len(reasons))


def resolve_side_by_side(grasp_model: GraspModel, paths: list[np.ndarray], approach: np.ndarray,
                         workers: int | None = None, progress: Progress = SILENT,
                         ) -> list[ResolvedPath]:
    """Solve several paths with the same approach, each in a process where cores allow."""
    return run_tasks(resolve_path, [(grasp_model, path, approach) for path in paths],
                     workers=workers, progress=progress, message="both paths on the full model")


def _unsolved(reasons: list[str], count: int) -> ConvergenceError:
    kinds = ", ".join(f"{reasons.count(kind)} {kind}" for kind in sorted(set(reasons)))
    return ConvergenceError(
        f"Of {count} poses of the planned path {len(reasons)} have no acceptable solution "
        f"({kinds}).", "The energy field promised more than the branch can do.",
        "Sample more poses with `limber energy --samples`, or choose a gentler goal.")
