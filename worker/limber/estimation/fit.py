"""Fit Young's modulus along a branch to its pulls: initial values and fit.

:mod:`limber.estimation.fit_assessment` holds the result and its uncertainty.
:mod:`limber.estimation.estimate_file` selects the written values.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from limber.core.errors import InputError, Option, WorkError
from limber.core.not_none import present
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.core.progress import SILENT, Progress
from limber.estimation import estimated_branch as subjects
from limber.estimation import fit_assessment as assessment
from limber.estimation.fitting import initial_modulus as starts
from limber.estimation.fitting import objective as targets
from limber.estimation.fitting import optimise
from limber.estimation.fitting.nuisances import NAMED
from limber.estimation.forward.forward_model import Forward, under_its_weight
from limber.estimation.forward.observed_path import ObservedPathForward
from limber.estimation.forward.solved_pull import QuasiStaticForward
from limber.estimation.parameters import LINK_DEVIATION, Values, bump_deviations, hats, stations_of
from limber.estimation.settings import FitSpec
from limber.estimation.uncertainty import covariance
from limber.estimation.uncertainty import identifiability as identify
from limber.estimation.uncertainty.creep import with_creep
from limber.geometry.skeleton.skeleton import FRACTIONS
from limber.recordings.recording import Pull, calibration_of
from limber.recordings.sensor_checks import force_unit_suspicion

FAR_FROM_FOLDING = 0.25
"""Factor on the moduli under which a branch still stands if its weight matters little. Chosen."""


class _ForceLeadsNowhereError(WorkError):
    """No equilibrium under a pull's measured force; there may be one along its path."""


def fit_branch(pulls: list[Pull], subject: subjects.Subject, settings: FitSpec, *,
               log: targets.EvaluationLog, near: Values | None = None,
               known: Sequence[Forward] = (), quick: bool = False, progress: Progress = SILENT,
               work: targets.Work | None = None) -> assessment.Estimate:
    """Estimate Young's modulus of a branch from its pulls.

    Args:
        log: Stores the evaluations. Those of a stopped run are reused.
        near, quick: As for :func:`fit_pulls`.
        known: The pulls as an earlier fit near there left them: it begins with their states.
        work: What earlier fits have spent of the budget. Where it ends the fit, another one with
            the same log goes on from there.

    Raises:
        InputError: the pulls cannot determine Young's modulus.
        WorkError: the simulation finds no equilibrium.
        Cancelled: the user stopped the fit before its first step.
    """
    if log.resumed_count:
        progress.warn(f"Resumed: {log.resumed_count} evaluations of a stopped run are reused.")
    found = _Strategy(pulls, subject, settings, near, known, progress,
                      work or targets.Work()).fitted(log)
    if found.fit.status is optimise.FitStatus.out_of_work:
        log.go_on_from(found.fit.evaluation)
    if not quick:
        complete(found, settings, progress)
    return found


@dataclass(frozen=True)
class _Strategy:
    """How pulls of a branch are fitted: with its weight or without; driven by their force, or along
    their path; the observer's frame put right; points placed where they were seen."""

    pulls: list[Pull]
    subject: subjects.Subject
    settings: FitSpec
    near: Values | None
    known: Sequence[Forward]
    progress: Progress
    work: targets.Work

    def fitted(self, log: targets.EvaluationLog) -> assessment.Estimate:
        """The estimate with the weight; without it if the weight cannot be carried."""
        if not (self.subject.hangs and any(under_its_weight(
                self.subject.model, pull.entry).prestress is not None for pull in self.pulls)):
            return self._driven(log)
        heavy: assessment.Estimate | None = None
        failure: Exception | None = None
        try:
            heavy = self._driven(log)
            sound = (heavy.uncertainty.variance_factor < assessment.MISFIT_FACTOR
                     and abs(heavy.density_off) < NAMED)
            # A much softer branch would carry the weight too: then it is no cause of what is off.
            margin = 1.0 if sound else FAR_FROM_FOLDING
            if heavy.fit.is_unfinished or self.subject.carries_itself(
                    replace(heavy.values, young=margin * heavy.values.young)):
                return heavy
        except (WorkError, NotPositiveDefiniteError) as error:
            failure = error
        try:
            found = self._weightless()
        except (WorkError, InputError):
            if heavy is None:
                raise
            return heavy
        if self.subject.carries_itself(found.values) or (
                heavy is not None and heavy.fit.evaluation.objective
                <= found.fit.evaluation.objective):
            # The weight was not the cause.
            if failure is not None:
                raise failure
            return present(heavy, "estimate with the weight")
        return found

    def _weightless(self) -> assessment.Estimate:
        """The estimate without the weight, with a warning if it tells a scale."""
        found = replace(self, subject=self.subject.without_weight())._driven(
            targets.EvaluationLog(None, ""))
        found.is_weightless = not self.subject.carries_itself(found.values)
        if found.is_weightless and found.scale_deviation <= identify.SCALE_DEVIATION:
            # Otherwise nothing is known of how soft it is, and the estimate is refused.
            self.progress.warn(
                "The branch is too soft to carry its own weight in the scanned shape. The estimate "
                "ignores its weight. Check the density, gravity and the unit of the force.")
        return found

    def _driven(self, log: targets.EvaluationLog) -> assessment.Estimate:
        """The fit by the measured force; along the recorded path where that leads nowhere."""
        try:
            return self._framed(log)
        except _ForceLeadsNowhereError as error:
            self.progress.warn(f"{error.seen} {error.why} The gripper's recorded path is "
                               "prescribed instead.")
            try:
                # Force-driven evaluations do not apply here.
                return self._with(drive="pose")._framed(targets.EvaluationLog(None, ""))
            except WorkError as second:
                raise error from second

    def _framed(self, log: targets.EvaluationLog) -> assessment.Estimate:
        """The fit in the observer's frame; a free one, which may be far turned, is put right."""
        if "frame" not in self.settings.also:
            return self._placed(log)
        step, found = self, self._placed(log)
        for _ in range(starts.ROUNDS - 1):
            shift, turn = starts.fitted_frame(found.cell_errors)
            if found.fit.is_unfinished or np.linalg.norm(turn) < starts.SMALL_RAD:
                break
            middle = found.objective.forwards[0].rest_points.mean(axis=0)
            step = replace(step, pulls=[
                starts.put_right(one, shift, turn, middle) for one in step.pulls])
            found = step._placed(targets.EvaluationLog(None, ""))
        try:
            other = self._with(also=tuple(part for part in self.settings.also if part != "frame")
                               )._placed(targets.EvaluationLog(None, ""))
        except (WorkError, InputError):
            return found
        assessment.require_one_explanation(found, other)
        return found

    def _placed(self, log: targets.EvaluationLog) -> assessment.Estimate:
        """The fit with points where the branch shows that they are, if that is far from where they
        are stated: an error along a bent branch is not linear."""
        forwards = subjects.forwards_of(self.pulls, self.subject, self.settings)
        near, shifts, known = self.near, {}, self.known
        beams = [] if any(forward.is_dynamic for forward in forwards) else starts.beams_of(forwards)
        if beams:
            begun = starts.beam_start(beams, self.subject.start)
            if begun.explained < starts.EXPLAINED:
                self.progress.warn(starts.unexplained(begun))
            shifts = starts.far_from_stated(beams, begun)
        if known:
            shifts = {forward.name: np.asarray(forward.point_shifts) for forward in known
                      if np.any(forward.point_shifts)}
        for rounds_left in reversed(range(starts.ROUNDS)):
            if shifts:
                forwards = subjects.forwards_of(self.pulls, self.subject, self.settings, shifts)
            _begin_at(forwards, known)
            objective = targets.Objective(
                forwards, subjects.parameter_space(self.subject, forwards, self.settings), log=log,
                force_sigma=[pull.entry.sensor.force_sigma_n for pull in self.pulls],
                progress=self.progress, work=self.work,
                expected_count=20 if self.settings.method == "gauss-newton" else 200)
            found = fit_pulls(objective, self.subject.start, self.settings, self.progress,
                              near=near, quick=True)
            far = starts.far_points(found.cell_errors, shifts)
            if far is None or found.fit.is_unfinished or not rounds_left:
                return found
            shifts, near, log, known = far, found.values, targets.EvaluationLog(None, ""), forwards
        raise AssertionError("the last round looks for no far points")

    def _with(self, **changes: Any) -> "_Strategy":
        return replace(self, settings=self.settings.model_copy(update=changes))


def _begin_at(forwards: Sequence[Forward], known: Sequence[Forward]) -> None:
    """Begin simulations with frames, states and force of earlier ones on as many nodes."""
    for forward, earlier in zip(forwards, known, strict=False):
        if (isinstance(forward, QuasiStaticForward) and isinstance(earlier, QuasiStaticForward)
                and forward.mesh.node_count == earlier.mesh.node_count):
            forward.set_key_count(earlier.key_count)
            forward.begin_at(earlier)


def fit_pulls(objective: targets.Objective, start: Values, settings: FitSpec,
              progress: Progress = SILENT, *, near: Values | None = None,
              quick: bool = False) -> assessment.Estimate:
    """Check what the data determine, fit, and compute intervals; ``quick`` keeps Gauss' and judges
    nothing (:func:`complete`). It starts from ``near`` if that has an equilibrium, otherwise from
    moduli of the right size."""
    subjects.require_scale_in_principle(objective.forwards)
    is_near, best = near is not None, objective.log.best
    if objective.log.resumed_count and best and len(best.parameters) == objective.space.size:
        is_near, near = False, objective.space.unpack(np.array(best.parameters))
    first = None if near is None else objective.evaluate(objective.space.pack(near),
                                                         jacobian=True)
    is_near &= first is not None
    if first is None:
        near, first = _standing(objective, start, progress)
    start = present(near, "initial values")
    judged = identify.identifiability(first, objective.space)
    if not identify.force_is_measured(objective):
        identify.require_scale(judged, objective, first)
    # Whether to warn is decided at the end: the data determine a modulus better once it is soft.
    space, _ = identify.link_unresolved(first, objective.space)
    if space.links:
        objective = objective.with_space(space)
    try:
        fit = _fitted(objective, space.pack(start), settings, progress, is_near=is_near)
    except targets.Stopped:
        fit = optimise.best_so_far(objective)
    if settings.method == "gauss-newton" and not fit.is_unfinished:
        fit, objective = _linked_at_the_end(fit, objective, settings, progress)
        fit, objective = with_creep(fit, objective)
        fit = covariance.weighed(fit, objective)
        _require_stable(objective, objective.space.unpack(fit.evaluation.free))
        fit = covariance.averaged(fit, objective)
    elif not fit.is_unfinished:
        for message in identify.link_unresolved(fit.evaluation, objective.space)[1]:
            progress.warn(message)
    found = assessment.Estimate(
        fit, objective, covariance.uncertainty(fit.evaluation, objective, fit.left), judged)
    if not quick:
        complete(found, settings, progress)
    return found


def complete(found: assessment.Estimate, settings: FitSpec, progress: Progress = SILENT) -> None:
    """Compute the intervals of a quick fit by the profile of its likelihood, and judge it. A fit
    without a valid result has no intervals."""
    while found.is_bad is None:
        found.uncertainty, lower, objective = covariance.profiled(
            found.uncertainty, found.fit.evaluation, found.objective, progress)
        if lower is None or not _descended(found, lower, objective):
            break
    assessment.judge_fit(found, progress)
    if settings.hold_out and len(found.objective.forwards) > 1 and found.is_bad is None:
        assessment.hold_out(found, progress)


def _descended(found: assessment.Estimate, lower: targets.Evaluation,
               objective: targets.Objective) -> bool:
    """Whether a fit from there ends lower; it then replaces the estimate's."""
    fit = optimise.gauss_newton(objective, lower.free, is_near=True)
    if optimise.cost_of(fit.evaluation, objective) > optimise.cost_of(
            found.fit.evaluation, objective) - optimise.UNSETTLED_FALL * objective.variance:
        return False
    found.fit, found.objective = covariance.averaged(fit, objective), objective
    found.uncertainty = covariance.uncertainty(fit.evaluation, objective, fit.left)
    return True


def _standing(objective: targets.Objective, start: Values, progress: Progress,
              ) -> tuple[Values, targets.Evaluation]:
    """Return initial values that have equilibria, and their evaluation."""
    for drifts in (False, True):
        begun = starts.scaled_start(objective, start, drifts=drifts)
        first = objective.evaluate(objective.space.pack(begun), jacobian=True)
        if first is not None:
            break
    else:
        raise _without_equilibrium(objective)
    if any(forward.uses_force for forward in objective.forwards) and (
            suspicion := force_unit_suspicion(float(np.exp(np.mean(np.log(begun.young)))))):
        progress.warn(suspicion)
    _require_stable(objective, begun)
    return begun, first


def _require_stable(objective: targets.Objective, values: Values) -> None:
    """Refuse to drive pulls by a force under which the observed states are unstable."""
    names = [forward.name for forward in objective.forwards
             if isinstance(forward, ObservedPathForward)
             and forward.is_held_against_its_force(values)]
    if names:
        raise _ForceLeadsNowhereError(
            f"{', '.join(names)}: the clamping gripper holds the branch in states that are "
            "unstable under its force and torque alone.",
            "It compresses the branch. Simulated by the force, the branch would move elsewhere.",
            "Pull outwards or sideways rather than towards the base.")


def _without_equilibrium(objective: targets.Objective) -> WorkError:
    seen = "The simulation finds no equilibrium for any of the tested Young's moduli."
    by_force = [forward for forward in objective.forwards if forward.watches_pose]
    if not by_force:
        return WorkError(seen,
                         "This branch cannot reach the recorded poses or bear the recorded forces.",
                         "Check the grasp point, the frame of reference and the units.")
    known = calibration_of(by_force[0].entry)
    peak = np.nanmax(np.linalg.norm(by_force[0].frames.wrenches[:, :3], axis=1))
    return _ForceLeadsNowhereError(
        seen, f"The measured force drives the simulation. It is at most {peak:.2g} N. Its zero is "
        f"known to {known.force_bias_sigma_n:g} N and drifts by {known.force_drift_sigma_n:g} N. "
        "With such an error, the force may fold a branch with a soft end.", "Tare the sensor "
        "before the pull and state it ([calibration] in pull.toml). Or pull farther. Or prescribe "
        "the gripper's pose if its frame is known well (", Option("drive", "pose"), "). Otherwise "
        "check the grasp point, the frame of reference and the units.")


def _fitted(objective: targets.Objective, start: np.ndarray, settings: FitSpec,
            progress: Progress, *, is_near: bool) -> optimise.Fit:
    if settings.method == "nelder-mead":
        fit = optimise.nelder_mead(objective, start, delta_m2=settings.delta_m2)
    else:
        fit = optimise.gauss_newton(objective, start, is_near=is_near)
    return fit if fit.is_unfinished else _refined(fit, objective, settings, progress)


def _refined(fit: optimise.Fit, objective: targets.Objective, settings: FitSpec,
             progress: Progress) -> optimise.Fit:
    """Simulate more key frames if the spline error between them exceeds the measurement noise."""
    for _ in range(3):
        coarse = []
        values = objective.space.unpack(fit.evaluation.free)
        for forward in objective.forwards:
            error = forward.thinning_error(values)
            sigma = float(np.sqrt(np.median(np.einsum("fmii->fm", forward.frames.covariance)) / 3
                                  )) if forward.frames.covariance.size else np.inf
            if isinstance(forward, QuasiStaticForward) and error > 0.3 * sigma:
                coarse.append(forward)
        if not coarse or settings.method == "nelder-mead":
            if coarse:
                progress.warn("The error of the interpolated frames exceeds a third of the noise. ",
                              Option("method", "gauss-newton"), " simulates more frames.")
            return fit
        for forward in coarse:
            forward.refine()
        fresh = objective.with_space(objective.space)
        if fresh.evaluate(fit.evaluation.free, jacobian=True) is None:
            for forward in coarse:  # the states between known ones lead nowhere: from rest
                forward.hint(None)
        fit = optimise.gauss_newton(fresh, fit.evaluation.free, is_near=True)
        objective.forward_count = fresh.forward_count
    return fit


def _linked_at_the_end(fit: optimise.Fit, objective: targets.Objective, settings: FitSpec,
                       progress: Progress) -> tuple[optimise.Fit, targets.Objective]:
    """Link what the data do not determine at the solution, and fit again if the links differ. After
    the first round links are only added; otherwise the iteration might not end."""
    messages: list[str] = []
    for attempt in range(objective.space.group_count):
        space, messages = identify.link_unresolved(fit.evaluation, objective.space)
        if attempt:
            kept = objective.space.links
            space = space.linked(kept + tuple(link for link in space.links if link[0] not in {
                group for group, _ in kept}))
        if set(space.links) == set(objective.space.links):
            break
        start = fit.evaluation.free
        objective = objective.with_space(space)
        fit = optimise.gauss_newton(objective, start)
    for message in messages:
        progress.warn(message)
    return fit, objective


# The number of control points of Young's modulus that the pulls support, by their evidence.
#
# More control points always fit as well or better; whether the data ask for them is told by the
# evidence, the probability of the data under all moduli that the prior allows. Here it is
# Laplace's approximation (MacKay, Information Theory, 2003, ch. 28) about one finished fit: with
# its bumps, its modulus is piecewise linear in the logarithm between stations twice as dense as
# the control points. Every other number of control points is a linear model of the values there,
# so no pull is simulated again.

MOST = 6
"""Largest number of control points that is considered."""
LEVEL_DEVIATION = 3.0
"""Prior deviation of the mean log E: a factor of 20."""
LINK_DISTANCE = 0.2
"""Distance of control points, over the path's length, to which ``LINK_DEVIATION`` belongs."""
LIKELIER = 3.0
"""Difference of log evidences above which the number of control points is changed: below it the
pulls do not tell, and fewer moduli would only look better known.
"""
ALIKE = 1.0
"""Difference of log evidences below which the smaller of two numbers is taken."""


@dataclass(frozen=True)
class Support:
    """What one fit says about the number of control points: their positions on the main path, log
    evidence by number, and values near the solution with them."""

    fractions: tuple[float, ...]
    evidence: dict[int, float]
    start: Values


def is_open(settings: FitSpec) -> bool:
    """Whether the number of control points is to be chosen: it is not given, and can be.
    Nelder-Mead has no derivatives; the paper's field has no bumps."""
    return (not settings.fractions and settings.method == "gauss-newton"
            and settings.field == "open")


def equal_fractions(count: int) -> tuple[float, ...]:
    """Return control points at equal distances from each other and from base and tip."""
    return tuple((k + 1) / (count + 1) for k in range(count))


def supported(found: assessment.Estimate) -> Support:
    """Return as many control points as the pulls support, by a fit with those at ``FRACTIONS``."""
    problem = _Problem.of(found)
    parts = {count: problem.posterior(equal_fractions(count)) for count in range(1, MOST + 1)}
    evidence = {count: part[0] for count, part in parts.items()}
    best, used = max(evidence.values()), len(FRACTIONS)
    count = used if evidence[used] > best - LIKELIER else min(
        count for count, value in evidence.items() if value > best - ALIKE)
    return Support(FRACTIONS if count == used else equal_fractions(count), evidence,
                   replace(found.values, young=np.exp(parts[count][1]), form=()))


@dataclass(frozen=True)
class _Problem:
    """A fit as linear in log E at stations [S], ascending, and q other unknowns: residual [r] over
    deviations, with the others' priors, and its derivatives [r, S] and [r, q]."""

    stations: np.ndarray
    log_young: np.ndarray
    residual: np.ndarray
    by_young: np.ndarray
    by_others: np.ndarray

    @classmethod
    def of(cls, found: assessment.Estimate) -> "_Problem":
        evaluation, space = found.fit.evaluation, found.objective.space
        field = found.objective.forwards[0].field
        residual, slopes = (
            covariance.scaled_rows(rows, space.own_row_count, found.objective.variance)
            for rows in (evaluation.residual[:, None], evaluation.slopes))
        stations = stations_of(FRACTIONS)
        bumps = [number for number, place in enumerate(stations)
                 if not np.isclose(place, FRACTIONS).any()]
        # Log E at the stations by log E at the control points and by the bumps.
        moved = np.zeros((len(stations), space.size))
        moved[:, :space.group_count] = hats(stations, np.array(FRACTIONS)) @ space.membership
        first = space.names.index(field.names[1])
        moved[bumps, np.arange(first, first + len(bumps))] = field.deviations(
            found.values)[:len(bumps)]
        chosen = np.r_[:space.group_count, first:first + len(bumps)]
        others = np.setdiff1d(np.arange(space.size), [*chosen, space.names.index(field.names[0])])
        # Their own prior is that of each model; links and the mixture belong to the fit's field.
        kept = np.r_[:len(residual) - space.own_row_count,
                     [len(residual) - space.own_row_count + number
                      for number, (name, _, _) in enumerate(space.priors)
                      if space.names.index(name) in others]].astype(int)
        return cls(stations, moved @ evaluation.free, residual[kept, 0],
                   slopes[np.ix_(kept, chosen)] @ np.linalg.inv(moved[:, chosen]),
                   slopes[np.ix_(kept, others)])

    def posterior(self, fractions: tuple[float, ...]) -> tuple[float, np.ndarray]:
        """Log evidence of control points, less a constant, and log E there, shape [K]."""
        positions, count = np.array(fractions), len(fractions)
        guess = np.interp(positions, self.stations, self.log_young)
        places, deviations = bump_deviations(fractions, guess)
        # Log E at the stations by log E at these control points, and by the bumps between them.
        of_bumps = hats(self.stations, stations_of(fractions))[:, places] * deviations
        shape = np.hstack([hats(self.stations, positions), of_bumps])
        prior = np.vstack([np.full(count, 1 / (count * LEVEL_DEVIATION)),
                           np.diff(np.eye(count), axis=0) / (
                               LINK_DEVIATION * (1 / (count + 1) / LINK_DISTANCE)**0.5)])
        level = np.interp(FRACTIONS, self.stations, self.log_young).mean()
        unknowns = shape.shape[1] + self.by_others.shape[1]
        own = np.eye(shape.shape[1], unknowns)
        own[:count, :count] = prior
        rows = np.vstack([np.hstack([self.by_young @ shape, self.by_others]), own])
        # The level of the prior is that of the fit, about which all models agree.
        target = np.r_[self.by_young @ self.log_young - self.residual,
                       prior @ np.full(count, level), np.zeros(len(places))]
        known = np.linalg.lstsq(rows, target, rcond=None)[0]
        off = rows @ known - target
        information = np.linalg.slogdet(rows.T @ rows)[1]
        return (float(-0.5 * off @ off + np.linalg.slogdet(prior)[1] - 0.5 * information),
                known[:count])
