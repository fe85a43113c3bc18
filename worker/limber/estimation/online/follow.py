"""``limber estimate --follow``: read a pull while it is recorded, or replay it at its own pace."""

import gc
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.core.errors import Cancelled, Command, InputError, Text
from limber.core.progress import SILENT, Progress
from limber.estimation.estimated_branch import Subject, forwards_of
from limber.estimation.fitting.initial_modulus import scaled_start
from limber.estimation.fitting.objective import Objective
from limber.estimation.fitting.optimise import gauss_newton
from limber.estimation.forward.forward_model import under_its_weight
from limber.estimation.online import filter as filtering
from limber.estimation.parameters import ParameterSpace, Values
from limber.estimation.settings import FitSpec
from limber.estimation.uncertainty.model_error import ModelError, geometry_error, total_interval
from limber.recordings.recording import Observations, Pull, calibration_of, grasp_on, read_pull
from limber.recordings.sensor_checks import clean
from limber.recordings.synchronisation import frames_of
from limber.reduced.model_cache import build_reduced
from limber.reduced.reduced_model import ReducedModel, ReducedSettings
from limber.reduced.training import TrainingSettings

SAID = {
    "enough": "every modulus is known to 2 %. Another pull would hardly improve the estimate.",
    "quiet": Text("noise adds less than 2 % to every modulus. Stop pulling: more frames do not "
                  "reduce the constant errors of the cell. ", Command("estimate"), " states the "
                  "intervals with these errors, and what reduces them most."),
    "idle": "continuing this pull adds nothing: the last tenth of the frames narrowed no interval "
    "by 1 %. Pull farther, at another point or in another direction."}
QUIET_SECONDS = 3.0
"""A recording that has not grown for this long has ended."""
BLIND_DEVIATION = 1.5
"""Deviation of log E if nothing is known."""
MOVED = 0.03
"""Smallest travel over the branch's extent at which a recording can be fitted."""
PRIOR_DEVIATION = 0.4
"""Deviation of log E around the reduced model's training values; it covers a factor of two."""


def follow(where: Callable[[], Path], name: str, subject: Subject, settings: FitSpec, *,
           axes: Path | None = None, pace: float = 1.0, training_count: int = 60,
           progress: Progress = SILENT) -> tuple[dict[str, Any], list[dict[str, Any]]]:
    """Estimate from a pull as it is recorded, or replayed at ``pace`` times its speed (0: as fast
    as possible), while a full-model process corrects. ``where`` returns its folder, which moves
    when it ends. InputError if it has no markers or frames."""
    size = _size(where())
    first = read_pull(where())
    if first.observations is None:
        raise InputError(f"{name} has images.", "Images can be tracked only after the pull.",
                         "Follow a pull with markers, or run ", Command("estimate"), " afterwards.")
    begun = begin(first, subject, settings, progress.part(0.0, 0.5), training_count)
    if _size(where()) != size:
        # It is being recorded now: missed frames are caught up.
        pace = np.inf
    states: list[filtering.OnlineState] = []
    reported = begun_sentences(first, progress)
    is_exact = "enough" not in reported
    slowest, stopped = 0.0, False
    with filtering.Beside(begun.branch) as beside:
        estimator = begun.estimator(beside)
        try:
            for frame, share in paced(where, pace):
                started = time.perf_counter()
                states.append(estimator.update(frame))
                slowest = max(slowest, time.perf_counter() - started)
                _report(name, states[-1], share, reported, progress)
            progress(0.95, "waiting for the full model")
            settled = estimator.settle()
            states += [settled] if settled is not None else []
        except (Cancelled, KeyboardInterrupt):
            if not states:
                raise
            stopped = True
            progress.warn(f"Stopped at {states[-1].time:.2f} s. The estimate up to this time is "
                          "kept.")
    if not states:
        raise InputError(f"{name} has no frames.", "There is nothing to estimate from.",
                         "Record a pull.")
    if estimator.refresh_count:
        progress.warn(f"{name}: the moduli left the range of the reduced model. The model was "
             f"rebuilt {estimator.refresh_count} times during the pull.")
    result = _result(name, states, slowest) | _with_radii(axes, subject, states[-1]) | {
        "frame_count": estimator.frame_count, "stopped": stopped,
        "enough": states[-1].enough and is_exact, "cell_errors_included": is_exact,
        "model_error": estimator.model_error, "refresh_count": estimator.refresh_count}
    return result, _history(states)


def begun_sentences(pull: Pull, progress: Progress) -> set[str]:
    """Say what live intervals leave out; return the sentences that are then not to be said. Where a
    cell has constant errors, noise alone does not say when enough is known."""
    known = calibration_of(pull.entry)
    if not any((known.pose_sigma_m, known.pose_sigma_rad, known.force_gain_sigma,
                known.force_bias_sigma_n, known.force_drift_sigma_n, known.camera_sigma_m,
                known.camera_sigma_rad, known.point_sigma_m)):
        return {"quiet"}
    progress.warn(f"{pull.name}: live intervals include the noise of the sensors alone. Constant "
                  "errors of the cell ([calibration]: gripper frame, zero and gain of the force, "
                  "camera) may be larger. ", Command("estimate"), " includes them.")
    return {"enough"}


def _report(name: str, state: filtering.OnlineState, share: float, reported: set[str],
            progress: Progress) -> None:
    """Report how well a pull is known; ``reported`` are the sentences already reported."""
    progress(0.5 + 0.45 * share, "following", time_s=state.time,
             young_mpa=" ".join(f"{young / 1e6:.4g}" for young in state.young),
             young_factor=" ".join(f"{np.sqrt(high / low):.3g}" for low, high in state.interval),
             enough=state.enough)
    for kind, is_so in (("enough", state.enough), ("quiet", state.enough), ("idle", state.idle)):
        if is_so and kind not in reported:
            progress.warn(f"{name}: {state.time:.2f} s: {SAID[kind]}")
            reported.add(kind)


def _with_radii(axes: Path | None, subject: Subject, last: filtering.OnlineState) -> dict[str, Any]:
    """The last interval combined with the uncertainty of the scan's radii, as in an estimate."""
    if axes is None:
        return {}
    radii = geometry_error(axes, subject.mesh, subject.weights)
    return {"young_interval_sensor_pa": last.interval, "young_interval_pa": total_interval(
        last.young, last.interval, ModelError().having(geometry=radii))}


@dataclass(frozen=True)
class Begun:
    """Initial state of an online estimate: reduced model, what the full one needs, the recording so
    far, and the prior deviation of log E."""

    reduced: ReducedModel
    branch: filtering.FullBranch
    pull: Pull
    prior_deviation: float

    def estimator(self, exact: filtering.Beside | None) -> filtering.OnlineEstimator:
        """Return the estimator that processes the frames."""
        # A full collection would visit all objects of all imported libraries during a frame.
        gc.collect()
        gc.freeze()
        sensor = self.pull.entry.sensor
        return filtering.OnlineEstimator(
            self.reduced, self.pull.entry.grasp, self.branch.mesh, self.branch.rest_points,
            position_sigma=sensor.position_sigma_m, force_sigma=sensor.force_sigma_n,
            prior_deviation=self.prior_deviation, exact=exact)


def begin(pull: Pull, subject: Subject, settings: FitSpec, progress: Progress,
          training_count: int) -> Begun:
    """Build the reduced model around an earlier estimate or a rough fit. A basis wide enough for a
    uniform guess would be inaccurate. Without motion it is built again during the pull."""
    start, deviation, spread = subject.start, PRIOR_DEVIATION, 2.0
    field = subject.mesh.cell_data["young"]
    if settings.young is None and np.ptp(field) > 0.02 * field.mean():
        known = np.linalg.lstsq(subject.weights, field, rcond=None)[0]
        start = replace(start, young=np.maximum(known, 0.05 * field.min()))
    else:
        rough = _rough(pull, subject, settings)
        if rough is None:
            deviation, spread = BLIND_DEVIATION, 4.0
            progress.warn(
                f"{pull.name}: nothing has moved yet. The reduced model is built for a uniform E = "
                f"{start.young[0] / 1e6:.3g} MPa (that of the branch's mesh).")
        else:
            start = rough
    grasp = grasp_on(subject.mesh, pull.entry.grasp)
    model = under_its_weight(subject.model, pull.entry).gripped(grasp).with_young(
        subject.weights @ start.young)
    training = TrainingSettings(grasp_count=training_count, young_spread=spread)
    reduced, _ = build_reduced(model, grasp, subject.weights, start.young,
                               ReducedSettings(training=training), progress)
    rest = subject.control_points if pull.entry.rest_points_m is None else np.array(
        pull.entry.rest_points_m)
    branch = filtering.FullBranch(
        subject.mesh, subject.weights, pull.entry.grasp, rest, start.poisson, start.density,
        tuple(model.gravity), model.point_masses, model.prestress is not None)
    return Begun(reduced, branch, pull, deviation)


def _rough(pull: Pull, subject: Subject, settings: FitSpec) -> Values | None:
    """A quick fit of the recording so far; None if the branch has not moved yet."""
    travel = np.linalg.norm(pull.poses[:, :3] - pull.entry.grasp.point_m, axis=1)
    if travel.max(initial=0.0) < MOVED * subject.model.extent:
        return None
    few = settings.model_copy(update={"key_frames": 4})
    forwards = forwards_of([clean(pull)], subject, few)
    objective = Objective(forwards, ParameterSpace.separate(subject.start),
                          force_sigma=[pull.entry.sensor.force_sigma_n])
    start = scaled_start(objective, subject.start)
    rough = gauss_newton(objective, objective.space.pack(start), evaluation_limit=8,
                         tolerance=1e-2)
    return objective.space.unpack(rough.evaluation.free)


def _size(folder: Path) -> int:
    try:
        return sum(path.stat().st_size for path in folder.glob("*.csv"))
    except FileNotFoundError:
        # Moved between the two checks.
        return -1


def paced(where: Callable[[], Path], pace: float) -> Iterator[tuple[filtering.OnlineFrame, float]]:
    """Yield the frames of a pull as they arrive, each with the processed fraction."""
    sent, start, last_growth, size = -np.inf, None, time.monotonic(), None
    frames: list[filtering.OnlineFrame] = []
    while True:
        folder = where()
        now = folder, _size(folder)
        if now != size:
            size, last_growth = now, time.monotonic()
            try:
                frames = list(online_frames(clean(read_pull(folder))))
            except InputError:
                # Being written or moved at this moment, or too short yet: try again later.
                if pace == 0:
                    raise
        fresh = [frame for frame in frames if frame.time > sent]
        for number, frame in enumerate(fresh):
            if start is None:
                start = time.monotonic(), frame.time
            if pace > 0:
                due = start[0] + (frame.time - start[1]) / pace
                time.sleep(max(due - time.monotonic(), 0.0))
            sent = frame.time
            yield frame, (len(frames) - len(fresh) + number + 1) / len(frames)
        if not fresh and (pace == 0 or time.monotonic() - last_growth > QUIET_SECONDS):
            return
        if not fresh:
            time.sleep(0.02)


def online_frames(pull: Pull) -> Iterator[filtering.OnlineFrame]:
    """Return the aligned frames of the recording so far."""
    seen = pull.observations
    frames = frames_of(pull if seen is None else replace(
        pull, observations=Observations(seen.times, seen.positions)))
    for index in range(len(frames)):
        yield filtering.OnlineFrame(float(frames.times[index]), frames.poses[index],
                          frames.wrenches[index, :3], frames.positions[index])


def _result(name: str, states: list[filtering.OnlineState], slowest: float) -> dict[str, Any]:
    last = states[-1]
    return {"method": "online", "pull": name, "young_pa": last.young,
            "young_interval_pa": last.interval, "frame_count": len(states),
            "slowest_update_s": slowest, "enough": last.enough, "idle": last.idle,
            "untrusted_frames": sum(not state.trusted for state in states)}


def _history(states: list[filtering.OnlineState]) -> list[dict[str, Any]]:
    return [{"time_s": state.time, "young_pa": state.young,
                         "young_interval_pa": state.interval, "residual": state.residual,
                         "enough": state.enough, "idle": state.idle} for state in states]
