"""Reduced model and interactive session against the full model (rows of issue 4's table)."""

import json
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from benchmarks.reduced_motion import ReducedMotion, simulate_reduced
from benchmarks.table import Asked, Row, Setting
from limber.core.progress import Progress
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics import BranchModel, Grasp, young_weights
from limber.mechanics.dynamics.integration import simulate_dynamics
from limber.reduced.model_cache import ReducedCache, model_key, reduce_snapshots
from limber.reduced.reduced_model import ReducedModel, ReducedSettings
from limber.reduced.training import Snapshots, Trainer, TrainingSettings, sample_poses, sample_young
from limber.session.client import InteractiveSession
from limber.session.session_start import load_held, reduced_settings
from limber.session.settings import SessionSettings
from limber.store import Branch

LENGTH = 0.6
YOUNG = 5e7
KNOWN = ReducedSettings(size=62, vibration_count=1, field_count=100)
CHANGED = ReducedSettings(size=66, vibration_count=0, field_count=110)
CLAMPED = ReducedSettings(size=90, vibration_count=0, field_count=140)
SESSION = {"mode": "point", "gravity": False, "grasps": 2, "size": 62, "fields": 100}


@dataclass(frozen=True)
class Branching:
    """The bench's branch, as in the notes' prototypes: 0.6 m, 6 to 2 mm, curved, one fork."""

    model: BranchModel
    weights: np.ndarray
    young: np.ndarray
    points: np.ndarray
    grasp_point: np.ndarray

    def grasp(self, mode: str) -> Grasp:
        radius = 0.006 if mode == "rigid" else 0.0
        return Grasp.at(self.model.mesh, self.grasp_point, radius, mode)


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


_ASKED_PINNED = "0.05 % of length / 0.5 %; 0.1 % / 2 %"
PINNED_ROWS = (
    Asked("reduced model, held-out pinned grasps, known E: position, energy (median / max)",
          _ASKED_PINNED),
    Asked("reduced model after E changed by up to a factor of 3 at each control point",
          "0.3 % of length, 1 % energy"),
    Asked("reduced implicit step (1/60 s), minimum / median", "1 ms at that accuracy"),
    Asked("reduced motion against the full one, brisk half-second pull", "-"),
    Asked("interactive session: rate; delay from move to frame as the client sees it"
          " (median / 95 % / 99 % / max), with a jump half-way, trainer at work",
          "60 Hz, under 20 ms"))
CLAMPED_ROW = Asked("the same, clamped grasps (position and rotation given), known E",
                    _ASKED_PINNED)


def pinned_rows(setting: Setting) -> list[Row]:
    """Measure pinned grasps and a session; the raw numbers go to the folder ``out`` as JSON."""
    quick, progress = setting.quick, setting.progress
    branch = bench_branch()
    bench = GraspBench(branch, "point", setting.seed)
    count, varied = (50, 100) if quick else (120, 160)
    known = bench.train(count, 1.0, None, progress.part(0.0, 0.25))
    held_out = bench.test(10 if quick else 40, False, known, progress.part(0.25, 0.32))
    reduced = bench.reduce(_with_known_young(known), KNOWN)
    exact = measure(reduced, held_out)
    both = known.joined(bench.train(varied, 4.0, known, progress.part(0.35, 0.6)))
    changed_test = bench.test(10 if quick else 30, True, both, progress.part(0.6, 0.66))
    wide = bench.reduce(both, CHANGED)
    changed = measure(wide, changed_test)
    progress(0.7, "stepping in time")
    motion, motion_error = moving(bench, reduced, held_out.poses[0], held_out.energy[0])
    wide_motion = brisk(wide, held_out.poses[0])
    progress(0.75, "running a session")
    session = run_session(bench, reduced, _with_known_young(known), 4.0 if quick else 15.0)
    found = [
        Row(*PINNED_ROWS[0], exact.text(), exact.is_small, len(exact.position)),
        Row(*PINNED_ROWS[1], changed.text(),
            bool(np.median(changed.position) <= 0.3 and np.median(changed.energy) <= 1),
            len(changed.position)),
        Row(*PINNED_ROWS[2],
            f"{_step_text(motion)} ({reduced.size} coordinates, known E); "
            f"{_step_text(wide_motion)} ({wide.size}, E changed)",
            bool(_typical(motion) <= 1.0 and _typical(wide_motion) <= 1.0)),
        Row(*PINNED_ROWS[3], motion_error, None),
        Row(*PINNED_ROWS[4], *session)]
    if setting.out is not None:
        content = {"tets": branch.model.mesh.tet_count, "rows": [vars(row) for row in found]}
        (setting.out / "mechanics_reduced.json").write_text(json.dumps(content, indent=1))
    return found


def clamped_rows(setting: Setting) -> list[Row]:
    """Measure clamped grasps: the position and the rotation are given."""
    bench = GraspBench(bench_branch(), "rigid", setting.seed)
    known = bench.train(setting.at_most(200, 100), 1.0, None, setting.progress.part(0.0, 0.7))
    errors = measure(bench.reduce(_with_known_young(known), CLAMPED), bench.test(
        setting.at_most(30, 10), False, known, setting.progress.part(0.8, 0.95)))
    return [Row(*CLAMPED_ROW, errors.text(), errors.is_small, len(errors.position))]


def _with_known_young(snapshots: Snapshots) -> Snapshots:
    return replace(snapshots, young_tangents=snapshots.young_tangents[:, :0])


class GraspBench:
    """One grasp of the branch, its training and its test grasps."""

    def __init__(self, branch: Branching, mode: str, seed: int):
        self.branch = branch
        self.grasp = branch.grasp(mode)
        self.trainer = Trainer(branch.model, self.grasp, branch.weights, branch.young)
        self._base, self._draws = seed, 0

    def train(self, count: int, spread: float, known: Snapshots | None,
              progress: Progress) -> Snapshots:
        settings = TrainingSettings(grasp_count=count)
        rng = self._generator()
        poses = sample_poses(self.branch.model, self.grasp, count, rng, settings)
        young = np.repeat(self.branch.young[None], count, axis=0)
        if spread > 1:
            young = young * spread ** rng.uniform(-1, 1, young.shape)
        return self.trainer.take(poses, young, known, vibration_every=0 if known else 4,
                                 vibration_count=4, progress=progress)

    def test(self, count: int, change: bool, known: Snapshots, progress: Progress) -> Snapshots:
        rng = self._generator()
        poses = sample_poses(self.branch.model, self.grasp, count, rng, TrainingSettings())
        young = sample_young(self.branch.young, 2 * count, rng, 3.0)[1::2] if change else \
            np.repeat(self.branch.young[None], count, axis=0)
        return self.trainer.take(poses, young, known, progress=progress)

    def _generator(self) -> np.random.Generator:
        """A grasp that no earlier draw had."""
        self._draws += 1
        return np.random.default_rng([self._base, 53, self._draws])

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


def _pull(reduced: ReducedModel, pose: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Times and poses: half a second to a pose, half a second held."""
    times = np.arange(61) / 60
    part = (1 - np.cos(np.pi * np.clip(2 * times, 0, 1))) / 2
    rest = reduced.grasp.rest_pose
    return times, rest + part[:, None] * (pose - rest)


def brisk(reduced: ReducedModel, pose: np.ndarray) -> ReducedMotion:
    """Move the reduced model through the pull several times; return the fastest run."""
    times, poses = _pull(reduced, pose)
    runs = [simulate_reduced(reduced, poses=poses, times=times) for _ in range(5)]
    return min(runs, key=lambda run: np.median(run.step_seconds))


def moving(bench: GraspBench, reduced: ReducedModel, pose: np.ndarray,
           energy: float) -> tuple[ReducedMotion, str]:
    """The same pull by both models."""
    times, poses = _pull(reduced, pose)
    full = simulate_dynamics(bench.branch.model, grasp=bench.grasp, poses=poses, times=times)
    motion = brisk(reduced, pose)
    count = min(len(full.times), len(motion.times))
    off = [100 * np.linalg.norm(reduced.displacement_of(q) - u, axis=1).max() / LENGTH
           for q, u in zip(motion.coordinates[:count], full.displacement[:count], strict=True)]
    strain = 100 * np.abs(motion.strain_energy[:count] - full.strain_energy[:count]).max() / energy
    ratio = full.seconds / max(motion.step_seconds.sum(), 1e-9)
    return motion, (f"position {np.median(off):.2f} / {max(off):.2f} % of length, strain energy"
                    f" {strain:.2f} %, {ratio:.0f} times as fast as the full model")


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


def _typical(motion: ReducedMotion) -> float:
    return 1e3 * float(np.median(motion.step_seconds))


def _step_text(motion: ReducedMotion) -> str:
    return f"{1e3 * motion.step_seconds.min():.2f} / {_typical(motion):.2f} ms"
