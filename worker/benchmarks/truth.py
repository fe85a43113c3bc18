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


def rows(quick: bool, progress: Progress, out: Path | None, seed: int,
         only: tuple[str, ...] = ()) -> list[Row]:
    """Measure the parts named in ``only``, or all; ``seed`` is the base of all that is drawn.

    With ``out`` each trial is kept in ``truth-trials.jsonl`` and ``truth-scans.jsonl``: a run of
    the same seed that was stopped goes on there.
    """
    table, chosen = [], only or tuple(PARTS)
    for number, name in enumerate(chosen):
        part = progress.part(number / len(chosen), (number + 1) / len(chosen))
        table += PARTS[name](quick, part, out, seed)
    return table


def _one_pull(quick: bool, progress: Progress, out: Path | None, seed: int) -> list[Row]:
    return _cell_rows("one pull; sensor noise, force gain 2 %, zero and drift 1 N, gripper 1 mm "
                      "and 1 degree, camera 1 mm, density 10 %, nu 0.05, another form of the "
                      "field", _trials(4 if quick else 60, progress, out, (seed, 1), CELL, 1),
                      0.12, quick)


def _three_pulls(quick: bool, progress: Progress, out: Path | None, seed: int) -> list[Row]:
    return _cell_rows("three pulls, gripper calibrated to 0.2 mm and 0.2 degrees", _trials(
        2 if quick else 20, progress, out, (seed, 2), CALIBRATED, 3), 0.06, quick)


def _scans(quick: bool, progress: Progress, out: Path | None, seed: int) -> list[Row]:
    kept = out / "truth-scans.jsonl" if out else None
    return [truth_scans.scan_row(2 if quick else 30, progress, kept, seed)]


PARTS: dict[str, Callable[[bool, Progress, Path | None, int], list[Row]]] = {
    "one-pull": _one_pull, "three-pulls": _three_pulls, "scans": _scans,
    "bad-recordings": lambda quick, progress, out, seed: [bad_recordings_row(progress, seed)],
    "beam": lambda quick, progress, out, seed: truth_beam.rows(progress, seed),
    "sag": lambda quick, progress, out, seed: [
        truth_beam.sag_row(4 if quick else 20, progress, seed)],
    "swing": lambda quick, progress, out, seed: [
        truth_states.swing_row(quick, progress, np.random.default_rng([seed, 11]))],
    "reduced": lambda quick, progress, out, seed: truth_states.doubt_rows(
        quick, progress, np.random.default_rng([seed, 12])),
    "second-pull": lambda quick, progress, out, seed: truth_states.quick_rows(
        np.random.default_rng([seed, 13]))}
"""What ``--only`` knows."""


def _trials(count: int, progress: Progress, out: Path | None, seed: tuple[int, ...],
            cell: CalibrationEntry, pull_count: int) -> list[Trial]:
    kept = out / "truth-trials.jsonl" if out else None
    source = source_digest(("estimation", "mechanics"), __file__, truth_trials.__file__,
                           truth_branch.__file__)
    known = {each.seed: each for each in read_trials(Trial, kept) if each.source == source}
    found = []
    for number in range(count):
        progress(number / count, f"trial {number + 1} of {count}")
        each = known.get((*seed, number))
        if each is None:
            each = trial((*seed, number), cell, pull_count, source=source)
            keep(each, kept)
        found.append(each)
    return found


def _cell_rows(label: str, trials: list[Trial], asked: float, quick: bool) -> list[Row]:
    """Error, coverage and width of a kind of trial."""
    fitted = [each for each in trials if not each.message]
    if not fitted:
        return [Row(f"{label}: estimates", "some", f"{len(trials)} of {len(trials)} refused: "
                    f"{trials[0].message}", False)]
    # A refusal is no small error.
    worst = [float(np.abs(each.errors).max()) if each.errors else np.inf for each in trials]
    covered = np.concatenate([each.covered for each in fitted])
    ratio = np.concatenate([np.array(each.widths) / _half_widths(each) for each in fitted])
    width = np.median([each.widths for each in fitted])
    share, median = float(covered.mean()), float(np.median(worst))
    ninth = float(np.quantile(worst, 0.9, method="lower"))
    refused = len(trials) - len(fitted)
    told = f", {refused} refused" if refused else ""
    told += f"; as good as the data allow: {_efficient([each.bound for each in fitted])}"
    told += (", were the form of the field known: "
             f"{_efficient([each.bound_of_known_form for each in fitted])}")
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


def _half_widths(trial: Trial) -> np.ndarray:
    """Of 95 % intervals of log E by a trial's bound, shape [4]."""
    return 1.96 * np.sqrt(np.diag(np.array(trial.bound, float)))


def _efficient(bounds: list[tuple]) -> str:
    """Median, in percent, of the worst E error of estimates that attain Cramer-Rao bounds.

    What is known beforehand is in the bounds as in the fit: they hold on the average over truths
    drawn from the fit's prior. The field's form is drawn from less than that here. Estimates then
    come between this and the same with that form known, which no fit comes below, and their
    intervals hold more often than they say.

    Args:
        bounds: Covariance of log E of each trial, shape [4, 4]; a kept one has None where there is
            none.
    """
    covariance = np.array(bounds, float)
    covariance = covariance[np.isfinite(covariance).all(axis=(1, 2))]
    drawn = np.random.default_rng(0).standard_normal((1000, len(covariance), 4, 1))
    errors = np.expm1(np.linalg.cholesky(covariance) @ drawn)
    return f"{100 * np.median(np.abs(errors).max(axis=(-2, -1))):.1f} %"
