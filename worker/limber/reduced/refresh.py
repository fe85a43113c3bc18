"""The error of a reduced model against the full one, and its refresh where that is too large.

A few Newton corrections of the full model at a reduced state give its error at the cost of as many
factorisations. A :class:`RefreshingModel` does this on request, and adds full solutions where the
reduced one is not good enough to the basis.
"""

from dataclasses import dataclass

import numpy as np

from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.mechanics.grasp import Grasp
from limber.mechanics.model import BranchModel
from limber.mechanics.statics.result import StaticResult
from limber.reduced.model_cache import reduce_snapshots
from limber.reduced.reduced_model import ReducedModel, ReducedSettings, ReducedState
from limber.reduced.training import Snapshots, Trainer

_CORRECTIONS = 4
"""Newton steps of the full model after which a reduced state is compared. Of 90 grasps after E
changed by up to 3, of which 11 had errors above 0.5 % of the length or 1 % of the energy: 1, 2, 3,
4 steps flag 74, 43, 4, 0 of the good ones, and 11, 9, 10, 11 of the bad ones.
"""
_POSITION, _ENERGY = 0.0045, 0.009
"""Errors, relative to the extent and the energy, above which a state is flagged: a tenth below the
largest unflagged errors allowed (0.5 %, 1 %), since the measured error is slightly too small. Of
300 grasps, 3 had errors of 0.50 to 0.52 % that were measured as less, and none of 245 good ones was
flagged.
"""


@dataclass(frozen=True)
class ErrorEstimate:
    """The error of a reduced state, measured by a correction with the full model.

    Attributes:
        position: Largest node displacement of the correction, relative to the branch's extent.
        energy: Strain energy of the reduced model against that of the corrected state, less 1.
        min_det_f: Smallest determinant of the deformation gradient at the reduced state.
        certain: Whether the full tangent was positive definite there; if not, the other numbers
            say little, and the state is not to be trusted.
        displacement: The corrected displacement [m], shape [node_count, 3].
    """

    position: float
    energy: float
    min_det_f: float
    certain: bool
    displacement: np.ndarray

    @property
    def is_small(self) -> bool:
        """Whether the state may be taken as it is. Its distance from the training says little: most
        bad states are within it, with a free end slightly misaligned."""
        return (self.certain and self.min_det_f > 0 and self.position <= _POSITION
                and abs(self.energy) <= _ENERGY)


def estimate_error(model: BranchModel, weights: np.ndarray, reduced: ReducedModel,
                   state: ReducedState) -> ErrorEstimate:
    """Return the error of a reduced static state by correcting it with the full model, which gets
    the state's Young's modulus; ``weights`` lead from control points to tetrahedra."""
    # Later corrections take their geometric stiffness from the one before (mixed integration
    # points): the strain noise of the basis would spoil a plain tangent. Four at most: a free end
    # that points a little astray takes more than one.
    full = model.with_young(weights @ state.young)
    start = reduced.displacement(state)
    equations = full.equations([reduced.grasp])
    now = full.internal(start)
    u, increment, certain, first = start, None, False, now
    for _ in range(_CORRECTIONS):
        try:
            tangent = equations.tangent(full, u, increment=increment)
        except NotPositiveDefiniteError:
            certain = False
            break
        certain = tangent.is_positive_definite
        increment = tangent.solve(equations.free_part(full.weight_force - now.force))
        u = u + increment
        now = full.internal(u)
    off = float(np.linalg.norm(u - start, axis=1).max()) / full.extent
    energy = state.strain_energy / max(now.strain_energy, 1e-12) - 1
    return ErrorEstimate(off, energy, first.min_det_f,
                         bool(certain and np.isfinite(off + energy)), u)


class RefreshingModel:
    """A reduced model and its full one, with arguments as for ``build_reduced``, and the full
    ``snapshots`` it was made from. After ``refresh_every`` new ones the basis is made again."""

    def __init__(self, model: BranchModel, grasp: Grasp, weights: np.ndarray,
                 settings: ReducedSettings, reduced: ReducedModel, snapshots: Snapshots, *,
                 refresh_every: int = 6):
        self.model, self.grasp, self.weights, self.settings = model, grasp, weights, settings
        self.reduced, self.snapshots = reduced, snapshots
        self.refresh_every, self.refresh_count = refresh_every, 0
        self.trainer = Trainer(model, grasp, weights, reduced.control_young,
                               young_tangents=snapshots.young_tangents.shape[1] > 0)
        self._new: list[tuple[np.ndarray, np.ndarray, np.ndarray]] = []

    def check(self, state: ReducedState) -> ErrorEstimate:
        """Return the error of a reduced state."""
        return estimate_error(self.model, self.weights, self.reduced, state)

    def learn(self, pose: np.ndarray, young: np.ndarray,
              estimate: ErrorEstimate) -> StaticResult:
        """Solve the full model at a pose and keep it; refresh after ``refresh_every`` of them."""
        start = estimate.displacement if estimate.certain else self.snapshots.displacement[
            int(self.reduced.nearest(pose, 1)[0])]
        result = self.trainer.solve(pose, young, start)
        if result.converged:
            self._new.append((np.asarray(pose, float), np.asarray(young, float),
                              result.displacement))
            if len(self._new) >= self.refresh_every:
                self.refresh()
        return result

    def refresh(self) -> None:
        """Make the basis again with the full solutions found since."""
        poses, young, displacements = (np.array(column)
                                       for column in zip(*self._new, strict=True))
        added = self.trainer.differentiate(poses, young, displacements)
        self.snapshots = self.snapshots.joined(added)
        self.reduced = reduce_snapshots(self.model, self.grasp, self.weights,
                                        self.reduced.control_young, self.snapshots,
                                        self.settings)
        self._new = []
        self.refresh_count += 1
