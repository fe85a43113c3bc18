"""Estimates against truths drawn anew: what was asked of them, what comes out."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from benchmarks import truth_beam, truth_branch, truth_scans, truth_states, truth_trials
from benchmarks.kept_trials import keep, read_trials, source_digest
from benchmarks.table import Row
from benchmarks.truth_recordings import bad_recordings_row
from benchmarks.truth_trials import Trial, trial
from limber.progress import Progress
from limber.recordings.calibration import CalibrationEntry

CELL = CalibrationEntry()
CALIBRATED = CalibrationEntry(pose_sigma_m=2e-4, pose_sigma_rad=3.5e-3)


def rows(quick: bool, progress: Progress, out: Path | None, seed: int) -> list[Row]:
    """Measure everything; ``seed`` is the base of all that is drawn.

    With ``out`` each trial is kept in ``truth-trials.jsonl`` and ``truth-scans.jsonl``: a run of
    the same seed that was stopped goes on there.
    """
    kept = out / "truth-trials.jsonl" if out else None
    scans = out / "truth-scans.jsonl" if out else None
    source = source_digest(("estimation", "mechanics"), __file__, truth_trials.__file__,
                           truth_branch.__file__)
    singles = _trials(4 if quick else 60, progress.part(0.0, 0.4), kept, source, (seed, 1),
                      lambda each: trial(each, CELL, 1, source=source))
    threes = _trials(2 if quick else 20, progress.part(0.4, 0.6), kept, source, (seed, 2),
                     lambda each: trial(each, CALIBRATED, 3, source=source))
    return [*cell_rows("one pull; sensor noise, force gain 2 %, zero and drift 1 N, gripper 1 mm "
                       "and 1 degree, camera 1 mm, density 10 %, nu 0.05, another form of the "
                       "field", singles, 0.12, quick),
            *cell_rows("three pulls, gripper calibrated to 0.2 mm and 0.2 degrees", threes, 0.06,
                       quick),
            truth_scans.scan_row(2 if quick else 30, progress.part(0.6, 0.9), scans, seed),
            bad_recordings_row(progress.part(0.9, 0.92), seed),
            *truth_beam.rows(progress.part(0.92, 0.94), seed),
            truth_beam.sag_row(4 if quick else 20, progress.part(0.94, 0.95), seed),
            *truth_states.rows(quick, progress.part(0.95, 1.0), seed)]


def _trials(count: int, progress: Progress, kept: Path | None, source: str,
            seed: tuple[int, ...], run: Callable[[tuple[int, ...]], Trial]) -> list[Trial]:
    known = {each.seed: each for each in read_trials(Trial, kept) if each.source == source}
    found = []
    for number in range(count):
        progress(number / count, f"trial {number + 1} of {count}")
        each = known.get((*seed, number))
        if each is None:
            each = run((*seed, number))
            keep(each, kept)
        found.append(each)
    return found


def cell_rows(label: str, trials: list[Trial], asked: float, quick: bool) -> list[Row]:
    """Error, coverage and width of a kind of trial."""
    fitted = [each for each in trials if not each.message]
    if not fitted:
        return [Row(f"{label}: estimates", "some", f"{len(trials)} of {len(trials)} refused: "
                    f"{trials[0].message}", False)]
    # A refusal is no small error.
    worst = [float(np.abs(each.errors).max()) if each.errors else np.inf for each in trials]
    covered = np.concatenate([each.covered for each in fitted])
    ratio = np.concatenate([np.array(each.widths) / each.bound for each in fitted])
    width = np.median([each.widths for each in fitted])
    share, median = float(covered.mean()), float(np.median(worst))
    ninth = float(np.quantile(worst, 0.9, method="lower"))
    refused = len(trials) - len(fitted)
    told = f", {refused} refused" if refused else ""
    told += f"; by the Cramer-Rao bounds it would be {100 * _efficient_median(fitted):.1f} %"
    enough = not quick
    return [
        Row(f"{label}: median of the worst E error", f"{100 * asked:.0f} %",
            f"{100 * median:.1f} % (90 % of trials under {100 * ninth:.0f} %; "
            f"{len(trials)} trials{told})", median <= asked),
        Row("95 % intervals that hold the truth", "90 to 99 %",
            f"{100 * share:.1f} % of {covered.size}",
            bool(0.9 <= share <= 0.99) if enough else None),
        Row("median half width of the intervals, over the Cramer-Rao bound of the problem",
            "1.5", f"{100 * width:.0f} %, {np.nanmedian(ratio):.2f} (worst {np.nanmax(ratio):.2f})",
            bool(np.nanmedian(ratio) <= 1.5))]


def _efficient_median(trials: list[Trial]) -> float:
    """Median of the worst E error of estimates as good as the Cramer-Rao bounds allow.

    Drawn from the bounds of the trials, the moduli's errors as independent of each other.
    """
    sigma = np.array([each.bound for each in trials]) / 1.96
    sigma = sigma[np.isfinite(sigma).all(axis=1)]
    drawn = np.random.default_rng(0).standard_normal((1000, *sigma.shape)) * sigma
    return float(np.median(np.abs(np.expm1(drawn)).max(axis=-1)))
