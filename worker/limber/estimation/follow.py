"""``limber estimate --follow``: read a pull while it is recorded, or replay one at its own pace."""

import json
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from limber.errors import Cancelled, InputError
from limber.estimation.alignment import frames_of
from limber.estimation.checks import clean
from limber.estimation.grasping import grasp_on
from limber.estimation.objective import Objective
from limber.estimation.online import OnlineEstimator, OnlineFrame, OnlineState
from limber.estimation.optimise import gauss_newton
from limber.estimation.parameters import ParameterSpace
from limber.estimation.preparation import Subject, forwards_of, pull_names, subject_of
from limber.estimation.recording import Observations, Pull, read_pull
from limber.estimation.settings import EstimateSettings
from limber.estimation.start import scaled_start
from limber.mechanics.reduced import ReducedSettings, build_reduced
from limber.mechanics.reduced_training import TrainingSettings
from limber.progress import SILENT, Progress
from limber.store import Branch, plain

QUIET_SECONDS = 3.0
"""A recording that has not grown for so long has ended."""
PRIOR_DEVIATION = 0.4
"""Of log E around what the reduced model was built for: it knows no more than twice or half."""


def follow(branch_folder: Path, settings: EstimateSettings, *, pace: float = 1.0,
           progress: Progress = SILENT, warn: Callable[[str], None] = lambda text: None,
           training_count: int = 100) -> dict[str, Any]:
    """Estimate frame by frame from the first pull that is named (or the only one).

    A pull that is still being recorded is read as it grows; a finished one is replayed at
    ``pace`` times its own speed (0: as fast as it goes). Writes ``estimate-online.json`` with the
    estimate after every frame; `limber estimate` afterwards gives the final word.

    Raises:
        InputError: no such pull, or one without markers.
    """
    branch = Branch.open(branch_folder)
    name = pull_names(branch, settings)[0]
    subject = subject_of(branch, settings)
    folder = branch.path(f"pulls/{name}")
    first = read_pull(folder)
    if first.observations is None:
        raise InputError(f"{name} has images.", "They are tracked when the pull is over.",
                         "Follow a pull with markers, or run `limber estimate` afterwards.")
    estimator = prepare(first, subject, settings, progress.part(0.0, 0.5), training_count)
    states: list[OnlineState] = []
    slowest, told = 0.0, False
    try:
        for frame, share in paced(folder, pace):
            started = time.perf_counter()
            states.append(estimator.update(frame))
            slowest = max(slowest, time.perf_counter() - started)
            latest = states[-1]
            progress(0.5 + 0.5 * share, "following", time_s=frame.time,
                     young_mpa=" ".join(f"{young / 1e6:.4g}" for young in latest.young),
                     enough=latest.enough)
            if latest.enough and not told:
                warn(f"{name}: since {frame.time:.2f} s more of this pull, or another like it, "
                     "would add nothing.")
                told = True
    except (Cancelled, KeyboardInterrupt):
        if not states:
            raise
        warn(f"Stopped at {states[-1].time:.2f} s; what was known then is kept.")
    if not states:
        raise InputError(f"{name} has no frames.", "Nothing could be followed.", "Record a pull.")
    result = _result(name, states, slowest)
    with branch.stage("estimate-online", settings, digests={"pull": name}) as stage:
        stage.path("estimate-online.json").write_text(
            json.dumps(plain(result | _history(states)), indent=1), encoding="utf-8")
        stage.result.update(result)
    return stage.result


def prepare(pull: Pull, subject: Subject, settings: EstimateSettings, progress: Progress,
            training_count: int) -> OnlineEstimator:
    """Make the reduced model around what is known: an earlier estimate, or a rough fit.

    A basis knows moduli within its training's spread; around a uniform guess that spread would
    have to be so wide that the basis is good nowhere.
    """
    cleaned = clean(pull)
    few = settings.model_copy(update={"key_frames": 4})
    forwards = forwards_of([cleaned], subject, few, lambda _message: None)
    objective = Objective(forwards, ParameterSpace.separate(subject.start),
                          force_sigma=[pull.entry.sensor.force_sigma_n])
    field = subject.mesh.cell_data["young"]
    if np.ptp(field) > 0.02 * field.mean():
        known = np.linalg.lstsq(subject.weights, field, rcond=None)[0]
        start = replace(subject.start, young=np.maximum(known, 0.05 * field.min()))
    else:
        start = scaled_start(objective, subject.start)
        rough = gauss_newton(objective, objective.space.pack(start), evaluation_limit=8,
                             tolerance=1e-2)
        start = objective.space.unpack(rough.evaluation.free)
    gravity = pull.entry.gravity_m_s2 or (0.0, 0.0, 0.0)
    model = subject.model.with_parameters(young=subject.weights @ start.young, gravity=gravity)
    grasp = grasp_on(subject.mesh, pull.entry.grasp)
    training = TrainingSettings(grasp_count=training_count, young_spread=2.0)
    reduced, _ = build_reduced(model, grasp, subject.weights, start.young,
                               ReducedSettings(training=training), progress)
    rest = subject.control_points if pull.entry.rest_points_m is None else np.array(
        pull.entry.rest_points_m)
    sensor = pull.entry.sensor
    return OnlineEstimator(reduced, pull.entry.grasp, subject.mesh, rest,
                           position_sigma=sensor.position_sigma_m,
                           force_sigma=sensor.force_sigma_n, prior_deviation=PRIOR_DEVIATION)


def paced(folder: Path, pace: float) -> Iterator[tuple[OnlineFrame, float]]:
    """Yield frames of a pull as they come, each with the share of what is there that is done."""
    sent, start, last_growth, size = -np.inf, None, time.monotonic(), -1
    frames: list[OnlineFrame] = []
    while True:
        now = sum(path.stat().st_size for path in folder.glob("*.csv"))
        if now != size:
            size, last_growth = now, time.monotonic()
            try:
                frames = list(online_frames(clean(read_pull(folder))))
            except InputError:
                # Caught in the middle of being written, or too little yet: the next look tells.
                if pace == 0:
                    raise
        fresh = [frame for frame in frames if frame.time > sent]
        for frame in fresh:
            if start is None:
                start = time.monotonic(), frame.time
            if pace > 0:
                due = start[0] + (frame.time - start[1]) / pace
                time.sleep(max(due - time.monotonic(), 0.0))
            sent = frame.time
            yield frame, frames.index(frame) / max(len(frames) - 1, 1)
        if not fresh and (pace == 0 or time.monotonic() - last_growth > QUIET_SECONDS):
            return
        if not fresh:
            time.sleep(0.02)


def online_frames(pull: Pull) -> Iterator[OnlineFrame]:
    """Return the aligned frames of what has been recorded so far."""
    frames = frames_of(replace(pull, observations=Observations(
        pull.observations.times, pull.observations.positions)))
    for index in range(len(frames)):
        yield OnlineFrame(float(frames.times[index]), frames.poses[index],
                          frames.wrenches[index, :3], frames.positions[index])


def _result(name: str, states: list[OnlineState], slowest: float) -> dict[str, Any]:
    last = states[-1]
    return {"method": "online", "pull": name, "young_pa": last.young,
            "young_interval_pa": last.interval, "frame_count": len(states),
            "slowest_update_s": slowest, "enough": last.enough,
            "untrusted_frames": sum(not state.trusted for state in states)}


def _history(states: list[OnlineState]) -> dict[str, Any]:
    return {"history": [{"time_s": state.time, "young_pa": state.young,
                         "young_interval_pa": state.interval, "residual": state.residual,
                         "enough": state.enough} for state in states]}
