"""Expected information on Young's modulus from a future pull, and its risk.

The pull is simulated without noise on the branch as estimated, and inserted into the problem that a
fit would solve. Its derivatives, with errors of cell and sensors eliminated, give the information
of such a pull (Fisher's; Pukelsheim 2006, Optimal Design of Experiments, 3). Added to the
information of the previous pulls, it gives the expected covariance. The interpolation of the
modulus between the control points is the same for all pulls: another pull at the same position adds
little information on it, one at another position more. No pull reduces the errors that all pulls of
this scan have in common, those of shape and mesh.
"""

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.linalg import block_diag

from limber.core.errors import LimberError, Option, Text, WorkError
from limber.core.processes import run_tasks
from limber.core.progress import SILENT, Progress
from limber.estimation.estimated_branch import Subject, forwards_of, parameter_space
from limber.estimation.fitting.objective import Objective
from limber.estimation.forward.observed_path import MotionWanted, moved, seen_at
from limber.estimation.parameters import LINK_DEVIATION, ParameterSpace, Values
from limber.estimation.settings import FitSpec
from limber.mechanics.model import BranchModel
from limber.mechanics.strain import strain_state
from limber.recordings import recording

UNKNOWN_SCALE = 1.15
"""Deviation of the common log E before any measurement: a factor of ten within its 95 %."""
_FIRM = 1e-4
"""Fraction of the variance by which moduli of one group may differ."""
_PROBE_REACH = 0.15  # fraction of the arc length at which positions and directions are compared
_SHARES = (0.25, 0.5, 0.9)  # of the reach at which a limit is met, tried for the best of them
_MOST_REACH = 0.35
_DIRECTIONS = 4
_GOOD = 2  # positions and directions for which other reaches are tried
_FRAMES = 12  # simulated; each counts for all frames of a recording at its position
_RECORDED_FRAMES = 100  # assumed for a recording that does not exist yet
_SECONDS = 6.0


@dataclass(frozen=True)
class Known:
    """Covariance of log E at K points and F numbers of their field's form [K + F, K + F] from
    pulls, which another pull reduces, and of log E that all pulls of a scan share [K, K]."""

    measured: np.ndarray
    common: np.ndarray

    @classmethod
    def nothing(cls, count: int, form_count: int = 0) -> "Known":
        """Before any pull: moduli within a factor of ten, neighbours similar as on branches, the
        form of their field within its deviations."""
        link_covariance = 0.5 * LINK_DEVIATION**2 * np.eye(count)
        return cls(block_diag(UNKNOWN_SCALE**2 + link_covariance, np.eye(form_count)),
                   np.zeros((count, count)))

    @classmethod
    def estimated(cls, found: dict[str, Any]) -> "Known":
        """Return the knowledge in an ``estimate.json``; none without finite intervals."""
        groups = list(found["groups"])
        form = [k for k, name in enumerate(found["parameters"]) if name.startswith("form")]
        indices, count = groups + form, len(groups)
        measured = np.array(found["covariance"], float)[np.ix_(indices, indices)]
        measured[:count, :count] += _FIRM * np.diag(np.diag(measured)[:count])
        interval, sensor = (np.array(found.get(name) or found["young_interval_pa"], float)
                            for name in ("young_interval_pa", "young_interval_sensor_pa"))
        if not np.isfinite([*measured.ravel(), *interval.ravel(), *sensor.ravel()]).all():
            return cls.nothing(count, len(form))
        whole, from_sensor = (np.log(each[:, 1] / each[:, 0]) / (2 * 1.96) for each
                              in (interval, sensor))
        # The interval of a soft piece is wider than the covariance states, and a pull can narrow
        # it.
        wider = np.r_[from_sensor / np.sqrt(np.diag(measured)[:count]), np.ones(len(form))]
        return cls(measured * np.outer(wider, wider),
                   np.diag(np.maximum(whole**2 - from_sensor**2, 0.0)))

    @property
    def total(self) -> np.ndarray:
        """Covariance of log E, shape [K, K]."""
        count = len(self.common)
        return self.measured[:count, :count] + self.common

    def after(self, information: np.ndarray) -> "Known":
        """Return the knowledge with an additional pull of this information [K + F, K + F]."""
        measured = np.linalg.inv(np.linalg.inv(self.measured) + information)
        return replace(self, measured=0.5 * (measured + measured.T))

    def gain(self, after: "Known") -> float:
        """Return the information gain of ``after`` in bits."""
        return 0.5 * float(np.linalg.slogdet(self.total)[1]
                           - np.linalg.slogdet(after.total)[1]) / np.log(2.0)


@dataclass(frozen=True)
class Cell:
    """Sensors, calibration and number of frames of a future pull."""

    sensor: recording.SensorEntry = recording.SensorEntry()  # noqa: RUF009 (frozen)
    calibration: recording.CalibrationEntry = recording.CalibrationEntry()  # noqa: RUF009 (frozen)
    frame_count: int = _RECORDED_FRAMES

    @classmethod
    def of(cls, pull: recording.Pull | None) -> "Cell":
        """Return the cell of an earlier pull, with that pull's length; without one, a carefully
        calibrated cell."""
        if pull is None:
            return cls()
        seen, entry = pull.observations, pull.entry
        is_alike = entry.motion == "quasi_static"
        return cls(entry.sensor, recording.calibration_of(entry),
                   len(seen.times) if seen is not None and is_alike else _RECORDED_FRAMES)

    def in_frames(self, count: int) -> "Cell":
        """Return the cell in which ``count`` frames contain the information of all of this one's.
        Errors that vary from frame to frame average out; constant ones do not."""
        part = (count / self.frame_count)**0.5
        sensor, known = self.sensor, self.calibration
        torque = sensor.torque_sigma_nm
        return Cell(sensor.model_copy(update={
            "position_sigma_m": part * sensor.position_sigma_m,
            "force_sigma_n": part * sensor.force_sigma_n,
            "torque_sigma_nm": None if torque is None else part * torque}),
                    known.model_copy(update={"pose_noise_m": part * known.pose_noise_m}), count)


@dataclass(frozen=True)
class PullChoice:
    """A candidate pull: its position on the main path, its initial direction [rad], and its
    travel over the arc length."""

    fraction: float
    phase: float
    reach: float


@dataclass(frozen=True)
class ExpectedPull:
    """A candidate's result: grasp positions [3] [m], the gripper's peak force [N], the largest
    principal strain, information [K + F, K + F] on log E and form, and bits gained."""

    choice: PullChoice
    point: np.ndarray
    end: np.ndarray
    peak_force: float
    peak_strain: float
    information: np.ndarray
    bits: float

    @property
    def bits_per_percent(self) -> float:
        """Information per percent of strain."""
        return self.bits / (100.0 * self.peak_strain)

    def room(self, max_strain: float, max_force: float) -> float:
        """About how many times as far it could go within the limits."""
        return min(max_strain / self.peak_strain, max_force / self.peak_force)


@dataclass(frozen=True)
class Suggested:
    """Pulls, best first; those that exceed a limit; and the number of impossible ones."""

    pulls: list[ExpectedPull]
    too_much: list[ExpectedPull]
    failed_count: int


def suggest(subject: Subject, values: Values, known: Known, cell: Cell,
            fractions: tuple[float, ...], *, max_strain: float, max_force: float = np.inf,
            workers: int | None = None, progress: Progress = SILENT) -> Suggested:
    """Return pulls by information per percent of strain: places and directions at one travel, for
    the best those that take a share of the limits. WorkError if no pull is within the limits."""
    phases = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    first = [PullChoice(fraction, float(phase), _PROBE_REACH)
             for fraction in fractions for phase in phases]
    found = _all(first, subject, values, known, cell, workers, progress.part(0.0, 0.6))
    best = sorted((one for one in found if one is not None),
                  key=lambda one: -one.bits_per_percent)[:_GOOD]
    found += _all([replace(one.choice, reach=min(share * one.choice.reach * one.room(
        max_strain, max_force), _MOST_REACH)) for one in best for share in _SHARES],
                  subject, values, known, cell, workers, progress.part(0.6, 1.0))
    made = sorted((one for one in found if one is not None), key=lambda one: -one.bits_per_percent)
    fit = [one.peak_strain <= max_strain and one.peak_force <= max_force for one in made]
    kept = [one for one, keeps in zip(made, fit, strict=True) if keeps]
    if not kept:
        raise _none_kept(made, len(found), max_strain, max_force)
    return Suggested(kept, [one for one, keeps in zip(made, fit, strict=True) if not keeps],
                     len(found) - len(made))


def _none_kept(made: list[ExpectedPull], count: int, max_strain: float, max_force: float,
               ) -> WorkError:
    """Why no pull is left, with the limits that would leave the gentlest one."""
    if not made:
        return WorkError(f"None of {count} pulls can be simulated.", "Each of their simulations on "
                         "this branch ended without a result.", "Check the moduli and the mesh, or "
                         "hold it elsewhere (", Option("fractions"), ").")
    least = min(made, key=lambda one: one.peak_strain)
    limits, enough = [f"a strain of {100 * max_strain:.3g} %"], []
    if least.peak_strain > max_strain:
        enough.append(Option("max_strain", float(f"{1.05 * least.peak_strain:.3g}")))
    if np.isfinite(max_force):
        limits.append(f"a force of {max_force:.3g} N")
    if least.peak_force > max_force:
        enough.append(Option("max_force", float(f"{1.05 * least.peak_force:.3g}")))
    return WorkError(f"No pull keeps the limits: {count - len(made)} of {count} are impossible, "
                     f"and the gentlest one strains the branch by {100 * least.peak_strain:.2g} % "
                     f"and takes {least.peak_force:.2g} N.", f"Allowed: {' and '.join(limits)}.",
                     "For that pull, ", Text.joined(" and ", enough), " would do if the branch "
                     "bears it. Or hold the branch elsewhere (", Option("fractions"), ").")


def _all(choices: list[PullChoice], subject: Subject, values: Values, known: Known, cell: Cell,
         workers: int | None, progress: Progress) -> list[ExpectedPull | None]:
    return run_tasks(_tried, [(choice, subject, values, known, cell) for choice in choices],
                     workers=workers, progress=progress, message="evaluating candidate pulls")


def _tried(choice: PullChoice, subject: Subject, values: Values, known: Known, cell: Cell,
           ) -> ExpectedPull | None:
    """Return the expected result of a pull; None if the branch cannot be pulled that way."""
    try:
        return expected_pull(choice, subject, values, known, cell)
    except LimberError:
        return None


def expected_pull(choice: PullChoice, subject: Subject, values: Values, known: Known,
                  cell: Cell) -> ExpectedPull:
    """Simulate a pull on the branch as estimated, and return its information. WorkError if the
    branch cannot be pulled that way."""
    simulated = cell.in_frames(_FRAMES)
    pull, displacements = _without_noise(choice, subject, values, simulated)
    settings = FitSpec(key_frames=4)
    at = replace(subject, start=values, model=_model(subject, values))
    forwards = forwards_of([pull], at, settings)
    space = parameter_space(at, forwards, settings)
    objective = Objective(forwards, space, force_sigma=[simulated.sensor.force_sigma_n])
    evaluation = objective.evaluate(space.pack(values), jacobian=True)
    if evaluation is None:
        raise WorkError("The forces of the pull give no valid simulation.",
                        "The branch has no equilibrium under them.",
                        "Choose another pull.")
    slopes = evaluation.slopes[:len(evaluation.slopes) - space.own_row_count]
    form_count = len(known.measured) - space.group_count
    information = _of_field(np.vstack([slopes, _own_rows(space, space.group_count + form_count)]),
                            space.group_count, form_count, cell.calibration.repeat_sigma)
    strain = max(float(np.abs(strain_state(at.model, u).principal_strain).max())
                 for u in displacements)
    return ExpectedPull(choice, pull.poses[0, :3], pull.poses[-1, :3],
                        float(np.linalg.norm(pull.wrenches[:, :3], axis=1).max()), strain,
                        information, known.gain(known.after(information)))


def _own_rows(space: ParameterSpace, known_count: int) -> np.ndarray:
    """Prior information on all free values but the first ones, which the pulls determine."""
    rows, _ = space.own_rows()
    return rows[~rows[:, :known_count].any(axis=1)]


def _of_field(jacobian: np.ndarray, count: int, form_count: int, repeat_sigma: float) -> np.ndarray:
    """Return the information on log E and form, the first free values, with all others unknown.
    Shape [count + form_count] twice."""
    whole, kept = jacobian.T @ jacobian, count + form_count
    cross = whole[:kept, kept:]
    found = whole[:kept, :kept]
    if cross.size:
        found = found - cross @ np.linalg.solve(whole[kept:, kept:], cross.T)
    # The stiffness differs between recordings: an error that all moduli share.
    along = found[:, :count].sum(axis=1)
    if repeat_sigma > 0.0:
        found = found - np.outer(along, along) / (repeat_sigma**-2 + along[:count].sum())
    return 0.5 * (found + found.T)


def _model(subject: Subject, values: Values) -> BranchModel:
    return subject.model.with_parameters(young=subject.young(values), poisson=values.poisson,
                                         density=values.density)


def _without_noise(choice: PullChoice, subject: Subject, values: Values, cell: Cell,
                   ) -> tuple[recording.Pull, list[np.ndarray]]:
    """Return a pull as a perfect cell would record it, and the branch's states [m]."""
    skeleton, model = subject.skeleton, _model(subject, values)
    point = skeleton.point_at(choice.fraction)
    times = np.linspace(0.0, _SECONDS, _FRAMES)
    entry = recording.PullEntry(
        calibration=cell.calibration, sensor=cell.sensor, weightless=not model.gravity.any(),
        grasp=recording.GraspEntry(point_m=tuple(map(float, point)), mode="point",
                         radius_m=float(1.3 * skeleton.radius_at(choice.fraction))),
        rest_points_m=tuple(tuple(map(float, p)) for p in subject.control_points),
        source="limber suggest-pull")
    grasp = recording.grasp_on(subject.mesh, entry.grasp)
    arc = choice.fraction * skeleton.arc_length[skeleton.main_path()[-1]]
    made = moved(model, grasp, MotionWanted(
        kind="pull", point=point, axis=point - skeleton.nodes[0], travel=choice.reach * arc,
        turn=0.0, phase=choice.phase, times=times, weight=np.zeros(3)))
    seen = seen_at(subject.control_points, subject.mesh, made.displacements)
    return (recording.Pull("suggested", entry, times, made.poses, made.wrenches,
                 recording.Observations(times, seen)), made.displacements)
