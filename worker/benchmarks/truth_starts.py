"""Fits that start far away, the paper's own method, and what following advice gives."""

import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from benchmarks import paper_branches, truth_branch, truth_trials
from benchmarks.paper_branches import BRANCHES, Bench, PaperBranch, measured
from benchmarks.table import Asked, Row, Setting
from benchmarks.trial_log import Numbers, numbers_of, source_digest
from benchmarks.truth_branch import FRACTIONS, Truth, drawn_truth, recorded
from limber.core.errors import LimberError
from limber.estimation.estimated_branch import Subject, forwards_of, parameter_space
from limber.estimation.fit import fit_branch
from limber.estimation.fit_assessment import Estimate, require_result
from limber.estimation.fitting.objective import EvaluationLog, Objective
from limber.estimation.fitting.optimise import gauss_newton
from limber.estimation.next_pull import PullChoice
from limber.estimation.parameters import Values
from limber.estimation.settings import EstimateSettings
from limber.estimation.simulated_pull import CellErrors
from limber.estimation.uncertainty.next_actions import ANOTHER_PULL
from limber.recordings.cell_errors import CalibrationEntry
from limber.recordings.recording import Pull

START_ROW = Asked("truths of 0.3 MPa to 10 GPa that fall 1 to 30 fold, at 1 to 4 control points, "
                  "half of them with a fork: fits that end at them (loss within 1 %)",
                  "198 of 200")
ADVICE_ROW = Asked("interval expected after an action over that got by following it",
                   "within 20 %")
PAPER_ROW = Asked("the paper's branches, noisy: worst error; simulations and seconds, its method / "
                  "ours", "6 %; 20 times fewer")
SETTINGS = EstimateSettings(hold_out=False, mesh_check=False)
_PLAIN = SETTINGS.model_copy(update={"field": "inverse_distance", "poisson": 0.35,
                                     "poisson_sigma": 0.0})
_BETTER = {
    "calibrate the gripper": {"pose_sigma_m": 2e-4, "pose_sigma_rad": 3.5e-3},
    "tare the force sensor": {"force_bias_sigma_n": 0.05, "force_drift_sigma_n": 0.1,
                              "torque_bias_sigma_nm": 5e-3},
    "check the force sensor": {"force_gain_sigma": 5e-3},
    "mark the points": {"point_sigma_m": 5e-4}}
"""Calibration after each action."""


def start_row(setting: Setting) -> list[Row]:
    """Draw truths over the paper's range and far beyond it, and fit each from its force alone."""
    source = source_digest(("estimation", "mechanics"), __file__, paper_branches.__file__)
    seeds = setting.seeds(200, 2)
    found = numbers_of("starts", seeds, partial(_start, source=source), source,
                       setting.kept / "truth-starts.jsonl", setting.budget,
                       progress=setting.progress)
    ends = [each.values for each in found]
    good = sum(each["ended"] for each in ends)
    refused = sum(each["refused"] for each in ends)
    return [Row(*START_ROW, f"{good} of {len(ends)} ({refused} refused)",
                good >= 0.99 * len(ends), len(ends))]


def _start(seed: int, source: str) -> Numbers:
    ended, refused = False, False
    branch, pull = _pulled(np.random.default_rng([seed, 77]))
    bench = Bench(branch, slice_length=2.4, sides=6)
    subject = Subject(bench.mesh, branch.skeleton, bench.points, bench.weights, bench.model,
                      Values(np.full(len(branch.young), 1e7), 0.35, 900.0))
    try:
        found = fit_branch([pull], subject, _PLAIN, log=EvaluationLog(None, ""))
        refused = found.is_bad is not None
        loss = found.fit.evaluation.objective
        ended = not refused and loss < 1.01 * _loss_from(np.array(branch.young), pull, subject)
    except LimberError:
        refused = True
    return Numbers("starts", seed, source, {"ended": ended, "refused": refused})


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
            pull = measured(paper_branches.exact_pull(branch, 0, frames=40), 0)
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


def advice_row(setting: Setting) -> list[Row]:
    """Follow one of the actions that an estimate lists, and compare the intervals."""
    source = source_digest(("estimation", "mechanics"), __file__, truth_trials.__file__,
                           truth_branch.__file__)
    found = numbers_of("advice", setting.seeds(20, 2), partial(_advice, source=source), source,
                       setting.kept / "truth-advice.jsonl", setting.budget,
                       progress=setting.progress)
    ratios = np.array([each.values["ratio"] for each in found if each.values["ratio"] > 0])
    if not len(ratios):
        return [ADVICE_ROW.not_shown()]
    off = np.maximum(ratios, 1 / ratios) - 1
    return [Row(*ADVICE_ROW, f"median {100 * np.median(off):.0f} %, worst {100 * off.max():.0f} % "
                f"off; {int(np.sum(off <= 0.2))} of {len(off)} within 20 %",
                bool(np.all(off <= 0.2)), len(off))]


def _advice(seed: int, source: str) -> Numbers:
    rng = np.random.default_rng([seed, 78])
    truth, calibration = drawn_truth(rng), CalibrationEntry()
    first = replace(truth_trials.FIRST_PULL, phase=rng.uniform(0, 2 * np.pi))
    shifts = calibration.point_sigma_m * rng.standard_normal(len(FRACTIONS))
    subject = truth_trials.fitting_subject(truth)
    cell = CellErrors.drawn(calibration, rng)
    try:
        exact = truth_branch.exact_pull(truth, 0, first, truth_trials.FIRST_TURN, shifts=shifts)
        pulls = [recorded(exact, cell, rng)]
        offered = [each for each in _fitted(pulls, subject).prospects.best()
                   if each["action"] in (*_BETTER, ANOTHER_PULL)]
        if not offered:
            return Numbers("advice", seed, source, {"ratio": 0.0})
        chosen = offered[int(rng.integers(len(offered)))]
        follow = chosen["action"]
        then = _fitted(_followed(follow, pulls, truth, cell, rng, first), subject)
    except LimberError:
        return Numbers("advice", seed, source, {"ratio": 0.0})
    got = _widths(then.uncertainty.young_interval)
    ratio = float(np.mean(_widths(chosen["young_interval_pa"])) / np.mean(got))
    return Numbers("advice", seed, source, {"ratio": ratio})


def _followed(action: str, pulls: list[Pull], truth: Truth, cell: CellErrors,
              rng: np.random.Generator, choice: PullChoice) -> list[Pull]:
    """The pulls after an action: one more, or the same in a better measured cell."""
    known = cell.calibration.model_copy(update=_BETTER.get(action, {}))
    shifts = known.point_sigma_m * rng.standard_normal(len(FRACTIONS))
    exact = truth_branch.exact_pull(truth, len(pulls) if action == ANOTHER_PULL else 0, choice,
                                    truth_trials.FIRST_TURN, shifts=shifts)
    if action == ANOTHER_PULL:
        return [*pulls, recorded(exact, cell, rng)]
    return [recorded(exact, CellErrors.drawn(known, rng), rng)]


def _fitted(pulls: list[Pull], subject: Subject) -> Estimate:
    found = fit_branch(pulls, subject, SETTINGS, log=EvaluationLog(None, ""))
    require_result(found)
    return found


def _widths(interval: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    return np.diff(np.log(interval), axis=1)[:, 0] / 2


def paper_row(setting: Setting) -> list[Row]:
    """Fit the paper's branches from one noisy pull by Nelder-Mead and by Gauss-Newton."""
    said, worst, ratios = [], 0.0, []
    for number, branch in enumerate(BRANCHES):
        setting.progress(number / len(BRANCHES), f"the paper's {branch.name} branch")
        bench = Bench(branch, slice_length=2.4, sides=6)
        pull = measured(paper_branches.exact_pull(branch, 0, frames=30), setting.seed)
        counts, seconds, errors = [], [], []
        for method in ("nelder-mead", "gauss-newton"):
            began = time.process_time()
            found = bench.fit([pull], SETTINGS.model_copy(update={
                "method": method, "poisson": branch.poisson, "key_frames": 6}))
            counts.append(found.objective.forward_count)
            seconds.append(time.process_time() - began)
            errors.append(float(np.abs(bench.errors(found)).max()) if found.fit.converged
                          else np.inf)
        worst, ratios = max(worst, *errors), [*ratios, counts[0] / counts[1]]
        said.append(f"{branch.name} {100 * errors[0]:.1f} / {100 * errors[1]:.1f} %, "
                    f"{counts[0]} / {counts[1]}, {seconds[0]:.0f} / {seconds[1]:.1f} s")
    return [Row(*PAPER_ROW, "; ".join(said), bool(worst <= 0.06 and min(ratios) >= 20),
                len(BRANCHES))]
