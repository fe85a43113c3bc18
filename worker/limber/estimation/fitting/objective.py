"""The objective: differences of simulation and measurement over their standard deviations."""

import copy
import json
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import Cancelled, WorkError
from limber.core.json_values import json_object
from limber.core.not_none import present
from limber.core.progress import SILENT, Progress
from limber.estimation.fitting.nuisances import CellErrors, Eliminated, eliminated
from limber.estimation.forward.forward_model import Forward, Simulated
from limber.estimation.forward.observed_path import ObservedPathForward
from limber.estimation.parameters import ParameterSpace, Values
from limber.recordings.synchronisation import Frames

# One pull's differences of simulated and measured values, each over its standard deviation.


@dataclass(frozen=True)
class _Kind:
    """A kind of measurement, of this name in ``Simulated``: values [f, ..., 3], which are there
    [f, ...], inverse deviations [f, ..., 3, 3], and its cause of uncertainty."""

    name: str
    cause: str
    measured: np.ndarray
    known: np.ndarray
    whitening: np.ndarray

    def scaled(self, values: np.ndarray) -> np.ndarray:
        """Values or their slopes [f, ..., 3(, P)] over the deviations."""
        slopes = values if values.ndim > self.measured.ndim else values[..., None]
        return np.einsum("...ij,...jp->...ip", self.whitening, slopes).reshape(values.shape)

    def residual(self, simulated: Simulated) -> np.ndarray:
        """Difference over its deviation, [f, ..., 3]; NaN: not measured."""
        return self.scaled(getattr(simulated, self.name) - self.measured)


class Residuals:
    """Compares a simulated pull with its measurements; the force sensor's deviation is in N."""

    def __init__(self, forward: Forward, force_sigma: float):
        self._forward, frames = forward, forward.frames
        self._span: tuple[Simulated, np.ndarray, np.ndarray] | None = None
        values, vectors = np.linalg.eigh(frames.covariance)
        averaged = np.sqrt(np.maximum(frames.wrench_counts, 1))

        def read(name: str, part: slice, sigma: float | None) -> _Kind:
            measured = frames.wrenches[:, part]
            deviation = present(sigma, f"deviation of the {name}") / averaged
            return _Kind(name, "noise of the force", measured, np.isfinite(measured).all(axis=1),
                         np.eye(3) / deviation[:, None, None])

        # Inverse square roots of the covariances, shape [f, m, 3, 3].
        self._points = _Kind(
            "positions", "noise of the points", frames.positions, seen_in(frames),
            np.einsum("fmij,fmj,fmkj->fmik", vectors, 1 / np.sqrt(values), vectors))
        self._force = read("forces", slice(3), force_sigma)
        self._kinds = [self._points]
        if forward.uses_force:
            self._kinds.append(self._force)
        if forward.uses_torque:
            self._kinds.append(read("torques", slice(3, 6),
                                    forward.entry.sensor.torque_sigma_nm))
        if forward.watches_pose:
            self._kinds.append(_Kind(
                "grasps", "noise of the gripper's poses", frames.poses[:, :3],
                np.ones(len(frames), bool), np.eye(3) / forward.pose_sigma))

    def standardised(self, simulated: Simulated) -> tuple[np.ndarray, np.ndarray]:
        """Residuals of points [f, m, 3] and force [f, 3]; NaN: not measured."""
        return self._points.residual(simulated), self._force.residual(simulated)

    def rows(self, simulated: Simulated) -> tuple[np.ndarray, np.ndarray | None]:
        """All residuals, of points, force, torque and gripper, [r], and their slopes [r, P]."""
        residual = np.concatenate([each.residual(simulated)[each.known].ravel()
                                   for each in self._kinds])
        return residual, None if simulated.slopes is None else self.slopes(simulated.slopes)

    def slopes(self, changes: Simulated) -> np.ndarray:
        """Slopes of the residuals, [r, P], from those of the predicted measurements."""
        count = changes.positions.shape[-1]
        return np.vstack([each.scaled(present(getattr(changes, each.name), each.name))[
            each.known].reshape(3 * int(each.known.sum()), count) for each in self._kinds])

    def kinds(self) -> list[str]:
        """Cause of uncertainty of each residual; length r."""
        return [each.cause for each in self._kinds for _ in range(3 * int(each.known.sum()))]

    def span(self) -> tuple[np.ndarray, np.ndarray] | None:
        """Orthonormal columns of all changes that the unknowns of the input force can cause, and
        their triangle; None if there are no unknowns."""
        response = self._forward.response
        if response is None:
            return None
        if self._span is None or self._span[0] is not response:
            self._span = (response, *np.linalg.qr(self.slopes(response)))
        return self._span[1:]

    def beside(self, rows: np.ndarray) -> np.ndarray:
        """Rows after elimination of the unknown input force."""
        span = self.span()
        return rows if span is None else rows - span[0] @ (span[0].T @ rows)

    def force_change(self, simulated: Simulated) -> np.ndarray:
        """Change of the unknown input force that explains the residuals."""
        columns, triangle = present(self.span(), "response of the pull to its force")
        return -np.linalg.lstsq(triangle, columns.T @ self.rows(simulated)[0], rcond=1e-9)[0]


def seen_in(frames: Frames) -> np.ndarray:
    """Which points were observed, shape [f, m] of bool."""
    return np.isfinite(frames.positions).all(axis=2)


# Log of all forward simulations of an estimate, from which a stopped estimate resumes.


@dataclass(frozen=True)
class EvaluationEntry:
    """One evaluation: free vector, objective, the paper's loss [m^2] and time [s]. Objective and
    loss are None if the simulation found no equilibrium."""

    parameters: tuple[float, ...]
    objective: float | None
    loss: float | None
    seconds: float


class EvaluationLog:
    """Appends one JSON line per evaluation, and reads those of an earlier run.

    The first line has a digest of the problem; evaluations of another problem are not reused, and
    those of a stopped run only if this one ``resumes``.
    """

    def __init__(self, path: Path | None, problem: str, *, resumes: bool = True):
        self.entries: list[EvaluationEntry] = []
        self.resumed_count = 0
        self._known: list[EvaluationEntry] = []
        self._path = path
        self._started = time.perf_counter()
        self._header: dict[str, str | bool] = {"problem": problem}
        if path is not None:
            self._resume(path, resumes)

    @property
    def best(self) -> EvaluationEntry | None:
        """The entry of the smallest objective; None: no evaluation had an equilibrium."""
        found = [(entry.objective, number, entry) for number, entry in enumerate(
            [*self.entries, *self._known]) if entry.objective is not None]
        return min(found)[2] if found else None

    def add(self, parameters: np.ndarray, objective: float | None, loss: float | None) -> None:
        """Add an evaluation. Its line is on disk when this returns."""
        entry = EvaluationEntry(tuple(float(x) for x in parameters), objective, loss,
                                round(time.perf_counter() - self._started, 4))
        self.entries.append(entry)
        if self._path is not None:
            with open(self._path, "a", encoding="utf-8") as stream:
                stream.write(json.dumps(entry.__dict__) + "\n")

    def go_on_from(self, best: "Evaluation") -> None:
        """Let the next run start at this evaluation, whether it is asked to or not."""
        self._header["goes_on"] = True
        if self._path is not None:
            self._begin(self._path)
            self.add(best.free, best.objective, best.loss)

    def forget(self) -> None:
        """Remove the file after the estimate."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _begin(self, path: Path) -> None:
        path.write_text(json.dumps(self._header) + "\n", encoding="utf-8")

    def _resume(self, path: Path, resumes: bool) -> None:
        lines = (path.read_text(encoding="utf-8", errors="replace").splitlines()
                 if path.exists() else [])
        header = json_object(lines[0]) if lines else None
        if header is None or not (resumes or header.get("goes_on")) or header.get(
                "problem") != self._header["problem"]:
            self._begin(path)
            return
        for line in lines[1:]:
            record = json_object(line) or {}
            try:
                self._known.append(EvaluationEntry(
                    **(record | {"parameters": tuple(record["parameters"])})))
            except (KeyError, TypeError, ValueError):
                continue  # a damaged line: repeat that evaluation
        self.resumed_count = len(self._known)


WORK_LIMIT = 4.5e6
"""Tetrahedra times linear systems after which a fit ends, the same on every machine: 40 to 65 s of
processor time, so that an estimate takes about a minute with what judges it.
"""


class Work:
    """A share of the limit, and what is ``left`` of it."""

    def __init__(self, share: float = 1.0):
        self.left = share * WORK_LIMIT


SETTLING_ROUNDS = 12
LONGEST_MOVE = 0.05
"""Largest motion of the gripper per change of its force, as a fraction of the branch's size; a
larger linear step overshoots.
"""
STILL_SETTLING = 0.6
"""A change of the force diverges if it moves the gripper by more than this fraction of the last
one.
"""
LINEAR_STEP = 0.02
"""Change of a log E within which no simulation shows more than derivatives: these change by two
percent.
"""
FORESEEN_STEP = 0.5
"""Largest change of a log E over which the force is foreseen by derivatives. Chosen: beyond it the
force is scaled with the stiffness.
"""
SETTLED_FORCE_M = 5e-4
"""Motion of the gripper by a change of its force below which the force has converged."""


@dataclass(frozen=True)
class Evaluation:
    """All pulls simulated with one free vector [p]: standardised residual [r], Jacobian [r, p], and
    the paper's J [m^2], the points' squared distances. ``pulls`` are as cell and sensors show them;
    ``unknown_count`` unknowns of force and errors were eliminated."""

    free: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray | None
    loss: float
    pulls: tuple[Simulated, ...]
    unknown_count: int = 0
    errors: Eliminated | None = None

    @property
    def objective(self) -> float:
        """Half the sum of squared residuals."""
        return 0.5 * float(self.residual @ self.residual)

    @property
    def slopes(self) -> np.ndarray:
        """The Jacobian of an evaluation with derivatives, shape [r, p]. ValueError if the
        evaluation has no derivatives."""
        return present(self.jacobian, "derivative of this evaluation")

    @property
    def deviations(self) -> np.ndarray:
        """Standard deviation of each free value from these derivatives, shape [p]."""
        return np.sqrt(np.diag(inverse_information(self.slopes)))


def inverse_information(slopes: np.ndarray) -> np.ndarray:
    """Covariance of the free vector from slopes [r, p] of residuals of unit variance, [p, p]."""
    _, values, rows = np.linalg.svd(slopes, full_matrices=False)
    spread = rows.T / np.maximum(values, 1e-9 * max(values[0], 1e-300))
    return spread @ spread.T


@dataclass(frozen=True)
class RawSlopes:
    """Slopes of a pull's r standardised residuals to the free vector [r, p], errors of cell and
    sensors [r, k] and its force's unknowns [r, L] (None: none). ``kinds`` name causes."""

    free: np.ndarray
    errors: np.ndarray
    response: np.ndarray | None
    residual: np.ndarray
    kinds: list[str]


class Stopped(Cancelled):
    """The user stopped the optimiser. The evaluation log has the best result so far."""


class Objective:
    """Evaluates free vectors, counts forward simulations and logs each one. ``variance`` is that
    of the measurements over the stated one, by which a fit weighs them and its priors."""

    def __init__(self, forwards: list[Forward], space: ParameterSpace, *,
                 log: EvaluationLog | None = None, force_sigma: list[float] | None = None,
                 progress: Progress = SILENT, expected_count: int = 20, work: Work | None = None):
        self.forwards = forwards
        self.work = work or Work()
        self.space = space
        self.log = log or EvaluationLog(None, "")
        self.forward_count = 0
        self.variance = 1.0
        self.force_sigma = force_sigma or [0.1] * len(forwards)
        self._progress = progress
        self._expected = expected_count
        self._last: Evaluation | None = None
        self._linear: tuple[np.ndarray, list[Simulated]] | None = None
        self._residuals = [Residuals(*each) for each in zip(forwards, self.force_sigma,
                                                            strict=True)]
        self.cell_errors = CellErrors(forwards)

    def with_space(self, space: ParameterSpace, forwards: list[Forward] | None = None,
                   ) -> "Objective":
        """Return an objective on other parameters, and perhaps other models of the same pulls, with
        the same log and count."""
        other = Objective(forwards or self.forwards, space, log=self.log,
                          force_sigma=self.force_sigma, progress=self._progress,
                          expected_count=self._expected, work=self.work)
        other.forward_count, other.variance = self.forward_count, self.variance
        return other

    def on_copies(self) -> "Objective":
        """Return an objective on copies of the pulls with its own log; evaluating it does not
        change this one."""
        other = Objective([copy.copy(forward) for forward in self.forwards], self.space,
                          force_sigma=self.force_sigma)
        other.variance = self.variance
        return other

    def forget(self) -> None:
        """Evaluate again at the last parameters, because a forward model has changed."""
        self._last = None

    def evaluate(self, free: np.ndarray, *, jacobian: bool = False) -> Evaluation | None:
        """Simulate all pulls. Return None if one has no equilibrium. Stopped by Ctrl-C or by
        cancelling the progress."""
        free = np.array(free, float)
        last = self._last
        if last is not None and np.array_equal(last.free, free) and (
                not jacobian or last.jacobian is not None):
            return last
        values = self.space.unpack(free)
        young = _listed(values)
        if self.work.left <= 0 and self.log.best is None:
            raise WorkError(
                "The fit has spent its budget before it found an equilibrium.", "No Young's "
                f"modulus of the {len(self.log.entries)} tested carries this pull.", "Check the "
                "grasp point, the frame of reference and the units, or mesh the branch coarser.")
        try:
            found = self._simulated(free, values, jacobian)
            if last is None or not np.array_equal(last.free, free):
                # The derivative at a known state does not count as a simulation.
                self.forward_count += 1
                self.log.add(free, *((found.objective, found.loss) if found else (None, None)))
            if found is None:
                self._report("no equilibrium", young_mpa=young)
            else:
                self._report("fitting", loss_m2=found.loss, young_mpa=young,
                             **_known_so_far(found, self.space))
        except (KeyboardInterrupt, Cancelled) as stop:
            raise Stopped("The estimate was stopped.") from stop
        if found is not None:
            self._last = found
        return found

    def _report(self, message: str, **numbers: Any) -> None:
        best = self.log.best
        self._progress(min(self.forward_count / self._expected, 0.99), message,
                       simulations=self.forward_count, **numbers,
                       **({} if best is None else {"best_m2": best.loss}))

    def standardised(self, evaluation: Evaluation) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per pull: residuals over deviations of points [f, m, 3] and force [f, 3]; NaN: none."""
        return [each.standardised(simulated)
                for each, simulated in zip(self._residuals, evaluation.pulls, strict=True)]

    def scored(self, evaluation: Evaluation) -> list[tuple[np.ndarray, np.ndarray]]:
        """Per pull: standardised residual of each point [f, m] (RMS of axes) and force [f]."""
        return [(np.sqrt(np.mean(points**2, axis=2)), np.sqrt(np.mean(forces**2, axis=1)))
                for points, forces in self.standardised(evaluation)]

    def follow_forces(self, evaluation: Evaluation) -> bool:
        """Move measured input forces to their values in an evaluation. Returns whether there are
        any; earlier evaluations then belong to another linearisation."""
        moved = False
        for index, forward in enumerate(self.forwards):
            if forward.response is None or forward.watches_pose:
                continue
            forward.shift_force(self._residuals[index].force_change(evaluation.pulls[index]))
            moved = True
        if moved:
            self.forget()
        return moved

    def _simulated(self, free: np.ndarray, values: Values, jacobian: bool) -> Evaluation | None:
        """Simulate all pulls; unknown forces with a recorded path are iterated until settled."""
        settling = {index: forward for index, forward in enumerate(self.forwards)
                    if isinstance(forward, ObservedPathForward)}
        if not settling:
            return self._compared(free, values, jacobian)
        left = sum(forward.iteration_limit for forward in settling.values())
        last, part, longest = np.inf, 1.0, LONGEST_MOVE * max(
            float(np.linalg.norm(np.ptp(forward.mesh.nodes, axis=0)))
            for forward in settling.values())
        foreseen = self._foreseen(free, settling)
        for index, change in foreseen.items():
            settling[index].foresee(change, values)
        for number in range(SETTLING_ROUNDS):
            # A foreseen force has usually settled: derivatives then reuse the states' factors.
            found = self._compared(free, values, jacobian and not number and bool(foreseen))
            if found is None:
                break
            # The comparison already includes the linear effect of the remaining change.
            changes = [self._residuals[index].force_change(found.pulls[index])
                       for index in settling]
            moved = max(forward.moved_by(change)
                        for forward, change in zip(settling.values(), changes, strict=True))
            if moved < SETTLED_FORCE_M:
                if jacobian and found.jacobian is None:
                    found = self._compared(free, values, True)
                for forward in settling.values():
                    forward.keep()
                return found
            left -= sum(forward.iteration_count for forward in settling.values())
            if moved > (STILL_SETTLING if part == 1.0 else 1.0) * last or left < 0:
                break
            last, part = moved, min(1.0, longest / moved)
            for forward, change in zip(settling.values(), changes, strict=True):
                forward.shift_force(part * change)
        # Parameters for which the force does not converge are too far away: no step there.
        self.forget()
        for forward in settling.values():
            forward.step_back()
        return None

    def _foreseen(self, free: np.ndarray, settling: dict[int, ObservedPathForward],
                  ) -> dict[int, np.ndarray]:
        """Changes of settling forces from the last derivatives to ``free``; empty: too far."""
        if self._linear is None:
            return {}
        known, step = self.space.unpack(self._linear[0]), free - self._linear[0]
        if np.abs(step[:self.space.group_count]).max() > FORESEEN_STEP or not all(
                forward.is_settled_for(known) for forward in settling.values()):
            return {}
        found = self._extrapolated(self._linear, step)
        return {index: self._residuals[index].force_change(found.pulls[index])
                for index in settling}

    def _extrapolated(self, linear: tuple[np.ndarray, list[Simulated]], step: np.ndarray,
                      ) -> Evaluation:
        at, pulls = linear
        count = self.space.group_count
        wide = np.r_[self.space.membership @ step[:count], step[count:]]
        return self.compare(at + step, [
            replace(pull.moved(slopes := present(pull.slopes, "derivatives"), wide), slopes=slopes)
            for pull in pulls])

    def moved(self, at: Evaluation, step: np.ndarray) -> Evaluation | None:
        """Evaluate at a step from an evaluation with derivatives: by these if it is short."""
        free = np.clip(at.free + step, *self.space.bounds())
        if self._linear is None or not np.array_equal(at.free, self._linear[0]) or np.abs(
                step[:self.space.group_count]).max() > LINEAR_STEP:
            return self.evaluate(free, jacobian=True)
        self._last = self._extrapolated(self._linear, free - at.free)
        return self._last

    def _compared(self, free: np.ndarray, values: Values, jacobian: bool) -> Evaluation | None:
        pulls = []
        for forward in self.forwards:
            self._report("simulating", young_mpa=_listed(values))
            found = forward.simulate(values, self.space.extra, jacobian)
            self.work.left -= forward.work
            if found is None:
                return None
            pulls.append(found)
        if jacobian:
            self._linear = free, pulls
        return self.compare(free, pulls)

    def compare(self, free: np.ndarray, pulls: list[Simulated]) -> Evaluation:
        """Return the evaluation of pulls that were simulated with a free vector."""
        residuals, jacobians, columns, slopes, unknown_count = [], [], [], [], 0
        with_errors = self.cell_errors.count > 0
        for index, simulated in enumerate(pulls):
            compared = self._residuals[index]
            residual, jacobian = compared.rows(simulated)
            span = compared.span()
            unknown_count += 0 if span is None else span[0].shape[1]
            residuals.append(compared.beside(residual))
            if jacobian is not None:
                jacobians.append(compared.beside(jacobian))
            if with_errors:
                slopes.append(self.cell_errors.slopes(index, simulated))
                columns.append(compared.beside(compared.slopes(slopes[-1])))
        residual = np.concatenate(residuals)
        jacobian = self.on_free(np.vstack(jacobians)) if jacobians else None
        errors: Eliminated | None = None
        if with_errors:
            known = self.cell_errors.known
            residual, jacobian, eliminated_errors = eliminated(residual, jacobian,
                                                               np.vstack(columns), known)
            # As cell and sensors with these errors would show them.
            pulls = [replace(simulated.moved(of_errors, eliminated_errors.values - known),
                             slopes=simulated.slopes)
                     for simulated, of_errors in zip(pulls, slopes, strict=True)]
            errors = eliminated_errors
            unknown_count += self.cell_errors.count
        rows, offsets = self.space.own_rows()
        residual = np.concatenate([residual, rows @ free - offsets])
        jacobian = None if jacobian is None else np.vstack([jacobian, rows])
        loss = sum(float(np.sum((pull.positions - forward.frames.positions)[
            seen_in(forward.frames)]**2)) for pull, forward in zip(pulls, self.forwards,
                                                                   strict=True))
        return Evaluation(free, residual, jacobian, loss, tuple(pulls), unknown_count, errors)

    def raw_slopes(self, evaluation: Evaluation) -> list[RawSlopes]:
        """Slopes of each pull's standardised residuals before elimination, of an evaluation with
        derivatives."""
        found = []
        for index, simulated in enumerate(evaluation.pulls):
            compared = self._residuals[index]
            residual, jacobian = compared.rows(simulated)
            errors = compared.slopes(self.cell_errors.slopes(index, simulated))
            span = compared.span()
            found.append(RawSlopes(
                self.on_free(present(jacobian, "derivative of this evaluation")), errors,
                None if span is None else span[0] @ span[1], residual, compared.kinds()))
        return found

    def residual_slopes(self, evaluation: Evaluation, changes: Sequence[Simulated],
                        ) -> np.ndarray:
        """Change [r, S] of residuals by S changes of the pulls' predictions, without the part that
        unknowns of a force and errors of cell and sensors would explain."""
        rows, columns = [], []
        for compared, piece, change in zip(
                self._residuals, self.raw_slopes(evaluation), changes, strict=True):
            rows.append(compared.beside(compared.slopes(change)))
            columns.append(compared.beside(piece.errors))
        found = np.vstack(rows)
        if self.cell_errors.count:
            _, left, _ = eliminated(np.zeros(len(found)), found, np.vstack(columns))
            found = present(left, "derivative of the residuals")
        return np.vstack([found, np.zeros((self.space.own_row_count, found.shape[1]))])

    def on_free(self, jacobian: np.ndarray) -> np.ndarray:
        """Derivatives to the free vector from those to the physical parameters, [r, p]."""
        count = len(self.space.groups)
        return np.hstack([jacobian[:, :count] @ self.space.membership, jacobian[:, count:]])


def _known_so_far(found: Evaluation | None, space: ParameterSpace) -> dict[str, str]:
    """Factor by which each modulus may be wrong (95 %) if the fit ended here."""
    if found is None or found.jacobian is None:
        return {}
    deviations = found.deviations[list(space.groups)]
    return {"young_factor": " ".join(f"{np.exp(min(1.96 * each, 35.0)):.3g}"
                                     for each in deviations)}


def _listed(values: Values) -> str:
    return " ".join(f"{each / 1e6:.3g}" for each in values.young)
