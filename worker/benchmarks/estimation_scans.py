"""Intervals if the branch's shape is known only from a scan; a stopped run continues.

Each trial follows a user's steps: a branch is generated and scanned, its scan reconstructed, the
true branch pulled, and the moduli estimated on the reconstructed mesh.
"""

import json
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from benchmarks.budget import Budget
from benchmarks.table import Asked, Row, Setting, share_met
from benchmarks.trial_log import go_on, read_trials, source_digest
from limber.core.errors import LimberError
from limber.core.progress import SILENT, Progress
from limber.estimation.settings import EstimateSettings
from limber.estimation.simulated_pull import VirtualPullSettings
from limber.geometry.generated import generate_branch
from limber.stages.moduli.estimate import estimate
from limber.stages.pulls.virtual_pull import virtual_pull
from limber.stages.shape.generate import write_generated
from limber.stages.shape.reconstruct import reconstruct
from limber.store import Branch

VIEWS = ("round", "one-sided")
NOISES = (1e-3, 4e-4)
"""Noise of the scan's points [m]; seeds take turns."""
PARTS = ("sensor", "geometry", "mesh")


@dataclass(frozen=True)
class Trial:
    """One branch from scan to moduli.

    Attributes:
        seed: Seed of branch, scan and pull.
        view: How it was scanned.
        errors: Errors of log E, shape [K]; empty if the trial failed.
        low, high: 95 % interval of log E less the true one, shape [K].
        total: Stated standard deviation of log E, shape [K].
        parts: Its parts, median over the control points, in the order of ``PARTS``.
        is_poor: Whether the estimate warned that model and pull do not fit.
        failure: Why there is no estimate, or empty.
        seconds: Total time.
        source: Digest of the sources; trials of other sources are not reused.
    """

    seed: int
    view: str
    errors: tuple[float, ...]
    low: tuple[float, ...]
    high: tuple[float, ...]
    total: tuple[float, ...]
    parts: tuple[float, ...]
    is_poor: bool
    failure: str
    seconds: float
    source: str

    @property
    def covered(self) -> np.ndarray:
        """Whether each interval contains the truth, shape [K] of bool."""
        return (np.array(self.low) <= 0) & (np.array(self.high) >= 0)


SCAN_ROWS = (
    Asked("reconstructed from a scan: 95 % intervals that cover the truth", "88 to 99 %"),
    Asked("the same: error of E", "-"))


def scan_rows(setting: Setting) -> list[Row]:
    """Measure as many branches as there is time for, each scanned in both ways."""
    tasks = [(seed, view) for seed in setting.seeds(20, 2) for view in VIEWS]
    trials = run_trials(tasks, setting.kept / "estimation-scans.jsonl", setting.budget,
                        None, setting.progress)
    return [coverage_row(trials), size_row(trials)]


def coverage_row(trials: list[Trial]) -> Row:
    """Number of intervals that contain the truth; a trial without an estimate contains none."""
    sound = [trial for trial in trials if not trial.failure]
    covered = [trial.covered for trial in sound]
    share = float(np.mean(np.concatenate(covered))) if covered else 0.0
    by_view = {view: [trial.covered for trial in sound if trial.view == view] for view in VIEWS}
    told = ", ".join(f"{view} {100 * np.mean(held):.0f} %"
                     for view, held in by_view.items() if held)
    poor = sum(trial.is_poor for trial in trials)
    failed = sum(bool(trial.failure) for trial in trials)
    count = sum(map(len, covered))
    is_met = share_met(share, count, 0.88, 0.99)
    return Row(*SCAN_ROWS[0],
               f"{100 * share:.1f} % of {count} ({told}; {poor} of {len(trials)} "
               f"fits say that they are poor, {failed} failed)",
               False if failed else is_met, len(trials))


def size_row(trials: list[Trial]) -> Row:
    """Errors of the moduli, and of the intervals."""
    told = []
    for view in VIEWS:
        chosen = [trial for trial in trials if trial.view == view and not trial.failure]
        if not chosen:
            continue
        errors = np.concatenate([trial.errors for trial in chosen])
        over = errors / np.concatenate([trial.total for trial in chosen])
        parts = np.median([trial.parts for trial in chosen], axis=0)
        each = ", ".join(f"{name} {100 * part:.1f} %"
                         for name, part in zip(PARTS, parts, strict=True))
        told.append(f"{view}: median {100 * np.median(np.abs(errors)):.1f} %, "
                    f"{np.median(np.abs(over)) / 0.6745:.2f} of what is stated ({each})")
    return Row(*SCAN_ROWS[1], "; ".join(told), None, len(trials))


def run_trials(tasks: list[tuple[int, str]], kept: Path, budget: Budget,
               workers: int | None = None, progress: Progress = SILENT) -> list[Trial]:
    """Trials of seeds and views, including those in ``kept`` from the same sources."""
    return go_on(read_trials(Trial, kept), tasks, lambda trial: (trial.seed, trial.view), trial_of,
                 _source_digest(), kept, budget, workers, progress)


def trial_of(task: tuple[int, str]) -> Trial:
    """Generate, scan, reconstruct, pull and estimate one branch."""
    seed, view = task
    started = time.perf_counter()
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        try:
            found = from_scan(folder, seed, view)
            failure = ""
        except LimberError as error:
            found, failure = {}, str(error)
        truth = np.array(json.loads((folder / "scan" / "truth.json").read_text(
            encoding="utf-8"))["young_pa"])
    seconds = round(time.perf_counter() - started, 1)
    if failure:
        return Trial(seed, view, (), (), (), (), (), False, failure, seconds, _source_digest())
    interval = np.log(np.array(found["young_interval_pa"]) / truth[:, None])
    deviation = found["young_deviation"]
    medians = [np.nan if deviation[name] is None else float(np.median(deviation[name]))
               for name in PARTS]
    return Trial(seed, view, _floats(np.log(np.array(found["young_pa"]) / truth)),
                 _floats(interval[:, 0]), _floats(interval[:, 1]), _floats(deviation["total"]),
                 tuple(medians), any("fit is poor" in text for text in found["warnings"]), "",
                 seconds, _source_digest())


def from_scan(folder: Path, seed: int, view: str) -> dict:
    """Return the estimate of one branch; its files are left in ``folder``."""
    write_generated(generate_branch(seed, view=view, noise=NOISES[seed % len(NOISES)]),
                    folder / "scan")
    branch = folder / "branch"
    reconstruct(folder / "scan" / "cloud.ply", branch)
    virtual_pull(branch, "pull-1", VirtualPullSettings(seed=seed))
    estimate(branch, EstimateSettings())
    return json.loads(Branch.open(branch).path("estimate.json").read_text(encoding="utf-8"))


def _floats(values: np.ndarray) -> tuple[float, ...]:
    return tuple(np.asarray(values, float).tolist())


def _source_digest() -> str:
    return source_digest(("geometry", "mechanics", "estimation"), __file__)
