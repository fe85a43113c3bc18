"""Reduced model and interactive session against the full model."""

import itertools
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path

import numpy as np
import scipy

from benchmarks.table import Asked, Row, Setting
from benchmarks.trials import joined, source_digest
from limber.core.errors import InputError
from limber.core.progress import SILENT, Progress
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics import BranchModel, Grasp, young_weights
from limber.mechanics.dynamics.drive import unwrapped
from limber.mechanics.dynamics.integration import NewmarkSettings
from limber.reduced.model_cache import ReducedCache, model_key, reduce_snapshots
from limber.reduced.reduced_model import (
    ReducedModel,
    ReducedMotionState,
    ReducedSettings,
    ReducedState,
    ReducedStepper,
)
from limber.reduced.refresh import estimate_error
from limber.reduced.training import Snapshots, Trainer, TrainingSettings, sample_poses
from limber.session.client import InteractiveSession
from limber.session.protocol import SessionSettings
from limber.session.session_branch import load_held, reduced_settings
from limber.store import Branch

LENGTH = 0.6
YOUNG = 5e7
KNOWN = ReducedSettings(size=62, vibration_count=1, field_count=100)
CHANGED = ReducedSettings(size=66, vibration_count=0, field_count=110)
SESSION = {"mode": "point", "gravity": False, "grasps": 2, "size": 62, "fields": 100}


@dataclass(frozen=True)
class Branching:
    """The bench's branch, as in the notes' prototypes: 0.6 m, 6 to 2 mm, curved, one fork."""

    model: BranchModel
    weights: np.ndarray
    young: np.ndarray
    points: np.ndarray
    grasp_point: np.ndarray

    @property
    def grasp(self) -> Grasp:
        return Grasp.at(self.model.mesh, self.grasp_point, 0.0, "point")


@dataclass(frozen=True)
class Errors:
    """Against full solutions, in percent: of the length, of the energy, of the force."""

    position: np.ndarray
    energy: np.ndarray
    force: np.ndarray
    untrusted: int
    milliseconds: float

    @property
    def is_small(self) -> bool:
        """Whether position and energy are as accurate as required where E is known."""
        return bool(np.median(self.position) <= 0.05 and self.position.max() <= 0.5
                    and np.median(self.energy) <= 0.1 and self.energy.max() <= 2)

    def text(self) -> str:
        parts = [f"{name} {np.median(values):.3f} / {values.max():.2f} %" for name, values in
                 (("position", self.position), ("energy", self.energy), ("force", self.force))]
        return (f"{', '.join(parts)} ({len(self.position)} grasps, {self.untrusted} flagged,"
                f" {self.milliseconds:.1f} ms a solve)")


def bench_branch(spacing: float = 2.0) -> Branching:
    """Return the branch, meshed by the sweep (the same each time)."""
    from limber.geometry.tets.tree_sweep import sweep_tree

    share = np.linspace(0, 1, 121)
    turn = 0.5 * share
    axis = np.cumsum(np.stack([np.sin(turn), 0.15 * np.sin(2 * turn), np.cos(turn)], 1), axis=0)
    axis = (axis - axis[0]) * LENGTH / np.linalg.norm(np.diff(axis, axis=0), axis=1).sum()
    along = np.linspace(0, 1, 40)[1:, None]
    twig = axis[55] + along * 0.2 * np.array([-0.5, 0.55, 0.67]) + along**2 * [0, 0, 0.03]
    skeleton = Skeleton.from_edges(
        np.vstack([axis, twig]), np.concatenate([np.arange(121) - 1, [55], 121 + np.arange(38)]),
        np.concatenate([0.006 - 0.004 * share, np.linspace(0.0028, 0.0018, 39)]))
    mesh = sweep_tree(skeleton, spacing=spacing).mesh.quadratic()
    lowest = mesh.nodes @ (axis[1] - axis[0]) < 1e-5
    mesh = mesh.with_data(point_data={"fixed": lowest.astype(np.int64)})
    points = np.array([skeleton.point_at(fraction) for fraction in (0.2, 0.4, 0.6, 0.8)])
    weights, young = young_weights(mesh, points), np.full(4, YOUNG)
    model = BranchModel(mesh, young=weights @ young, poisson=0.35, density=900.0, gravity=None)
    return Branching(model, weights, young, points, skeleton.point_at(2 / 3))


PINNED_ROWS = (
    Asked("reduced model, held-out pinned grasps, known E: position, energy (median / max)",
          "0.05 % of length / 0.5 %; 0.1 % / 2 %"),
    Asked("reduced implicit step (1/60 s), minimum / median", "1 ms at that accuracy"),
    Asked("interactive session: rate; delay from move to frame as the client sees it"
          " (median / 95 % / 99 % / max), with a jump half-way, trainer at work",
          "60 Hz, under 20 ms"))
FLAGGED_ROWS = (
    Asked("reduced model after E changed by up to 3: worst error among the unflagged",
          "0.5 % of the length, 1 % energy"),
    Asked("bad states flagged / good ones flagged", "95 % / under 10 %"))
_KNOWN, _VARIED, _PIECE = 120, 160, 20  # training grasps with the known moduli, with others; each
_SPREAD, _CHANGE = 4.0, 3.0  # largest factor of the moduli in training, and in the test
_HALVINGS = 6
_NEWMARK = NewmarkSettings()
_TESTED, _TESTS = 300, 10  # test grasps, and those of one trial


def pinned_rows(setting: Setting) -> list[Row]:
    """Measure pinned grasps with known moduli, steps in time, and a session."""
    progress, bench = setting.progress, GraspBench(bench_branch())
    known = bench.take(setting.at_most(120, 50), 1.0, setting.generator(53, 1), None,
                       progress.part(0.0, 0.5))
    known = replace(known, young_tangents=known.young_tangents[:, :0])
    held_out = bench.take(setting.at_most(40, 10), 1.0, setting.generator(53, 2), known,
                          progress.part(0.5, 0.7))
    reduced = bench.reduce(known, KNOWN)
    exact = measure(reduced, held_out)
    progress(0.7, "stepping in time")
    steps = 1e3 * brisk(reduced, held_out.poses[0]).step_seconds
    progress(0.75, "running a session")
    return [
        Row(*PINNED_ROWS[0], exact.text(), exact.is_small, len(exact.position)),
        Row(*PINNED_ROWS[1], f"{steps.min():.2f} / {np.median(steps):.2f} ms ({reduced.size} "
            "coordinates)", bool(np.median(steps) <= 1.0)),
        Row(*PINNED_ROWS[2], *run_session(bench, reduced, known, 4.0 if setting.quick else 15.0))]


class GraspBench:
    """One grasp of the branch, its training and its test grasps."""

    def __init__(self, branch: Branching):
        self.branch, self.grasp = branch, branch.grasp
        self.trainer = Trainer(branch.model, self.grasp, branch.weights, branch.young)

    def take(self, count: int, spread: float, rng: np.random.Generator, known: Snapshots | None,
             progress: Progress = SILENT) -> Snapshots:
        """Solve drawn grasps; moduli change by factors up to ``spread``."""
        poses = sample_poses(self.branch.model, self.grasp, count, rng, TrainingSettings())
        young = self.branch.young * spread**rng.uniform(-1, 1, (count, len(self.branch.young)))
        return self.trainer.take(poses, young, known, vibration_every=0 if known else 4,
                                 vibration_count=4, progress=progress)

    def reduce(self, snapshots: Snapshots, settings: ReducedSettings) -> ReducedModel:
        branch = self.branch
        return reduce_snapshots(branch.model, self.grasp, branch.weights, branch.young, snapshots,
                                settings)


def measure(reduced: ReducedModel, truth: Snapshots) -> Errors:
    """Compare static reduced solutions with full ones."""
    position, energy, force, untrusted, seconds = [], [], [], 0, []
    for pose, young, u, true_energy, true_force in zip(
            truth.poses, truth.young, truth.displacement, truth.energy, truth.force, strict=True):
        model = reduced.with_young(young)
        state = model.solve_static(pose)
        off = np.linalg.norm(model.displacement(state) - u, axis=1).max()
        position.append(100 * off / LENGTH)
        energy.append(100 * abs(state.strain_energy / true_energy - 1))
        force.append(100 * np.linalg.norm(state.reaction_force - true_force)
                     / np.linalg.norm(true_force))
        untrusted += not state.trusted
        seconds.append(state.seconds)
    return Errors(np.array(position), np.array(energy), np.array(force), untrusted,
                  1e3 * float(np.median(seconds)))


@dataclass(frozen=True)
class ReducedMotion:
    """A motion of the reduced model.

    Attributes:
        converged: Whether all frames were reached.
        times: [s], shape [frames].
        coordinates: Shape [frames, size]; displacements by ``ReducedModel.displacement_of``.
        strain_energy, kinetic_energy: [J], shape [frames].
        reaction_force, reaction_torque: Force and torque of the gripper on the branch [N, Nm],
        shape [frames, 3].
        step_seconds: Wall time of each step [s].
        iteration_count: Total Newton iterations.
    """

    converged: bool
    times: np.ndarray
    coordinates: np.ndarray
    strain_energy: np.ndarray
    kinetic_energy: np.ndarray
    reaction_force: np.ndarray
    reaction_torque: np.ndarray
    step_seconds: np.ndarray
    iteration_count: int
    last: ReducedMotionState
    message: str = ""
    warnings: list[str] = field(default_factory=list)


def simulate_reduced(model: ReducedModel, *, poses: np.ndarray, times: np.ndarray,
                     start: ReducedState | ReducedMotionState | None = None,
                     nodal_forces: np.ndarray | None = None,
                     settings: NewmarkSettings = _NEWMARK,
                     progress: Progress = SILENT) -> ReducedMotion:
    """Move the grasp through poses in time; never raises for lack of convergence.

    Args:
        poses: [m, rad], shape [frames, 6]; a cubic spline between, at rest at the start.
        times: [s], ascending, shape [frames].
        start: By default the equilibrium at the first pose.
    """
    times, poses = np.asarray(times, float), np.asarray(poses, float)
    if times.ndim != 1 or len(times) < 2 or not (np.diff(times) > 0).all():
        raise InputError("Times do not ascend.", "Each frame needs a later time.", "Sort them.")
    path = scipy.interpolate.CubicSpline(times, unwrapped(poses[:, None])[:, 0], axis=0,
                                         bc_type=((1, np.zeros(6)), (2, np.zeros(6))))
    begin = start or model.solve_static(poses[0], nodal_forces=nodal_forces)
    stepper = ReducedStepper(model, begin, nodal_forces=nodal_forces, settings=settings)
    stepper.state.time = float(times[0])
    if not isinstance(begin, ReducedMotionState):
        _begin(stepper, _held_at(model, path, float(times[0]))[2])
    rows, message = [_row(stepper, poses[0])], ""
    seconds: list[float] = []
    for number in range(1, len(times)):
        progress(number / len(times), "moving the reduced model", time=float(times[number]))
        pieces = max(1, int(np.ceil((times[number] - times[number - 1]) / settings.max_step
                                    - 1e-9)))
        reached = all(_spline_step(stepper, path, a, b, seconds)
                      for a, b in _pairs(times[number - 1], times[number], pieces))
        if not reached:
            message = f"the step to {times[number]:.4g} s did not converge"
            break
        rows.append(_row(stepper, path(times[number])))
    coordinates, strain, kinetic, force, torque = map(np.array, zip(*rows, strict=True))
    return ReducedMotion(not message, times[:len(rows)], coordinates, strain, kinetic, force,
                         torque, np.array(seconds), stepper.iteration_count, stepper.state, message)


def _begin(stepper: ReducedStepper, held_acceleration: np.ndarray) -> None:
    """Set the acceleration that a state at rest starts with when the grasp starts to move.

    Without it the first step would cost the motion its second order.
    """
    mass, count = stepper.model.mass, len(held_acceleration)
    _, force = stepper.model.energy_force(stepper.state.coordinates)
    right = (stepper.load - force)[count:] - mass[count:, :count] @ held_acceleration
    stepper.state.acceleration[:count] = held_acceleration
    stepper.state.acceleration[count:] = np.linalg.solve(mass[count:, count:], right)


def _pairs(first: float, second: float, pieces: int) -> list[tuple[float, float]]:
    cuts = np.linspace(first, second, pieces + 1)
    return list(itertools.pairwise(cuts))


def _spline_step(stepper: ReducedStepper, path: "scipy.interpolate.CubicSpline", first: float,
                 second: float, seconds: list[float], depth: int = 0) -> bool:
    began = time.perf_counter()
    held = _held_at(stepper.model, path, second)
    if stepper.step(*held, second - first):
        seconds.append(time.perf_counter() - began)
        return True
    middle = (first + second) / 2
    return depth < _HALVINGS and all(
        _spline_step(stepper, path, a, b, seconds, depth + 1)
        for a, b in ((first, middle), (middle, second)))


def _held_at(model: ReducedModel, path: "scipy.interpolate.CubicSpline", instant: float,
             ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Grasp coordinates, velocity and acceleration on a path, by central differences."""
    small = 2e-5
    before, now, after = (model.held.at(path(instant + shift)) for shift in (-small, 0.0, small))
    return now, (after - before) / (2 * small), (before - 2 * now + after) / small**2


def _row(stepper: ReducedStepper, pose: np.ndarray) -> tuple:
    force, torque = stepper.reaction(pose)
    return (stepper.state.coordinates.copy(), stepper.strain_energy, stepper.kinetic_energy,
            force, torque)


def brisk(reduced: ReducedModel, pose: np.ndarray) -> ReducedMotion:
    """Pull the reduced model to a pose in half a second, several times; return the fastest run."""
    times = np.arange(61) / 60
    part = (1 - np.cos(np.pi * np.clip(2 * times, 0, 1))) / 2
    rest = reduced.grasp.rest_pose
    runs = [simulate_reduced(reduced, poses=rest + part[:, None] * (pose - rest), times=times)
            for _ in range(5)]
    return min(runs, key=lambda run: np.median(run.step_seconds))


def run_session(bench: GraspBench, reduced: ReducedModel, snapshots: Snapshots,
                seconds: float) -> tuple[str, bool]:
    """Send poses at 60 Hz along a smooth path with one jump, and record the frames.

    Meanwhile the trainer compares with the full model, about once a second.
    """
    with tempfile.TemporaryDirectory(prefix="limber-bench-") as folder:
        path = write_branch(Path(folder) / "bench.branch", bench)
        _put_in_cache(path, Path(folder), reduced, snapshots)
        with InteractiveSession(path, **SESSION, cache_folder=Path(folder)) as session:
            if session.wait_for("model", 120) is None:
                return f"no model: {session.events[-3:]}", False
            goals = snapshots.poses[np.linspace(0, len(snapshots) - 1, 12).astype(int)]
            texts, good = [], True
            for name, dynamics in (("equilibria", False), ("motion in time", True)):
                session.set_dynamics(dynamics)
                delays, frames, lost = _follow(session, goals, seconds)
                delay = 1e3 * np.array(delays)
                slow = np.percentile(delay, [50, 95, 99, 100])
                texts.append(f"{name} {frames / seconds:.1f} Hz; "
                             + " / ".join(f"{value:.1f}" for value in slow)
                             + f" ms, {lost} of {round(60 * seconds)} moves overtaken")
                good = good and bool(frames / seconds >= 59 and slow[1] < 20)
    return "; ".join(texts), good


def write_branch(path: Path, bench: GraspBench) -> Path:
    """Write the bench's branch as a branch folder."""
    mesh: TetMesh = bench.branch.model.mesh
    full = np.ones(mesh.tet_count)
    held = np.zeros(mesh.node_count, np.int64)
    held[bench.grasp.nodes] = 1
    marks = np.full(mesh.node_count, -1, np.int64)
    for number, point in enumerate(bench.branch.points):
        marks[np.linalg.norm(mesh.nodes - point, axis=1).argmin()] = number
    mesh = mesh.with_data(
        cell_data={"young": YOUNG * full, "poisson": 0.35 * full, "density": 900.0 * full},
        point_data={"grasp": held, "control_point": marks})
    branch = Branch.create(path)
    with branch.stage("mesh") as stage:
        mesh.write(stage.path("mesh.vtu"))
    return path


def _put_in_cache(path: Path, cache: Path, reduced: ReducedModel, snapshots: Snapshots) -> None:
    """Let the session find the existing model instead of making one."""
    settings = SessionSettings(**SESSION)
    held = load_held(path, settings)
    grasp = held.loaded.marked_grasp("point")
    key = model_key(held.model, grasp, held.weights, held.young, reduced_settings(settings))
    ReducedCache(cache).store(key, reduced, snapshots)


def _follow(session: InteractiveSession, goals: np.ndarray, seconds: float,
            ) -> tuple[list[float], int, int]:
    """Delays of the received frames, number of frames, number of moves without their own frame."""
    path = _two_ways(goals, seconds)
    session.wait(session.move(path(0.0)), 30)
    sent: dict[int, float] = {}
    delays: list[float] = []
    seen = session.latest().move_id
    begin = time.perf_counter()
    for number in range(round(60 * seconds)):
        due = begin + number / 60
        seen = _watch(session, due, sent, seen, delays)
        sent[session.move(path(number / 60))] = time.perf_counter()
    _watch(session, time.perf_counter() + 0.1, sent, seen, delays)
    return delays, len(delays), len(sent) - len(delays)


def _two_ways(goals: np.ndarray, seconds: float) -> Callable[[float], np.ndarray]:
    """Return a pose over time: a smooth path along goals, and half-way a jump to other goals."""
    from scipy.interpolate import CubicSpline

    middle, half = len(goals) // 2, seconds / 2
    ways = [CubicSpline(np.linspace(0, half, len(part)), part, axis=0)
            for part in (goals[:middle], goals[:middle - 1:-1])]
    return lambda instant: ways[int(instant >= half)](instant % half)


def _watch(session: InteractiveSession, until: float, sent: dict[int, float], seen: int,
           delays: list[float]) -> int:
    while time.perf_counter() < until:
        frame = session.latest()
        if frame is not None and frame.move_id != seen:
            seen = frame.move_id
            if seen in sent:
                delays.append(time.perf_counter() - sent[seen])
        time.sleep(0.0005)
    return seen


def flagged_rows(setting: Setting) -> list[Row]:
    """Whether a reduced model flags its bad states after E changed by up to 3."""
    bench = GraspBench(bench_branch())
    known = trained(bench, setting)
    if known is None:
        return [Row(*asked, "the training goes on with the same --seed and --out", None, 0)
                for asked in FLAGGED_ROWS]
    setting.progress(0.5, "building the reduced model")
    trials = setting.trials(
        "reduced", setting.seeds(_TESTED // _TESTS, 3), partial(
            _tested, bench=bench, model=bench.reduce(known, CHANGED), known=known),
        "mechanics", "reduced")
    off, energy, flagged, milliseconds = (joined(trials, name) for name in (
        "off", "energy", "flagged", "milliseconds"))
    # A state without bound is bad too.
    off, energy, flagged = np.nan_to_num(off, nan=1e9), np.nan_to_num(energy, nan=1e9), flagged > 0
    bad = (off > 0.5) | (energy > 1)
    worst, worst_energy = off[~flagged].max(initial=0), energy[~flagged].max(initial=0)
    caught = 100 * flagged[bad].mean() if bad.any() else np.nan
    false = 100 * flagged[~bad].mean() if (~bad).any() else np.nan
    return [
        Row(*FLAGGED_ROWS[0],
            f"{worst:.2f} %, {worst_energy:.2f} % (among all {off.max():.1f}, {energy.max():.1f} "
            f"%; {np.median(milliseconds):.0f} ms a checked grasp)",
            bool(worst <= 0.5 and worst_energy <= 1), len(off)),
        Row(*FLAGGED_ROWS[1],
            f"{caught:.0f} % of {bad.sum()} / {false:.1f} % of {(~bad).sum()}",
            bool(caught >= 95 and false < 10) if bad.any() else None, len(off))]


def trained(bench: GraspBench, setting: Setting) -> Snapshots | None:
    """All training grasps, in pieces of some ten seconds that are kept; None: no time for all."""
    counts = [setting.at_most(_KNOWN, 60), setting.at_most(_VARIED, 100)]
    spreads = [spread for count, spread in zip(counts, (1.0, _SPREAD), strict=True)
               for _ in range(count // _PIECE)]
    source = source_digest(("mechanics", "reduced"))
    found: Snapshots | None = None
    done = 0
    for number in setting.budget.items(range(len(spreads))):
        setting.progress(0.5 * number / len(spreads), "training")
        path = setting.kept / f"reduced-{source}-{setting.seed}-{number}.npz"
        if path.is_file():
            with np.load(path) as held:
                piece = Snapshots.from_arrays(dict(held))
        else:
            piece = bench.take(_PIECE, spreads[number], setting.generator(12, number), found)
            part = path.with_suffix(".part.npz")
            np.savez(part, **piece.arrays())
            part.replace(path)
        found, done = piece if found is None else found.joined(piece), number + 1
    return found if done == len(spreads) else None


def _tested(seed: int, bench: GraspBench, model: ReducedModel, known: Snapshots,
            ) -> dict[str, list]:
    """Some grasps by the full model and by the reduced one, which is checked: errors [%]."""
    truth = bench.take(_TESTS, _CHANGE, np.random.default_rng([seed, 13]), known)
    branch = bench.branch
    found: dict[str, list] = {"off": [], "energy": [], "flagged": [], "milliseconds": []}
    for pose, young, exact, exact_energy in zip(
            truth.poses, truth.young, truth.displacement, truth.energy, strict=True):
        mixed = model.with_young(young)
        began = time.process_time()
        state = mixed.solve_static(pose)
        checked = estimate_error(branch.model, branch.weights, mixed, state)
        found["milliseconds"].append(1e3 * (time.process_time() - began))
        away = np.linalg.norm(mixed.displacement(state) - exact, axis=1).max()
        found["off"].append(100 * away / LENGTH)
        found["energy"].append(100 * abs(state.strain_energy / exact_energy - 1))
        found["flagged"].append(not (state.converged and checked.is_small))
    return found
