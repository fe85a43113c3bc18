"""Samples by the rod, corrected by some solutions of the full model (a control variate).

What the full model finds less what the rod does is smooth over the grasp's positions, also where
the branch buckles. So it is known everywhere from some forty poses, farthest apart first. Each
further round of full solutions is predicted before; when most predictions hold, no more is needed.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from limber.core.not_none import present
from limber.core.processes import run_tasks
from limber.core.progress import SILENT, Progress
from limber.mechanics.statics.result import Status
from limber.planning.field.chart import Chart
from limber.planning.field.energy_field import SMOOTHING
from limber.planning.field.grasp_model import GraspModel
from limber.planning.field.radial import RadialInterpolant
from limber.planning.field.rod import RodState
from limber.planning.field.stored_states import Solved, taken

_FIRST, _MORE = 36, 12  # full solutions to begin with, and in each further round
_SHARE_POSES = 6
"""Poses of one task; must not depend on the number of processes."""
_OTHER_SHAPE = 0.02  # fraction of the branch's length by which the full model finds another shape
_ENERGY, _PLACE = 1e-3, 1e-3
"""Errors of the correction that most predictions keep: of the energy itself, and of tip and targets
over the branch's length."""
_MOST = 0.8
_FAR = (0.2, 5.0)  # most change of a load by the correction, as a factor


@dataclass(frozen=True)
class Correction:
    """What the full model finds less what the rod does, over places in a chart: energy [J]; shape
    [rad, m]; largest strain and stress over the rod's."""

    chart: Chart
    energy: RadialInterpolant
    shape: RadialInterpolant
    load: RadialInterpolant

    @classmethod
    def fit(cls, full: Sequence[Solved], rod: Sequence[Solved], chart: Chart) -> "Correction":
        """Fit the differences at samples of both models, rest first."""
        positions = np.array([one.pose[:3] for one in full])
        flat = chart.map(positions)

        def less(name: str) -> np.ndarray:
            return np.array([getattr(one, name) - getattr(other, name)
                             for one, other in zip(full, rod, strict=True)])

        slopes = np.nan_to_num(less("shape_slopes"))  # the rod's where the full model's are unknown
        slopes = np.stack([chart.push_forward(positions, slopes[:, :, c])
                           for c in range(slopes.shape[2])], axis=2)
        ratios = np.array([[one.strain / max(other.strain, 1e-12),
                            one.stress / max(other.stress, 1e-9)]
                           for one, other in zip(full, rod, strict=True)])
        ratios[0] = np.median(ratios[1:], axis=0)  # at rest nothing bends
        return cls(chart, RadialInterpolant.fit(flat, less("energy"), chart.push_forward(
            positions, less("force")), smoothing=SMOOTHING), RadialInterpolant.fit(
                flat, less("shape"), slopes, smoothing=SMOOTHING),
            RadialInterpolant.fit(flat, np.clip(ratios, *_FAR), smoothing=SMOOTHING))

    def of(self, grasp_model: GraspModel, asked: Sequence[Solved]) -> list[Solved]:
        """Return samples of the rod as the full model would find them."""
        positions = np.array([one.pose[:3] for one in asked]).reshape(-1, 3)
        flat = self.chart.map(positions)
        more, moved = self.energy.value(flat)[:, 0], self.shape.value(flat)
        force = self.chart.pull_back(positions, self.energy.gradient(flat)[:, :, 0])
        steeper = self.shape.gradient(flat)
        steeper = np.stack([self.chart.pull_back(positions, steeper[:, :, c])
                            for c in range(steeper.shape[2])], axis=2)
        factors = np.clip(self.load.value(flat), *_FAR)
        found = []
        for k, one in enumerate(asked):
            pose = one.pose + np.concatenate([np.zeros(3), moved[k, :3]])
            whole = one.force + force[k]
            found.append(replace(
                one, pose=pose, energy=one.energy + more[k], force=whole,
                axial_force=grasp_model.reach.along(pose[3:], whole),
                tip=one.tip + moved[k, 3:6], targets=one.targets + moved[k, 6:].reshape(-1, 3),
                shape_slopes=one.shape_slopes + steeper[k],
                strain=one.strain * factors[k, 0], stress=one.stress * factors[k, 1]))
        return found


def far_apart(points: np.ndarray, count: int) -> np.ndarray:
    """Return numbers of at most ``count`` of ``points`` [n, 3], each far from those before."""
    chosen = [0]
    away = np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < min(count, len(points)) and away.max() > 0.0:
        chosen.append(int(away.argmax()))
        away = np.minimum(away, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.array(chosen)


def rod_samples(grasp_model: GraspModel, states: Sequence[RodState]) -> list[Solved]:
    """Return the samples that the rod's states make, uncorrected."""
    rod, branch = grasp_model.rod, grasp_model.branch
    points = rod.points(np.array([grasp_model.tip(np.zeros_like(grasp_model.mesh.nodes)),
                                  *(target.position for target in branch.targets)]))
    known = rod.known(states, points)
    found = []
    for k, state in enumerate(states):
        guess = rod.lifted(state)
        most, place, stress, det = rod.peak_load(present(guess.strain, "strain of the rod"))
        shape, force = known["shapes"][k], known["forces"][k]
        found.append(Solved(
            k, np.concatenate([state.places[-1], shape[:3]]), known["energies"][k], force,
            shape[3:6], det, None, shape[6:].reshape(-1, 3), np.zeros(3), most, place, stress,
            known["slopes"][k], grasp_model.reach.along(shape[:3], force), guess.displacement,
            True))
    return found


def corrected(grasp_model: GraspModel, samples: list[Solved], states: Sequence[RodState],
              chart: Chart, *, workers: int | None = None, progress: Progress = SILENT,
              ) -> tuple[list[Solved], dict[int, Status | None], int]:
    """Correct the rod's samples, rest first, by full solutions of some of them. Return them,
    without those where the full model finds no state (why, by number) or another shape (None), and
    how many it solved."""
    count = len(samples)
    flat = chart.map(np.array([one.pose[:3] for one in samples]))
    full = {0: taken(grasp_model, grasp_model.rest)}
    refused: dict[int, Status | None] = {}
    ahead = far_apart(flat, _FIRST)[1:]
    correction: Correction | None = None
    while True:
        shares = [ahead[k:k + _SHARE_POSES] for k in range(0, len(ahead), _SHARE_POSES)]
        solved = [one for share in run_tasks(
            _confirmed, [(grasp_model, [states[k] for k in share], share) for share in shares],
            # To start processes again takes longer than the few poses of a further round.
            workers=workers if correction is None else 1,
            progress=progress.part((len(full) - 1) / count, 1.0),
            message="confirming poses by the full model") for one in share]
        shaped = [one for one in solved if not one.trouble and np.abs(
            one.shape[3:] - samples[one.target].shape[3:]).max() <= (
                _OTHER_SHAPE * grasp_model.reach.arc_length)]
        full |= {one.target: one for one in shaped}
        refused |= {one.target: one.trouble for one in solved if one.target not in full}
        off = np.array([2.0]) if correction is None else _missed(
            shaped, correction.of(grasp_model, [samples[one.target] for one in shaped]),
            max(one.energy for one in full.values()), grasp_model.reach.arc_length)
        known = sorted(full)
        correction = Correction.fit([full[k] for k in known], [samples[k] for k in known], chart)
        left = np.array([k for k in range(count) if k not in full and k not in refused], int)
        if not len(left) or (len(off) and np.quantile(off, _MOST) <= 1.0):
            break
        gaps = np.linalg.norm(flat[left][:, None] - flat[known], axis=2).min(axis=1)
        ahead = left[np.argsort(-gaps, kind="stable")[:_MORE]]
    kept = [k for k in range(count) if k not in refused]
    changed = correction.of(grasp_model, [samples[k] for k in kept])
    return [full.get(k, one) for k, one in zip(kept, changed, strict=True)], refused, len(full)


def _confirmed(grasp_model: GraspModel, states: Sequence[RodState], numbers: Sequence[int],
               progress: Progress = SILENT) -> list[Solved]:
    """Return the full model's solutions, from the rod's shapes and strains."""
    found = []
    for k, (state, number) in enumerate(zip(states, numbers, strict=True)):
        progress(k / len(states), "confirming poses by the full model")
        found.append(taken(grasp_model, grasp_model.confirm(state), int(number)))
    return found


def _missed(full: list[Solved], predicted: list[Solved], most_energy: float, length: float,
            ) -> np.ndarray:
    """Return errors of predictions of full solutions over those allowed, shape [n]."""
    off = [max(abs(one.energy - other.energy) / max(one.energy, 0.02 * most_energy) / _ENERGY,
               float(np.linalg.norm((one.shape - other.shape)[3:].reshape(-1, 3), axis=1).max())
               / (_PLACE * length)) for one, other in zip(full, predicted, strict=True)]
    return np.array(off)
