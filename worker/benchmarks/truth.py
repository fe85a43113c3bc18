"""Estimates against newly drawn truths: required and measured."""

from functools import partial

import numpy as np

from benchmarks import (
    truth_beam,
    truth_branch,
    truth_reduced,
    truth_scans,
    truth_starts,
    truth_states,
    truth_trials,
)
from benchmarks.table import Asked, Part, Row, Setting, share_met
from benchmarks.trial_log import go_on, read_trials, source_digest
from benchmarks.truth_recordings import BAD_RECORDINGS, bad_recordings_row
from benchmarks.truth_trials import Trial, trial
from limber.recordings.cell_errors import CalibrationEntry

CELL = CalibrationEntry()
CALIBRATED = CalibrationEntry(pose_sigma_m=2e-4, pose_sigma_rad=3.5e-3)


def _asked(label: str) -> tuple[Asked, ...]:
    return (Asked(f"{label}: median of the worst E error, over that expected of estimates that "
                  "attain the Cramer-Rao bound", "1.15"),
            Asked(f"{label}: 95 % intervals that hold the truth", "90 to 99 %"),
            Asked(f"{label}: median half width of the intervals, over the Cramer-Rao bound of the "
                  "problem", "1.5"))


_ONE_PULL = _asked(
    "one pull; sensor noise, force gain 2 %, zero and drift 1 N, gripper 1 mm and 1 degree, camera "
    "1 mm, points 5 mm along the branch, density 10 %, nu 0.05, another form of the field")
_THREE_PULLS = _asked("three pulls, gripper calibrated to 0.2 mm and 0.2 degrees")


def _one_pull(setting: Setting) -> list[Row]:
    trials = _trials(setting, 1, setting.at_most(60, 4), CELL, 1)
    return _cell_rows(_ONE_PULL, trials)


def _three_pulls(setting: Setting) -> list[Row]:
    trials = _trials(setting, 2, setting.at_most(20, 2), CALIBRATED, 3)
    return _cell_rows(_THREE_PULLS, trials)


def _trials(setting: Setting, kind: int, count: int, cell: CalibrationEntry, pull_count: int,
            ) -> list[Trial]:
    kept = setting.kept / "truth-trials.jsonl"
    source = source_digest(("estimation", "mechanics"), __file__, truth_trials.__file__,
                           truth_branch.__file__)
    tasks = [(setting.seed, kind, number) for number in range(count)]
    work = partial(trial, calibration=cell, pull_count=pull_count, source=source)
    return go_on(read_trials(Trial, kept), tasks, lambda each: each.seed, work, source, kept,
                 setting.budget, None, setting.progress)


def _cell_rows(asked: tuple[Asked, ...], trials: list[Trial]) -> list[Row]:
    """Error, coverage and width of a kind of trial."""
    count = len(trials)
    fitted = [each for each in trials if not each.message]
    if not fitted:
        return [Row(*each, f"{count} of {count} refused: {trials[0].message}", False, count)
                for each in asked]
    # A refusal is no small error.
    worst = [float(np.abs(each.errors).max()) if each.errors else np.inf for each in trials]
    covered = np.concatenate([each.covered for each in fitted])
    ratio = np.concatenate([np.array(each.widths) / _half_widths(each) for each in fitted])
    width = np.median([each.widths for each in fitted])
    share, median = float(covered.mean()), float(np.median(worst))
    ninth = float(np.quantile(worst, 0.9, method="lower"))
    refused = count - len(fitted)
    told = f"; {refused} refused" if refused else ""
    expected = _efficient([each.bound for each in fitted])
    told += f"; as good as the data allow: {100 * expected:.1f} %"
    told += (", were the form of the field known: "
             f"{100 * _efficient([each.bound_of_known_form for each in fitted]):.1f} %")
    return [
        Row(*asked[0], f"{median / expected:.2f}: {100 * median:.1f} % (90 % of trials under "
            f"{100 * ninth:.0f} %{told})", bool(median <= 1.15 * expected), count),
        Row(*asked[1], f"{100 * share:.1f} % of {covered.size}",
            share_met(share, covered.size, 0.90, 0.99), len(fitted)),
        Row(*asked[2],
            f"{100 * width:.0f} %, {np.nanmedian(ratio):.2f} (worst {np.nanmax(ratio):.2f})",
            bool(np.nanmedian(ratio) <= 1.5), len(fitted))]


def _half_widths(trial: Trial) -> np.ndarray:
    """Half widths of 95 % intervals of log E by a trial's bound, shape [4]."""
    return 1.96 * np.sqrt(np.diag(np.array(trial.bound, float)))


def _efficient(bounds: list[tuple]) -> float:
    """Median of the worst relative E error of estimates that attain Cramer-Rao bounds.

    Prior knowledge is in the bounds as in the fit: they hold on average over truths drawn from the
    fit's prior. Here the field's form is drawn from a narrower range. Estimates are then between
    this bound and the one with that form known, which no fit beats, and their intervals contain the
    truth more often than they state.

    Args:
        bounds: Covariance of log E of each trial, shape [4, 4]; a kept one has None if there is
            none.
    """
    covariance = np.array(bounds, float)
    covariance = covariance[np.isfinite(covariance).all(axis=(1, 2))]
    drawn = np.random.default_rng(0).standard_normal((1000, len(covariance), 4, 1))
    errors = np.expm1(np.linalg.cholesky(covariance) @ drawn)
    return float(np.median(np.abs(errors).max(axis=(-2, -1))))


PARTS = {
    "one-pull": Part(_one_pull, 60, _ONE_PULL, grows=True),
    "scans": Part(truth_scans.scan_row, 60, truth_scans.ROWS, grows=True),
    "three-pulls": Part(_three_pulls, 150, _THREE_PULLS, grows=True),
    "starts": Part(truth_starts.start_row, 20, (truth_starts.START_ROW,), grows=True),
    "advice": Part(truth_starts.advice_row, 30, (truth_starts.ADVICE_ROW,), grows=True),
    "paper": Part(truth_starts.paper_row, 60, (truth_starts.PAPER_ROW,)),
    "bad-recordings": Part(bad_recordings_row, 80, (BAD_RECORDINGS,), grows=True),
    "beam": Part(truth_beam.beam_rows, 60, truth_beam.BEAM_ROWS),
    "real-beam": Part(truth_beam.real_row, 60, (truth_beam.REAL_ROW,)),
    "sag": Part(truth_beam.sag_row, 20, (truth_beam.SAG_ROW,), grows=True),
    "swing": Part(truth_states.swing_row, 30, (truth_states.SWING_ROW,)),
    "second-pull": Part(truth_states.quick_rows, 120, truth_states.QUICK_ROWS),
    "reduced": Part(truth_reduced.doubt_rows, 60, truth_reduced.DOUBT_ROWS, grows=True)}
"""The table, in order of importance."""
