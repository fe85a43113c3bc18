"""Fit with the reduced model, corrected so that it ends at the full model's solution.

A basis made for any grasp and any Young's modulus is inaccurate everywhere: moduli found with it
were off by up to 14 %. Here it is made for one branch and grasp, from the first pull's own poses
and others equally far out in every direction, at moduli around a rough fit; later pulls of that
grasp
reuse it. Its remaining error is measured: the full model at some frames gives the difference in
positions, forces and their derivatives, which is added to the reduced model's results (space
mapping with first-order consistency; Alexandrov et al., "Approximation and model management in
aerodynamic optimization with variable-fidelity models", 2001). Where the corrected fit no longer
moves, its residuals and derivatives are the full model's.
"""

import hashlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from limber.core.errors import InputError, Option, WorkError
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.estimation.fitting.objective import Objective
from limber.estimation.fitting.optimise import Fit, FitStatus
from limber.estimation.forward.forward_model import Forward, Simulated, key_frames, travel
from limber.estimation.forward.solved_pull import QuasiStaticForward, uses_torque
from limber.estimation.parameters import Values
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.points import point_operator
from limber.recordings.recording import PullEntry, pose_on
from limber.recordings.synchronisation import Frames
from limber.reduced.model_cache import read_model, reduce_snapshots, write_model
from limber.reduced.reduced_model import (
    ReducedModel,
    ReducedSensitivities,
    ReducedSettings,
    ReducedState,
)
from limber.reduced.training import Trainer, TrainingSettings, sample_poses, sample_young

# A slow pull on the reduced model: a few milliseconds per frame.

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


# Sizes and limits are chosen. The model's error is measured in every fit and corrected, so they
# affect time, not accuracy.
STATES_PER_PULL = 24
"""Full solutions along each pull from which the basis is made."""
STATES_AROUND = 24
"""Further training poses in all directions, for later pulls."""
SIZE, SIZE_PER_PULL = 56, 16
"""Coordinates of a basis: a base number plus a number per pull; at most 90."""
YOUNG_SPREAD = 1.5
"""Factor in Young's modulus within which they are sampled."""
ROUGH_KEY_FRAMES = 4
"""Key frames of the full model's fit around which the basis is made."""
ROUND_LIMIT = 5
"""Most corrections."""
REBUILD_LIMIT = 2
"""Most further bases if the fit leaves the range of the first."""
SETTLED = 1e-3
"""Change of a log E by a new correction below which it is good enough."""
SETTLED_DEVIATIONS = 0.05
"""Or: that change over the standard deviation of the log E."""

Optimise = Callable[..., Fit]
"""Takes an objective, a start vector, and whether it is near the solution."""


class Reduction:
    """Reduced models of pulls; those of one grasp and gravity share a basis, kept in ``cache`` by
    ``digest`` of its other dependencies. InputError if a pull is force-driven or dynamic."""

    def __init__(self, forwards: list[Forward], cache: Path | None = None, digest: str = ""):
        self.forwards = [_required(forward) for forward in forwards]
        self.groups = _groups(self.forwards)
        self.paths = [None if cache is None else cache / _file_name(group[0], digest)
                      for group in self.groups]
        found = [_read(path, group[0])
                 for path, group in zip(self.paths, self.groups, strict=True)]
        self.bases = [basis for basis in found if basis is not None]
        if len(self.bases) < len(found):
            self.bases = []

    @property
    def is_built(self) -> bool:
        return bool(self.bases)

    def around(self, values: Values) -> Values:
        """Return ``values`` with the moduli around which the bases were made."""
        return replace(values, young=self.bases[0].control_young)

    def build(self, values: Values, progress: Progress = SILENT) -> None:
        """Make the bases from full solutions along the pulls, around ``values``."""
        self.bases = [_built(group, values, progress) for group in self.groups]

    def objective(self, full: Objective, values: Values) -> Objective:
        """Return the objective of the reduced models, not yet corrected."""
        basis_of = {id(forward): basis
                    for group, basis in zip(self.groups, self.bases, strict=True)
                    for forward in group}
        return full.with_forwards([CorrectedForward(forward, ReducedForward(
            forward.name, basis_of[id(forward)], forward.mesh, forward.entry, forward.frames,
            forward.rest_points, density=values.density)) for forward in self.forwards])

    def keep(self) -> None:
        """Write the bases to the cache; bases of another mesh are removed, of other grasps kept."""
        kept = {path for path in self.paths if path is not None}
        for path in kept:
            own = path.name.rsplit("-", 1)[0]
            for old in path.parent.glob(".reduced-*.npz"):
                if not old.name.startswith(own):
                    old.unlink()
        for file, basis in zip(self.paths, self.bases, strict=True):
            if file is not None:
                part = file.with_suffix(".part")
                write_model(basis, part)
                part.replace(file)


def fit_reduced(objective: Objective, start: np.ndarray, optimise: Optimise, rough: Optimise,
                reduction: Reduction, progress: Progress = SILENT,
                ) -> tuple[Fit, Objective]:
    """Fit on the pulls' reduced models, with bases around a ``rough`` quick fit of the full model;
    return fit and objective. If they do not cover the pulls, the full model fits and warns."""
    free = start
    if not reduction.is_built:
        counts = [forward.key_count for forward in reduction.forwards]
        for forward in reduction.forwards:
            forward.set_key_count(ROUGH_KEY_FRAMES)
        free = rough(objective, start).evaluation.free
        for forward, count in zip(reduction.forwards, counts, strict=True):
            forward.set_key_count(count)
        reduction.build(objective.space.unpack(free), progress)
    for attempt in range(REBUILD_LIMIT + 1):
        corrected = reduction.objective(objective, objective.space.unpack(free))
        try:
            fit = _settled(corrected, free, optimise, progress)
        except WorkError:
            progress.warn(
                "The reduced model finds no equilibrium at one of the recorded poses. The full "
                "model is used instead.")
            return optimise(objective, free), objective
        objective.forward_count = corrected.forward_count
        free = fit.evaluation.free
        values = objective.space.unpack(free)
        basis = reduction.bases[0]
        away = float(np.exp(np.abs(np.log(values.young / basis.control_young)).max()))
        if away <= 1.05 * basis.young_spread or attempt == REBUILD_LIMIT:
            break
        # The basis was made around moduli too far from the result; make it again around the result.
        reduction.build(values, progress)
    reduction.keep()
    return fit, corrected


def _settled(corrected: Objective, free: np.ndarray, optimise: Optimise, progress: Progress) -> Fit:
    """Fit, measure the reduced model's error there, and fit again until the result settles."""
    fit = optimise(corrected, free)
    for _ in range(ROUND_LIMIT):
        values = corrected.space.unpack(fit.evaluation.free)
        if not all(forward.correct(values, corrected.space.extra)
                   for forward in corrected.forwards if isinstance(forward, CorrectedForward)):
            progress.warn(
                "The full model finds no equilibrium at the solution of the reduced model. The "
                "solution is therefore not confirmed. Use ", Option("forward", "full"), ".")
            return replace(fit, status=FitStatus.unconfirmed)
        # Earlier evaluations belong to another correction.
        corrected.forget()
        again = optimise(corrected, fit.evaluation.free, is_near=True)
        moved = np.abs(again.evaluation.free - fit.evaluation.free)
        fit = again
        spread = np.linalg.pinv(fit.evaluation.slopes, rcond=1e-9)
        deviation = np.linalg.norm(spread, axis=1)
        if np.all(moved <= np.maximum(SETTLED, SETTLED_DEVIATIONS * deviation)):
            return fit
    progress.warn(
        "The corrections of the reduced model did not converge. The last one changed a free "
        f"parameter by {moved.max():.2g} (1 is a factor of 2.7).")
    return replace(fit, status=FitStatus.unconfirmed)


def _required(forward: Forward) -> QuasiStaticForward:
    if not isinstance(forward, QuasiStaticForward) or forward.drive != "pose":
        entry = forward.entry
        raise InputError(f"{forward.name} is {entry.drive}-driven and {entry.motion}.",
                         "The reduced model supports only slow pulls with prescribed poses.",
                         "Use the full model for this pull (", Option("forward", "full"), ").")
    return forward


def _groups(forwards: list[QuasiStaticForward]) -> list[list[QuasiStaticForward]]:
    """Pulls of one grasp and one gravity share a basis."""
    groups: dict[str, list[QuasiStaticForward]] = {}
    for forward in forwards:
        key = f"{forward.entry.grasp} {forward.entry.gravity_m_s2} {forward.entry.weightless}"
        groups.setdefault(key, []).append(forward)
    return list(groups.values())


def _built(group: list[QuasiStaticForward], values: Values, progress: Progress) -> ReducedModel:
    """Make the basis from full solutions along the group's own pulls."""
    first = group[0]
    model = first.model_with(values)
    own = [_training_poses(forward) for forward in group]
    poses = np.concatenate([*own, _poses_around(first, np.concatenate(own))])
    trainer = Trainer(model, first.grasp, first.weights, values.young)
    young = sample_young(values.young, len(poses), np.random.default_rng(0), YOUNG_SPREAD)
    snapshots = trainer.take(poses, young, progress=progress)
    settings = ReducedSettings(size=min(SIZE + SIZE_PER_PULL * len(group), 90))
    return reduce_snapshots(model, first.grasp, first.weights, values.young, snapshots, settings)


def _training_poses(forward: QuasiStaticForward) -> np.ndarray:
    keys, _ = key_frames(travel(forward.frames.poses), STATES_PER_PULL)
    return np.array([pose_on(forward.grasp, forward.entry.grasp, pose)
                     for pose in forward.frames.poses[keys]])


def _poses_around(forward: QuasiStaticForward, poses: np.ndarray) -> np.ndarray:
    """Return poses [s, 6] in all directions, as far out as a pull's own."""
    model, rng = forward.model, np.random.default_rng(1)
    reach = np.linalg.norm(poses[:, :3] - forward.grasp.centre, axis=1).max() / model.extent
    return sample_poses(model, forward.grasp, STATES_AROUND, rng,
                        TrainingSettings(reach=float(np.clip(1.1 * reach, 0.01, 0.9))))


def _file_name(forward: QuasiStaticForward, digest: str) -> str:
    """Digests of a basis' dependencies: mesh, then grasp, weight and control points; no pull."""
    model, grasp, entry = forward.model, forward.grasp, forward.entry
    joined = hashlib.sha256(
        f"{digest} {grasp.mode} {entry.gravity_m_s2} {entry.weightless} {model.gravity}"
        f" {sorted(map(repr, model.point_masses))} {STATES_PER_PULL} {STATES_AROUND}".encode())
    for array in (forward.weights, grasp.nodes, grasp.weights, model.fixed, model.stiffening):
        joined.update(np.ascontiguousarray(array).tobytes())
    return f".reduced-{forward.mesh.geometry_digest()[:10]}-{joined.hexdigest()[:20]}.npz"


def _read(path: Path | None, forward: QuasiStaticForward) -> ReducedModel | None:
    if path is None or not path.is_file():
        return None
    try:
        found = read_model(path)
    except (InputError, KeyError):
        # Truncated: it is made again.
        return None
    same = (found.rest.shape == forward.mesh.nodes.shape
            and np.array_equal(found.grasp.nodes, forward.grasp.nodes))
    return found if same else None
