"""From a scan to moduli like a user: scan, reconstruct, import a pull, estimate.

The branches are cut from plants of the worlds and seen by their sensors. No constant was set on
their sources, but how the radius' error varies along a run (:mod:`limber.geometry.shape_samples`),
on other seeds. The pull is that of a rod with the true axes and radii, in a cell with all its
errors. A refusal counts as correct if it states what the scan lacks.
"""

import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.drawn_branches import recorded
from benchmarks.scan_cases import ScanCase
from benchmarks.table import Asked, Row, Setting, share_met
from benchmarks.trials import Trial, column, joined, sound
from benchmarks.worlds.sources import LEFT_OUT, branch_case
from limber.core.errors import LimberError, WorkError
from limber.core.progress import Progress
from limber.estimation.estimated_branch import forwards_of, parameter_space, subject_of
from limber.estimation.fitting.objective import Objective, inverse_information
from limber.estimation.settings import FitSpec, PullSpec
from limber.estimation.simulated_pull import CellErrors, TrueBranch, simulate_pull
from limber.estimation.uncertainty.shape_error import SectionMean
from limber.geometry.reconstruction import mesh_skeleton
from limber.geometry.settings import ReconstructSettings
from limber.geometry.skeleton.radii.fit_kernels import on_cylinders
from limber.geometry.skeleton.skeleton import FRACTIONS, Skeleton, control_points
from limber.geometry.tets.tet_mesh import TetMesh
from limber.recordings.recording import CalibrationEntry, Pull, write_pull
from limber.recordings.settings import ImportSpec
from limber.stages.moduli.estimate import EstimateYoung
from limber.stages.pulls.import_pull import ImportPull
from limber.stages.shape.reconstruct import Reconstruct
from limber.store import Branch
from limber.store.loading import hung_masses, load_skeleton

PLANTS = tuple(sorted(LEFT_OUT - {"opposite"}))
"""Sources in turn. Sections of the one left out are oval: no E I of theirs holds for all
directions.
"""
SCANS = (("one-sided", 1e-3), ("round", 1e-3), ("one-sided", 2e-3), ("round", 2e-3))
"""View and noise [m] in turn."""
YOUNG_PA = (3e5, 1e10)
"""Mean modulus of a branch, least and most. One that cannot stand as it was scanned, or cannot be
pulled, is made threefold stiffer."""
ZERO_N, ZERO_SHARE = 1.0, 0.05
"""Deviation of the force's zero, and of its drift: of the peak force if that is less, as a sensor
is chosen for the branch.
"""
LACKS = ("scan", "cloud", "point")
"""A helpful refusal names one of these."""
SETTINGS = FitSpec(hold_out=False)


class _Import(ImportSpec, ImportPull):
    """An import."""


class _Fit(FitSpec, EstimateYoung):
    """An estimate with what only Python sets."""


SCAN_ROW = Asked("scan to moduli, 0.3 MPa to 10 GPa, branches of left-out sources, round and "
                 "one-sided, noise 1 and 2 mm: 95 % intervals that hold",
                 "88 to 99 %, or a refusal that says what the scan lacks")
BENDING_ROW = Asked("the same of bending stiffness E I", "88 to 99 %")
WIDTH_ROW = Asked("the same: median half width of E I's intervals, over the Cramer-Rao bound with "
                  "known shape", "1.5")
ENDS_ROW = Asked("the same: estimates that end with a result or a reason; longest silence, in "
                 "processor time", "all; 10 s")
ROWS = SCAN_ROW, BENDING_ROW, WIDTH_ROW, ENDS_ROW


def loop_rows(setting: Setting) -> list[Row]:
    """Measure as many branches as there is time for; sources, views and noises take turns."""
    trials = setting.trials("loops", setting.seeds(60, 4), loop, "estimation", "mechanics",
                            "geometry", workers=None, catch=LimberError)
    if not sound(trials):
        return [coverage_row(trials), *(Row(*asked, "no estimate", False, len(trials))
                                        for asked in ROWS[1:])]
    return [coverage_row(trials), *(row(sound(trials)) for row in (
        bending_row, width_row, ends_row))]


def scan_of(seed: int) -> tuple[str, str, float]:
    """Source, view and noise [m] of a branch."""
    return (PLANTS[seed % len(PLANTS)], *SCANS[seed % len(SCANS)])


def coverage_row(trials: list[Trial]) -> Row:
    """Number of intervals that contain the truth, and whether refusals help."""
    fitted, refused = sound(trials), [each.failure for each in trials if each.failure]
    mute = [text for text in refused if not any(word in text for word in LACKS)]
    held = joined(fitted, "covered")
    share = float(held.mean()) if len(held) else 0.0
    worst = [float(np.abs(each["errors"]).max()) for each in fitted]
    size = f"; median of the worst error {100 * np.median(worst):.0f} %" if worst else ""
    is_met = share_met(share, len(held), 0.88, 0.99) if fitted else True
    return Row(
        *SCAN_ROW,
        f"{100 * share:.1f} % of {len(held)} ({len(trials)} branches, {len(refused)} refused, "
        f"{len(mute)} of these do not say what lacks{size})"
        + "".join(f"; {text[:100]}" for text in mute[:3]),
        False if mute else is_met, len(trials))


def bending_row(fitted: list[Trial]) -> Row:
    """Number of intervals of E I that contain the truth, and their width relative to those of E."""
    held = joined(fitted, "bending_covered")
    width, of_young, size = (100 * np.median(np.abs(joined(fitted, name))) for name in (
        "bending_widths", "widths", "bending_errors"))
    return Row(*BENDING_ROW, f"{100 * held.mean():.1f} % of {len(held)} (median error "
               f"{size:.0f} %, half width {width:.0f} %, of E {of_young:.0f} %)",
               share_met(float(held.mean()), len(held), 0.88, 0.99), len(fitted))


def width_row(fitted: list[Trial]) -> Row:
    """Width of the intervals of E I relative to what the pull tells if the shape is known."""
    def ratios(some: list[Trial]) -> np.ndarray:
        return joined(some, "bending_widths") / joined(some, "bounds")

    by_scan = "; ".join(
        f"{view} {1e3 * noise:.0f} mm {np.nanmedian(ratios(own)):.2f}" for view, noise in SCANS
        if (own := [each for each in fitted if scan_of(each.task)[1:] == (view, noise)]))
    median = float(np.nanmedian(ratios(fitted)))
    return Row(*WIDTH_ROW, f"{median:.2f} (worst {np.nanmax(ratios(fitted)):.1f}; {by_scan})",
               median <= 1.5, len(fitted))


def ends_row(fitted: list[Trial]) -> Row:
    """How long results took. A fit without an end has no trial: the bench ends by its error."""
    silence, seconds = column(fitted, "silence"), column(fitted, "seconds")
    return Row(*ENDS_ROW, f"all; {silence.max():.1f} s (a fit: median {np.median(seconds):.0f} s, "
               f"worst {seconds.max():.0f} s)", bool(silence.max() <= 10), len(fitted))


def loop(seed: int) -> dict[str, Any]:
    """Draw a branch, scan it, reconstruct it, pull it in a cell with errors, and estimate.

    Returns:
        Relative errors of E; of E and of E I: whether intervals contain the truth, their half
        widths in the log; errors of log E I; ``bounds``: half widths of intervals by the
        Cramer-Rao bound if the shape were known, the same for log E and log E I. Each of shape [K].
        Processor ``seconds`` of the estimate, and the longest part without a report, ``silence``.
    """
    rng = np.random.default_rng([seed, 3])
    with tempfile.TemporaryDirectory() as temporary:
        return _looped(Path(temporary), branch_case(int(rng.integers(2**31)), *scan_of(seed)), rng)


def _compared(interval: list, truth: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whether each interval contains its truth, and their half widths in the log."""
    low, high = np.log(np.array(interval, float)).T
    log_truth = np.log(truth)
    return (low <= log_truth) & (log_truth <= high), (high - low) / 2


def _looped(folder: Path, case: ScanCase, rng: np.random.Generator) -> dict[str, Any]:
    """Reconstruct a scan, pull its true branch, import the pull and estimate."""
    folder_of_branch = folder / "drawn.branch"
    reconstructing = ReconstructSettings(**{"root": "auto"} | case.settings)
    Reconstruct.of(reconstructing, cloud=case.write(folder), output=folder_of_branch).run()
    branch = Branch.open(folder_of_branch)
    axes = case.truth.moved(branch.manifest.alignment.apply(case.truth.nodes))
    meshed = mesh_skeleton(axes, reconstructing)
    truth, exact = _pulled(meshed.mesh, axes, branch.gravity, rng)
    peak = float(np.linalg.norm(exact.wrenches[:, :3], axis=1).max())
    zero = min(ZERO_N, ZERO_SHARE * peak)
    cell = CalibrationEntry(force_bias_sigma_n=zero, force_drift_sigma_n=zero)
    pull = recorded(exact, CellErrors.drawn(cell, rng), rng)
    _imported(folder / "recorded", pull, folder_of_branch)
    reports = [time.process_time()]
    _Fit.of(SETTINGS, branch_folder=folder_of_branch).run(
        Progress(lambda *_: reports.append(time.process_time())))
    reports.append(time.process_time())
    done = Branch.open(folder_of_branch)
    written = json.loads(done.path("estimate.json").read_text(encoding="utf-8"))
    young = truth.young_at(np.array(written["control_points_m"]))
    bending = _true_bending(done, axes, young, written)
    covered, widths = _compared(written["young_interval_pa"], young)
    bending_covered, bending_widths = _compared(written["bending_stiffness_interval_nm2"], bending)
    return {"errors": np.array(written["young_pa"]) / young - 1, "covered": covered,
            "widths": widths, "bending_covered": bending_covered,
            "bending_widths": bending_widths,
            "bending_errors": np.log(np.array(written["bending_stiffness_nm2"]) / bending),
            "bounds": _bounds(truth, hung_masses(meshed.masses, ()), exact, pull, written),
            "seconds": reports[-1] - reports[0], "silence": np.diff(reports).max()}


def _pulled(mesh: TetMesh, axes: Skeleton, gravity: tuple[float, float, float],
            rng: np.random.Generator) -> tuple[TrueBranch, Pull]:
    """A branch with drawn moduli that stands and bears a pull as a rod, and that pull."""
    drawn = np.exp(rng.uniform(*np.log(YOUNG_PA)) + np.linspace(0.4, -0.4, len(FRACTIONS))
                   + rng.uniform(-0.5, 0.5, len(FRACTIONS)))
    settings = PullSpec(model="rod", position_noise=0.0, force_noise=0.0, frames=60, reach=0.3,
                        seed=int(rng.integers(2**31)))
    while True:
        truth = TrueBranch(mesh, axes, control_points(axes), FRACTIONS, drawn, gravity)
        try:
            pull = simulate_pull(truth, "pull-1", settings)[0]
            if not pull.entry.weightless:
                return truth, pull
        except WorkError:
            if drawn.max() > YOUNG_PA[1]:
                raise
        drawn = 3 * drawn


def _imported(folder: Path, pull: Pull, branch: Path) -> None:
    """Import a recording as a user does: tables of the robot and of the markers."""
    write_pull(folder, pull)
    entry, sensor = pull.entry, folder / "sensor.toml"
    sensor.write_text("[calibration]\n" + "".join(
        f"{name} = {getattr(entry.calibration, name)!r}\n"
        for name in ("force_bias_sigma_n", "force_drift_sigma_n")), encoding="utf-8")
    _Import(branch_folder=branch, source=folder / "markers.csv", name="pull-1",
               robot=str(folder / "robot.csv"), time_offset=0.0, grasp_point=entry.grasp.point_m,
               grasp_radius=entry.grasp.radius_m, grasp_mode="point",
               position_sigma=entry.sensor.position_sigma_m, force_sigma=entry.sensor.force_sigma_n,
               pull_toml=str(sensor)).run()


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
