"""Result of an estimate, its fit to the pulls, and its uncertainty."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import Command, Option, WorkError
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.estimation.estimated_branch import Subject, forwards_of, neck
from limber.estimation.fitting import nuisances
from limber.estimation.fitting.initial_modulus import held_out, without
from limber.estimation.fitting.objective import Objective
from limber.estimation.fitting.optimise import Fit, FitStatus, gauss_newton
from limber.estimation.forward.forward_model import Forward
from limber.estimation.forward.observed_path import AT_REST_M
from limber.estimation.parameters import Values, pieces_along
from limber.estimation.settings import FitSpec
from limber.estimation.uncertainty import identifiability as identify
from limber.estimation.uncertainty import model_error as errors
from limber.estimation.uncertainty import shape_error as shapes
from limber.estimation.uncertainty.covariance import Uncertainty, largest, outliers, variance_parts
from limber.estimation.uncertainty.creep import creep_sentence
from limber.estimation.uncertainty.model_error import ModelError
from limber.estimation.uncertainty.next_actions import Prospects
from limber.geometry.skeleton.skeleton import Skeleton
from limber.mechanics.materials.materials import LayeredSection
from limber.recordings.recording import GraspEntry, Pull, calibration_of, grasp_on
from limber.recordings.sensor_checks import PLAUSIBLE_YOUNG_PA

_PARTS = ("geometry", "mesh", "path", "hung", "grip", "graph")  # None where not examined
MISFIT_FACTOR = 4.0
"""Mean squared residual over the expected one above which model and pull do not belong together:
twice the stated noise. Of 10 branches reconstructed from scans, all correct ones stayed under 1.3;
the one whose axis ran into a twig and back reached 13, with moduli off by a factor of three.
"""
UNEXPLAINED_FACTOR = 1.5
"""The same, above which something acts that is not in the model."""
UNLIKE = 0.2
"""RMS distance of simulated from observed points over that of their motion, above which a poor fit
is no result: the simulated branch moves otherwise. Below it the stated noise may just be too small.
Chosen.
"""
AS_LIKELY = 8.0
"""Difference of the objectives below which two fits explain the pulls as well: one is then 3,000
times as likely as the other, about as much as priors that are stated roughly may be wrong.
"""
FAR_OFF = 2.0
"""Assumed errors of a point's place on the branch beyond which it is named where a fit fails."""
FORCE_OFF = 0.5
"""Difference of simulated and recorded force over the recorded one that is named likewise."""
WIDE = 0.15
"""Standard deviation of a log E above which advice on narrowing it is given."""


@dataclass
class Estimate:
    """Result of an estimate.

    Attributes:
        fit: The result of the optimiser.
        objective: The minimised objective. Its parameter space has the links.
        uncertainty: Covariance and intervals.
        identifiability: Computed before the fit.
        warnings: Warnings for the user.
        held_out: Per pull, the prediction of a fit without it: RMS distance [m] and RMS force
            error [N], also relative to the pull's travel and peak force.
        model_error: Errors of shape and mesh, which residuals do not show.
        second_moment: Mean second moment of area of each control point's section of the branch
            [m^4], shape [K]; None before the shape was judged.
        sections: The means that it is made of.
        is_weightless: Whether the estimate ignores the weight because the branch cannot carry it.
    """

    fit: Fit
    objective: Objective
    uncertainty: Uncertainty
    identifiability: identify.Identifiability
    warnings: list[str] = field(default_factory=list)
    held_out: dict[str, dict[str, Any]] = field(default_factory=dict)
    model_error: ModelError = field(default_factory=ModelError)
    second_moment: np.ndarray | None = None
    sections: shapes.SectionMean | None = None
    is_weightless: bool = False

    @property
    def stopped(self) -> bool:
        """Whether the user stopped it."""
        return self.fit.status is FitStatus.stopped

    @property
    def values(self) -> Values:
        """Young's modulus of the model on its mesh."""
        return self.objective.space.unpack(self.fit.evaluation.free)

    @property
    def deviations(self) -> dict[str, Any]:
        """Relative standard deviations of the moduli by source."""
        groups = list(self.objective.space.groups)
        sensor = np.minimum(np.sqrt(np.diag(self.uncertainty.covariance))[groups], 35.0)
        error = self.model_error
        return {"sensor": sensor, **dict.fromkeys(_PARTS), **error.parts,
                "axis_is_exact": error.axis_is_exact, "total": error.total(sensor)}

    @property
    def young(self) -> np.ndarray:
        """Young's modulus of the material [Pa], corrected for the mesh's excess stiffness, [K]."""
        return self.values.young * self.model_error.mesh_factor

    @property
    def cell_errors(self) -> list[dict[str, Any]]:
        """Each error of cell and sensors with its value and interval."""
        found = self.fit.evaluation.errors
        return [] if found is None else nuisances.nuisance_records(
            self.objective.cell_errors.nuisances, found, self.uncertainty.covariance)

    @property
    def creep(self) -> dict[str, Any] | None:
        """Creep of the branch: ``share`` by which a lasting load lowers the moduli, its 95 %
        ``interval``, and ``time_s``, the time constant [s]; None: the record does not show it.
        """
        record = next((each for each in self.cell_errors if each["name"] == nuisances.CREEP), None)
        if record is None:
            return None
        seconds = next(each.creep_time for each in self.objective.forwards if each.creep_time)
        return {"share": record["value"], "interval": record["interval"], "time_s": seconds}

    @property
    def causes(self) -> dict[str, np.ndarray]:
        """Variance of log E at the control points by cause, each of shape [K]."""
        sure = self.uncertainty
        parts = variance_parts(self.fit.evaluation, self.objective,
                               sure.variance_factor * sure.repetition)
        for name, deviation in self.model_error.parts.items():
            cause = nuisances.OTHER_CAUSES[name].name
            parts[cause] = parts.get(cause, 0.0) + deviation**2
        return parts

    @property
    def prospects(self) -> Prospects:
        """The intervals to expect after actions."""
        return Prospects(self.fit.evaluation, self.objective, self.uncertainty, self.model_error,
                         self.values.young)

    @property
    def scale_deviation(self) -> float:
        """Standard deviation of the common log E at the end of the fit."""
        return identify.identifiability(self.fit.evaluation, self.objective.space).scale_deviation

    @property
    def density_off(self) -> float:
        """Deviations of the density from the stated one, 0 if it is no unknown or has no prior."""
        space, free = self.objective.space, self.fit.evaluation.free
        return next((float(free[space.names.index(name)] - middle) / sigma
                     for name, middle, sigma in space.priors if name == "density"), 0.0)

    @property
    def is_bad(self) -> str | None:
        """Reason why the fit gives no valid result; None if it does."""
        if self.fit.is_unfinished:
            return f"The fit has not ended: {self.fit.reason}"
        space = self.objective.space
        bound = [name for name in space.on_bound(self.fit.evaluation.free)
                 if name not in {prior for prior, _, _ in space.priors}]
        if bound:
            return f"{', '.join(bound)} reached a bound. The data require a value beyond it."
        low, high = PLAUSIBLE_YOUNG_PA
        beyond = [f"E{number} would be {young:.2g} Pa" for number, young in enumerate(
            self.values.young, start=1) if not low <= young <= high]
        if beyond:
            return (f"{', '.join(beyond)}. No plant has such a modulus: they are between {low:.0e} "
                    f"and {high:.0e} Pa.")
        if error := nuisances.unlikely(self.cell_errors):
            return error
        scale = self.scale_deviation
        if not scale <= identify.SCALE_DEVIATION:
            return ("The data do not determine the moduli: their common scale is known only to "
                    f"within a factor of {np.exp(min(2 * scale, 20)):.2g}.")
        if not self.fit.converged:
            return f"The optimiser did not converge: {self.fit.reason}"
        if self.uncertainty.variance_factor > MISFIT_FACTOR and self.unexplained > UNLIKE:
            return (
                "The simulated branch does not move as the observed one: the distance of the "
                f"points is {100 * self.unexplained:.0f} % of their motion, and the residuals are "
                f"{self.uncertainty.variance_factor**0.5:.1f} times the stated noise. The pull may "
                "be of another branch, or the positions of its points on the branch may be wrong.")
        return None

    @property
    def unexplained(self) -> float:
        """RMS distance of simulated from observed points over that of the observed motion."""
        off, motion = 0.0, 0.0
        for forward, pull in zip(self.objective.forwards, self.fit.evaluation.pulls, strict=True):
            seen = forward.frames.positions
            off += float(np.nansum((pull.positions - seen)**2))
            motion += float(np.nansum((seen - forward.rest_points)**2))
        return (off / motion)**0.5 if motion > 0 else np.inf


def judge_fit(found: Estimate, progress: Progress) -> None:
    """Report the quality of the fit, the errors of the cell, and the outliers; of an unfinished
    fit nothing is known."""
    if found.fit.is_unfinished:
        return
    if found.uncertainty.variance_factor > MISFIT_FACTOR:
        progress.warn(
            f"The fit is poor: the residuals are {found.uncertainty.variance_factor**0.5:.1f} "
            "times the stated noise, and the intervals are not valid. Check that the pull was "
            "recorded on this branch and in its frame of reference. Check that the skeleton "
            "follows the branch.")
    elif found.uncertainty.variance_factor > UNEXPLAINED_FACTOR:
        progress.warn(
            f"The residuals are {found.uncertainty.variance_factor**0.5:.1f} times the stated "
            "noise. Either the model lacks an effect, or the sensors are noisier than stated. The "
            "intervals are widened by this factor.")
    if found.is_bad is None:
        # Of a refused fit neither is known, and no interval includes them.
        if (corrected := nuisances.in_words(found.cell_errors)) is not None:
            progress.warn(corrected)
        if (creep := found.creep) is not None:
            progress.warn(creep_sentence(creep))
    if abs(found.density_off) > nuisances.NAMED:
        progress.warn(
            f"The pulls fit with a density of {found.values.density:.3g} kg/m3. That is "
            f"{abs(found.density_off):.0f} standard deviations from the stated one. Weigh a piece "
            "of the branch, and check gravity, the unit of the force, and whether the branch hung "
            "freely when it was scanned. Otherwise the moduli come out wrong.")
    named = outliers(found.fit.evaluation, found.objective)
    if named:
        worst = "; ".join(f"{entry['pull']} {entry['what']} at {entry['time_s']:.2f} s "
                          f"({entry['deviations']:.0f} deviations)" for entry in named[:4])
        progress.warn(f"Outliers: {worst}{' ...' if len(named) > 4 else ''}.")


def hold_out(found: Estimate, progress: Progress) -> None:
    """Score the prediction of each pull by a fit without it, into ``found.held_out``."""
    objective = found.objective.on_copies()
    for index, forward in enumerate(objective.forwards):
        rest = without(objective, index)
        try:
            fit = gauss_newton(rest, found.fit.evaluation.free, evaluation_limit=15)
            distance, force = held_out(objective, fit.evaluation.free, index)
        except WorkError as error:
            progress.warn(str(error))
            continue
        found.held_out[forward.name] = _score(forward, distance, force, in_fit=True)


def _score(forward: Forward, distance: float, force: float, *, in_fit: bool) -> dict[str, Any]:
    """Score the prediction of a pull by a fit without it. ``in_fit``: the pull is one of the
    estimate's, left out for this score alone."""
    moved = forward.frames.positions - forward.rest_points
    size = float(np.sqrt(np.nanmean(np.sum(moved**2, axis=2)))) if (
        np.isfinite(moved).any()) else np.nan
    pull = np.linalg.norm(forward.frames.wrenches[:, :3], axis=1)
    peak = float(np.nanmax(pull)) if np.isfinite(pull).any() else np.nan
    return {"rms_m": distance, "rms_force_n": force, "in_fit": in_fit,
            "relative_distance": distance / size if size > 0 else np.nan,
            "relative_force": force / peak if peak > 0 else np.nan}


def score_unused(pull: Pull, subject: Subject, found: Estimate, settings: FitSpec) -> None:
    """Score the prediction of a pull that the estimate does not use, into ``found.held_out``.
    LimberError if the pull has no measurement to compare."""
    forward = forwards_of([pull], subject, settings)
    alone = Objective(forward, found.objective.space,
                      force_sigma=[pull.entry.sensor.force_sigma_n])
    distance, force = held_out(alone, found.fit.evaluation.free, 0)
    found.held_out[pull.name] = _score(forward[0], distance, force, in_fit=False)


def require_result(found: Estimate, skeleton: Skeleton) -> None:
    """Reject a fit without a valid result. WorkError says why, InputError if the measured force is
    too uncertain for the moduli's scale."""
    reason = found.is_bad
    if reason is None:
        return
    if not found.scale_deviation <= identify.SCALE_DEVIATION and any(
            forward.uses_force for forward in found.objective.forwards):
        raise identify.too_little_said(found.objective, found.fit.evaluation,
                                       identify.SCALE_DEVIATION)
    ended = f"The fit ended at {_listed(found.values.young)} MPa. Nothing was written."
    reason = " ".join([reason, *_force_off(found)])
    seen = [*_points_off(found.objective.forwards), *neck(skeleton)]
    if seen:
        raise WorkError("The pulls give no estimate.", " ".join([reason, *seen]), f"{ended} "
                        "Correct the reconstruction (", Command("skeleton"), ", or a scan from "
                        "more sides), and check that the points are where they should be on it.")
    raise WorkError("The pulls give no estimate.", reason,
                    f"{ended} Check units, grasp point and mode, frame of reference, the order of "
                    "the markers, and the warnings about the recording. Or use more pulls.")


def _force_off(found: Estimate) -> list[str]:
    """A sentence if a prescribed path takes another force than the recorded one."""
    for forward in found.objective.forwards:
        if forward.drive != "pose" or not forward.uses_force:
            continue
        # Without the fitted errors of the sensor, which would hide it.
        simulated = forward.simulate(found.values, (), False)
        read = forward.frames.wrenches[:, :3]
        peak = int(np.nanargmax(np.linalg.norm(read, axis=1)))
        if simulated is None or not (np.linalg.norm(simulated.forces[peak] - read[peak])
                                     > FORCE_OFF * np.linalg.norm(read[peak])):
            continue
        takes, recorded = (", ".join(f"{value:.3g}" for value in force)
                           for force in (simulated.forces[peak], read[peak]))
        return [f"At the largest force in {forward.name}, the gripper's recorded path and rotation "
                f"take ({takes}) N in the simulation; ({recorded}) N were recorded."]
    return []


def _points_off(forwards: Sequence[Forward]) -> list[str]:
    """A sentence if points are at rest far from their places on the branch."""
    worst, name = 0.0, ""
    for forward in forwards:
        poses, known = forward.frames.poses, calibration_of(forward.entry)
        at_rest = np.linalg.norm(poses[:, :3] - forward.entry.grasp.point_m, axis=1) < AT_REST_M
        off = np.linalg.norm(forward.frames.positions[at_rest] - forward.rest_points, axis=2)
        # Where a fit has moved them already, they are off by that.
        off = np.maximum(off, np.abs(forward.point_shifts))
        allowed = FAR_OFF * np.hypot(known.point_sigma_m, forward.entry.sensor.position_sigma_m)
        if np.isfinite(off).any() and np.nanmax(off) > max(worst, allowed):
            worst, name = float(np.nanmax(off)), forward.name
    return [f"In {name}, the points at rest are up to {1e3 * worst:.0f} mm away from their places "
            "on the reconstructed branch."] if name else []


def require_one_explanation(free: Estimate, as_stated: Estimate) -> None:
    """Refuse a free frame where points that are off along the branch explain the pulls as well.
    WorkError if with the frame as stated the fit is as good, with moduli outside the intervals."""
    loss, other = (each.fit.evaluation.objective for each in (free, as_stated))
    if free.fit.is_unfinished or as_stated.is_bad is not None or other - loss > AS_LIKELY:
        return
    low, high = free.uncertainty.young_interval.T
    young = as_stated.values.young
    if np.any((young < low) | (young > high)):
        raise WorkError(
            "The pulls do not tell a shift of the frame from a shift of the points.",
            f"With a free frame they give {_listed(free.values.young)} MPa, with the frame as "
            f"stated and points off along the branch {_listed(young)} MPa. Both fit as well.",
            "Register the camera (camera_sigma_m) and omit frame of ", Option("also"), ". Or mark "
            "the points on the branch, give their positions (", Option("nominal"), " of "
            "import-pull), and state that under [calibration] (point_sigma_m).")


def _listed(young: np.ndarray) -> str:
    return ", ".join(f"{value / 1e6:.4g}" for value in young)


def judge_model(found: Estimate, subject: Subject, grasp: GraspEntry, settings: FitSpec,
                *, axes: Path | None, cloud: np.ndarray | None,
                progress: Progress = SILENT) -> None:
    """Compute errors of shape and mesh, which residuals do not show, from the table of fitted
    cylinders and the scan's points [n, 3] [m], where they exist."""
    subject = subject.without_weight() if found.is_weightless else subject
    pieces = pieces_along(subject.mesh, subject.skeleton, shapes.PIECES)
    effect = shapes.effect_of_pieces(found.fit.evaluation, found.objective, pieces)
    found.sections = shapes.SectionMean.of(
        subject.skeleton, subject.mesh, subject.weights if effect is None else pieces, effect)
    found.second_moment = np.exp(found.sections.log_second_moment(
        subject.skeleton.radius, LayeredSection(**settings.section)))
    error = _geometry_error(subject, found, settings, axes, cloud, progress)
    if settings.mesh_check:
        progress(1.0, "measuring the excess stiffness of the mesh")
        held = grasp_on(subject.mesh, grasp)
        model = subject.model.with_parameters(poisson=found.values.poisson,
                                              density=found.values.density)
        forwards = found.objective.forwards
        seen = errors.observer(subject.mesh, forwards, held, subject.control_points)
        stiff = errors.mesh_error(model, held, seen, subject.weights, found.values.young,
                                  errors.steady_loads(forwards))
        if stiff is not None:
            error = replace(error.having(mesh=stiff.deviation), mesh_factor=stiff.factor)
    found.model_error = error.having(
        path=_path_error(found, progress),
        hung=shapes.hung_error(found.fit.evaluation, found.objective, settings.hung_sigma),
        grip=shapes.grip_error(found.fit.evaluation, found.objective))
    _tell_largest_part(found.causes, progress)
    if "frame" in settings.also:
        progress.warn(
            "The frame of the observed points was fitted freely. If it were known to 1 mm and 0.06 "
            f"degrees, the intervals would be {100 * found.prospects.cost_of_the_frame():.0f} % "
            "narrower.")


def _path_error(found: Estimate, progress: Progress) -> np.ndarray | None:
    """Error from the gripper's frame if its path is prescribed, with a warning."""
    prescribed = errors.path_prescribed(found.objective.forwards)
    if not prescribed:
        return None
    error = errors.path_error(found.fit.evaluation, found.objective)
    grown = ("Its effect could not be computed and is NOT in the intervals"
             if error is None else
             f"It adds up to {100 * error.max():.0f} % to the standard deviations")
    progress.warn(
        f"{', '.join(forward.name for forward in prescribed)}: the fit prescribes the gripper's "
        "recorded path and takes its frame as exact. According to [calibration], the frame may "
        f"have an error. {grown}. Record the force and use it to drive the fit (of a clamped grasp "
        "also the torque, with torque_sigma_nm), or state a better [calibration] in pull.toml.")
    return error


def _geometry_error(subject: Subject, found: Estimate, settings: FitSpec,
                    axes: Path | None, cloud: np.ndarray | None, progress: Progress) -> ModelError:
    """From the scan's axis and radii; none for a skeleton that was not fitted to a scan."""
    if axes is None:
        return ModelError()
    radii = errors.geometry_error(axes, subject.mesh, subject.weights)
    if radii is None or cloud is None:
        return ModelError().having(geometry=radii)
    drawn = shapes.shape_error(
        found.fit.evaluation, found.objective, subject, cloud, settings.shapes,
        present(found.sections, "sections of the branch"), progress=progress)
    return (ModelError({"geometry": radii}) if drawn is None else
            ModelError({"geometry": drawn[0]}, bending=drawn[1], axis_is_exact=False))


def _tell_largest_part(parts: dict[str, np.ndarray], progress: Progress) -> None:
    """Say how to narrow a wide interval, from the causes of most of the variance [K] of log E."""
    total = np.sqrt(np.sum(list(parts.values()), axis=0))
    worst = int(np.argmax(total))
    if total[worst] < WIDE:
        return
    each = "; ".join(f"{cause['cause']} {100 * cause['deviation']:.0f} % ({cause['advice']})"
                     for cause in largest({name: part[worst:worst + 1]
                                           for name, part in parts.items()}))
    progress.warn(
        f"E at control point {worst + 1} has a standard deviation of "
        f"{100 * min(total[worst], 99.0):.0f} %. Its main causes, each with a remedy, are: "
        f"{each}.")
