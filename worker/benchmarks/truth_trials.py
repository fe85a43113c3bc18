"""Trials of estimates against a truth: error, interval, and the bound that no interval undercuts.

The Cramer-Rao bound is that of the trial's own problem: the Fisher information of all measurements,
taken at the truth, in all unknowns (moduli, form of their field, Poisson's ratio, density, every
error of the cell, the course of the force), with the prior knowledge of each.

The first pull is at the obvious position, near the tip; further ones where `limber suggest-pull`
suggests after the estimate from those before, as the documentation advises.
"""

import time
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from benchmarks.truth_branch import (
    DENSITY,
    FRACTIONS,
    POISSON,
    Truth,
    drawn_truth,
    exact_pull,
    recorded,
)
from limber.core.errors import Cancelled, LimberError
from limber.core.json_values import plain
from limber.estimation.estimate_file import details, summary
from limber.estimation.estimated_branch import Subject
from limber.estimation.fit import fit_branch
from limber.estimation.fit_assessment import Estimate, judge_model, require_result
from limber.estimation.fitting.objective import EvaluationLog, Objective
from limber.estimation.interpolation_prior import open_field
from limber.estimation.next_pull import Cell, Known, PullChoice, suggest
from limber.estimation.parameters import Values
from limber.estimation.settings import EstimateSettings
from limber.estimation.simulated_pull import CellErrors
from limber.estimation.uncertainty.covariance import inverse_information
from limber.estimation.uncertainty.model_error import total_interval
from limber.geometry.skeleton.skeleton import control_points
from limber.mechanics.materials.materials import young_weights
from limber.mechanics.model import BranchModel
from limber.recordings.cell_errors import CalibrationEntry
from limber.recordings.recording import Pull
from limber.stages.pulls.suggest_pull import SuggestPullSettings

SETTINGS = EstimateSettings(hold_out=False)
FIRST_PULL, FIRST_TURN = PullChoice(0.92, 0.0, 0.4), 2.0
MOST_STRAIN = 0.02
"""Largest strain of suggested pulls: the first strains the branches by 1.4 to 1.9 %."""
FORM_MISFIT = 0.1
"""Remaining difference between the true field and the fit's nearest one, in log E: approximate."""


@dataclass(frozen=True)
class Trial:
    """One fit of a drawn branch in a drawn cell.

    Attributes:
        seed: Seed of all random numbers.
        form: Form of the true field.
        errors: Relative errors of the moduli, shape [4].
        covered: Whether each 95 % interval contains the truth, shape [4].
        widths: Half widths of the intervals in log E, shape [4].
        bound: Covariance of log E by the Cramer-Rao bound, shape [4, 4].
        bound_of_known_form: The same if the form of the field were known.
        variance_factor: Mean squared residual over the stated variance.
        converged: Whether the optimiser converged.
        seconds: Time of the fit.
        message: Why there is no result; empty if there is one.
        source: Digest of the sources; trials of other sources are not reused.
    """

    seed: tuple[int, ...]
    form: str
    errors: tuple[float, ...] = ()
    covered: tuple[bool, ...] = ()
    widths: tuple[float, ...] = ()
    bound: tuple[tuple[float, ...], ...] = ()
    bound_of_known_form: tuple[tuple[float, ...], ...] = ()
    variance_factor: float = float("nan")
    converged: bool = False
    seconds: float = 0.0
    message: str = ""
    source: str = ""


def trial(seed: tuple[int, ...], calibration: CalibrationEntry, pull_count: int,
          settings: EstimateSettings = SETTINGS, source: str = "") -> Trial:
    """Draw a branch and a cell, pull, fit, and compare with the truth."""
    rng = np.random.default_rng(seed)
    truth = drawn_truth(rng)
    cell = CellErrors.drawn(calibration, rng)
    first = replace(FIRST_PULL, phase=rng.uniform(0, 2 * np.pi))

    def off() -> np.ndarray:
        return calibration.point_sigma_m * rng.standard_normal(len(FRACTIONS))

    pulls = [recorded(exact_pull(truth, 0, first, FIRST_TURN, shifts=off()), cell, rng)]
    started = time.perf_counter()
    subject = fitting_subject(truth)
    try:
        found = _estimated(pulls, subject, settings)
        while len(pulls) < pull_count:
            choice = _suggested(found, pulls, subject, settings)
            pulls.append(recorded(exact_pull(truth, len(pulls), choice, shifts=off()), cell, rng))
            found = _estimated(pulls, subject, settings)
    except Cancelled:
        # Stopped from outside: not a trial.
        raise
    except LimberError as error:
        return Trial(seed, truth.form, seconds=time.perf_counter() - started, message=str(error),
                     source=source)
    seconds = time.perf_counter() - started
    log_truth = np.log(truth.young)
    low, high = np.log(total_interval(found.values.young, found.uncertainty.young_interval,
                                      found.model_error)).T
    return Trial(
        seed, truth.form, tuple((found.young / truth.young - 1).tolist()),
        tuple(((low <= log_truth) & (log_truth <= high)).tolist()),
        tuple(((high - low) / 2).tolist()), *(tuple(map(tuple, covariance.tolist()))
                                              for covariance in bounds(truth, found.objective,
                                                                       subject)),
        found.uncertainty.variance_factor, found.fit.converged, seconds, source=source)


def _estimated(pulls: list[Pull], subject: Subject, settings: EstimateSettings) -> Estimate:
    """Result of `limber estimate`, its mesh's stiffness corrected, or its refusal."""
    found = fit_branch(pulls, subject, settings, log=EvaluationLog(None, ""))
    require_result(found)
    judge_model(found, subject, pulls[0].entry.grasp, settings, axes=None, cloud=None)
    return found


def _suggested(found: Estimate, pulls: list[Pull], subject: Subject,
               settings: EstimateSettings) -> PullChoice:
    """The most informative pull that `limber suggest-pull` finds after an estimate."""
    written = summary(found, settings) | details(found, subject, pulls)
    offered = suggest(subject, found.values, Known.estimated(plain(written)),
                      Cell.of(pulls[-1]), SuggestPullSettings().fractions,
                      max_strain=MOST_STRAIN, workers=1)
    return max(offered.pulls, key=lambda pull: pull.bits).choice


def fitting_subject(truth: Truth) -> Subject:
    """The user's branch: a coarser mesh, textbook density and Poisson's ratio."""
    branch = truth.branch
    return _subject(branch.mesh(slice_length=3.0, sides=8), truth, POISSON, DENSITY)


def bounds(truth: Truth, objective: Objective, subject: Subject) -> tuple[np.ndarray, np.ndarray]:
    """Covariances of log E by the Cramer-Rao bound, each of shape [4, 4]; no link helps them.

    With the form of the field as little known as the fit assumes, and with it known: no fit that
    knows as little of the cell beats the latter, however forms are drawn.
    """
    objective = objective.with_space(objective.space.linked(()))
    evaluation = objective.evaluate(objective.space.pack(true_values(truth, subject)),
                                    jacobian=True)
    count = len(truth.young)
    if evaluation is None:
        return (np.full((count, count), np.nan),) * 2
    known = [name not in subject.field.names for name in objective.space.names]
    return tuple(inverse_information(slopes)[:count, :count] for slopes in (
        evaluation.jacobian, evaluation.jacobian[:, known]))


def true_values(truth: Truth, subject: Subject) -> Values:
    """The truth in a fit's terms: the information about moduli depends on the form of the field
    too, which is taken as near to the true one as the fit's field comes.
    """
    values = Values(truth.young, truth.poisson, truth.density)
    nearest = cKDTree(truth.model.mesh.centroids).query(subject.mesh.centroids)[1]
    missing = np.log(truth.model.young[nearest]) - np.log(subject.young(values))
    slopes = subject.field.shares(values, subject.field.names)[len(truth.young):]
    rows = np.vstack([slopes.T / FORM_MISFIT, np.eye(len(slopes))])
    form = np.linalg.lstsq(rows, np.r_[missing / FORM_MISFIT, np.zeros(len(slopes))], rcond=None)[0]
    return replace(values, form=tuple(form.tolist()))


def _subject(mesh: object, truth: Truth, poisson: float, density: float) -> Subject:
    skeleton = truth.branch.skeleton
    points = control_points(skeleton, FRACTIONS)
    weights = young_weights(mesh, points)
    model = BranchModel(mesh, young=1e9, poisson=poisson, density=density, gravity=None)
    return Subject(mesh, skeleton, points, weights, model, Values(np.full(4, 1e9), poisson,
                   density), open_field(mesh, skeleton, weights, FRACTIONS))
