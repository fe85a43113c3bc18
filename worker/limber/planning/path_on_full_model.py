"""A planned path on the full model: the states of the branch along it."""

from dataclasses import dataclass

import numpy as np

from limber.core.errors import Command, ConvergenceError, Option
from limber.core.progress import SILENT, Progress
from limber.planning.cost import PathMeasures, measure_path, resample
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.field.rod import RodState
from limber.planning.field.stored_states import States

_APPROACH_STEP = 0.02  # [m] between poses on the path from rest to the start
_MOST_UNSOLVED = 0.1  # fraction of a path's poses


@dataclass(frozen=True)
class ResolvedPath:
    """A path solved by finite elements, with states from hanging to its start, positions [k, 3] [m]
    without solution and why. It ends early, not ``is_whole``, if over a tenth is unsolved."""

    solved: States
    approach: States
    unsolved: np.ndarray
    reasons: tuple[str, ...]
    is_whole: bool

    @property
    def measures(self) -> PathMeasures:
        return measure_path(self.solved.poses[:, :3], self.solved.energies,
                            self.solved.force_sizes)

    @property
    def ahead(self) -> States:
        """Approach and path, the pose where they join once."""
        joined = np.linalg.norm(self.approach.poses[-1, :3] - self.solved.poses[0, :3]) < 1e-9
        kept = np.arange(len(self.approach.poses) - joined)
        return self.approach.take(kept).joined(self.solved)

    @property
    def unsolved_count(self) -> int:
        return len(self.reasons)

    def require(self) -> "ResolvedPath":
        """Return this. ConvergenceError if over a tenth of the poses, or the last one, has no
        acceptable solution."""
        if self.is_whole:
            return self
        kinds = ", ".join(f"{self.reasons.count(kind)} {kind}"
                          for kind in sorted(set(self.reasons)))
        raise ConvergenceError(f"{len(self.reasons)} poses along a path have no acceptable "
                               f"solution ({kinds}).", "The energy field allows motion that the "
                               "branch cannot follow.", "Sample more poses with ",
                               Command("energy", Option("samples")), ", or choose a gentler goal.")


def resolve_path(grasp_model: GraspModel, path: np.ndarray, approach: np.ndarray,
                 progress: Progress = SILENT) -> ResolvedPath:
    """Solve the branch along ``path`` [n, 3], coming from rest along ``approach`` [k, 3]."""
    before, unsolved, reasons = [grasp_model.rest], [], []
    good: list[bool] = []
    rod_state: RodState | None = grasp_model.rod.rest
    state = grasp_model.rest.displacement
    ahead = resample(approach, _APPROACH_STEP)[1:-1]
    is_whole = True
    for number, point in enumerate(np.concatenate([ahead, path])):
        progress(number / (len(ahead) + len(path)), "path on the full model")
        # Beyond a fold of the rod the branch may be in another shape than it.
        rod_state = rod_state and grasp_model.rod.followed(rod_state, point)[0]
        guess = None if rod_state is None else grasp_model.rod.lifted(rod_state)
        result = grasp_model.follow(point[None], state, guess)[0]
        if reason := refusal(result):
            unsolved.append(point)
            reasons.append(str(reason))
            is_whole = number < len(ahead) + len(path) - 1 and (
                len(reasons) <= _MOST_UNSOLVED * len(path))
            if not is_whole:
                break
            continue
        (before if number < len(ahead) else good).append(result)
        state = result.displacement
    return ResolvedPath(
        States.of(grasp_model, good or before[-1:]), States.of(grasp_model, before),
        np.array(unsolved).reshape(-1, 3), tuple(reasons), is_whole)
