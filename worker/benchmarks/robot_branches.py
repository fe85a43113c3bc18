"""The virtual robot with random branches in its gripper: predicted forces, slip, break.

Young's modulus is known here, so that differences come from mesh, grasp, arm and sensor alone; the
closed loop (:mod:`limber.cli.closed_loop`) measures the contribution of an estimate.
"""

import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.machine_stalls import Voided
from benchmarks.robot_cells import cell_file, robot_holding, sideways, standing_at
from benchmarks.table import Asked, Row, Setting
from benchmarks.trial_log import Numbers, numbers_of, source_digest
from limber.core.errors import LimberError, SafetyStop
from limber.estimation.simulated_pull import VirtualPullSettings
from limber.geometry.generated import generate_branch
from limber.geometry.tets.tet_mesh import base_nodes
from limber.geometry.tets.tetrahedra import MeshSettings, mesh_branch
from limber.mechanics import solve_static
from limber.mechanics.materials.materials import young_weights
from limber.robot.cell.cell import ApproachEntry
from limber.robot.motion.execution import across
from limber.robot.virtual.launch import VirtualRobot
from limber.stages.paths.execute import ExecuteOptions, ExecuteSettings, execute
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
    truth = load_truth(branch, VirtualPullSettings())
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
    source = source_digest(_PACKAGES, __file__)
    seeds = range(setting.seed, setting.seed + setting.at_most(10, 1))
    trials = [each.values for each in numbers_of("branches", seeds, partial(
        _follow_trial, source=source, voided=voided, address=address), source,
        setting.kept / "robot.jsonl", setting.budget, progress=setting.progress)]
    ended = [each for each in trials if "stopped" not in each]
    stopped, count = len(trials) - len(ended), len(trials)
    if not ended:
        return [Row(*asked, "no run reached its end", False, count) for asked in FOLLOWED_ROWS]
    within, errors, ways = (np.array([each[name] for each in ended])
                            for name in ("within", "error", "way"))
    return [
        Row(*FOLLOWED_ROWS[0], f"{100 * within.min():.1f} % (median {100 * np.median(within):.1f});"
            f" {stopped} failed{voided}", bool(within.min() >= _WITHIN) and not stopped, count),
        Row(*FOLLOWED_ROWS[1], f"{1000 * ways.max():.2f} mm", bool(ways.max() < 1e-3), len(ways)),
        Row(*FOLLOWED_ROWS[2], f"{100 * errors.max():.1f} % of the peak", None, len(errors))]


def _follow_trial(seed: int, source: str, voided: Voided, address: str) -> Numbers:
    """One branch's path: accuracy of the predicted force, or why it did not end."""
    try:
        result, off = voided.again(partial(_followed, seed, address), f"seed {seed}")
    except (AssertionError, LimberError) as error:
        print(f"seed {seed}: {error}", flush=True)
        return Numbers("branches", seed, source, {"stopped": str(error)})
    within, peak = result["force_within_share"], result["force_error_of_peak"]
    print(f"seed {seed}: within {within:.3f}, 95 % of the path below {100 * peak:.1f} % of "
          f"{result['predicted_peak_force_n']:.1f} N, the virtual branch's extrapolation off by "
          f"{off:.2f} N at most", flush=True)
    return Numbers("branches", seed, source, {"within": float(within), "error": float(peak),
                                              "way": float(result["path_error_m"])})


def _followed(seed: int, address: str) -> tuple[dict, float]:
    result, off = _executed(seed, address)
    # A machine that stalls solves the virtual branch too late: its force is then invalid.
    assert result["force_within_share"] >= _WITHIN or off <= _OFF_N, (
        f"within {result['force_within_share']:.3f}, the virtual branch was {off:.2f} N off")
    return result, off


def _executed(seed: int, address: str,
              fault: Callable[[VirtualRobot], None] | None = None) -> tuple[dict, float]:
    with tempfile.TemporaryDirectory() as place:
        return _executed_in(Path(place), seed, address, fault)


def _executed_in(folder: Path, seed: int, address: str,
                 fault: Callable[[VirtualRobot], None] | None) -> tuple[dict, float]:
    """Execute the path armed; ``fault`` acts on the robot once the force is up.

    Returns:
        Output of `execute`, and the extrapolation error of the virtual branch's force [N].
    """
    branch, young = random_branch(folder / "random.branch", seed)
    cell = standing_at(branch, address, fraction=FRACTION, back=ApproachEntry().distance_m,
                       grip_seconds=4.0)
    skeleton = load_skeleton(branch)
    axis = skeleton.point_at(FRACTION) - skeleton.point_at(FRACTION - 0.05)
    settings = ExecuteSettings(gripper_rotation=tuple(map(float, across(axis)[0])), hold=0.5)
    path = cell_file(cell, folder)
    dry = execute(branch.folder, "path", path, settings, ExecuteOptions())
    with robot_holding(branch, cell, folder, seed=seed, young=young) as robot:
        robot.ask("stand", joints=list(map(float, dry["start_joints_rad"])))
        largest = [0.0]
        ended = threading.Event()
        watcher = threading.Thread(target=_watch, args=(robot, largest, ended, fault))
        watcher.start()
        try:
            result = execute(branch.folder, "path", path, settings,
                             ExecuteOptions(arm=True, confirm="path", after_stop="hold"))
        finally:
            ended.set()
            watcher.join()
    return result, largest[0]


def _watch(robot: VirtualRobot, largest: list[float], ended: threading.Event,
           fault: Callable[[VirtualRobot], None] | None) -> None:
    """Record the virtual branch's error; provoke the fault once the force is up."""
    while not ended.wait(0.2):
        state = robot.state
        largest[0] = max(largest[0], state.get("extrapolation_error_n", 0.0))
        if fault is not None and np.linalg.norm(state.get("true_wrench", [0.0])[:3]) > 4.0:
            fault(robot)
            fault = None


FAULTS_OF_BRANCHES: tuple[tuple[str, Callable[[VirtualRobot], None]], ...] = (
    ("slips", lambda robot: robot.ask("slip", part=0.95) and None),
    ("breaks", lambda robot: robot.ask("break") and None))
LOST_ROW = Asked("branch slips, branch breaks while it is led: stop for the lost force, and a "
                 "report", "every one")


def lost_branches(setting: Setting, voided: Voided, address: str) -> list[Row]:
    """The branch slips in the grip, or breaks, while it is moved: the arm stops and reports it."""
    source, kinds = source_digest(_PACKAGES, __file__), len(FAULTS_OF_BRANCHES)
    tasks = range(kinds * setting.seed, kinds * (setting.seed + setting.at_most(20, 1)))
    trials = numbers_of("lost", tasks, partial(
        _loss_trial, source=source, voided=voided, address=address), source,
        setting.kept / "robot.jsonl", setting.budget, progress=setting.progress)
    failed = [each.values["failed"] for each in trials if each.values["failed"]]
    names = {FAULTS_OF_BRANCHES[each.seed % kinds][0] for each in trials}
    # A fault that was not run is not known to be noticed.
    is_met = False if failed else True if len(names) == kinds else None
    return [Row(*LOST_ROW, f"{len(trials) - len(failed)} of {len(trials)} ("
                f"{', '.join(sorted(names))}){voided}", is_met, len(trials))]


def _loss_trial(task: int, source: str, voided: Voided, address: str) -> Numbers:
    """One fault with one branch; faults take turns."""
    seed, kind = divmod(task, len(FAULTS_OF_BRANCHES))
    name, fault = FAULTS_OF_BRANCHES[kind]
    failed, began = "", time.monotonic()
    try:
        told = voided.again(partial(_stop_for_loss, seed, address, fault), f"{name}, seed {seed}")
    except (AssertionError, LimberError) as error:
        failed = told = f"{name}, seed {seed}: {error}"
    print(f"branch {name}: {time.monotonic() - began:.0f} s in all: {told}", flush=True)
    return Numbers("lost", task, source, {"failed": failed})


def _stop_for_loss(seed: int, address: str, fault: Callable[[VirtualRobot], None]) -> str:
    """Return the report of the stop.

    Raises:
        AssertionError: it did not stop.
        LimberError: the reason is not the lost force, or came before it: the fault did not cause
            the stop.
    """
    done = []

    def noted(robot: VirtualRobot) -> None:
        done.append(seed)
        fault(robot)
    try:
        _executed(seed, address, noted)
    except SafetyStop as stop:
        if not done or "slipped, broke" not in str(stop):
            raise
        return str(stop)
    raise AssertionError("it went on")
