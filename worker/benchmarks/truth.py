"""Estimates against newly drawn truths: required and measured."""

from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks import drawn_branches, estimation, scan_loops, silicone_beam
from benchmarks import mechanics_reduced as reduced
from benchmarks.drawn_branches import (
    FIRST_PULL,
    FIRST_TURN,
    FRACTIONS,
    Truth,
    cell_trial,
    drawn_truth,
    fitting_subject,
    recorded,
)
from benchmarks.paper_branches import Bench, PaperBranch, exact_pull, measured
from benchmarks.table import Asked, Part, Row, Setting, share_met
from benchmarks.trials import column, joined, sound
from limber.core.errors import LimberError
from limber.estimation.estimated_branch import Subject, forwards_of, parameter_space
from limber.estimation.fit import fit_branch
from limber.estimation.fit_assessment import Estimate, require_result
from limber.estimation.fitting.objective import EvaluationLog, Objective
from limber.estimation.fitting.optimise import gauss_newton
from limber.estimation.next_pull import PullChoice
from limber.estimation.parameters import Values
from limber.estimation.settings import FitSpec
from limber.estimation.simulated_pull import CellErrors
from limber.estimation.uncertainty.next_actions import ANOTHER_PULL
from limber.recordings.recording import CalibrationEntry, Pull

_CALIBRATED = CalibrationEntry(pose_sigma_m=2e-4, pose_sigma_rad=3.5e-3)


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


_START = Asked("truths of 0.3 MPa to 10 GPa that fall 1 to 30 fold, at 1 to 4 control points, "
                  "half of them with a fork: fits that end at them (loss within 1 %)",
               "198 of 200")
_ADVICE = Asked("interval expected after an action over that got by following it", "within 20 %")
_SETTINGS = FitSpec(hold_out=False, mesh_check=False)
_PLAIN = _SETTINGS.model_copy(update={"field": "inverse_distance", "poisson": 0.35,
                                     "poisson_sigma": 0.0})
_BETTER = {
    "calibrate the gripper": {"pose_sigma_m": 2e-4, "pose_sigma_rad": 3.5e-3},
    "tare the force sensor": {"force_bias_sigma_n": 0.05, "force_drift_sigma_n": 0.1,
                              "torque_bias_sigma_nm": 5e-3},
    "check the force sensor": {"force_gain_sigma": 5e-3},
    "mark the points": {"point_sigma_m": 5e-4}}
"""Calibration after each action."""


def _cell_rows(setting: Setting, asked: tuple[Asked, ...], kind: int, count: int,
               cell: CalibrationEntry, pull_count: int) -> list[Row]:
    """Error, coverage and width of a kind of trial."""
    trials = setting.trials(
        "cells", [(setting.seed, kind, number) for number in range(count)],
        partial(cell_trial, calibration=cell, pull_count=pull_count), "estimation", "mechanics",
        workers=None, catch=LimberError)
    count, fitted = len(trials), sound(trials)
    if not fitted:
        return [Row(*each, f"{count} of {count} refused: {trials[0].failure}", False, count)
                for each in asked]
    # A refusal is no small error.
    worst = [np.inf if each.failure else float(np.abs(each["errors"]).max()) for each in trials]
    covered, bounds = joined(fitted, "covered"), column(fitted, "bound")
    half_widths = 1.96 * np.sqrt(np.diagonal(bounds, axis1=1, axis2=2))
    ratio = column(fitted, "widths") / half_widths
    share, median = float(covered.mean()), float(np.median(worst))
    refused, expected = count - len(fitted), efficient(bounds)
    told = f"; {refused} refused" if refused else ""
    return [
        Row(*asked[0], f"{median / expected:.2f}: {100 * median:.1f} % (90 % of trials under "
            f"{100 * np.quantile(worst, 0.9, method='lower'):.0f} %{told}; as good as the data "
            f"allow: {100 * expected:.1f} %, were the form of the field known: "
            f"{100 * efficient(column(fitted, 'bound_of_known_form')):.1f} %)",
            bool(median <= 1.15 * expected), count),
        Row(*asked[1], f"{100 * share:.1f} % of {covered.size}",
            share_met(share, covered.size, 0.90, 0.99), len(fitted)),
        Row(*asked[2], f"{100 * np.median(column(fitted, 'widths')):.0f} %, "
            f"{np.nanmedian(ratio):.2f} (worst {np.nanmax(ratio):.2f})",
            bool(np.nanmedian(ratio) <= 1.5), len(fitted))]


def efficient(covariance: np.ndarray) -> float:
    """Median of the worst relative E error of estimates that attain Cramer-Rao bounds.

    Prior knowledge is in the bounds as in the fit: they hold on average over truths drawn from the
    fit's prior. Here the field's form is drawn from a narrower range. Estimates are then between
    this bound and the one with that form known, which no fit beats, and their intervals contain the
    truth more often than they state.

    Args:
        covariance: Of log E of each trial, shape [trials, 4, 4]; not finite if there is none.
    """
    covariance = covariance[np.isfinite(covariance).all(axis=(1, 2))]
    drawn = np.random.default_rng(0).standard_normal((1000, len(covariance), 4, 1))
    errors = np.expm1(np.linalg.cholesky(covariance) @ drawn)
    return float(np.median(np.abs(errors).max(axis=(-2, -1))))


def _start_row(setting: Setting) -> list[Row]:
    """Draw truths over the paper's range and far beyond it, and fit each from its force alone."""
    trials = setting.trials("starts", setting.seeds(200, 2), _start, "estimation", "mechanics",
                            catch=LimberError)
    good = sum(each["ended"] for each in sound(trials))
    refused = sum(each["refused"] for each in sound(trials)) + len(trials) - len(sound(trials))
    return [Row(*_START, f"{good} of {len(trials)} ({refused} refused)",
                good >= 0.99 * len(trials), len(trials))]


def _start(seed: int) -> dict[str, bool]:
    branch, pull = _pulled(np.random.default_rng([seed, 77]))
    bench = Bench(branch, slice_length=2.4, sides=6)
    subject = Subject(bench.mesh, branch.skeleton, bench.points, bench.weights, bench.model,
                      Values(np.full(len(branch.young), 1e7), 0.35, 900.0))
    found = fit_branch([pull], subject, _PLAIN, log=EvaluationLog(None, ""))
    refused, loss = found.is_bad is not None, found.fit.evaluation.objective
    return {"refused": refused, "ended": not refused and loss < 1.01 * _loss_from(
        np.array(branch.young), pull, subject)}


def _pulled(rng: np.random.Generator) -> tuple[PaperBranch, Pull]:
    """Draw a branch that can be pulled, and its recording."""
    while True:
        count = int(rng.integers(1, 5))
        shares = rng.dirichlet(np.ones(count - 1)) if count > 1 else []
        steps = np.log(rng.uniform(1.0, 30.0)) * np.r_[0.0, np.cumsum(shares)]
        young = np.exp(rng.uniform(np.log(3e5), np.log(1e10)) - steps)
        branch = PaperBranch(
            "drawn", tuple(young.tolist()), 0.35, rng.uniform(0.3, 0.8),
            (rng.uniform(4e-3, 1e-2), rng.uniform(3e-3, 4e-3)), rng.uniform(0, 0.6),
            (rng.uniform(0.3, 0.7), rng.uniform(0.05, 0.2)) if rng.uniform() < 0.5 else None)
        try:
            pull = measured(exact_pull(branch, 0, frames=40), 0)
        except LimberError:
            continue
        peak = float(np.linalg.norm(pull.wrenches[:, :3], axis=1).max())
        known = CalibrationEntry(force_bias_sigma_n=0.03 * peak, force_drift_sigma_n=0.03 * peak,
                                 point_sigma_m=0.0)
        return branch, replace(pull, entry=pull.entry.model_copy(update={"calibration": known}))


def _loss_from(young: np.ndarray, pull: Pull, subject: Subject) -> float:
    """Least objective that a fit from the true moduli finds."""
    forwards = forwards_of([pull], subject, _PLAIN)
    space = parameter_space(subject, forwards, _PLAIN)
    objective = Objective(forwards, space, force_sigma=[pull.entry.sensor.force_sigma_n])
    try:
        fit = gauss_newton(objective, space.pack(replace(subject.start, young=young)))
    except LimberError:
        return np.inf
    return fit.evaluation.objective


def _advice_row(setting: Setting) -> list[Row]:
    """Follow one of the actions that an estimate lists, and compare the intervals."""
    trials = setting.trials("advice", setting.seeds(20, 2), _advice, "estimation", "mechanics",
                            catch=LimberError)
    ratios = np.array([each["ratio"] for each in sound(trials) if each["ratio"] > 0])
    if not len(ratios):
        return [_ADVICE.not_shown()]
    off = np.maximum(ratios, 1 / ratios) - 1
    return [Row(*_ADVICE, f"median {100 * np.median(off):.0f} %, worst {100 * off.max():.0f} % "
                f"off; {int(np.sum(off <= 0.2))} of {len(off)} within 20 %",
                bool(np.all(off <= 0.2)), len(off))]


def _advice(seed: int) -> dict[str, float]:
    """Width expected over width got; 0: nothing was offered."""
    rng = np.random.default_rng([seed, 78])
    truth, calibration = drawn_truth(rng), CalibrationEntry()
    first = replace(FIRST_PULL, phase=rng.uniform(0, 2 * np.pi))
    shifts = calibration.point_sigma_m * rng.standard_normal(len(FRACTIONS))
    subject, cell = fitting_subject(truth), CellErrors.drawn(calibration, rng)
    exact = drawn_branches.exact_pull(truth, 0, first, FIRST_TURN, shifts=shifts)
    pulls = [recorded(exact, cell, rng)]
    offered = [each for each in _fitted(pulls, subject).prospects.best()
               if each["action"] in (*_BETTER, ANOTHER_PULL)]
    if not offered:
        return {"ratio": 0.0}
    chosen = offered[int(rng.integers(len(offered)))]
    then = _fitted(_followed(chosen["action"], pulls, truth, cell, rng, first), subject)
    got = _widths(then.uncertainty.young_interval)
    return {"ratio": np.mean(_widths(chosen["young_interval_pa"])) / np.mean(got)}


def _followed(action: str, pulls: list[Pull], truth: Truth, cell: CellErrors,
              rng: np.random.Generator, choice: PullChoice) -> list[Pull]:
    """The pulls after an action: one more, or the same in a better measured cell."""
    known = cell.calibration.model_copy(update=_BETTER.get(action, {}))
    shifts = known.point_sigma_m * rng.standard_normal(len(FRACTIONS))
    exact = drawn_branches.exact_pull(truth, len(pulls) if action == ANOTHER_PULL else 0, choice,
                                      FIRST_TURN, shifts=shifts)
    if action == ANOTHER_PULL:
        return [*pulls, recorded(exact, cell, rng)]
    return [recorded(exact, CellErrors.drawn(known, rng), rng)]


def _fitted(pulls: list[Pull], subject: Subject) -> Estimate:
    found = fit_branch(pulls, subject, _SETTINGS, log=EvaluationLog(None, ""))
    require_result(found, subject.skeleton)
    return found


def _widths(interval: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    return np.diff(np.log(interval), axis=1)[:, 0] / 2


PARTS = {
    "one-pull": Part(lambda setting: _cell_rows(
        setting, _ONE_PULL, 1, setting.at_most(60, 4), CalibrationEntry(), 1), 60, _ONE_PULL,
        grows=True),
    "scans": Part(scan_loops.loop_rows, 60, scan_loops.ROWS, grows=True),
    "three-pulls": Part(lambda setting: _cell_rows(
        setting, _THREE_PULLS, 2, setting.at_most(20, 2), _CALIBRATED, 3), 150, _THREE_PULLS,
        grows=True),
    "starts": Part(_start_row, 20, (_START,), grows=True),
    "advice": Part(_advice_row, 30, (_ADVICE,), grows=True),
    "beam": Part(silicone_beam.beam_rows, 60, silicone_beam.BEAM_ROWS),
    "real-beam": Part(silicone_beam.real_row, 60, (silicone_beam.REAL_ROW,)),
    "second-pull": Part(lambda setting: estimation.speed_rows(setting)[3:], 120,
                        (estimation.FOLLOWED,)),
    "reduced": Part(reduced.flagged_rows, 60, reduced.FLAGGED_ROWS, grows=True)}
"""The table, in order of importance."""
