"""The kernel and the charts of a field's fit, chosen by cross-validation."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from limber.core.errors import WorkError
from limber.core.progress import Progress
from limber.planning.field.chart import Chart
from limber.planning.field.radial import RadialInterpolant
from limber.planning.field.stored_states import GraspSamples
from limber.planning.field.valid_region import TrustRegion

KERNELS_TRIED = (("cubic", 1.0), ("quintic", 1.0), ("multiquadric", 1.0), ("multiquadric", 2.0))
CHARTS_TRIED = ((1.0, np.inf), (2.0, np.inf), (4.0, np.inf), (8.0, np.inf), (5.0, 0.02),
                (12.0, 0.02), (30.0, 0.02), (12.0, 0.005), (30.0, 0.005), (80.0, 0.005))
"""Stretch and depth; they depend on the curvature off the shell, for any kernel."""
_FINALISTS = 3  # best charts with the first kernel; the other kernels are tried on them
SMOOTHING = 1e-6  # fraction of the scaled system; more blurs, less invites rounding errors
_CHOSEN_BY = ("energy_error_median", "energy_error_most", "force_error_median", "force_error_most")
_MOST = 0.95  # quantile of the samples
_MOST_TIPS = 0.9  # the same; beyond it the branch may buckle either way
_CHOOSE_FROM = 150  # most samples; more change the choice little but take time


@dataclass(frozen=True)
class FitChoice:
    """Choices of a field's fit: kernel and shape; stretch and depth of the chart (in radii)."""

    kernel: str
    shape: float
    stretch: float = 1.0
    depth: float = np.inf

    def on(self, chart: Chart) -> Chart:
        """Return the chart with this stretch and depth."""
        return replace(chart, stretch=self.stretch, depth=self.depth * (chart.radius or 1.0))


def chosen_fits(samples: GraspSamples, region: TrustRegion, charts: Sequence[tuple[float, float]],
                progress: Progress) -> tuple[FitChoice, FitChoice]:
    """Return the choices of least cross-validation error for the energy and for the shape;
    ``charts`` are stretch and depth of those to try."""
    chart = region.chart
    picked = _spread_out(region.is_face(), _CHOOSE_FROM)
    some, face = samples.take(picked), region.is_face()[picked]
    sure = with_slopes(some)
    bending, inside = some.take(sure), ~face[sure]

    def energy_missed(choice: FitChoice) -> float:
        errors = cross_validated_errors(some, choice.on(chart), choice, face)[0]
        # Each relative to its own value: a few stiff poses, compressed and buckled, dominate means.
        return float(np.prod([errors[name] for name in _CHOSEN_BY]))

    def shape_missed(choice: FitChoice) -> float:
        size = misplaced_tips(bending, choice, chart)[inside, 0]
        return float(np.median(size) * np.quantile(size, _MOST_TIPS))

    return (_least(energy_missed, charts, progress.part(0.0, 0.5)),
            _least(shape_missed, charts, progress.part(0.5, 1.0)))


def _least(missed: Callable[[FitChoice], float], charts: Sequence[tuple[float, float]],
           progress: Progress) -> FitChoice:
    """Return the choice with the least ``missed``: the first kernel on all charts, then every other
    kernel on the best of those."""
    first, *others = KERNELS_TRIED
    asked = [FitChoice(*first, *chart) for chart in charts]
    scores: dict[FitChoice, float] = {}
    while asked:
        for choice in asked:
            progress(len(scores) / (len(charts) + _FINALISTS * len(others)),
                     "choosing the interpolation")
            scores[choice] = missed(choice)
        best = sorted(scores, key=scores.__getitem__)
        asked = [replace(chosen, kernel=kernel, shape=shape) for kernel, shape in others
                 for chosen in best[:_FINALISTS]] if len(scores) == len(charts) else []
    return best[0]


def misplaced_tips(samples: GraspSamples, choice: FitChoice, chart: Chart,
                   channels: slice = slice(3)) -> np.ndarray:
    """Return the tip's error at each sample in the fit to all the others [m], and its targets' with
    more ``channels`` than those of the tip, shape [m, channels / 3]."""
    chart = choice.on(chart)
    slopes = slopes_on(chart, samples)
    missed = RadialInterpolant.leave_one_out(
        chart.map(samples.positions), samples.shape[:, 3:][:, channels],
        None if slopes is None else slopes[:, :, 3:][:, :, channels],
        kernel=choice.kernel, shape=choice.shape, smoothing=SMOOTHING)[:, 0]
    return np.linalg.norm(missed.reshape(len(missed), -1, 3), axis=2)


def with_slopes(samples: GraspSamples) -> np.ndarray:
    """Return the samples of the shape's fit: those with known slopes, which are unknown at a snap;
    all if hardly any are known."""
    everything = np.arange(len(samples.poses))
    if samples.shape_slopes is None:
        return everything
    known = np.flatnonzero(np.isfinite(samples.shape_slopes).all(axis=(1, 2)))
    return known if len(known) >= 0.5 * len(everything) else everything


def slopes_on(chart: Chart, samples: GraspSamples) -> np.ndarray | None:
    """Return the slopes of the shape to the chart's coordinates, [m, 3, channels], if all known."""
    if samples.shape_slopes is None or not np.isfinite(samples.shape_slopes).all():
        return None
    return np.stack([chart.push_forward(samples.positions, samples.shape_slopes[:, :, c])
                     for c in range(samples.shape_slopes.shape[2])], axis=2)


def _spread_out(face: np.ndarray, count: int) -> np.ndarray:
    """Return at most ``count`` indices, those on the hull's face and others at even steps."""
    if len(face) <= count:
        return np.arange(len(face))
    inner = np.flatnonzero(~face)
    left = max(count - int(face.sum()), count // 2)
    picked = inner[np.linspace(0, len(inner) - 1, min(left, len(inner))).astype(int)]
    return np.sort(np.concatenate([np.flatnonzero(face), picked]))


def cross_validated_errors(samples: GraspSamples, chart: Chart, choice: FitChoice, face: np.ndarray,
                           ) -> tuple[dict[str, float], np.ndarray]:
    """Errors of a fit at each sample left out, in closed form: :func:`error_measures`, and
    prediction less truth of energy [J] and force [N] [m, 4]. Samples on the hull's ``face`` do not
    count: the planner never leaves the hull."""
    if not (~face).any():
        raise WorkError(f"{len(samples.poses)} grasp poses are too few for cross-validation.",
                        "The error of the energy field cannot be measured.",
                        "Sample more poses.")
    in_chart = chart.map(samples.positions)
    missed = RadialInterpolant.leave_one_out(
        in_chart, samples.energies, chart.push_forward(samples.positions, samples.forces),
        kernel=choice.kernel, shape=choice.shape, smoothing=SMOOTHING)[:, :, 0]
    energy = np.maximum(samples.energies - missed[:, 0], 0.0)
    off = -chart.pull_back(samples.positions, missed[:, 1:])
    inside = np.flatnonzero(~face)
    measures = error_measures(samples.take(inside), energy[inside], (samples.forces + off)[inside])
    return measures, np.column_stack([energy - np.maximum(samples.energies, 0.0), off])


def error_measures(truth: GraspSamples, energy: np.ndarray, force: np.ndarray,
                   ) -> dict[str, float]:
    """Errors of predictions. ``energy_error`` and ``force_error`` are root mean squares over that
    of the truth; ``_median`` and ``_most`` (95 %) are of each sample's over its own value;
    ``gentle_energy_error`` is over the half of least energy, where gentle paths run."""
    true_energies = np.maximum(truth.energies, 0.0)
    energy_off = np.abs(energy - true_energies)
    force_off = np.linalg.norm(force - truth.forces, axis=1)
    size = np.linalg.norm(truth.forces, axis=1)
    felt = (true_energies > 1e-3 * true_energies.max()) & (size > 1e-3 * size.max())
    gentle = true_energies <= np.median(true_energies)
    energy_share, force_share = energy_off[felt] / true_energies[felt], force_off[felt] / size[felt]
    return {
        "energy_error": _rms(energy_off) / _rms(true_energies),
        "force_error": _rms(force_off) / _rms(size),
        "energy_error_median": float(np.median(energy_share)),
        "force_error_median": float(np.median(force_share)),
        "energy_error_most": float(np.quantile(energy_share, _MOST)),
        "force_error_most": float(np.quantile(force_share, _MOST)),
        "gentle_energy_error": _rms(energy_off[gentle]) / _rms(true_energies[gentle]),
        "held_out_count": float(len(energy)),
    }


def _rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.square(values))))
