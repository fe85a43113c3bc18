"""The energy field: deformation energy of the branch over the position of its grasp.

The energy is the potential of strain and weight above the hanging state, the branch with the
gripper open: what the gripper does to bring the branch there slowly. Its gradient is the force of
the gripper. Without weight it is the strain energy, the paper's measure of deformation.

The field also gives the rotation that the grasped piece takes by itself, and the branch's tip.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from limber.compiled import compiled
from limber.errors import InputError, WorkError
from limber.planning.field.chart import Chart, mapped, pulled_back_size
from limber.planning.field.radial import RadialInterpolant, gradient_at, value_at
from limber.planning.field.trust import TrustRegion, trusted_at
from limber.progress import SILENT, Progress


@dataclass(frozen=True)
class FitChoice:
    """How a field is fitted: kernel and shape, the chart's stretch, and whether to forces too."""

    kernel: str
    shape: float
    stretch: float
    with_forces: bool


# Tried in turn; the least held-out error wins.
CHOICES = tuple(
    FitChoice(kernel, shape, stretch, with_forces)
    for kernel, shape in (("cubic", 1.0), ("quintic", 1.0), ("multiquadric", 1.0),
                          ("multiquadric", 2.0))
    for stretch in (1.0, 2.0, 3.0)
    for with_forces in (True, False))
_SMOOTHING = 1e-6  # of the scaled system; more blurs the valley, less invites round-off
_CHOSEN_BY = ("energy_error", "force_error", "energy_error_median", "force_error_median")
_FOLDS_TO_CHOOSE, _FOLDS_TO_REPORT = 4, 10


@dataclass(frozen=True)
class GraspSamples:
    """What the branch model says of ``m`` accepted grasp poses, rest pose first.

    Attributes:
        poses: Position [m] and the rotation vector [rad] that the grasped piece takes, [m, 6].
        energies: Potential of strain and weight above the hanging state [J], shape [m].
        forces: Force that the gripper exerts on the branch [N], shape [m, 3].
        tips: Position of the branch's tip [m], shape [m, 3].
        min_det_f: Least determinant of the deformation gradient, shape [m].
        rejected_poses: Poses without an acceptable solution, shape [q, 6].
        targets: Positions of the named targets [m], shape [m, targets, 3].
    """

    poses: np.ndarray
    energies: np.ndarray
    forces: np.ndarray
    tips: np.ndarray
    min_det_f: np.ndarray
    rejected_poses: np.ndarray
    targets: np.ndarray | None = None

    @property
    def positions(self) -> np.ndarray:
        return self.poses[:, :3]

    def take(self, index: np.ndarray) -> "GraspSamples":
        """Return the samples of ``index``; rejected poses stay."""
        names = ("poses", "energies", "forces", "tips", "min_det_f")
        names = names if self.targets is None else (*names, "targets")
        return replace(self, **{name: getattr(self, name)[index] for name in names})


class FieldArrays(NamedTuple):
    """A field and its limits as the compiled loops take them; see :meth:`EnergyField.limited`."""

    chart: tuple
    energy: tuple
    planes: np.ndarray
    accepted: np.ndarray
    rejected: np.ndarray
    max_energy: float
    max_force: float


@dataclass(frozen=True)
class EnergyField:
    """Fitted field; positions [n, 3] in, arrays out. Make it with :func:`fit_field`.

    Attributes:
        samples: What it was fitted to.
        chart: The coordinates of the fits.
        energy_fit: Interpolant of the energy (cut off at 0 by the methods).
        shape_fit: Six channels: natural rotation vector and tip position.
        region: Where the field may be believed.
        errors: Held-out errors; see :func:`held_out_errors`.
    """

    samples: GraspSamples
    chart: Chart
    energy_fit: RadialInterpolant
    shape_fit: RadialInterpolant
    region: TrustRegion
    errors: dict[str, float]

    @property
    def rest(self) -> np.ndarray:
        """Position of the grasp in the rest state [m], shape [3]."""
        return self.samples.positions[0]

    def energy(self, points: np.ndarray) -> np.ndarray:
        """Return the deformation energy [J] at ``points`` [n, 3], never negative, shape [n]."""
        return np.maximum(self._value(self.energy_fit, points)[:, 0], 0.0)

    def energy_gradient(self, points: np.ndarray) -> np.ndarray:
        """Return its gradient [N], shape [n, 3]; zero where the energy is cut off."""
        cut_off = self._value(self.energy_fit, points)[:, 0] <= 0.0
        return np.where(cut_off[:, None], 0.0, self._gradient(self.energy_fit, points, 0))

    def force(self, points: np.ndarray) -> np.ndarray:
        """Return the force that holds the grasp there [N], the energy's gradient, [n, 3]."""
        return self._gradient(self.energy_fit, points, 0)

    def poses(self, points: np.ndarray) -> np.ndarray:
        """Return positions with the rotation that the grasped piece takes there, [n, 6]."""
        return np.hstack([_rows(points), self._value(self.shape_fit, points)[:, :3]])

    def tip(self, points: np.ndarray) -> np.ndarray:
        """Return where the branch's tip is with the grasp at ``points`` [m], [n, 3]."""
        return self._value(self.shape_fit, points)[:, 3:]

    def tip_gradient(self, points: np.ndarray) -> np.ndarray:
        """Return d tip_c / d x_k, shape [n, 3 (k), 3 (c)]."""
        return np.stack([self._gradient(self.shape_fit, points, 3 + c) for c in range(3)], axis=2)

    def _value(self, fit: RadialInterpolant, points: np.ndarray) -> np.ndarray:
        return fit.value(self.chart.map(_rows(points)))

    def _gradient(self, fit: RadialInterpolant, points: np.ndarray, channel: int) -> np.ndarray:
        points = _rows(points)
        gradient = fit.gradient(self.chart.map(points))[:, :, channel]
        return self.chart.pull_back(points, gradient)

    def limited(self, max_energy: float = np.inf, max_force: float = np.inf) -> FieldArrays:
        """Return the arrays for compiled loops, with limits on energy [J] and force [N]."""
        return FieldArrays(self.chart.arrays, self.energy_fit.arrays,
                           self.region.planes, self.region.accepted, self.region.rejected,
                           float(max_energy), float(max_force))

    def write(self, path: Path, extra: dict[str, Any] | None = None) -> None:
        """Write ``energy.npz``: samples, weights, errors and ``extra`` arrays; nothing pickled."""
        samples = self.samples
        arrays = {
            "poses": samples.poses, "energies_j": samples.energies,
            "forces_n": samples.forces, "tips_m": samples.tips, "min_det_f": samples.min_det_f,
            "rejected_poses": samples.rejected_poses,
            "chart_base_m": self.chart.base, "chart_radius_m": np.array(self.chart.radius),
            "chart_stretch": np.array(self.chart.stretch),
            "error_names": np.array(list(self.errors)),
            "error_values": np.array(list(self.errors.values())),
            "energy_error": np.array(self.errors["energy_error"]),
            "force_error": np.array(self.errors["force_error"]),
        }
        if samples.targets is not None:
            arrays["targets_m"] = samples.targets
        for name in ("energy_fit", "shape_fit"):
            arrays |= getattr(self, name).to_arrays(f"{name}_")
        np.savez_compressed(path, **arrays, **(extra or {}))

    @classmethod
    def read(cls, path: Path) -> "EnergyField":
        """Read what :meth:`write` wrote; nothing is fitted again.

        Raises:
            InputError: the file is not an energy field.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = dict(file)
            samples = GraspSamples(
                arrays["poses"], arrays["energies_j"], arrays["forces_n"], arrays["tips_m"],
                arrays["min_det_f"], arrays["rejected_poses"],
                arrays.get("targets_m"))
            chart = Chart(arrays["chart_base_m"], float(arrays["chart_radius_m"]),
                          float(arrays["chart_stretch"]))
            fits = [RadialInterpolant.from_arrays(arrays, f"{name}_")
                    for name in ("energy_fit", "shape_fit")]
            errors = dict(zip(arrays["error_names"].tolist(), arrays["error_values"].tolist(),
                              strict=True))
        except (KeyError, ValueError, OSError, TypeError) as error:
            raise InputError(f"{path} is not an energy field ({error}).",
                             "It was not written by `limber energy`, or is damaged.",
                             "Run `limber energy` again with --force.") from error
        return cls(samples, chart, *fits, TrustRegion.of(samples.positions,
                                                  samples.rejected_poses[:, :3]), errors)


def fit_field(samples: GraspSamples, base: np.ndarray | None = None, *, seed: int = 0,
              progress: Progress = SILENT) -> EnergyField:
    """Fit the field; of ``CHOICES`` the one with the least held-out error.

    Args:
        samples: What the branch model says.
        base: Where the branch is rooted [m]; None: no chart is tried.
        seed: Of the folds.

    Raises:
        WorkError: too few samples, or they span no volume.
    """
    needed = 20
    if len(samples.poses) < needed:
        raise WorkError(f"Only {len(samples.poses)} grasp poses were accepted.",
                        f"A field in three coordinates needs at least {needed}.",
                        "Sample more poses, or a smaller deflection.")
    choices = [choice for choice in CHOICES if base is not None or choice.stretch == 1.0]
    base = np.zeros(3) if base is None else np.asarray(base, float)
    scores = []
    for number, choice in enumerate(choices):
        progress(number / len(choices), "choosing the interpolation")
        errors = held_out_errors(samples, choice, base, folds=_FOLDS_TO_CHOOSE, seed=seed)
        # Their product: mean errors speak for the stiff poses, medians for the gentle ones.
        scores.append(np.prod([errors[name] for name in _CHOSEN_BY]))
    choice = choices[int(np.argmin(scores))]
    return replace(_fitted(samples, choice, base),
                   errors=held_out_errors(samples, choice, base, seed=seed))


def held_out_errors(samples: GraspSamples, choice: FitChoice, base: np.ndarray, *,
                    folds: int = _FOLDS_TO_REPORT, seed: int = 0) -> dict[str, float]:
    """Return errors on samples that the fit has not seen (``folds`` fits, each without a part).

    Only held-out samples inside the hull of the others count: the planner never goes outside.

    Returns:
        ``energy_error`` and ``force_error``: root mean square error over root mean square of the
        branch model's values; ``energy_error_median`` and ``force_error_median``: median of
        the error of each sample over its own value; ``gentle_energy_error``: as the first, over
        the half of the samples with the least energy, where gentle paths run; ``held_out_count``.
    """
    order = np.random.default_rng(seed).permutation(len(samples.poses))
    tested, energy, force = [], [], []
    for fold in range(folds):
        out = order[fold::folds]
        kept = np.setdiff1d(order, out)
        field = _fitted(samples.take(kept), choice, base)
        inside = out[field.region.contains(samples.positions[out])]
        tested.append(inside)
        energy.append(field.energy(samples.positions[inside]))
        force.append(field.force(samples.positions[inside]))
    index = np.concatenate(tested)
    if len(index) == 0:
        raise WorkError(f"{len(samples.poses)} grasp poses are too few to hold any out.",
                        "Then the error of the energy field cannot be told.",
                        "Sample more poses.")
    return error_measures(samples.take(index), np.concatenate(energy), np.concatenate(force))


def error_measures(truth: GraspSamples, energy: np.ndarray, force: np.ndarray,
                   ) -> dict[str, float]:
    """Return the measures of :func:`held_out_errors` for predictions at ``truth``'s poses."""
    wanted = np.maximum(truth.energies, 0.0)
    energy_off = np.abs(energy - wanted)
    force_off = np.linalg.norm(force - truth.forces, axis=1)
    size = np.linalg.norm(truth.forces, axis=1)
    felt = (wanted > 1e-3 * wanted.max()) & (size > 1e-3 * size.max())
    gentle = wanted <= np.median(wanted)
    return {
        "energy_error": _rms(energy_off) / _rms(wanted),
        "force_error": _rms(force_off) / _rms(size),
        "energy_error_median": float(np.median(energy_off[felt] / wanted[felt])),
        "force_error_median": float(np.median(force_off[felt] / size[felt])),
        "gentle_energy_error": _rms(energy_off[gentle]) / _rms(wanted[gentle]),
        "held_out_count": float(len(energy)),
    }


def _fitted(samples: GraspSamples, choice: FitChoice, base: np.ndarray) -> EnergyField:
    chart = Chart(base, float(np.linalg.norm(samples.positions[0] - base)), choice.stretch)
    places = chart.map(samples.positions)
    forces = chart.push_forward(samples.positions, samples.forces) if choice.with_forces else None
    options = {"kernel": choice.kernel, "shape": choice.shape, "smoothing": _SMOOTHING}
    energy = RadialInterpolant.fit(places, samples.energies, forces, **options)
    shape = RadialInterpolant.fit(places, np.hstack([samples.poses[:, 3:], samples.tips]),
                                  **options)
    region = TrustRegion.of(samples.positions, samples.rejected_poses[:, :3])
    return EnergyField(samples, chart, energy, shape, region, {})


def _rows(points: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(points, float).reshape(-1, 3)


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))


@compiled
def energy_at(point, field):
    """Return the energy [J], cut off at 0, at ``point`` [3]."""
    return max(value_at(mapped(point, *field.chart), 0, *field.energy), 0.0)


@compiled
def allowed_at(point, energy, field):
    """Return whether ``point``, whose energy is known, is trusted and within the limits."""
    if energy > field.max_energy:
        return False
    if not trusted_at(point, field.planes, field.accepted, field.rejected):
        return False
    if field.max_force == np.inf:
        return True
    slope = np.empty(len(point))
    gradient_at(mapped(point, *field.chart), 0, *field.energy, slope)
    return pulled_back_size(point, slope, *field.chart) <= field.max_force
