"""The energy field: deformation energy of the branch over the position of its grasp.

The energy is the potential of strain and weight above the hanging state, the branch with the
gripper open: the work of the gripper to bring the branch there slowly. Its gradient is the force of
the gripper. Without weight it is the strain energy, the paper's measure of deformation.

The field also gives the natural rotation of the grasped piece, and the position of the branch's
tip.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import Command, InputError, Option, Text, WorkError
from limber.core.files.reading import read_arrays, require_shapes
from limber.core.progress import SILENT, Progress
from limber.planning.field.chart import Chart
from limber.planning.field.radial import (
    KERNELS,
    LocalError,
    RadialInterpolant,
    Slack,
    slack_of,
    slack_slopes,
    slacks_at,
)
from limber.planning.field.stored_states import States
from limber.planning.field.valid_region import TrustRegion

# The kernel and the charts of a field's fit, chosen by cross-validation.

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


def chosen_fits(samples: States, region: TrustRegion, charts: Sequence[tuple[float, float]],
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


def misplaced_tips(samples: States, choice: FitChoice, chart: Chart,
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


def with_slopes(samples: States) -> np.ndarray:
    """Return the samples of the shape's fit: those with known slopes, which are unknown at a snap;
    all if hardly any are known."""
    everything = np.arange(len(samples.poses))
    if samples.shape_slopes is None:
        return everything
    known = np.flatnonzero(np.isfinite(samples.shape_slopes).all(axis=(1, 2)))
    return known if len(known) >= 0.5 * len(everything) else everything


def slopes_on(chart: Chart, samples: States) -> np.ndarray | None:
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


def cross_validated_errors(samples: States, chart: Chart, choice: FitChoice, face: np.ndarray,
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


def error_measures(truth: States, energy: np.ndarray, force: np.ndarray,
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


_OPTIONAL = {"strains": "strains", "targets": "targets_m", "torques": "torques_nm",
             "strain_places": "strain_places_m", "stresses": "stresses_pa",
             "shape_slopes": "shape_slopes", "axial_forces": "axial_forces_n", "solved": "solved"}
WHAT = Text("an energy field (", Command("energy", Option("force", True)), " creates one)")
_SHAPES = {"poses": ("m", 6), "energies_j": ("m",), "forces_n": ("m", 3), "tips_m": ("m", 3),
           "min_det_f": ("m",), "rejected_poses": ("q", 6), "chart_pivot_m": (3,),
           "chart_radius_m": ()}
_OPTIONAL_SHAPES = {
    "strains": ("m",), "targets_m": ("m", "t", 3), "torques_nm": ("m", 3),
    "strain_places_m": ("m", 3), "stresses_pa": ("m",), "shape_slopes": ("m", 3, "s"),
    "axial_forces_n": ("m",), "solved": ("m",), "rest_pose": (6,)}
"""Shapes of the arrays in a file; equal letters are equal lengths."""
_CHOSEN = ("energy_fit", "shape_fit")  # whose kernels and charts are in it


@dataclass(frozen=True)
class FieldArrays:
    """A field and its limits as arrays for the kernels; see :meth:`EnergyField.limited`."""

    field: np.ndarray
    region: np.ndarray
    loads: np.ndarray
    max_energy: float
    max_force: float
    max_loads: np.ndarray
    low: np.ndarray
    high: np.ndarray
    slack: Slack

    @cached_property
    def numbers(self) -> np.ndarray:
        """What the kernels read, shape [n]."""
        return np.hstack([self.max_energy, self.max_force, len(self.max_loads), self.max_loads,
                          self.low, self.high, self.field, self.region, self.loads,
                          self.slack.numbers])


@dataclass(frozen=True)
class EnergyField:
    """Fitted field; positions [n, 3] in, arrays out. Make it with :func:`fit_field`.

    Attributes:
        samples: The samples of the fit.
        chart: Coordinates of the energy's fit.
        shape_chart: Coordinates of the other two.
        energy_fit: Interpolant of the energy (cut off at 0 by the methods).
        shape_fit: Channels: natural rotation vector, position of the tip and of each target.
        load_fit: Channels: those of ``load_names``.
        region: Region in which the field is trusted.
        errors: Errors at left-out samples; see :func:`error_measures`.
        missed: There, prediction less truth of energy [J], force [N] and loads, [m, 4 + loads]; nan
            if not known.
        misplaced: There, distance of the predicted tip and targets from the true ones [m], shape
            [m, 1 + targets]; nan if not known.
    """

    samples: States
    chart: Chart
    shape_chart: Chart
    energy_fit: RadialInterpolant
    shape_fit: RadialInterpolant
    load_fit: RadialInterpolant
    region: TrustRegion
    errors: dict[str, float]
    missed: np.ndarray
    misplaced: np.ndarray

    @property
    def rest(self) -> np.ndarray:
        """Position of the grasp in the rest state [m], shape [3]."""
        return self.samples.positions[0]

    @property
    def tested(self) -> np.ndarray:
        """Which samples tell the field's error, bool [m]: solved ones off the hull's face."""
        return _tested(self.samples, self.region)

    @property
    def load_names(self) -> tuple[str, ...]:
        """``LOADS``, and the loads added by a plan's constraints."""
        return tuple(self.samples.loads)

    def energy(self, points: np.ndarray) -> np.ndarray:
        """Return the deformation energy [J] at ``points`` [n, 3], never negative, shape [n]."""
        return np.maximum(self._value(self.energy_fit, points)[:, 0], 0.0)

    def energy_gradient(self, points: np.ndarray) -> np.ndarray:
        """Return the energy's gradient [N], shape [n, 3]; zero where the energy is cut off."""
        cut_off = self._value(self.energy_fit, points)[:, 0] <= 0.0
        return np.where(cut_off[:, None], 0.0, self._gradient(self.energy_fit, points, 0))

    def force(self, points: np.ndarray) -> np.ndarray:
        """Return the force that holds the grasp there [N], the energy's gradient, [n, 3]."""
        return self._gradient(self.energy_fit, points, 0)

    def poses(self, points: np.ndarray) -> np.ndarray:
        """Return positions with the natural rotation of the grasped piece there, [n, 6]."""
        return np.hstack([_rows(points), self._value(self.shape_fit, points, slice(3), True)])

    def tip(self, points: np.ndarray, target: int | None = None) -> np.ndarray:
        """Return the position of the tip, or a target, with the grasp at ``points`` [m], [n, 3].
        """
        first = 3 if target is None else 6 + 3 * target
        return self._value(self.shape_fit, points, slice(first, first + 3), True)

    def position_error(self, target: int | None = None) -> float:
        """Return the largest error of the field's position of the tip, or a target [m].

        The largest distance at left-out samples, inside the samples' hull; infinite if none is
        known.
        """
        off = self.misplaced[self.tested, 0 if target is None else 1 + target]
        return float(np.max(off, where=np.isfinite(off), initial=0.0)) if (
            np.isfinite(off).any()) else np.inf

    def place_errors(self, target: int | None, points: np.ndarray, covered: float = 1.0,
                     ) -> np.ndarray:
        """Return the possible error of the tip's position, or a target's, with the grasp at
        ``points`` [n, 3]: a fraction ``covered`` of the left-out samples keeps it, nowhere more
        than :meth:`position_error` [m], shape [n].
        """
        chart, known = self.region.chart.plain, self._known_place_errors
        if (target, covered) not in known:
            inner = self.tested
            known[target, covered] = LocalError.of(
                chart.map(self.samples.positions)[inner],
                self.misplaced[inner, 0 if target is None else 1 + target], covered,
                self.position_error(target))
        return known[target, covered].at(chart.map(_rows(points)))

    @cached_property
    def _known_place_errors(self) -> dict[tuple[int | None, float], LocalError]:
        return {}

    def tip_gradient(self, points: np.ndarray, target: int | None = None) -> np.ndarray:
        """Return d tip_c / d x_k, shape [n, 3 (k), 3 (c)]."""
        first = 3 if target is None else 6 + 3 * target
        return np.stack([self._gradient(self.shape_fit, points, first + c, True)
                         for c in range(3)], axis=2)

    def _value(self, fit: RadialInterpolant, points: np.ndarray, channels: slice = slice(1),
               shape: bool = False) -> np.ndarray:
        chart = self.shape_chart if shape else self.chart
        return fit.value(chart.map(_rows(points)), channels)

    def _gradient(self, fit: RadialInterpolant, points: np.ndarray, channel: int,
                  shape: bool = False) -> np.ndarray:
        points, chart = _rows(points), self.shape_chart if shape else self.chart
        slope = fit.gradient(chart.map(points), slice(channel, channel + 1))
        return chart.pull_back(points, slope[:, :, 0])

    def load(self, points: np.ndarray, name: str) -> np.ndarray:
        """Return one of the loads at ``points`` [n, 3], shape [n]."""
        channel = self.load_names.index(name)
        return self._value(self.load_fit, points, slice(channel, channel + 1), True)[:, 0]

    def load_gradient(self, points: np.ndarray, name: str) -> np.ndarray:
        """Return its gradient to the position, shape [n, 3]."""
        return self._gradient(self.load_fit, points, self.load_names.index(name), True)

    def limited(self, max_energy: float = np.inf, max_force: float = np.inf, *,
                low: np.ndarray | None = None, high: np.ndarray | None = None,
                slack: Slack | None = None, **max_loads: float) -> FieldArrays:
        """Return the arrays for the kernels, with limits on energy [J], force [N], the box from
        ``low`` to ``high`` [m] that the grasp stays in, and on loads by name (magnitudes);
        ``slack`` tightens them by position, in the order energy, force, loads.
        """
        return FieldArrays(np.hstack([self.chart.numbers, self.energy_fit.numbers]),
                           self.region.numbers,
                           np.hstack([self.shape_chart.numbers, self.load_fit.numbers]),
                           float(max_energy), float(max_force),
                           np.array([max_loads.get(name, np.inf) for name in self.load_names]),
                           np.full(3, -np.inf) if low is None else np.asarray(low, float),
                           np.full(3, np.inf) if high is None else np.asarray(high, float),
                           slack or slack_of(("energy", "force", *self.load_names), {}, 0.0))

    def write(self, path: Path, extra: dict[str, Any] | None = None) -> None:
        """Write ``energy.npz``: samples, kernels, charts and ``extra`` arrays; without pickling."""
        samples = self.samples
        arrays = {
            "poses": samples.poses, "energies_j": samples.energies,
            "forces_n": samples.forces, "tips_m": samples.tips, "min_det_f": samples.min_det_f,
            "rejected_poses": samples.rejected_poses,
            "chart_pivot_m": self.chart.pivot, "chart_radius_m": np.array(self.chart.radius),
            "chart_layers": np.array([[chart.stretch, chart.depth]
                                      for chart in (self.chart, self.shape_chart)])}
        for name in _CHOSEN:
            fit = getattr(self, name)
            arrays |= {f"{name}_kernel": np.array(fit.kernel), f"{name}_shape": np.array(fit.shape)}
        arrays |= {stored: getattr(samples, name) for name, stored in _OPTIONAL.items()
                   if getattr(samples, name) is not None}
        np.savez_compressed(path, **arrays, **(extra or {}))

    @classmethod
    def read(cls, path: Path) -> "EnergyField":
        """Read a file that :meth:`write` wrote; the samples are fitted again as they were.

        Raises:
            InputError: the file is not an energy field.
        """
        try:
            arrays = read_arrays(path, WHAT)
            require_shapes(path, arrays, _SHAPES | {
                name: shape for name, shape in _OPTIONAL_SHAPES.items() if name in arrays}, WHAT,
                           flags=("solved",))
            stored: dict[str, Any] = {name: arrays.get(key) for name, key in _OPTIONAL.items()}
            samples = States(
                arrays["poses"], arrays["energies_j"], arrays["forces_n"], arrays["tips_m"],
                arrays["min_det_f"], arrays["rejected_poses"], **stored)
            radius = float(arrays["chart_radius_m"])
            energy, shape = (FitChoice(
                str(arrays[f"{name}_kernel"]), float(arrays[f"{name}_shape"]), stretch,
                depth / (radius or 1.0)) for name, (stretch, depth) in zip(
                    _CHOSEN, arrays["chart_layers"].tolist(), strict=True))
            if not all(one.kernel in KERNELS and one.shape > 0.0 and one.stretch > 0.0
                       and one.depth > 0.0 for one in (energy, shape)):
                raise ValueError("unknown kernels or charts")
            return _fitted(samples, energy, shape, TrustRegion.of(
                samples.positions, samples.rejected_poses[:, :3], arrays["chart_pivot_m"], radius))
        except (KeyError, ValueError, OSError, TypeError) as error:
            raise InputError(f"{path} is not an energy field ({error}).",
                             Text("It was not written by ", Command("energy"), ", or is damaged."),
                             "Run ", Command("energy"), " again with ", Option("force", True),
                             ".") from error


def fit_field(samples: States, base: np.ndarray | None = None, radius: float | None = None,
              *, progress: Progress = SILENT) -> EnergyField:
    """Fit the field with the kernel and chart of least cross-validation error.

    Args:
        samples: Results of the branch model.
        base: Pivot of the shell along which the branch yields
            (:class:`~limber.planning.field.sampling.LowEnergySurface`), or the branch's
            root [m]; None: no chart is tried.
        radius: Radius of the shell [m]; by default the distance of the rest position.

    Raises:
        WorkError: too few samples, or they span no volume.
    """
    needed = 20
    if len(samples.poses) < needed:
        raise WorkError(f"Only {len(samples.poses)} grasp poses were accepted.",
                        f"A field in three coordinates needs at least {needed}.",
                        "Sample more poses, or use a smaller deflection.")
    if radius is None:
        radius = 0.0 if base is None else float(np.linalg.norm(samples.positions[0] - base))
    region = TrustRegion.of(samples.positions, samples.rejected_poses[:, :3], base, radius)
    charts = CHARTS_TRIED if base is not None else CHARTS_TRIED[:1]
    return _fitted(samples, *chosen_fits(samples, region, charts, progress), region)


def refit(field: EnergyField, added: States) -> EnergyField:
    """Return the field fitted to ``added`` samples as well, in the same manner."""
    return as_before(field, field.samples.joined(added))


def knowing(field: EnergyField, added: dict[str, np.ndarray]) -> EnergyField:
    """Return the field with ``added`` quantities at its samples as loads, by name, [m] each."""
    return as_before(field, replace(field.samples, added=added))


def as_before(field: EnergyField, samples: States) -> EnergyField:
    """Return a field fitted to ``samples`` in the manner of ``field``."""
    energy, shape = (FitChoice(fit.kernel, fit.shape, chart.stretch,
                               chart.depth / (chart.radius or 1.0))
                     for fit, chart in ((field.energy_fit, field.chart),
                                        (field.shape_fit, field.shape_chart)))
    region = TrustRegion.of(samples.positions, samples.rejected_poses[:, :3], field.chart.pivot,
                            field.chart.radius)
    return _fitted(samples, energy, shape, region)


def _tested(samples: States, region: TrustRegion) -> np.ndarray:
    return ~region.is_face() & (True if samples.solved is None else samples.solved)


def _fitted(samples: States, choice: FitChoice, bent: FitChoice, region: TrustRegion,
            ) -> EnergyField:
    chart = choice.on(region.chart)
    tested = _tested(samples, region)
    errors, missed = cross_validated_errors(samples, chart, choice, ~tested)
    in_chart = chart.map(samples.positions)
    forces = chart.push_forward(samples.positions, samples.forces)
    energy = RadialInterpolant.fit(in_chart, samples.energies, forces, kernel=choice.kernel,
                                   shape=choice.shape, smoothing=SMOOTHING)
    shape_chart = bent.on(region.chart)
    in_chart = shape_chart.map(samples.positions)
    options: dict[str, Any] = {"kernel": bent.kernel, "shape": bent.shape, "smoothing": SMOOTHING}
    sure = with_slopes(samples)
    bending = samples.take(sure)
    shape = RadialInterpolant.fit(in_chart[sure], bending.shape, slopes_on(shape_chart, bending),
                                  **options)
    loads = RadialInterpolant.fit(in_chart, samples.load_table, **options)
    off = -RadialInterpolant.leave_one_out(in_chart, samples.load_table, **options)[:, 0]
    off[:, [one is None for one in samples.loads.values()]] = np.nan
    found = misplaced_tips(bending, bent, region.chart, slice(None))
    misplaced = np.full((len(samples.poses), found.shape[1]), np.nan)
    misplaced[sure] = found
    errors["tip_error_median_m"] = float(np.median(found[tested[sure], 0]))
    return EnergyField(samples, chart, shape_chart, energy, shape, loads, region, errors,
                       np.column_stack([missed, off]), misplaced)


def _rows(points: np.ndarray) -> np.ndarray:
    return np.ascontiguousarray(points, float).reshape(-1, 3)


# The limited quantities of the field, one by one.

UNITS = {"energy": "J", "force": "N", "strain": "", "stress": "Pa", "axial_force": "N",
         "torque": "Nm", "closeness": ""}
"""Built-in limited quantities; a plan's constraints bring their own."""
_STEP = 1e-5  # [m] of finite differences


@dataclass(frozen=True)
class Quantity:
    """A quantity of poses on the field and its ``limit``, which ``slack`` tightens by position with
    its row ``row``."""

    field: EnergyField
    name: str
    limit: float
    row: int
    slack: Slack

    @property
    def words(self) -> str:
        return self.name.replace("_", " ")

    def size(self, points: np.ndarray) -> np.ndarray:
        """Return the limited quantity at ``points`` [n, 3], shape [n]."""
        if self.name == "energy":
            return self.field.energy(points)
        if self.name == "force":
            return np.linalg.norm(self.field.force(points), axis=1)
        return np.abs(self.field.load(points, self.name))

    def share(self, points: np.ndarray) -> np.ndarray:
        """Return it with the slack there, over its limit, shape [n]."""
        size = self.size(points)
        if self.slack.factors[self.row]:
            size = size + slacks_at(self.field.region.chart.plain.map(points), self.row, self.slack)
        return size / self.limit

    def limit_at(self, points: np.ndarray) -> np.ndarray:
        """Return the limit less the slack at ``points`` [n, 3], shape [n]."""
        limits = np.full(len(points), self.limit)
        if self.slack.factors[self.row]:
            limits -= slacks_at(self.field.region.chart.plain.map(points), self.row, self.slack)
        return limits

    @property
    def largest(self) -> float:
        """The limit where the slack extends it most."""
        return self.limit - min(float(self.slack.most[self.row]), 0.0)

    def slope(self, points: np.ndarray) -> np.ndarray:
        """Return the gradient of size and slack, shape [n, 3]."""
        field, chart = self.field, self.field.region.chart.plain
        if self.name == "energy":
            slope = field.energy_gradient(points)
        elif self.name == "force":
            # The Hessian times F / |F|: one difference along the force.
            force = field.force(points)
            step = _STEP * force / np.maximum(np.linalg.norm(force, axis=1), 1e-12)[:, None]
            slope = (field.force(points + step) - field.force(points - step)) / (2.0 * _STEP)
        else:
            slope = np.sign(field.load(points, self.name))[:, None] * field.load_gradient(
                points, self.name)
        if self.slack.factors[self.row]:
            slope = slope + chart.pull_back(points, slack_slopes(chart.map(points), self.row,
                                                                 self.slack))
        return slope

    def smooth(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return the energy, or the square of a load, and its gradient: without a kink at 0."""
        if self.name == "energy":
            return self.field.energy(points), self.field.force(points)
        load = self.field.load(points, self.name)
        return load**2, 2.0 * load[:, None] * self.field.load_gradient(points, self.name)

    def smooth_limit(self, limits: np.ndarray) -> np.ndarray:
        """Return the limit of :meth:`smooth` where the quantity's is ``limits``."""
        return limits if self.name == "energy" else limits**2

    def with_unit(self, value: float) -> str:
        """Return a value of it in words."""
        return f"{value:.3g} {UNITS.get(self.name, '')}".rstrip()


def limited(field: EnergyField, limits: FieldArrays) -> Iterator[Quantity]:
    """Yield the quantities with a finite limit: energy, force, and loads."""
    of_loads = zip(field.load_names, limits.max_loads, strict=True)
    asked = (("energy", limits.max_energy), ("force", limits.max_force), *of_loads)
    for row, (name, limit) in enumerate(asked):
        if limit < np.inf:
            yield Quantity(field, name, float(limit), row, limits.slack)
