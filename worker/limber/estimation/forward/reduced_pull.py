"""A slow pull on the reduced model: a few milliseconds per frame."""

from dataclasses import dataclass, replace

import numpy as np

from limber.core.errors import InputError, Option
from limber.core.not_none import present
from limber.estimation.forward.forward_model import Forward, Simulated, key_frames, travel
from limber.estimation.forward.quasi_static import QuasiStaticForward, uses_torque
from limber.estimation.parameters import Values
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.points import point_operator
from limber.recordings.recording import PullEntry, pose_on
from limber.recordings.synchronisation import Frames
from limber.reduced.reduced_model import ReducedModel, ReducedSensitivities, ReducedState

STEPS = {"poisson": 2e-3, "density": 2e-2}
"""Steps of the central differences for parameters without derivatives in the reduced model."""


class ReducedForward(Forward):
    """Simulates one pose-driven pull on the reduced model of a branch held at the grasp, at most at
    ``key_count`` frames; a spline gives the others. InputError if driven by force."""

    def __init__(self, name: str, reduced: ReducedModel, mesh: TetMesh, entry: PullEntry,
                 frames: Frames, rest_points: np.ndarray, *, density: float = 900.0,
                 key_count: int = 100):
        if entry.drive != "pose" or entry.motion != "quasi_static":
            raise InputError(f"{name} is {entry.drive}-driven and {entry.motion}.",
                             "The reduced model supports only slow pulls with prescribed poses.",
                             "Use the full model for this pull (", Option("forward", "full"), ").")
        super().__init__(name, entry, frames, rest_points)
        self.uses_torque = uses_torque(entry, frames)
        self.keys, self.spread = key_frames(travel(frames.poses), key_count)
        self._reduced, self._density = reduced, density
        columns = reduced.basis.columns.reshape(reduced.size, -1)
        self._observe = np.asarray(point_operator(mesh, self.rest_points) @ columns.T)
        self._directions = self._directions_on(mesh)
        self._poses = [pose_on(reduced.grasp, entry.grasp, pose)
                       for pose in frames.poses[self.keys]]
        self._states: list[ReducedState | None] = [None] * len(self._poses)

    def simulate(self, values: Values, extra: tuple[str, ...], sensitivities: bool,
                 ) -> Simulated | None:
        model = self._model(values)
        moved = {name: [self._model(_shifted(values, name, sign * STEPS[name]))
                        for sign in (1, -1)] for name in extra if name in STEPS}
        count = len(values.young)
        shape = (len(self._poses), len(self.rest_points), 3)
        positions, forces = np.empty(shape), np.empty((len(self._poses), 6))
        d_positions = np.zeros((*shape, count + len(extra))) if sensitivities else None
        d_forces = np.zeros((len(self._poses), 6, count + len(extra))) if sensitivities else None
        before = None
        for index, pose in enumerate(self._poses):
            state = model.solve_static(pose, start=self._states[index] or before)
            if not state.converged:
                return None
            self._states[index] = before = state
            positions[index] = self._seen(state)
            # About the recorded grasp point, which differs from the patch's centre.
            arm = pose[:3] - self.frames.poses[self.keys[index], :3]
            forces[index] = _wrench(state, arm)
            if d_positions is None or d_forces is None:
                continue
            slopes = model.sensitivities(state)
            d_positions[index, ..., :count] = (self._observe @ slopes.coordinates).reshape(
                *shape[1:], count)
            d_forces[index, :, :count] = _wrench(slopes, arm)
            for name, pair in moved.items():
                column, step = count + extra.index(name), 2 * STEPS[name]
                ahead, behind = (beside.solve_static(pose, start=state) for beside in pair)
                if not (ahead.converged and behind.converged):
                    return None
                d_positions[index, ..., column] = (self._seen(ahead) - self._seen(behind)) / step
                d_forces[index, :, column] = (_wrench(ahead, arm) - _wrench(behind, arm)) / step
        if self._directions is not None:
            self.point_directions = np.tensordot(self.spread, [
                self._directions.bent(each) for each in self.displacements(self.keys)], axes=1)
        positions, wrenches = (
            np.tensordot(self.spread, value, axes=1) for value in (positions, forces))
        d_positions, d_wrenches = (
            None if value is None else np.tensordot(self.spread, value, axes=1)
            for value in (d_positions, d_forces))
        torques = (wrenches[:, 3:], None if d_wrenches is None else d_wrenches[:, 3:])
        return Simulated(positions, wrenches[:, :3], d_positions,
                         None if d_wrenches is None else d_wrenches[:, :3],
                         *(torques if self.uses_torque else (None, None)))

    def displacements(self, frames: np.ndarray) -> list[np.ndarray]:
        """Nodal displacements [m] at the simulated frames nearest to ``frames``, from the last
        simulation."""
        nearest = [int(np.argmin(np.abs(self.keys - frame))) for frame in frames]
        return [self._reduced.displacement(present(self._states[index], "state of a key frame"))
                for index in nearest]

    def _seen(self, state: ReducedState) -> np.ndarray:
        return self.rest_points + (self._observe @ state.coordinates).reshape(-1, 3)

    def _model(self, values: Values) -> ReducedModel:
        model = self._reduced.with_young(values.young, values.poisson)
        return model.with_density(values.density / self._density)


def _wrench(of: ReducedState | ReducedSensitivities, arm: np.ndarray) -> np.ndarray:
    """Force, and torque about a point at the offset ``arm`` behind the pose's position."""
    torque = of.reaction_torque.T + np.cross(arm, of.reaction_force.T)
    return np.concatenate([of.reaction_force, torque.T])


def _shifted(values: Values, name: str, step: float) -> Values:
    if name == "poisson":
        return replace(values, poisson=values.poisson + step)
    return replace(values, density=values.density * float(np.exp(step)))


# A slow pull on a reduced model, corrected by its error against the full model.


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
