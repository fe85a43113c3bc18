"""Measures of estimation: what was asked, what comes out.

The truth is always simulated on another, finer mesh than the fit, with noise of another seed.
"""

import tempfile
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from benchmarks import silicone_beam
from benchmarks.estimation_force import force_rows
from benchmarks.estimation_noise import noise_rows
from benchmarks.estimation_scans import scan_rows
from benchmarks.paper_branches import (
    BRANCHES,
    FRACTIONS,
    Bench,
    PaperBranch,
    exact_pull,
    measured,
)
from benchmarks.table import Row
from limber.estimation.fit import Estimate
from limber.estimation.online.exact import Beside
from limber.estimation.online.filter import OnlineFrame
from limber.estimation.online.follow import begin
from limber.estimation.optimise import gauss_newton, nelder_mead
from limber.estimation.parameters import Values
from limber.estimation.settings import EstimateSettings
from limber.estimation.start import scaled_start
from limber.estimation.subject import Subject
from limber.estimation.virtual_pull import (
    VirtualPullSettings,
    simulate_pull,
    write_depth_frames,
)
from limber.jobs import run_tasks
from limber.progress import SILENT, Progress
from limber.recordings.alignment import frames_of
from limber.recordings.recording import Pull

SETTINGS = EstimateSettings(hold_out=False)


def rows(quick: bool, progress: Progress, out: Path | None) -> list[Row]:
    """Measure everything; about 30 minutes on two quiet cores, 7 with ``quick``.

    With ``out`` each fit is kept in ``estimation-noise.jsonl`` and ``estimation-scans.jsonl``: a
    run that was stopped goes on there.
    """
    progress(0.01, "the paper's branches")
    table = _paper_table()
    kept = out / "estimation-noise.jsonl" if out else None
    table += noise_rows(3 if quick else 20, progress.part(0.05, 0.45), kept)
    kept = out / "estimation-scans.jsonl" if out else None
    table += scan_rows(2 if quick else 10, progress.part(0.45, 0.6), kept)
    progress(0.58, "driven by force")
    table += force_rows(2 if quick else 10)
    progress(0.6, "depth frames")
    table += _depth_rows(quick)
    progress(0.7, "Nelder-Mead against Gauss-Newton")
    table += _optimiser_rows()
    progress(0.85, "full and reduced model, online")
    table += _speed_rows()
    progress(0.95, "silicone beam")
    return table + _beam_rows()


def _exact(branch: PaperBranch) -> tuple[np.ndarray, float, int]:
    """Errors of the moduli, Poisson's ratio and count of simulations, from data without noise."""
    bench = Bench(branch)
    found = bench.fit([measured(exact_pull(branch, 0), 0, points=0.0, force=0.0)],
                      EstimateSettings(hold_out=False, fit_poisson=True, key_frames=20))
    return bench.errors(found), found.values.poisson, found.objective.forward_count


def _paper_table() -> list[Row]:
    found = run_tasks(_exact, [(branch,) for branch in BRANCHES])
    table = []
    for branch, (errors, poisson, count) in zip(BRANCHES, found, strict=True):
        truth = " ".join(f"{young / 1e7:.3g}" for young in branch.young)
        ours = " ".join(f"{young / 1e7 * (1 + error):.3g}"
                        for young, error in zip(branch.young, errors, strict=True))
        table.append(Row(f"paper's table, {branch.name}: E1..E4 [1e7 Pa], nu",
                         f"{truth}, {branch.poisson}",
                         f"{ours}, {poisson:.3f} ({count} simulations)", None))
    worst = [float(np.abs(errors).max()) for errors, _, _ in found]
    each = ", ".join(f"{branch.name} {100 * error:.2f} %"
                     for branch, error in zip(BRANCHES, worst, strict=True))
    table.append(Row("three branches, one pull, exact data: worst E error", "1 %", each,
                     bool(max(worst) <= 0.01)))
    return table


def _depth_rows(quick: bool) -> list[Row]:
    from limber.perception.observe import observe

    worst, sizes, squares, covered = [], [], [], []
    branches = BRANCHES[1:2] if quick else BRANCHES
    for branch in branches:
        truth = branch.truth()
        settings = VirtualPullSettings(
            young=branch.young, poisson=branch.poisson, frames=40, reach=0.4, phase=0.3,
            camera=True, seed=11)
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
        worst.append(float(np.abs(bench.errors(found)).max()))
        low, high = found.uncertainty.young_interval.T
        covered += ((low <= branch.young) & (high >= branch.young)).tolist()
    each = ", ".join(f"{branch.name} {100 * error:.1f} %"
                     for branch, error in zip(branches, worst, strict=True))
    return [Row("depth frames of a simulated D455 at 1 m, one side: worst E error", "10 %",
                f"{each} (points found to {1e3 * np.median(sizes):.2f} mm, "
                f"{np.sqrt(np.mean(squares)):.1f} of their stated deviation; "
                f"{sum(covered)} of {len(covered)} intervals hold)", max(worst) <= 0.10)]


def _moved(truth: object, displacements: list) -> list[np.ndarray]:
    from limber.mechanics.points import point_operator

    operator = point_operator(truth.mesh, truth.control_points)
    return [(operator @ displacement.ravel()).reshape(-1, 3) for displacement in displacements]


def _optimiser_rows() -> list[Row]:
    """Both from the same start; how many simulations each needs to Nelder-Mead's final loss."""
    branch = BRANCHES[1]
    bench = Bench(branch)
    pull = measured(exact_pull(branch, 0, frames=40), 7)
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
    return [Row("forward simulations, Nelder-Mead over Gauss-Newton, to the same loss",
                "10 times fewer", f"{theirs.forward_count} / {reached} = {ratio:.0f}{note}",
                bool(ratio >= 10 and not note))]


def _speed_rows() -> list[Row]:
    branch = BRANCHES[1]
    # About 2,500 quadratic tetrahedra.
    bench = Bench(branch, slice_length=0.95, sides=10)
    pull = measured(exact_pull(branch, 0), 5)
    started = time.perf_counter()
    found = bench.fit([pull], SETTINGS)
    full = time.perf_counter() - started
    short, build, away = _reduced(bench, pull, found)
    updates, _, online_error = followed(bench, measured(exact_pull(branch, 1), 6), pull, found)
    return [
        Row(f"one pull of 100 frames, {bench.mesh.tet_count} quadratic tetrahedra, full model",
            "240 s", f"{full:.0f} s ({found.objective.forward_count} simulations)", full <= 240),
        Row("the same on the reduced model, its basis built", "20 s",
            f"{short:.1f} s; {100 * away:.1f} % from the full model's E; with the basis "
            f"{build:.0f} s", short <= 20),
        Row("online update", "33 ms a frame",
            f"median {1e3 * np.median(updates):.0f} ms, 95 % under "
            f"{1e3 * np.percentile(updates, 95):.0f} ms; ends {100 * online_error:.1f} % from the "
            "full fit", bool(np.percentile(updates, 95) <= 0.033))]


def _reduced(bench: Bench, pull: Pull, found: Estimate) -> tuple[float, float, float]:
    """Seconds with the basis built and with building it; how far E is from the full model's."""
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
    """Follow a pull at its own pace, with what a rough fit of an earlier one gave to start with.

    Returns:
        Seconds of each frame; how far E is from the full fit's after the last frame, and settled.
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


def _beam_rows() -> list[Row]:
    asked = "simulated static tip drop within 2 % of the measured"
    if not silicone_beam.RECORDING.is_file():
        return [Row("silicone_beam: E", asked, "the recording is not here", None)]
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        branch = silicone_beam.made_branch(folder)
        c3d = silicone_beam.estimate_beam(branch, silicone_beam.RECORDING_C3D,
                                          silicone_beam.LOAD_N, "c3d")
        found = silicone_beam.estimate_beam(branch, silicone_beam.RECORDING,
                                            silicone_beam.LOAD_N, "csv")
        others = ", ".join(
            f"{load:g} N {1e3 * silicone_beam.predicted_drop(branch, 'csv', load):.2f} mm"
            for load in (0.0, 0.25, 0.75, 1.0))
        off, covered = _simulated_beam(folder, branch)
    drop_off = found.simulated_drop / found.measured_drop - 1
    low, high = (value / 1e3 for value in found.interval)
    return [
        Row("silicone_beam: E from the recording (CSV; C3D in brackets)", asked,
            f"E = {found.young / 1e3:.1f} kPa ({c3d.young / 1e3:.1f}), 95 % {low:.0f} to "
            f"{high:.0f} (sensors {100 * found.sensor:.1f} %, mesh {100 * found.mesh:.1f} %); drop "
            f"{1e3 * found.simulated_drop:.2f} of {1e3 * found.measured_drop:.2f} mm "
            f"({100 * drop_off:+.2f} %)", bool(abs(drop_off) <= 0.02)),
        Row("silicone_beam: drop foretold for other loads", "-", others, None),
        Row("the same with simulated recordings, fitted at 0.51 N: worst error of the drop at 0, "
            "0.2 and 1 N", "5 %", f"{100 * off:.1f} % (E's interval holds the truth: {covered})",
            bool(off <= 0.05))]


def _simulated_beam(folder: Path, branch: Path) -> tuple[float, str]:
    """Worst relative error of a drop at other loads, and how often the interval held, 3 beams."""
    worst, held = 0.0, 0
    for seed, young in enumerate((1.6e5, 2.4e5, 4.0e5)):
        path = folder / f"simulated-{seed}.csv"
        silicone_beam.simulated_recording(path, young, silicone_beam.LOAD_N, seed)
        found = silicone_beam.estimate_beam(branch, path, silicone_beam.LOAD_N, "simulated")
        held += found.interval[0] <= young <= found.interval[1]
        for load in (0.0, 0.2, 1.0):
            # Markers where they should be: what is compared is the beam.
            true = silicone_beam.drop(young, load, cells=(16, 5, 5))
            foretold = silicone_beam.predicted_drop(branch, "simulated", load)
            worst = max(worst, abs(foretold / true - 1))
    return worst, f"{held} of 3"
