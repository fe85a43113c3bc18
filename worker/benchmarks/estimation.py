"""Measures of estimation: required and measured.

The truth is always simulated on another, finer mesh than the fit, with noise of another seed.
"""

import tempfile
import time
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks import silicone_beam
from benchmarks.estimation_force import FORCE_ROWS, force_rows
from benchmarks.estimation_noise import NOISE_ROWS, noise_rows
from benchmarks.estimation_scans import SCAN_ROWS, scan_rows
from benchmarks.paper_branches import BRANCHES, FRACTIONS, Bench, PaperBranch, exact_pull, measured
from benchmarks.table import Asked, Part, Row, Setting
from benchmarks.trial_log import Numbers, numbers_of, source_digest
from limber.core.processes import run_tasks
from limber.core.progress import SILENT
from limber.estimation.estimated_branch import Subject
from limber.estimation.fit_assessment import Estimate
from limber.estimation.fitting.initial_modulus import scaled_start
from limber.estimation.fitting.optimise import gauss_newton, nelder_mead
from limber.estimation.online.filter import OnlineFrame
from limber.estimation.online.follow import begin
from limber.estimation.online.full_model import Beside
from limber.estimation.parameters import Values
from limber.estimation.settings import EstimateSettings
from limber.estimation.simulated_pull import VirtualPullSettings, simulate_pull, write_depth_frames
from limber.recordings.recording import Pull
from limber.recordings.synchronisation import frames_of

SETTINGS = EstimateSettings(hold_out=False)
_BEAM_YOUNG_PA = (1.6e5, 4.0e5)
"""Range of simulated beams."""


_TABLE = tuple(Asked(f"paper's table, {branch.name}: E1..E4 [1e7 Pa], nu", " ".join(
    f"{young / 1e7:.3g}" for young in branch.young) + f", {branch.poisson}") for branch in BRANCHES)
_EXACT = Asked("three branches, one pull, exact data: worst E error", "1 %")
_DEPTH = Asked("depth frames of a simulated D455 at 1 m, one side: worst E error", "10 %")
_OPTIMISER = Asked("forward simulations, Nelder-Mead over Gauss-Newton, to the same loss",
                   "10 times fewer")
_SPEED = (
    Asked("one pull of 100 frames, 2,500 quadratic tetrahedra, full model", "240 s"),
    Asked("the same on the reduced model, its basis built", "20 s"),
    Asked("online update", "33 ms a frame"))
_BEAM = (Asked("silicone_beam: E from the recording (CSV; C3D in brackets)",
               "simulated static tip drop within 2 % of the measured"),
         Asked("silicone_beam: drop foretold for other loads", "-"))
_OTHER_LOADS = Asked("the same with simulated recordings, fitted at 0.51 N: worst error of the "
                     "drop at 0, 0.2 and 1 N", "5 %")


def _exact(branch: PaperBranch) -> tuple[np.ndarray, float, int]:
    """Errors of the moduli, Poisson's ratio and count of simulations, from data without noise."""
    bench = Bench(branch)
    found = bench.fit([measured(exact_pull(branch, 0), 0, points=0.0, force=0.0)],
                      EstimateSettings(hold_out=False, fit_poisson=True, key_frames=20))
    return bench.errors(found), found.values.poisson, found.objective.forward_count


def _paper_table(_setting: Setting) -> list[Row]:
    found = run_tasks(_exact, [(branch,) for branch in BRANCHES])
    table = []
    for asked, branch, (errors, poisson, count) in zip(_TABLE, BRANCHES, found, strict=True):
        ours = " ".join(f"{young / 1e7 * (1 + error):.3g}"
                        for young, error in zip(branch.young, errors, strict=True))
        table.append(Row(*asked, f"{ours}, {poisson:.3f} ({count} simulations)", None))
    worst = [float(np.abs(errors).max()) for errors, _, _ in found]
    each = ", ".join(f"{branch.name} {100 * error:.2f} %"
                     for branch, error in zip(BRANCHES, worst, strict=True))
    return [Row(*_EXACT, each, bool(max(worst) <= 0.01), len(worst)), *table]


def _depth_rows(setting: Setting) -> list[Row]:
    from limber.perception.observe import observe

    worst, sizes, squares, covered = {}, [], [], []
    branches = BRANCHES[1:2] if setting.quick else BRANCHES
    for branch in setting.budget.items(branches):
        truth = branch.truth()
        settings = VirtualPullSettings(
            young=branch.young, poisson=branch.poisson, frames=40, reach=0.4, phase=0.3,
            camera=True, seed=setting.seed)
        pull, states = simulate_pull(truth, "pull-1", settings)
        with tempfile.TemporaryDirectory() as folder:
            write_depth_frames(Path(folder), truth, pull, states, settings)
            seen, _ = observe(Path(folder), pull, truth.skeleton, FRACTIONS)
        bench = Bench(branch)
        true_points = np.array([truth.control_points + moved for moved in _moved(truth, states)])
        off = seen.positions - true_points
        sizes.append(np.nanmedian(np.linalg.norm(off, axis=2)))
        squares.append(np.nanmean(np.einsum("fmi,fmij,fmj->fm", off,
                                            np.linalg.inv(seen.covariance), off)) / 3)
        found = bench.fit([replace(pull, observations=seen)], SETTINGS)
        worst[branch.name] = float(np.abs(bench.errors(found)).max())
        low, high = found.uncertainty.young_interval.T
        covered += ((low <= branch.young) & (high >= branch.young)).tolist()
    each = ", ".join(f"{name} {100 * error:.1f} %" for name, error in worst.items())
    return [Row(*_DEPTH,
                f"{each} (points found to {1e3 * np.median(sizes):.2f} mm, "
                f"{np.sqrt(np.mean(squares)):.1f} of their stated deviation; "
                f"{sum(covered)} of {len(covered)} intervals hold)",
                max(worst.values()) <= 0.10, len(worst))]


def _moved(truth: object, displacements: list) -> list[np.ndarray]:
    from limber.mechanics.points import point_operator

    operator = point_operator(truth.mesh, truth.control_points)
    return [(operator @ displacement.ravel()).reshape(-1, 3) for displacement in displacements]


def _optimiser_rows(setting: Setting) -> list[Row]:
    """Both from the same start; the simulations each needs to reach Nelder-Mead's final loss."""
    branch = BRANCHES[1]
    bench = Bench(branch)
    pull = measured(exact_pull(branch, 0, frames=40), setting.seed)
    settings = EstimateSettings(hold_out=False, key_frames=8)
    start = scaled_start(bench.objective([pull], settings), Values(np.full(4, 1e7), 0.35, 900.0))
    ours, theirs = (bench.objective([pull], settings) for _ in range(2))
    free = ours.space.pack(start)
    # Both minimise the plain sum of squares: a robust loss has its minimum elsewhere.
    fitted = gauss_newton(ours, free, robust=False)
    simplex = nelder_mead(theirs, free)
    final = simplex.evaluation.objective
    reached = next((number + 1 for number, entry in enumerate(ours.log.entries)
                    if entry.objective <= final * (1 + 1e-6)), ours.forward_count)
    ratio = theirs.forward_count / reached
    note = "" if fitted.evaluation.objective <= final * (1 + 1e-6) else ", which it misses"
    return [Row(*_OPTIMISER, f"{theirs.forward_count} / {reached} = {ratio:.0f}{note}",
                bool(ratio >= 10 and not note))]


def _speed_rows(setting: Setting) -> list[Row]:
    branch = BRANCHES[1]
    # About 2,500 quadratic tetrahedra.
    bench = Bench(branch, slice_length=0.95, sides=10)
    pull = measured(exact_pull(branch, 0), setting.seed)
    started = time.perf_counter()
    found = bench.fit([pull], SETTINGS)
    full = time.perf_counter() - started
    short, build, away = _reduced(bench, pull, found)
    updates, _, online_error = followed(
        bench, measured(exact_pull(branch, 1), setting.seed), pull, found)
    return [
        Row(*_SPEED[0], f"{full:.0f} s ({found.objective.forward_count} simulations, "
            f"{bench.mesh.tet_count} tetrahedra)", full <= 240),
        Row(*_SPEED[1],
            f"{short:.1f} s; {100 * away:.1f} % from the full model's E; with the basis "
            f"{build:.0f} s", short <= 20),
        Row(*_SPEED[2],
            f"median {1e3 * np.median(updates):.0f} ms, 95 % under "
            f"{1e3 * np.percentile(updates, 95):.0f} ms; ends {100 * online_error:.1f} % from the "
            "full fit", bool(np.percentile(updates, 95) <= 0.033), len(updates))]


def _reduced(bench: Bench, pull: Pull, found: Estimate) -> tuple[float, float, float]:
    """Seconds with the basis built and with building it; difference of E from the full model's."""
    settings, seconds = SETTINGS.model_copy(update={"forward": "reduced"}), []
    with tempfile.TemporaryDirectory() as folder:
        for _ in range(2):
            started = time.perf_counter()
            quick = bench.fit([pull], settings, cache=Path(folder))
            seconds.append(time.perf_counter() - started)
    away = float(np.abs(quick.values.young / found.values.young - 1).max())
    return seconds[1], seconds[0], away


def followed(bench: Bench, earlier: Pull, pull: Pull, found: Estimate,
             ) -> tuple[np.ndarray, float, float]:
    """Follow a pull at its own pace, starting from a rough fit of an earlier one.

    Returns:
        Seconds of each frame; difference of E from the full fit's after the last frame, and
        settled.
    """
    mesh = bench.mesh.with_data(cell_data={"young": np.full(bench.mesh.tet_count, 1e7)})
    subject = Subject(mesh, bench.branch.skeleton, bench.points, bench.weights,
                      bench.model, Values(np.full(4, 1e7), 0.35, 900.0))
    begun = begin(earlier, subject, SETTINGS, SILENT, 120)
    frames, seconds = frames_of(pull), []
    with Beside(begun.branch) as beside:
        estimator = begun.estimator(beside)
        start = time.perf_counter()
        for index in range(len(frames)):
            frame = OnlineFrame(float(frames.times[index]), frames.poses[index],
                                frames.wrenches[index, :3], frames.positions[index])
            ahead = frames.times[index] - frames.times[0] - (time.perf_counter() - start)
            time.sleep(max(ahead, 0.0))
            started = time.perf_counter()
            estimator.update(frame)
            seconds.append(time.perf_counter() - started)
        live = float(np.abs(estimator.young / found.values.young - 1).max())
        estimator.settle()
    settled = float(np.abs(estimator.young / found.values.young - 1).max())
    return np.array(seconds), live, settled


def _beam_rows(_setting: Setting) -> list[Row]:
    if not silicone_beam.RECORDING.is_file():
        return [Row(*_BEAM[0], "the recording is not here", None, 0)]
    with tempfile.TemporaryDirectory() as temporary:
        branch = silicone_beam.made_branch(Path(temporary))
        c3d = silicone_beam.estimate_beam(branch, silicone_beam.RECORDING_C3D,
                                          silicone_beam.LOAD_N, "c3d")
        found = silicone_beam.estimate_beam(branch, silicone_beam.RECORDING,
                                            silicone_beam.LOAD_N, "csv")
        others = ", ".join(
            f"{load:g} N {1e3 * silicone_beam.predicted_drop(branch, 'csv', load):.2f} mm"
            for load in (0.0, 0.25, 0.75, 1.0))
    drop_off = found.simulated_drop / found.measured_drop - 1
    low, high = (value / 1e3 for value in found.interval)
    return [
        Row(*_BEAM[0],
            f"E = {found.young / 1e3:.1f} kPa ({c3d.young / 1e3:.1f}), 95 % {low:.0f} to "
            f"{high:.0f} (sensors {100 * found.sensor:.1f} %, mesh {100 * found.mesh:.1f} %); drop "
            f"{1e3 * found.simulated_drop:.2f} of {1e3 * found.measured_drop:.2f} mm "
            f"({100 * drop_off:+.2f} %)", bool(abs(drop_off) <= 0.02)),
        Row(*_BEAM[1], others, None)]


def _other_loads_row(setting: Setting) -> list[Row]:
    """Drawn beams, weighed with one load: errors of the predicted drops under others."""
    source = source_digest(("estimation", "mechanics"), __file__, silicone_beam.__file__)
    trials = numbers_of("beam", setting.seeds(6, 1), partial(_simulated_beam, source=source),
                        source, setting.kept / "estimation-beam.jsonl", setting.budget,
                        progress=setting.progress)
    worst = max(trial.values["off"] for trial in trials)
    held = sum(trial.values["held"] for trial in trials)
    return [Row(*_OTHER_LOADS, f"{100 * worst:.1f} % (E's interval holds the truth: {held} of "
                f"{len(trials)})", bool(worst <= 0.05), len(trials))]


def _simulated_beam(seed: int, source: str) -> Numbers:
    """Worst relative error of a drop at other loads, and whether the interval held."""
    young = float(np.exp(np.random.default_rng(seed).uniform(*np.log(_BEAM_YOUNG_PA))))
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        branch, path = silicone_beam.made_branch(folder), folder / "simulated.csv"
        silicone_beam.simulated_recording(path, young, silicone_beam.LOAD_N, seed)
        found = silicone_beam.estimate_beam(branch, path, silicone_beam.LOAD_N, "simulated")
        worst = 0.0
        for load in (0.0, 0.2, 1.0):
            # Markers at their nominal positions: the beam is compared.
            true = silicone_beam.drop(young, load, cells=(16, 5, 5))
            foretold = silicone_beam.predicted_drop(branch, "simulated", load)
            worst = max(worst, abs(foretold / true - 1))
    return Numbers("beam", seed, source, {
        "off": float(worst), "held": bool(found.interval[0] <= young <= found.interval[1])})


PARTS = {
    "exact": Part(_paper_table, 60, (_EXACT, *_TABLE)),
    "noise": Part(noise_rows, 90, NOISE_ROWS, grows=True),
    "scans": Part(scan_rows, 60, SCAN_ROWS, grows=True),
    "beam": Part(_beam_rows, 30, _BEAM),
    "other-loads": Part(_other_loads_row, 20, (_OTHER_LOADS,), grows=True),
    "speed": Part(_speed_rows, 120, _SPEED),
    "depth": Part(_depth_rows, 30, (_DEPTH,), grows=True),
    "force": Part(force_rows, 60, FORCE_ROWS, grows=True),
    "optimiser": Part(_optimiser_rows, 60, (_OPTIMISER,))}
"""The table, in order of importance."""
