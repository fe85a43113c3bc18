"""A slow pull on a reduced model, corrected by its error against the full model."""

from dataclasses import dataclass

import numpy as np

from limber.core.not_none import present
from limber.estimation.forward.forward_model import Forward, Simulated
from limber.estimation.forward.quasi_static import QuasiStaticForward
from limber.estimation.forward.reduced_pull import ReducedForward
from limber.estimation.parameters import Values


@dataclass(frozen=True)
class _Correction:
    """Full model minus reduced model at some values, at all frames."""

    values: Values
    positions: np.ndarray
    forces: np.ndarray
    d_positions: np.ndarray
    d_forces: np.ndarray
    torques: np.ndarray | None
    d_torques: np.ndarray | None


class CorrectedForward(Forward):
    """A reduced forward simulation with a correction from the full model."""

    def __init__(self, full: QuasiStaticForward, reduced: ReducedForward):
        super().__init__(full.name, full.entry, full.frames, full.rest_points)
        self._full, self.reduced = full, reduced
        self.point_shifts = full.point_shifts
        self._correction: _Correction | None = None

    def correct(self, values: Values, extra: tuple[str, ...]) -> bool:
        """Measure the reduced model's error at ``values``. Return whether both models converged."""
        rough = self.reduced.simulate(values, extra, True)
        if rough is None:
            return False
        # Two Newton iterations from there instead of a path from another state.
        self._full.hint(self.reduced.displacements(self._full.keys))
        exact = self._full.simulate(values, extra, True)
        if exact is None:
            return False
        keys, spread = self._full.keys, self._full.spread

        def off(name: str) -> np.ndarray:
            one, other = (present(getattr(each, name), name) for each in (exact, rough))
            return np.tensordot(spread, (one - other)[keys], axes=1)

        torques = None if exact.torques is None else off("torques")
        d_torques = None if exact.d_torques is None else off("d_torques")
        self._correction = _Correction(values, off("positions"), off("forces"), off("d_positions"),
                                       off("d_forces"), torques, d_torques)
        return True

    @property
    def full(self) -> QuasiStaticForward:
        return self._full

    def with_prescribed_poses(self, poses: np.ndarray) -> QuasiStaticForward:
        return self._full.with_prescribed_poses(poses)

    @property
    def reduction_error(self) -> tuple[float, float] | None:
        if self._correction is None:
            return None
        force = self.frames.wrenches[:, :3]
        size = float(np.nanmax(np.linalg.norm(force, axis=1), initial=0.0)) or np.inf
        return (float(np.linalg.norm(self._correction.positions, axis=2).max(initial=0.0)),
                float(np.linalg.norm(self._correction.forces, axis=1).max()) / size)

    def simulate(self, values: Values, extra: tuple[str, ...], sensitivities: bool,
                 ) -> Simulated | None:
        found = self.reduced.simulate(values, extra, sensitivities)
        self.point_directions = self.reduced.point_directions
        known = self._correction
        if found is None or known is None:
            return found
        step = _coordinates(values, extra) - _coordinates(known.values, extra)
        return Simulated(
            found.positions + known.positions + known.d_positions @ step,
            found.forces + known.forces + known.d_forces @ step,
            found.d_positions + known.d_positions if sensitivities else None,
            found.d_forces + known.d_forces if sensitivities else None,
            *_torques(found, known, step))


def _torques(found: Simulated, known: _Correction, step: np.ndarray,
             ) -> tuple[np.ndarray | None, np.ndarray | None]:
    """The corrected torques, and their derivatives if those of ``found`` are known."""
    if found.torques is None or known.torques is None or known.d_torques is None:
        return None, None
    return (found.torques + known.torques + known.d_torques @ step,
            None if found.d_torques is None else found.d_torques + known.d_torques)


def _coordinates(values: Values, extra: tuple[str, ...]) -> np.ndarray:
    """The physical parameters of the derivatives, as one vector."""
    tail = {"poisson": values.poisson, "density": np.log(values.density), "alpha": 0.0,
            "beta": 0.0}
    return np.r_[np.log(values.young), [tail[name] for name in extra]]
