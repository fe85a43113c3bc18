"""The branch model as planning uses it, answered by a trained reduced model.

The full model corrects the reduced model's result once, with the tangent at the strain that the
reduced model assumes: its displacement alone has ten times the error in strain, all of it stiff.
The correction measures the error. If it exceeds the error a state may have without a warning, or
the full tangent is not positive definite, or the branch would have snapped there, the full model
alone is used. So a field on it is as good as one on the full model, at one factorisation per pose
instead of a dozen.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import ClassVar

import numpy as np

from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.mechanics import StaticResult
from limber.planning.field.grasp_model import GraspModel, Guess
from limber.reduced.model_cache import (
    SHARED,
    ReducedCache,
    as_control_points,
    default_folder,
    learnt_model,
)
from limber.reduced.reduced_model import ReducedModel, ReducedState, ReducedStaticSettings
from limber.reduced.refresh import corrected_once

_SETTINGS = ReducedStaticSettings(tolerance=1e-7)  # the correction removes the rest


@dataclass(frozen=True)
class CorrectedResult(StaticResult):
    """A state of the reduced model, corrected once by the full one.

    Attributes:
        tangents: Its change with the grasp's position, shape [3, node_count, 3].
    """

    tangents: np.ndarray | None = None


@dataclass(frozen=True)
class LearntGraspModel(GraspModel):
    """A branch with a trained reduced model; also picklable.

    Attributes:
        reduced: Reduced model of this branch and this grasp.
    """

    needs_guess: ClassVar[bool] = False

    reduced: ReducedModel

    @classmethod
    def learnt(cls, grasp_model: GraspModel, cache: ReducedCache | None = None, *,
               progress: Progress = SILENT) -> "LearntGraspModel":
        """Return a grasp model that tries the reduced model of its branch first.

        The model of `limber session --mode point` on the same branch, from the ``cache``, by
        default the one that sessions use; trained now, which takes minutes, if there is none yet.

        Raises:
            ConvergenceError: no training grasp has an equilibrium.
        """
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
                                                           _SETTINGS))
            if result is None:
                result = super().follow(position[None], at, guess, snap=snap)[0]
            results.append(result)
            at, guess = result.displacement if result.converged else at, None
        return results

    def pulled(self, force: np.ndarray, start: np.ndarray) -> StaticResult:
        state = self.reduced.pulled(self._coordinates(start), force, _SETTINGS)
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
