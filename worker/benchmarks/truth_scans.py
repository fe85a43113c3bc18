"""From a scan to moduli like a user: scan, reconstruct, import a pull, estimate.

The branches are cut from plants of the worlds and seen by their sensors. No constant was set on
their sources, but how the radius' error varies along a run (:mod:`limber.geometry.shape_samples`),
on other seeds. The pull is that of a rod with the true axes and radii, in a cell with all its
errors. A refusal counts as correct if it states what the scan lacks.
"""

import json
import tempfile
import time
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import truth_branch
from benchmarks.scan_cases import ScanCase
from benchmarks.table import Asked, Row, Setting, share_met
from benchmarks.trial_log import go_on, read_trials, source_digest
from benchmarks.truth_branch import recorded
from benchmarks.worlds.sources import LEFT_OUT, branch_case
from limber.core.errors import Cancelled, LimberError
from limber.estimation.estimated_branch import forwards_of, parameter_space, subject_of
from limber.estimation.fitting.objective import Objective
from limber.estimation.settings import EstimateSettings, VirtualPullSettings
from limber.estimation.simulated_pull import CellErrors, TrueBranch, simulate_pull
from limber.estimation.uncertainty.covariance import inverse_information
from limber.estimation.uncertainty.shape_error import SectionMean
from limber.geometry.reconstruction import mesh_skeleton
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.radii.fit_kernels import on_cylinders
from limber.geometry.skeleton.skeleton import FRACTIONS, Skeleton, control_points
from limber.recordings.cell_errors import CalibrationEntry
from limber.recordings.recording import Pull, write_pull
from limber.recordings.settings import ImportSettings
from limber.stages.moduli.estimate import estimate
from limber.stages.pulls.import_pull import import_pull
from limber.stages.shape.reconstruct import reconstruct
from limber.store import Branch
from limber.store.loading import hung_masses, load_skeleton

PLANTS = tuple(sorted(LEFT_OUT - {"opposite"}))
"""Sources in turn. Sections of the one left out are oval: no E I of theirs holds for all
directions.
"""
SCANS = (("one-sided", 1e-3), ("round", 1e-3), ("one-sided", 2e-3), ("round", 2e-3))
"""View and noise [m] in turn."""
YOUNG_PA = (1e9, 5e9)
"""Mean modulus of a branch, least and most: wood, as in the other trials."""
ZERO_N, ZERO_SHARE = 1.0, 0.05
"""Deviation of the force's zero, and of its drift: of the peak force if that is less, as a sensor
is chosen for the branch.
"""
LACKS = ("scan", "cloud", "point")
"""A helpful refusal names one of these."""
SETTINGS = EstimateSettings(hold_out=False)


@dataclass(frozen=True)
class ScanTrial:
    """One branch from scan to moduli.

    Attributes:
        seed: Seed of all draws.
        plant: Its source.
        view: How it was scanned.
        noise: Noise of the scan's points [m].
        errors: Relative errors of the moduli; empty: there is no estimate.
        covered: Whether each interval contains the truth.
        widths: Half widths of the intervals in log E.
        bending_covered: Whether each interval of E I contains the truth.
        bending_widths: Half widths of the intervals in log E I.
        bending_errors: Errors of log E I.
        bounds: Half widths of intervals by the Cramer-Rao bound if the shape were known: those of
            log E are then those of log E I. NaN: there is none.
        refusal: Why there is no estimate.
        seconds: Total time.
        source: Digest of the sources; trials of other sources are not reused.
    """

    seed: tuple[int, ...]
    plant: str
    view: str
    noise: float
    errors: tuple[float, ...]
    covered: tuple[bool, ...]
    widths: tuple[float, ...]
    bending_covered: tuple[bool, ...]
    bending_widths: tuple[float, ...]
    bending_errors: tuple[float, ...]
    bounds: tuple[float, ...]
    refusal: str
    seconds: float
    source: str


SCAN_ROW = Asked("scan to moduli, branches of left-out sources, round and one-sided, noise 1 and 2 "
                 "mm: 95 % intervals that hold",
                 "88 to 99 %, or a refusal that says what the scan lacks")
BENDING_ROW = Asked("the same of bending stiffness E I", "88 to 99 %")
WIDTH_ROW = Asked("the same: median half width of E I's intervals, over the Cramer-Rao bound with "
                  "known shape", "1.5")
ROWS = SCAN_ROW, BENDING_ROW, WIDTH_ROW


def scan_row(setting: Setting) -> list[Row]:
    """Measure as many branches as there is time for; sources, views and noises take turns."""
    source = source_digest(("estimation", "mechanics", "geometry"), __file__,
                           truth_branch.__file__,
                           *sorted((Path(__file__).parent / "worlds").glob("*.py")))
    kept = setting.kept / "truth-scans.jsonl"
    tasks = [(setting.seed, 3, number) for number in range(setting.at_most(24, 4))]
    trials = go_on(read_trials(ScanTrial, kept), tasks, lambda each: each.seed,
                   partial(scan_trial, source=source), source, kept, setting.budget, None,
                   setting.progress)
    return [coverage_row(trials), bending_row(trials), width_row(trials)]


def coverage_row(trials: list[ScanTrial]) -> Row:
    """Number of intervals that contain the truth, and whether refusals help."""
    fitted = [each for each in trials if not each.refusal]
    refused = [each.refusal for each in trials if each.refusal]
    mute = [text for text in refused if not any(word in text for word in LACKS)]
    held = np.concatenate([each.covered for each in fitted]) if fitted else np.zeros(0)
    share = float(held.mean()) if len(held) else 0.0
    worst = [float(np.abs(each.errors).max()) for each in fitted]
    size = f"; median of the worst error {100 * np.median(worst):.0f} %" if worst else ""
    is_met = share_met(share, len(held), 0.88, 0.99) if fitted else True
    return Row(
        *SCAN_ROW,
        f"{100 * share:.1f} % of {len(held)} ({len(trials)} branches, {len(refused)} refused, "
        f"{len(mute)} of these do not say what lacks{size})"
        + "".join(f"; {text[:100]}" for text in mute[:3]),
        False if mute else is_met, len(trials))


def bending_row(trials: list[ScanTrial]) -> Row:
    """Number of intervals of E I that contain the truth, and their width relative to those of E."""
    fitted = [each for each in trials if not each.refusal]
    if not fitted:
        return Row(*BENDING_ROW, "no estimate", False, len(trials))
    held = np.concatenate([each.bending_covered for each in fitted])
    width, of_young = (100 * np.median(np.concatenate(parts)) for parts in (
        [each.bending_widths for each in fitted], [each.widths for each in fitted]))
    size = 100 * np.median(np.abs(np.concatenate([each.bending_errors for each in fitted])))
    return Row(*BENDING_ROW, f"{100 * held.mean():.1f} % of {len(held)} (median error "
               f"{size:.0f} %, half width {width:.0f} %, of E {of_young:.0f} %)",
               share_met(float(held.mean()), len(held), 0.88, 0.99), len(trials))


def width_row(trials: list[ScanTrial]) -> Row:
    """Width of the intervals of E I relative to what the pull tells if the shape is known."""
    fitted = [each for each in trials if not each.refusal]
    ratios = np.concatenate([np.array(each.bending_widths) / np.array(each.bounds, float)
                             for each in fitted]) if fitted else np.zeros(0)
    if not np.isfinite(ratios).any():
        return Row(*WIDTH_ROW, "no estimate", False, len(trials))
    by_scan = "; ".join(
        f"{view} {1e3 * noise:.0f} mm {np.nanmedian(np.concatenate(parts)):.2f}"
        for view, noise in SCANS if (parts := [
            np.array(each.bending_widths) / np.array(each.bounds, float) for each in fitted
            if (each.view, each.noise) == (view, noise)]))
    median = float(np.nanmedian(ratios))
    return Row(*WIDTH_ROW, f"{median:.2f} (worst {np.nanmax(ratios):.1f}; {by_scan})",
               median <= 1.5, len(trials))


def scan_trial(seed: tuple[int, ...], source: str = "") -> ScanTrial:
    """Draw a branch, scan it, reconstruct it, pull it in a cell with errors, and estimate."""
    rng, number = np.random.default_rng(seed), seed[-1]
    plant, (view, noise) = PLANTS[number % len(PLANTS)], SCANS[number % len(SCANS)]
    case = branch_case(int(rng.integers(2**31)), plant, view, noise)
    started = time.perf_counter()
    found: _Loop | None = None
    refusal = ""
    with tempfile.TemporaryDirectory() as temporary:
        try:
            found = _looped(Path(temporary), case, rng)
        except Cancelled:
            # Stopped from outside: not a trial.
            raise
        except LimberError as error:
            refusal = str(error)
    seconds = round(time.perf_counter() - started, 1)
    if found is None:
        return ScanTrial(seed, plant, view, noise, (), (), (), (), (), (), (), refusal,
                         seconds, source)
    written = found.written
    errors = np.array(written["young_pa"]) / found.young - 1
    return ScanTrial(
        seed, plant, view, noise, tuple(errors.tolist()),
        *_compared(written["young_interval_pa"], found.young),
        *_compared(written["bending_stiffness_interval_nm2"], found.bending),
        tuple(np.log(np.array(written["bending_stiffness_nm2"]) / found.bending).tolist()),
        tuple(found.bounds.tolist()), "", seconds, source)


def _compared(interval: list, truth: np.ndarray) -> tuple[tuple[bool, ...], tuple[float, ...]]:
    """Whether each interval contains its truth, and their half widths in the log."""
    low, high = np.log(np.array(interval, float)).T
    log_truth = np.log(truth)
    return (tuple(((low <= log_truth) & (log_truth <= high)).tolist()),
            tuple(((high - low) / 2).tolist()))


@dataclass(frozen=True)
class _Loop:
    """What was estimated, and the truth at the same control points, each of shape [K].

    Attributes:
        written: Content of ``estimate.json``.
        young: True E [Pa].
        bending: True E I [N m^2] over the control points' parts.
        bounds: As :attr:`ScanTrial.bounds`.
    """

    written: dict
    young: np.ndarray
    bending: np.ndarray
    bounds: np.ndarray


def _looped(folder: Path, case: ScanCase, rng: np.random.Generator) -> _Loop:
    """Reconstruct a scan, pull its true branch, import the pull and estimate."""
    drawn = np.exp(rng.uniform(*np.log(YOUNG_PA)) + np.linspace(0.4, -0.4, len(FRACTIONS))
                   + rng.uniform(-0.5, 0.5, len(FRACTIONS)))
    folder_of_branch = folder / "drawn.branch"
    reconstructing = ReconstructSettings(**{"root": "auto"} | case.settings)
    reconstruct(case.write(folder), folder_of_branch, reconstructing)
    branch = Branch.open(folder_of_branch)
    axes = case.truth.moved(branch.manifest.alignment.apply(case.truth.nodes))
    meshed = mesh_skeleton(axes, reconstructing)
    truth = TrueBranch(meshed.mesh, axes, control_points(axes), FRACTIONS, drawn, branch.gravity)
    settings = VirtualPullSettings(model="rod", position_noise=0.0, force_noise=0.0, frames=60,
                                   reach=0.3, seed=int(rng.integers(2**31)))
    exact = simulate_pull(truth, "pull-1", settings)[0]
    peak = float(np.linalg.norm(exact.wrenches[:, :3], axis=1).max())
    zero = min(ZERO_N, ZERO_SHARE * peak)
    cell = CalibrationEntry(force_bias_sigma_n=zero, force_drift_sigma_n=zero)
    pull = recorded(exact, CellErrors.drawn(cell, rng), rng)
    _imported(folder / "recorded", pull, folder_of_branch)
    estimate(folder_of_branch, SETTINGS)
    done = Branch.open(folder_of_branch)
    written = json.loads(done.path("estimate.json").read_text(encoding="utf-8"))
    young = truth.young_at(np.array(written["control_points_m"]))
    return _Loop(written, young, _true_bending(done, axes, young, written),
                 _bounds(truth, hung_masses(meshed.masses, ()), exact, pull, written))


def _imported(folder: Path, pull: Pull, branch: Path) -> None:
    """Import a recording as a user does: tables of the robot and of the markers."""
    write_pull(folder, pull)
    entry, sensor = pull.entry, folder / "sensor.toml"
    sensor.write_text("[calibration]\n" + "".join(
        f"{name} = {getattr(entry.calibration, name)!r}\n"
        for name in ("force_bias_sigma_n", "force_drift_sigma_n")), encoding="utf-8")
    import_pull(branch, folder / "markers.csv", "pull-1", ImportSettings(
        robot=str(folder / "robot.csv"), time_offset=0.0, grasp_point=entry.grasp.point_m,
        grasp_radius=entry.grasp.radius_m, grasp_mode="point",
        position_sigma=entry.sensor.position_sigma_m, force_sigma=entry.sensor.force_sigma_n,
        pull_toml=str(sensor)))


def _true_bending(branch: Branch, true: Skeleton, young: np.ndarray, written: dict) -> np.ndarray:
    """True E times the second moment of area of the true branch, over the same parts, shape [K]."""
    skeleton = load_skeleton(branch)
    low, high, fraction, _ = on_cylinders(true, skeleton.nodes[skeleton.main_path()])
    radius = (1 - fraction) * true.radius[low] + fraction * true.radius[high]
    mean = SectionMean(np.array(written["bending_stiffness_share"]))
    return young * np.exp(mean.log_second_moment(radius))


def _bounds(truth: TrueBranch, masses: tuple, exact: Pull, pull: Pull, written: dict,
            ) -> np.ndarray:
    """Half widths of 95 % intervals of log E by the bound, on the true shape, shape [K].

    The information is taken at the truth, from all that the cell records, with the priors of its
    errors and of the field's form.
    """
    settings = SETTINGS.model_copy(update={"fractions": tuple(written["fractions"])})
    subject = subject_of(truth.mesh, truth.skeleton, masses, truth.gravity, settings)
    seen = replace(pull, poses=exact.poses, wrenches=exact.wrenches,
                   observations=exact.observations)
    forwards = forwards_of([seen], subject, settings)
    objective = Objective(forwards, parameter_space(subject, forwards, settings),
                          force_sigma=[pull.entry.sensor.force_sigma_n])
    values = replace(subject.start, young=truth.young_at(subject.control_points))
    evaluation = objective.evaluate(objective.space.pack(values), jacobian=True)
    count = len(values.young)
    if evaluation is None:
        return np.full(count, np.nan)
    return 1.96 * np.sqrt(np.diag(inverse_information(evaluation.slopes))[:count])
