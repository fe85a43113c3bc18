"""From a scan to moduli like a user: generate, reconstruct, import a pull, estimate.

The pull is of the true branch, in a cell with all its errors; the scan is noisier than a laser's. A
refusal counts as correct if it states what the scan lacks.
"""

import json
import tempfile
import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import truth_branch
from benchmarks.table import Asked, Row, Setting, share_met
from benchmarks.trial_log import go_on, read_trials, source_digest
from benchmarks.truth_branch import recorded
from limber.core.errors import Cancelled, LimberError
from limber.estimation.settings import EstimateSettings, VirtualPullSettings
from limber.estimation.simulated_pull import simulate_pull
from limber.estimation.uncertainty.bending_stiffness import SectionMean
from limber.estimation.virtual_cell import CellErrors
from limber.geometry.generated import generate_branch
from limber.geometry.skeleton.radii.cylinders import on_cylinders
from limber.mechanics.materials.young_field import young_weights
from limber.recordings.cell_errors import CalibrationEntry
from limber.recordings.recording import write_pull
from limber.recordings.settings import ImportSettings
from limber.stages.moduli.estimate import estimate
from limber.stages.pulls.import_pull import import_pull
from limber.stages.pulls.virtual_pull import load_truth
from limber.stages.shape.generate import write_generated
from limber.stages.shape.reconstruct import reconstruct
from limber.store import Branch
from limber.store.loading import load_mesh, load_skeleton

VIEWS = ("round", "one-sided")
NOISE_M = (1e-3, 3e-3)
"""Noise of the scan's points, least and most."""
YOUNG_PA = (1e9, 5e9)
"""Mean modulus of a branch, least and most: wood, as in the other trials."""
LACKS = ("scan", "cloud", "point")
"""A helpful refusal names one of these."""


@dataclass(frozen=True)
class ScanTrial:
    """One branch from scan to moduli.

    Attributes:
        seed: Seed of all draws.
        view: How it was scanned.
        noise: Noise of the scan's points [m].
        errors: Relative errors of the moduli; empty: there is no estimate.
        covered: Whether each interval contains the truth.
        widths: Half widths of the intervals in log E.
        bending_covered: Whether each interval of E I contains the truth.
        bending_widths: Half widths of the intervals in log E I.
        refusal: Why there is no estimate.
        seconds: Total time.
        source: Digest of the sources; trials of other sources are not reused.
    """

    seed: tuple[int, ...]
    view: str
    noise: float
    errors: tuple[float, ...]
    covered: tuple[bool, ...]
    widths: tuple[float, ...]
    bending_covered: tuple[bool, ...]
    bending_widths: tuple[float, ...]
    refusal: str
    seconds: float
    source: str


SCAN_ROW = Asked("scan to moduli, round and one-sided, noise 1 to 3 mm: 95 % intervals that hold",
                 "88 to 99 %, or a refusal that says what the scan lacks")
BENDING_ROW = Asked("the same of bending stiffness E I", "88 to 99 %")
ROWS = SCAN_ROW, BENDING_ROW


def scan_row(setting: Setting) -> list[Row]:
    """Measure as many branches as there is time for, views in turn."""
    source = source_digest(("estimation", "mechanics", "geometry"), __file__,
                           truth_branch.__file__)
    kept = setting.kept / "truth-scans.jsonl"
    tasks = [(setting.seed, 3, number) for number in range(setting.at_most(30, 2))]
    trials = go_on(read_trials(ScanTrial, kept), tasks, lambda each: each.seed,
                   partial(scan_trial, source=source), source, kept, setting.budget, None,
                   setting.progress)
    return [coverage_row(trials), bending_row(trials)]


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
    return Row(*BENDING_ROW, f"{100 * held.mean():.1f} % of {len(held)} (median half width "
               f"{width:.0f} %, of E {of_young:.0f} %)",
               share_met(float(held.mean()), len(held), 0.88, 0.99), len(trials))


def scan_trial(seed: tuple[int, ...], source: str = "") -> ScanTrial:
    """Draw a branch, scan it, reconstruct it, pull it in a cell with errors, and estimate."""
    rng, view = np.random.default_rng(seed), VIEWS[seed[-1] % len(VIEWS)]
    noise = float(rng.uniform(*NOISE_M))
    made = generate_branch(int(rng.integers(2**31)), view=view, noise=noise,
                           young_mean=float(np.exp(rng.uniform(*np.log(YOUNG_PA)))))
    started = time.perf_counter()
    found, refusal = {}, ""
    with tempfile.TemporaryDirectory() as temporary:
        try:
            found = _estimated(Path(temporary), made, rng)
        except Cancelled:
            # Stopped from outside: not a trial.
            raise
        except LimberError as error:
            refusal = str(error)
    seconds = round(time.perf_counter() - started, 1)
    if refusal:
        return ScanTrial(seed, view, noise, (), (), (), (), (), refusal, seconds, source)
    of_young, of_bending = (_compared(found[name], truth) for name, truth in (
        ("young_interval_pa", made.young),
        ("bending_stiffness_interval_nm2", found["true_bending_stiffness"])))
    return ScanTrial(seed, view, noise,
                     tuple((np.array(found["young_pa"]) / made.young - 1).tolist()),
                     *of_young, *of_bending, "", seconds, source)


def _compared(interval: list, truth: np.ndarray) -> tuple[tuple[bool, ...], tuple[float, ...]]:
    """Whether each interval contains its truth, and their half widths in the log."""
    low, high = np.log(np.array(interval, float)).T
    log_truth = np.log(truth)
    return (tuple(((low <= log_truth) & (log_truth <= high)).tolist()),
            tuple(((high - low) / 2).tolist()))


def _true_bending(branch: Branch, made: object) -> np.ndarray:
    """True E times the second moment of area of the true branch, over the same parts, shape [K]."""
    skeleton, mesh = load_skeleton(branch), load_mesh(branch)
    points = np.array(json.loads(branch.path("estimate.json").read_text())["control_points_m"])
    true = made.skeleton
    low, high, fraction, _ = on_cylinders(true, skeleton.nodes)
    radius = (1 - fraction) * true.radius[low] + fraction * true.radius[high]
    mean = SectionMean.of(skeleton, mesh, young_weights(mesh, points))
    return made.young * np.exp(mean.log_second_moment(radius))


def _estimated(folder: Path, made: object, rng: np.random.Generator) -> dict:
    write_generated(made, folder / "scan")
    branch = folder / "drawn.branch"
    reconstruct(folder / "scan" / "cloud.ply", branch)
    settings = VirtualPullSettings(young=tuple(made.young.tolist()), position_noise=0.0,
                                   force_noise=0.0, frames=60, reach=0.3,
                                   seed=int(rng.integers(2**31)))
    exact = simulate_pull(load_truth(Branch.open(branch), settings), "pull-1", settings)[0]
    pull = recorded(exact, CellErrors.drawn(CalibrationEntry(), rng), rng)
    write_pull(folder / "recorded", pull)
    entry = pull.entry
    import_pull(branch, folder / "recorded" / "markers.csv", "pull-1", ImportSettings(
        robot=str(folder / "recorded" / "robot.csv"), time_offset=0.0,
        grasp_point=entry.grasp.point_m, grasp_radius=entry.grasp.radius_m, grasp_mode="pinned",
        position_sigma=entry.sensor.position_sigma_m, force_sigma=entry.sensor.force_sigma_n))
    estimate(branch, EstimateSettings(hold_out=False))
    done = Branch.open(branch)
    return json.loads(done.path("estimate.json").read_text(encoding="utf-8")) | {
        "true_bending_stiffness": _true_bending(done, made)}
