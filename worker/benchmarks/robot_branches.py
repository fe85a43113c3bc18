"""The virtual robot with random branches in its gripper: forces, slip, break, streams, loops.

Young's modulus is known here, so that differences come from mesh, grasp, arm and sensor alone; the
closed loop (:mod:`limber.cli.closed_loop`) measures the contribution of an estimate.
"""

import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from benchmarks.machine_stalls import FAILURES, Voided
from benchmarks.robot_cells import cell_file, robot_holding, sideways, standing_at
from benchmarks.table import Asked, Row, Setting, share_met
from benchmarks.trials import column, joined, sound
from limber.cell.cell_file import ApproachEntry
from limber.cli.closed_loop.comparison import GOAL_TOLERANCE_M, Watch, comparison
from limber.cli.closed_loop.loop import OPEN_FACTOR, ClosedLoop
from limber.cli.terminal import table_lines
from limber.core.errors import LimberError
from limber.core.progress import Progress
from limber.estimation.simulated_pull import PullSpec
from limber.geometry.generated import generate_branch
from limber.geometry.tets.tet_mesh import base_nodes
from limber.geometry.tets.tetrahedra import MeshSettings, mesh_branch
from limber.mechanics import solve_static
from limber.mechanics.materials.materials import young_weights
from limber.recordings.time_series import read_stream
from limber.robot.motion.execution import across
from limber.stages.paths.execute import ExecutePlan
from limber.stages.pulls.record import RecordPull
from limber.stages.pulls.virtual_pull import load_truth
from limber.store import Branch
from limber.store.loading import load_grasp_model, load_skeleton

FRACTION = 0.85
# So short that a solution of the virtual branch takes tens of milliseconds: over one that takes
# half a second its force is extrapolated too far, and that error, not the prediction's, is
# measured.
_LENGTH_M = 0.4
_PEAK_N, _TRAVEL_M = 6.0, 0.04
_WITHIN = 0.95
_PACKAGES = ("robot", "mechanics", "stages", "geometry")
_OFF_N = 0.5
"""Self-reported error above which the virtual branch itself was off. Chosen."""

FOLLOWED_ROWS = (
    Asked("force within 5 % of the peak or the interval, least share of a branch's path", "95 %"),
    Asked("following a branch's path: distance from it, worst", "1 mm"),
    Asked("difference of the force, 95 % of a path below, worst branch", "reported"))


def random_branch(folder: Path, seed: int) -> tuple[Branch, tuple[float, ...]]:
    """Return a folder with a generated branch's axes, a coarse mesh with its moduli, and a path;
    and those moduli at the control points [Pa].

    The moduli are scaled so that 6 N across it move the grasp by about 40 mm.
    """
    made = generate_branch(seed, length=_LENGTH_M, fork_count=0)
    branch = Branch.create(folder)
    mesh = mesh_branch(made.skeleton, MeshSettings(mesher="sweep")).mesh
    place = made.skeleton.point_at(FRACTION)
    mesh = mesh.with_data(point_data={
        "fixed": base_nodes(mesh, made.skeleton),
        "grasp": (np.linalg.norm(mesh.nodes - place, axis=1) < 0.012).astype(int)})
    with branch.stage("reconstruct") as stage:
        made.skeleton.write_swc(stage.path("skeleton.swc"))
        _write_mesh(stage.path("mesh.vtu"), mesh, np.full(mesh.tet_count, 1e9))
    truth = load_truth(branch, PullSpec())
    shares = young_weights(mesh, truth.control_points) @ np.asarray(truth.young, float)
    with branch.stage("estimate") as stage:
        _write_mesh(stage.path("mesh.vtu"), mesh, shares)
    model = load_grasp_model(branch, gravity=True)
    push = sideways(branch, FRACTION)
    soft = solve_static(model.model, grasp=model.grasp, grasp_force=1e-3 * push, start=model.rest)
    moved = np.linalg.norm(model.pose(soft.require().displacement)[:3] - model.rest_position)
    factor = _PEAK_N * moved / 1e-3 / _TRAVEL_M
    with branch.stage("estimate") as stage:
        _write_mesh(stage.path("mesh.vtu"), mesh, factor * shares)
    _plan_sideways(branch, push)
    return branch, tuple(map(float, factor * np.asarray(truth.young, float)))


def _write_mesh(path: Path, mesh, young: np.ndarray) -> None:
    count = mesh.tet_count
    mesh.with_data(cell_data={"young": young, "poisson": np.full(count, 0.35),
                              "density": np.full(count, 900.0)}).write(path)


def _plan_sideways(branch: Branch, push: np.ndarray) -> None:
    """Write the path of the branch under an increasing force across it: it stretches nothing."""
    model = load_grasp_model(branch, gravity=True)
    state, rows = model.rest, []
    for number, part in enumerate(np.linspace(0, _PEAK_N, 9)):
        state = solve_static(model.model, grasp=model.grasp, grasp_force=part * push,
                             start=state).require()
        rows.append(np.r_[number, model.pose(state.displacement), 0, part, 0])
    lines = ["s_m,x_m,y_m,z_m,rx_rad,ry_rad,rz_rad,energy_j,force_n,strain",
             *(",".join(f"{x:.9g}" for x in row) for row in rows)]
    with branch.stage("plan:path") as stage:
        stage.path("plans/path.csv").write_text("\n".join(lines) + "\n", encoding="utf-8")


def followed_paths(setting: Setting, voided: Voided, address: str) -> list[Row]:
    """Follow a path with random branches: predicted force, and the arm's path."""
    trials = setting.trials("branches", setting.seeds(10, 1), partial(
        _follow_trial, voided=voided, address=address), *_PACKAGES, catch=FAILURES)
    ended, count = sound(trials), len(trials)
    stopped = count - len(ended)
    if not ended:
        return [Row(*asked, "no run reached its end", False, count) for asked in FOLLOWED_ROWS]
    within, errors, ways = (column(ended, name) for name in ("within", "error", "way"))
    return [
        Row(*FOLLOWED_ROWS[0], f"{100 * within.min():.1f} % (median {100 * np.median(within):.1f});"
            f" {stopped} failed{voided}", bool(within.min() >= _WITHIN) and not stopped, count),
        Row(*FOLLOWED_ROWS[1], f"{1000 * ways.max():.2f} mm", bool(ways.max() < 1e-3), len(ways)),
        Row(*FOLLOWED_ROWS[2], f"{100 * errors.max():.1f} % of the peak", None, len(errors))]


def _follow_trial(seed: int, voided: Voided, address: str) -> dict[str, Any]:
    """One branch's path: accuracy of the predicted force, or why it did not end."""
    result, off = _said(f"seed {seed}", voided, partial(_followed, seed, address))
    within, peak = result["force_within_share"], result["force_error_of_peak"]
    print(f"seed {seed}: within {within:.3f}, 95 % of the path below {100 * peak:.1f} % of "
          f"{result['predicted_peak_force_n']:.1f} N, the virtual branch's extrapolation off by "
          f"{off:.2f} N at most", flush=True)
    return {"within": within, "error": peak, "way": result["path_error_m"]}


def _said(name: str, voided: Voided, run: Callable[[], Any]) -> Any:
    """What ``run`` returns, again where the machine stood still; a failure is printed."""
    try:
        return voided.again(run, name)
    except FAILURES as error:
        print(f"{name}: {error}", flush=True)
        raise


def _followed(seed: int, address: str) -> tuple[dict, float]:
    result, off = _executed(seed, address)
    # A machine that stalls solves the virtual branch too late: its force is then invalid.
    assert result["force_within_share"] >= _WITHIN or off <= _OFF_N, (
        f"within {result['force_within_share']:.3f}, the virtual branch was {off:.2f} N off")
    return result, off


def _executed(seed: int, address: str) -> tuple[dict, float]:
    """Execute the path armed.

    Returns:
        Output of `execute`, and the extrapolation error of the virtual branch's force [N].
    """
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        branch, young = random_branch(folder / "random.branch", seed)
        cell = standing_at(branch, address, fraction=FRACTION, back=ApproachEntry().distance_m,
                           grip_seconds=4.0)
        skeleton = load_skeleton(branch)
        axis = skeleton.point_at(FRACTION) - skeleton.point_at(FRACTION - 0.05)
        executed = partial(
            ExecutePlan, branch_folder=branch.folder, name="path", cell=cell_file(cell, folder),
            hold=0.5, gripper_rotation=tuple(map(float, across(axis)[0])))
        dry = executed().run()
        with robot_holding(branch, cell, folder, seed=seed, young=young) as robot:
            robot.ask("stand", joints=list(map(float, dry["start_joints_rad"])))
            with Watch(robot) as watch:
                result = executed(arm=True, confirm="path", after_stop="hold").run()
        return result, watch.extrapolation_error


# --- a recording for minutes, ended by kill -9 ---------------------------------------------------

_DISTANCE_M = 0.012  # 20 times there and back with pauses take 630 s
_BEGUN_M_S, _APART = 5e-4, 20  # samples over which a speed is taken
_HEADER_BYTES = 1000  # more than the names of its columns
_BEGIN_S = 120.0  # for connecting, the arc and the tare


LEAST_STREAM_S = 150.0
_STREAM_S = 600.0
_AROUND_S = 90.0  # what a measurement takes besides the recording
STREAM_ROWS = (
    Asked("500 Hz recorded for 600 s: samples lost, not ascending; memory of recorder and driver",
          "0; flat"),
    Asked("the same: lost by kill -9, at most", "1 s"))


def recorded_stream(setting: Setting, address: str) -> list[Row]:
    """Record with `limber record`, kill it, and recover the data.

    With less than the required 600 s, it records as long as it may; that can fail, but not pass.
    """
    seconds = 8.0 if setting.quick else min(_STREAM_S, setting.budget.remaining - _AROUND_S)
    seed = setting.seed
    with tempfile.TemporaryDirectory() as place:
        branch, young = random_branch(Path(place, "stream.branch"), seed)
        cell = standing_at(branch, address, fraction=FRACTION)
        path = cell_file(cell, Path(place))
        with robot_holding(branch, cell, Path(place), seed=seed, young=young) as robot:
            process = _started(branch, path)
            try:
                begin, memory, grown, killed = _watched_stream(branch, robot, process, seconds)
            finally:
                # A separate driver process that ends with its pipe.
                process.kill()
                process.wait()
            lost_by_robot = robot.state["lost_seconds"]
        if killed is not None:
            RecordPull(branch_folder=branch.folder, cell=path, name="stream", recover=True).run()
        kept = Branch.open(branch.folder)
        rows = read_stream(kept.path("pulls/stream/robot.csv"))
        ended = kept.manifest.stages["record:stream"].result["ended"]
    times, places = rows.times, rows.values[:, :3]
    steps = np.diff(times)
    lost = int(np.round(steps / 0.002).sum() - len(steps))
    if killed is None:
        return [Row(*STREAM_ROWS[0], f"{lost} of "
                    f"{len(times)}, but stopped after {times[-1]:.0f} s: {ended} (load of the "
                    f"machine {os.getloadavg()[1]:.1f})", False)]
    # Both clocks from when it began to move.
    way = np.linalg.norm(places[_APART:] - places[:-_APART], axis=1)
    first = int(np.argmax(way > _BEGUN_M_S * (times[_APART:] - times[:-_APART])))
    missing = (killed - begin) - float(times[-1] - times[first])
    is_good = lost == 0 and bool(np.all(steps > 0)) and abs(grown) < 0.05 * memory
    return [
        Row(*STREAM_ROWS[0], f"{times[-1]:.0f} s: {lost} of {len(times)}, "
            f"{int(np.sum(steps <= 0))}; {memory / 1e6:.0f} MB {grown / 1e6:+.1f} MB (virtual "
            f"clock stood still for {lost_by_robot:.2f} s)",
            None if is_good and seconds < _STREAM_S else is_good),
        Row(*STREAM_ROWS[1], f"{max(missing, 0.0):.2f} s",
            missing <= 1.0)]


def _started(branch: Branch, path: Path) -> subprocess.Popen:
    way = [str(value) for value in sideways(branch, FRACTION)]
    return subprocess.Popen(
        [sys.executable, "-m", "limber", "record", str(branch.folder), "--cell", str(path),
         "--name", "stream", "--confirm", "stream", "--direction", *way, "--distance",
         str(_DISTANCE_M), "--speed", "0.002", "--cycles", "20", "--pause", "10"],
        stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _watched_stream(branch: Branch, robot, process: subprocess.Popen, seconds: float,
             ) -> tuple[float, int, int, float | None]:
    """Return the clock when it began to move with rows in the file, after the nudge, memory after a
    tenth of the time and its growth since, and the clock of the kill; None if the recording ended
    before.
    """
    end = time.monotonic() + _BEGIN_S

    def has_rows() -> bool:
        folder = branch.growing("pulls/stream")
        return folder is not None and (folder / "robot.csv").stat().st_size > _HEADER_BYTES
    while not has_rows() or np.linalg.norm(robot.state["tool_speed"][:3]) < _BEGUN_M_S:
        if process.poll() is not None or time.monotonic() > end:
            raise RuntimeError("the recording did not begin")
        time.sleep(0.01)
    begin = robot.state["clock"]
    before = grown = 0
    for share in (0.1, 0.9):
        end = time.monotonic() + share * seconds
        while time.monotonic() < end:
            if process.poll() is not None:
                return begin, before, grown, None
            time.sleep(0.5)
        now = _memory(process.pid)
        before, grown = (now, 0) if share == 0.1 else (before, now - before)
    killed = robot.state["clock"]
    os.kill(process.pid, signal.SIGKILL)
    return begin, before, grown, killed


def _memory(pid: int) -> int:
    parent = psutil.Process(pid)
    return sum(each.memory_info().rss for each in (parent, *parent.children(recursive=True)))


# --- the closed loop ----------------------------------------------------------------------------

_LOOP = "closed loop on random branches"
LOOP_ROWS = (
    Asked(f"{_LOOP}: ended, no limit broken", "all"),
    Asked(f"{_LOOP}: true E in its 95 % interval", "88 to 99 %"),
    Asked(f"{_LOOP}: the flower within {1000 * GOAL_TOLERANCE_M:.0f} mm of its goal", "all"),
    Asked(f"{_LOOP}: force within 5 % of the peak or the interval, least share of a path", "95 %"),
    Asked(f"{_LOOP}: an interval of E open beyond a factor of {OPEN_FACTOR:g} that another pull "
          "would be worth for the path", "reported"),
    Asked(f"{_LOOP}: way after a provoked overload at 30 mm/s, worst", "reported"))


def closed_loops(setting: Setting, voided: Voided, address: str) -> list[Row]:
    """Run `limber demo --robot` on as many random branches as there is time for.

    Folders stay in the user's folder, if named.
    """
    trials = setting.trials("loops", setting.seeds(10, 1), partial(
        _loop, address=address, out=setting.out, progress=setting.progress, voided=voided),
                            "cli", "planning", "estimation", *_PACKAGES, catch=LimberError)
    ended, count = sound(trials), len(trials)
    failed = [each.failure for each in trials if each.failure]
    if not ended:
        return [Row(*asked, f"none ended: {failed[0]}", False, count) for asked in LOOP_ROWS]
    covered, within, open_factor = joined(ended, "covered"), column(
        ended, "force_within_share"), column(ended, "open_factor")
    flowers, broken, pulls, off = (column(ended, name) for name in (
        "flower_in_goal", "limit_broken", "pull_count", "flower_off_m"))
    ways = column(ended, "overload_way_m")
    ways, share, opened = ways[np.isfinite(ways)], covered.mean(), open_factor > OPEN_FACTOR
    worthless = sum("keeps its limits" in each["no_further_pull"] for each, is_open in zip(
        ended, opened, strict=True) if is_open)
    return [
        Row(*LOOP_ROWS[0], f"{len(ended)} of {count} ended, {broken.sum():.0f} broke one{voided}",
            not failed and not broken.any(), count),
        Row(*LOOP_ROWS[1], f"{covered.sum():.0f} of {len(covered)} ({100 * share:.0f} %)",
            share_met(float(share), len(covered), 0.88, 0.99), len(ended)),
        Row(*LOOP_ROWS[2], f"{flowers.sum():.0f} of {count}; farthest {1000 * off.max():.1f} mm",
            bool(flowers.all()) and not failed, count),
        Row(*LOOP_ROWS[3], f"{100 * within.min():.1f} % (median {100 * np.median(within):.1f})",
            bool(within.min() >= 0.95) and not failed, count),
        Row(*LOOP_ROWS[4], f"{opened.sum()} open after {pulls.sum():.0f} pulls: {worthless} of no "
            "worth for it", None, len(ended)),
        Row(*LOOP_ROWS[5], f"{1000 * ways.max():.1f} mm" if len(ways) else "none came to one",
            None, len(ways))]


def _loop(seed: int, address: str, out: Path | None, progress: Progress, voided: Voided,
          ) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place, "loop") if out is None else out / f"loop-{seed}"

        def run() -> dict[str, Any]:
            # Files of a run that was stopped in the middle.
            shutil.rmtree(folder, ignore_errors=True)
            return ClosedLoop(folder, seed, address, progress=progress).run()
        result = _said(f"closed loop, seed {seed}", voided, run)
    print(f"closed loop, seed {seed}: {result['part_seconds']}")
    for title, rows in comparison(result):
        print("\n".join([title, *(f"  {line}" for line in table_lines(rows))]), flush=True)
    return result
