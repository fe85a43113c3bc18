"""Energy of the branch at sampled grasp positions, by the full model.

Some poses follow the shell on which a free grasp moves, and go a little beyond
(:mod:`limber.planning.field.sampling`). The positions of the others come from a Sobol
sequence in the ball about the rest position that the deflection allows, inside that shell, cut by
the paper's hemisphere. They are solved along a nearest-neighbour tree: the next position is the one
nearest to any solved one, and starts from that solution. So every step is short, also where a tour
would have to jump, and the branch stays in the equilibrium that bends out of rest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import scipy
from scipy.spatial import Delaunay

from limber.core.errors import Command, ConvergenceError, Option, WorkError
from limber.core.processes import Pool, core_budget, run_tasks, worker_count
from limber.core.processes.pool import Task
from limber.core.progress import SILENT, Progress
from limber.mechanics import StaticResult
from limber.planning.field.chart import Chart
from limber.planning.field.energy_field import EnergyField, refit
from limber.planning.field.grasp_model import GraspModel, Reach, refusal
from limber.planning.field.stored_states import (
    GraspSamples,
    Solved,
    extrapolated,
    guess_of,
    midpoint_blend,
    samples_of,
    taken,
)
from limber.planning.settings import EnergySettings

# Processes that each hold the branch, for all solves of one field.
#
# A process takes about a second to start, and the branch's equations as long again: both only once.

_held: list[GraspModel] = []  # in a process of the pool


class SolverPool:
    """Solves a branch in parallel; close it, or use it in a ``with``. At most ``workers`` processes
    (None: the core budget; one: none is started)."""

    def __init__(self, grasp_model: GraspModel, workers: int | None = None):
        self.grasp_model = grasp_model
        self._count = worker_count(core_budget(), requested=workers)
        self._pool: Pool | None = None

    def run(self, function: Callable, tasks: Sequence[tuple], *, progress: Progress = SILENT,
            message: str = "") -> list:
        """Return ``[function(grasp_model, *task) for task in tasks]`` by any number of processes;
        it may take ``progress``. WorkError if a process crashed, else the first error of a call."""
        if self._count == 1 or len(tasks) == 1:
            return run_tasks(function, [(self.grasp_model, *task) for task in tasks], workers=1,
                             progress=progress, message=message)
        self._pool = self._pool or Pool(self._count, begin=_hold,
                                        begin_arguments=(self.grasp_model,),
                                        name=message or "the computation")
        return self._pool.map(_with_branch, [(function, task) for task in tasks],
                              progress=progress, message=message)

    def close(self) -> None:
        """End the processes."""
        if self._pool is not None:
            self._pool.close()
            self._pool = None

    def __enter__(self) -> "SolverPool":
        return self

    def __exit__(self, *_error: object) -> None:
        self.close()


def _hold(grasp_model: GraspModel) -> None:
    _held[:] = [grasp_model]


def _with_branch(function: Callable, arguments: tuple, progress: Progress) -> Any:
    return Task(function, (_held[0], *arguments)).run(progress)


# Neighbouring samples that disagree, and the states of the branch between them.
#
# Pushed together below its rest position, a branch buckles to one side or the other, within
# millimetres, and with its grasp at one position it may be in either of two shapes, depending on
# the path there. A field fitted to both gives a mean that the branch never takes. So where the
# shapes of two neighbours differ by more than their slopes explain, the branch is moved half-way
# between them: first where it matters most, by the difference of the shapes and the number of poses
# around the two. If it arrives in one state, that is a further sample. If it arrives in two, or
# would have to snap, no path may lead there: the position counts as refused.

_JUMP = 0.01  # fraction of the branch's length by which predictions of two neighbours differ
_ONE = 0.003  # fraction of it below which shapes are the same
_NEARER = 0.4  # largest fraction of a jump left half-way where the neighbours' state is certain
_LEAST = 0.02  # fraction of it; nearer neighbours are not examined further
_ROUNDS = 4  # each uses what the earlier ones found
_SHARE_PAIRS = 6
"""Pairs of one task; must not depend on the number of processes."""
_CORNERS = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]

Pair = tuple[Solved, Solved]


def sample_between(
    solvers: SolverPool,
    known: Sequence[Solved],
    chart: Chart,
    usual: np.ndarray,
    most: int,
    *,
    progress: Progress = SILENT,
) -> tuple[list[Solved], np.ndarray]:
    """Return samples between neighbours that disagree in a plain chart, and places [t, 3] with two
    shapes. ``usual`` [n, 3] are as dense as queries to the field: errors near many matter more."""
    known, begun, asked = list(known), len(known), 0
    bistable = np.empty((0, 3))
    for number in range(_ROUNDS):
        budget = round(most * (number + 1) / _ROUNDS) - asked
        pairs = disagreeing(known, chart, usual, solvers.grasp_model.reach.arc_length)
        chosen = _apart(pairs, known, bistable, chart)[:budget]
        if not chosen:
            break
        asked += len(chosen)
        # In turn: hard places come first, and are close together.
        count = max(2, -(-len(chosen) // _SHARE_PAIRS))
        shares = [chosen[k::count] for k in range(count)]
        found = solvers.run(_ask, [(share,) for share in shares if share],
                            progress=progress.part(number / _ROUNDS, (number + 1) / _ROUNDS),
                            message="between neighbouring poses")
        known += [one for added, _ in found for one in added]
        bistable = np.concatenate([bistable, *(middles for _, middles in found)])
    return known[begun:], bistable


def disagreeing(known: Sequence[Solved], chart: Chart, usual: np.ndarray, length: float,
                ) -> list[tuple[int, int, np.ndarray]]:
    """Pairs of neighbours that disagree, the most important first, by jump times ``usual`` places
    in the tetrahedra that share them, whose numbers [k] come too."""
    flat = chart.map(np.array([one.pose[:3] for one in known]))
    tetrahedra = Delaunay(flat)
    inside = tetrahedra.find_simplex(chart.map(usual))
    crowd = np.bincount(inside[inside >= 0], minlength=len(tetrahedra.simplices))
    sides = np.sort(tetrahedra.simplices[:, _CORNERS], axis=2)
    edges, number = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
    number = number.reshape(len(sides), 6)
    weight = np.bincount(number.ravel(), np.repeat(crowd, 6), len(edges))
    jumps = _jumps(known, edges)
    distance = np.linalg.norm(flat[edges[:, 0]] - flat[edges[:, 1]], axis=1)
    worth = np.where((jumps > _JUMP * length) & (distance > _LEAST * length), jumps * weight, 0.0)
    return [(int(edges[k, 0]), int(edges[k, 1]), np.flatnonzero((number == k).any(axis=1)))
            for k in np.argsort(-worth, kind="stable")[:int((worth > 0.0).sum())]]


def neighbours(flat: np.ndarray) -> np.ndarray:
    """Return the pairs of ``flat`` places [m, 3] that share an edge of the Delaunay tetrahedra,
    shape [e, 2]."""
    sides = Delaunay(flat).simplices[:, _CORNERS].reshape(-1, 2)
    return np.unique(np.sort(sides, axis=1), axis=0)


def jump(first: Solved, second: Solved) -> float:
    """Return the distance between two neighbours' predictions of tip or target half-way [m]. By the
    slopes of each; if one has none, by the other's alone."""
    return float(_jumps([first, second], np.array([[0, 1]]))[0])


def _jumps(known: Sequence[Solved], edges: np.ndarray) -> np.ndarray:
    """Return the distances for pairs of numbers [e, 2] in ``known``, shape [e]."""
    positions = np.array([one.pose[:3] for one in known])
    shapes = np.array([one.shape[3:] for one in known])
    slopes = np.array([one.shape_slopes[:, 3:] for one in known])
    sure = np.isfinite(slopes).all(axis=(1, 2))
    slopes[~sure] = 0.0
    first, second = edges.T
    count = np.maximum(sure[first].astype(int) + sure[second], 1)
    change = np.einsum("ek,ekc->ec", positions[second] - positions[first],
                       (slopes[first] + slopes[second]) / count[:, None, None])
    off = (shapes[second] - shapes[first] - change).reshape(len(edges), -1, 3)
    return np.linalg.norm(off, axis=2).max(axis=1)


def _apart(pairs: list[tuple[int, int, np.ndarray]], known: Sequence[Solved], bistable: np.ndarray,
           chart: Chart) -> list[tuple[Pair, np.ndarray]]:
    """Return pairs and the places [1, 3] half-way, one pair per tetrahedron; none where a place
    with two shapes is nearer than any known one."""
    flat = chart.map(np.array([one.pose[:3] for one in known]))
    positions = np.array([one.pose[:3] for one in known])
    used: set[int] = set()
    chosen = []
    for first, second, about in pairs:
        if not used.isdisjoint(about.tolist()):
            continue
        middle = chart.curved(flat[[first, second]].mean(axis=0)[None])
        if len(bistable) and _nearest(middle, bistable) < _nearest(middle, positions):
            continue
        used.update(about.tolist())
        chosen.append(((known[first], known[second]), middle))
    return chosen


def _ask(grasp_model: GraspModel, pairs: list[tuple[Pair, np.ndarray]],
         progress: Progress = SILENT) -> tuple[list[Solved], np.ndarray]:
    added, bistable = [], [np.empty((0, 3))]
    for number, ((first, second), middle) in enumerate(pairs):
        progress(number / len(pairs), "between neighbouring poses")
        found = _solved_midpoint(grasp_model, first, second, middle)
        if found is None:
            bistable.append(middle)
        else:
            added.append(found)
    return added, np.concatenate(bistable)


def _solved_midpoint(grasp_model: GraspModel, first: Solved, second: Solved, middle: np.ndarray,
                     ) -> Solved | None:
    """Return the state at ``middle`` [1, 3] that both neighbours reach, None if there is none."""
    found, jumped = None, jump(first, second)
    if (guess := midpoint_blend(grasp_model, first, second, middle[0])) is not None:
        result = grasp_model.follow(middle, first.displacement, guess, snap=False)[0]
        if not refusal(result):
            found = taken(grasp_model, result)
            if max(jump(first, found), jump(found, second)) < _NEARER * jumped:
                return found
    back = grasp_model.follow(middle, second.displacement,
                              extrapolated(grasp_model, second, middle[0]), snap=False)[0]
    if refusal(back):
        return None
    back = taken(grasp_model, back)
    if found is not None and _are_one(found, back, grasp_model):
        return found
    result = grasp_model.follow(middle, first.displacement,
                                extrapolated(grasp_model, first, middle[0]), snap=False)[0]
    if refusal(result) or not _are_one(taken(grasp_model, result), back, grasp_model):
        return None
    return back


def _are_one(first: Solved, second: Solved, grasp_model: GraspModel) -> bool:
    off = np.abs(first.shape[3:] - second.shape[3:]).max()
    return bool(off <= _ONE * grasp_model.reach.arc_length)


def _nearest(position: np.ndarray, others: np.ndarray) -> float:
    return float(np.linalg.norm(others - position, axis=1).min())


# The low-energy surface: the sphere on which a free grasp moves.
#
# A branch yields easily across and hardly along. Under forces across, its grasp stays within a
# tenth of a millimetre on a sphere about a pivot at a fifth to a quarter of its height (the
# pseudo-rigid body of a cantilever: Howell, Compliant Mechanisms, 2001, 5.1; measured on four
# branches, 40 % deflection). Inside it the branch is pushed together and bends; beyond it the
# branch is drawn taut, and the force grows a hundred times as fast. Gentle paths run along the
# shell. So samples follow it, and some are drawn a little beyond: no path is best at the border of
# the sampled region.

_STEP = 1e-4  # [m] displacement that measures the stiffness at rest
_RIM = 1.1  # factor on the force of linear bending at the largest deflection
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
_WORST = 0.02  # rms deviation of the states from the sphere, over the radius
_SHARE_DIRECTIONS = 3
"""Directions of one task; must not depend on the number of processes."""


@dataclass(frozen=True)
class LowEnergySurface:
    """A sphere: ``pivot`` [m] of shape [3] and ``radius`` [m]."""

    pivot: np.ndarray
    radius: float


def walk_energy_surface(solvers: SolverPool, count: int, *, deflection: float, seed: int = 0,
                        progress: Progress = SILENT) -> tuple[LowEnergySurface, list[Solved]]:
    """Return the shell, and states on it and a little beyond: per direction one under a force
    across, one also drawn outward. ``deflection`` is over arc length, ``seed`` turns the
    directions. A branch that is no cantilever gets the sphere about its base."""
    grasp_model = solvers.grasp_model
    reach = grasp_model.reach
    stiffness, axes = _stiffness(grasp_model)
    force = float(np.sqrt(max(stiffness[0] * stiffness[1], 0.0))) * deflection * reach.arc_length
    turn = float(np.random.default_rng([seed, 11]).uniform(0.0, 2.0 * np.pi))
    angles = turn + _GOLDEN * np.arange(count)
    across = _RIM * force * np.sqrt((np.arange(count) + 0.5) / count)[:, None] * (
        np.cos(angles)[:, None] * axes[:, 0] + np.sin(angles)[:, None] * axes[:, 1])
    across = np.concatenate([np.zeros((1, 3)), across])
    # In turn: the farther from rest, the longer it takes.
    shares = max(2, -(-len(across) // _SHARE_DIRECTIONS))
    found = solvers.run(_walk, [(across[k::shares], force) for k in range(shares)],
                        progress=progress, message="finding the low-energy surface")
    pairs = [found[k % shares][k // shares] for k in range(len(across))]
    slack = [pair[0] for pair in pairs[1:] if pair[0] is not None]
    positions = np.array([grasp_model.rest_position, *(state.pose[:3] for state in slack)])
    return _sphere(positions, reach.base, grasp_model.rest_position), [
        *slack, *(pair[1] for pair in pairs if pair[1] is not None)]


def _walk(grasp_model: GraspModel, across: np.ndarray, outward: float,
          progress: Progress = SILENT) -> list[tuple[Solved | None, Solved | None]]:
    """Return the states under each force [n, 3], also drawn ``outward`` [N]."""
    pairs: list[tuple[Solved | None, Solved | None]] = []
    for number, force in enumerate(across):
        progress(number / len(across), "finding the low-energy surface")
        slack = _under(grasp_model, force, grasp_model.rest) if force.any() else grasp_model.rest
        if slack is None:
            pairs.append((None, None))
            continue
        kept = taken(grasp_model, slack)
        drawn = _under(grasp_model, force + outward * _unit(kept.pose[:3] - grasp_model.reach.base),
                       slack)
        pairs.append((kept, None if drawn is None else taken(grasp_model, drawn)))
    return pairs


def _stiffness(grasp_model: GraspModel) -> tuple[np.ndarray, np.ndarray]:
    """Return stiffnesses of the grasp at rest [N/m], ascending, and their axes as columns."""
    moved = [grasp_model.follow((grasp_model.rest_position + _STEP * axis)[None],
                                grasp_model.rest.displacement)[0].require().reaction_force / _STEP
             for axis in np.eye(3)]
    whole = np.array(moved)
    return np.linalg.eigh(0.5 * (whole + whole.T))


def _under(grasp_model: GraspModel, force: np.ndarray, start: StaticResult) -> StaticResult | None:
    """Return the state under a force [3] on the grasp, held there; None if there is none."""
    held = grasp_model.pulled(force, start.displacement)
    return None if refusal(held) else held


def _sphere(positions: np.ndarray, base: np.ndarray, rest: np.ndarray) -> LowEnergySurface:
    arm = rest - base
    chord = float(np.linalg.norm(arm))

    def missed(unknown: np.ndarray) -> np.ndarray:
        return np.linalg.norm(positions - unknown[:3], axis=1) - unknown[3]

    if len(positions) >= 8:
        start = np.r_[base + 0.2 * arm, 0.8 * chord]
        found = scipy.optimize.least_squares(missed, start, x_scale=chord)
        pivot, radius = found.x[:3], float(found.x[3])
        close = np.sqrt(np.mean(found.fun**2)) < _WORST * radius
        if close and 0.2 * chord < radius < 3.0 * chord and (rest - pivot) @ arm > 0.0:
            return LowEnergySurface(pivot, radius)
    return LowEnergySurface(np.asarray(base, float), chord)


def _unit(vector: np.ndarray) -> np.ndarray:
    return vector / np.linalg.norm(vector)


_LAYER = 0.06  # fraction of the surface's radius
_SPREAD = 2 / 3  # fraction of the samples that are evenly spaced; others are placed between
_WALK = 1 / 8  # directions along the surface for each evenly spaced sample
_FEWEST_DIRECTIONS = 8
_USUAL = 2048  # poses that show where the field is evaluated most
_TAUT = 2.0  # times the median force
_SHARE_POSES = 30
"""Poses of one tree. The number of trees must not depend on the processes, nor on their results."""
_SECOND_TRIES = 3  # other solutions tried as start for a pose that was not reached
TWO_SHAPES = "two shapes"
"""One of the reasons for refusing poses: which of two shapes results depends on the path."""


@dataclass(frozen=True)
class Sampled:
    """Results of the branch model, the rest pose first, with all nodes' displacements [node_count,
    3] [m], the shell that they follow, and rejected poses by reason; taut ones were left out."""

    samples: GraspSamples
    displacements: list[np.ndarray]
    energy_surface: LowEnergySurface
    reasons: dict[str, int]
    taut_count: int


def sample_field(grasp_model: GraspModel, settings: EnergySettings, *, workers: int | None = None,
                 progress: Progress = SILENT) -> Sampled:
    """Solve the branch at ``settings.samples`` poses: two thirds of them spread over the allowed
    positions of its grasp, the others between neighbours that disagree
    (:mod:`limber.planning.field.sampling`).

    Raises:
        WorkError: the grasp has hardly any room. ConvergenceError: the branch has no rest state.
    """
    spread = round(settings.samples * _SPREAD)
    directions = max(_FEWEST_DIRECTIONS, round(spread * _WALK))
    with SolverPool(grasp_model, workers) as solvers:
        energy_surface, walked = walk_energy_surface(
            solvers,
            directions,
            deflection=settings.deflection,
            seed=settings.seed,
            progress=progress.part(0.0, 0.2),
        )
        count = max(spread - len(walked), 1)
        usual = sample_positions(
            grasp_model.reach, grasp_model.rest_position, max(_USUAL, count), energy_surface,
            deflection=settings.deflection, seed=settings.seed, fewest=count)
        targets = usual[:count]
        good, bad = solve_branch(solvers, targets, walked, progress=progress.part(0.2, 0.6))
        drawn = max((float(np.linalg.norm(state.force)) for state in walked), default=0.0)
        forces = np.array([np.linalg.norm(one.force) for one in good])
        slack = _slack(forces, forces[1 + len(walked):], drawn)
        good = [one for one, kept in zip(good, slack, strict=True) if kept]
        chart = Chart.about(energy_surface.pivot, energy_surface.radius, grasp_model.rest_position)
        added, bistable = sample_between(solvers, good, chart, usual, settings.samples - spread,
                                         progress=progress.part(0.6, 1.0))
    good += added
    reasons = _counted(bad) | ({TWO_SHAPES: len(bistable)} if len(bistable) else {})
    samples = samples_of(good, np.concatenate([_asked(bad, targets), bistable]))
    return Sampled(samples, [one.displacement for one in good], energy_surface, reasons,
                   int((~slack).sum()))


def sample_positions(
    reach: Reach,
    rest: np.ndarray,
    count: int,
    energy_surface: LowEnergySurface,
    *,
    deflection: float,
    seed: int = 0,
    fewest: int | None = None,
) -> np.ndarray:
    """Return ``count`` allowed positions of the grasp [m], shape [count, 3].

    Fewer if there is little room, but no fewer than ``fewest`` (by default all).

    They are within ``deflection`` times the arc length of ``rest``, above the base, and inside the
    shell. Half of them are in a layer just inside it: there the branch bends without being pushed
    together or pulled taut, the energy is least and changes fastest, and gentle paths run.

    Raises:
        WorkError: the grasp has hardly any room.
    """
    radius = deflection * reach.arc_length
    sequence = scipy.stats.qmc.Sobol(4, seed=seed)
    found: list[np.ndarray] = []
    for _ in range(64):
        draw = sequence.random(512)
        points = rest + radius * (2.0 * draw[:, :3] - 1.0)
        arm = points[1::2] - energy_surface.pivot
        depth = 1.0 - _LAYER * draw[1::2, 3:]
        points[1::2] = energy_surface.pivot + arm * (
            energy_surface.radius * depth / np.linalg.norm(arm, axis=1, keepdims=True))
        inside = np.linalg.norm(points - rest, axis=1) <= radius
        inside &= np.linalg.norm(points - energy_surface.pivot, axis=1) <= energy_surface.radius
        # The sphere's other half is not part of the shell: no position is sampled beyond the pivot.
        inside &= (points - energy_surface.pivot) @ (rest - energy_surface.pivot) > 0.0
        inside &= points[:, 2] >= reach.base[2]
        bulk, layer = points[::2][inside[::2]], points[1::2][inside[1::2]]
        found.append(_alternating(bulk, layer))
        if sum(map(len, found)) >= count:
            break
    if sum(map(len, found)) >= (count if fewest is None else fewest):
        return np.concatenate(found)[:count]
    raise WorkError("The grasp can hardly move.",
                    f"The branch is held {reach.arc_length:.3f} m from its base and reaches "
                    f"little more than the {radius:.3f} m around its rest position.",
                    "Grasp the branch farther from its base, or raise ", Option("deflection"), ".")


def _alternating(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    shared = min(len(first), len(second))
    return np.stack([first[:shared], second[:shared]], axis=1).reshape(-1, 3)


def sample_branch(grasp_model: GraspModel, targets: np.ndarray, *, workers: int | None = None,
                  progress: Progress = SILENT) -> tuple[GraspSamples, dict[str, int]]:
    """Solve the branch with its grasp at each of ``targets`` [n, 3].

    Returns:
        The accepted samples, the rest pose first; and the number of rejected ones by reason.
    """
    with SolverPool(grasp_model, workers) as solvers:
        good, bad = solve_branch(solvers, targets, progress=progress)
    return samples_of(good, _asked(bad, targets)), _counted(bad)


def solve_branch(solvers: SolverPool, targets: np.ndarray, known: Sequence[Solved] = (), *,
                 progress: Progress = SILENT) -> tuple[list[Solved], list[Solved]]:
    """Return accepted solutions, the rest state first, then ``known`` ones, and refused ones."""
    # Slabs of space; each has its own tree that starts from the known states.
    share_count = max(2, -(-len(targets) // _SHARE_POSES))
    shares = np.array_split(np.argsort(targets[:, 0], kind="stable"), share_count)
    begin = [taken(solvers.grasp_model, solvers.grasp_model.rest), *known]
    found = solvers.run(_solve_share, [(targets[share], share, begin) for share in shares],
                        progress=progress, message="solving grasp poses")
    solved = sorted((one for share in found for one in share), key=lambda s: s.target)
    return ([*begin, *(one for one in solved if not one.trouble)],
            [one for one in solved if one.trouble])


def _asked(bad: list[Solved], targets: np.ndarray) -> np.ndarray:
    return targets[[one.target for one in bad]] if bad else np.empty((0, 3))


def _counted(bad: list[Solved]) -> dict[str, int]:
    reasons = [str(one.trouble) for one in bad]
    return {reason: reasons.count(reason) for reason in sorted(set(reasons))}


def _solve_tree(grasp_model: GraspModel, targets: np.ndarray, numbers: np.ndarray,
                known: Sequence[Solved], report: Callable[[int], None]) -> list[Solved]:
    """Solve ``targets``, each from the nearest solution so far; ``numbers`` are their numbers. A
    pose that cannot be reached from there is tried again at the end, from other sides."""
    states, positions = list(known), [one.pose[:3] for one in known]
    solved: list[Solved] = []

    def attempt(target: int, source: int) -> Solved:
        position, begin = targets[target], states[source]
        guess = guess_of(grasp_model, states, np.array(positions), position)
        result = grasp_model.follow(position[None], begin.displacement, guess)[0]
        found = taken(grasp_model, result, int(numbers[target]))
        if not found.trouble:
            positions.append(position)
            states.append(found)
        return found

    waiting, failed = list(range(len(targets))), []
    while waiting:
        gaps = np.linalg.norm(targets[waiting][:, None] - np.array(positions)[None], axis=2)
        flat_index, source = np.unravel_index(np.argmin(gaps), gaps.shape)
        target = waiting.pop(int(flat_index))
        found = attempt(target, int(source))
        if found.trouble:
            failed.append((target, int(source)))
        else:
            solved.append(found)
        report(len(solved) + len(failed))
    for target, tried in failed:
        gaps = np.linalg.norm(np.array(positions) - targets[target], axis=1)
        for source in [s for s in np.argsort(gaps)[:_SECOND_TRIES + 1] if s != tried]:
            found = attempt(target, int(source))
            if not found.trouble:
                break
        solved.append(found)
    return solved


def displacements_at(grasp_model: GraspModel, positions: np.ndarray, *,
                     workers: int | None = None, progress: Progress = SILENT) -> np.ndarray:
    """Return states [m, node_count, 3] at ``positions`` [m, 3] that were solved before, each from
    the nearest one before. ConvergenceError if one cannot be solved again."""
    with SolverPool(grasp_model, workers) as solvers:
        good, bad = solve_branch(solvers, positions, progress=progress)
    if bad:
        position = ", ".join(f"{x:.3f}" for x in positions[bad[0].target])
        raise ConvergenceError(f"No acceptable solution ({bad[0].trouble}) with the grasp at "
                               f"({position}) m.", "This pose is a sample of the energy field and "
                               "had a solution before.", "Run ", Command("energy"), " again with ",
                               Option("force", True), ".").at(positions[bad[0].target])
    return np.array([one.displacement for one in good[1:]])


def _solve_share(grasp_model: GraspModel, targets: np.ndarray, numbers: np.ndarray,
                 known: Sequence[Solved], progress: Progress = SILENT) -> list[Solved]:
    def report(done: int) -> None:
        progress(done / len(targets), "solving grasp poses", solved=done)
    return _solve_tree(grasp_model, targets, numbers, known, report)


def _slack(forces: np.ndarray, usual: np.ndarray, drawn: float) -> np.ndarray:
    """Return which poses' forces [m] are not of a wall. Pulled taut, a branch takes many times its
    usual force within millimetres; this spoils the field, and no gentle path goes there. So over
    twice the median is a wall, except up to ``drawn`` [N], the force drawn outward with."""
    middle = np.median(usual) if len(usual) else 0.0
    slack = forces <= max(_TAUT * middle, drawn * (1.0 + 1e-9))
    slack[0] = True
    return slack


def energy_inputs(grasp_model: GraspModel) -> dict[str, str]:
    """Digests of what the field depends on: geometry, grasp, material, weight, targets. Of stored
    or counted data only: last digits of computed ones differ between machines."""
    import hashlib

    model, material = grasp_model.model, hashlib.sha256()
    for values in (model.young, model.poisson, model.density):
        material.update(np.ascontiguousarray(values, float).tobytes())
    grasp = grasp_model.grasp
    nodes = hashlib.sha256(np.ascontiguousarray(grasp.nodes, np.int64).tobytes())
    return {"mesh geometry": grasp_model.mesh.geometry_digest(), "material": material.hexdigest(),
            "grasp nodes": f"{grasp.mode} {nodes.hexdigest()}",
            "weight": str((model.gravity.tolist(), model.point_masses)),
            "targets": str(grasp_model.branch.targets)}


# Samples added where the field's error is largest, until the requested error is met.

_ROUND = 0.15  # fraction of the samples added in a round
_FEWEST = 8
_NEW_SAMPLE_GAP = 0.5  # no new sample is within this fraction of two samples' distance of another
_SHARE_PLACES = 20
"""Places of one task; must not depend on the number of processes."""


def refined(grasp_model: GraspModel, sampled: Sampled, field: EnergyField, asked: float, most: int,
            *, workers: int | None = None, progress: Progress = SILENT,
            ) -> tuple[Sampled, EnergyField]:
    """Return the field with samples added where its error is largest, until its ``energy_error`` on
    left-out samples is at most ``asked``, there are ``most``, or none can be added."""
    begun = len(field.samples.poses)
    while field.errors["energy_error"] > asked and len(field.samples.poses) < most:
        count = len(field.samples.poses)
        progress((count - begun) / max(most - begun, 1),
                 "adding poses where the field's error is large",
                 error=field.errors["energy_error"], samples=count)
        positions, sources = _where_off(field,
                                        min(max(_FEWEST, round(_ROUND * count)), most - count))
        if not len(positions):
            break
        solved = _solved(grasp_model, positions, [sampled.displacements[k] for k in sources],
                         workers)
        good = [one for one in solved if not one.trouble]
        bad = np.array([one.trouble is not None for one in solved])
        added = samples_of(good, positions[bad]) if good else replace(
            field.samples.take(np.empty(0, int)), rejected_poses=np.hstack(
                [positions[bad], np.zeros((int(bad.sum()), 3))]))
        field = refit(field, added)
        sampled = replace(sampled, samples=field.samples, displacements=[
            *sampled.displacements, *(one.displacement for one in good)])
    return sampled, field


def _where_off(field: EnergyField, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return places [n, 3] half-way between neighbours where the energy's error is largest, and the
    sample nearest to each, [n]."""
    chart, positions = field.region.chart, field.samples.positions
    flat = chart.map(positions)
    edges = neighbours(flat)
    off = np.where(field.region.is_face(), 0.0, np.abs(field.missed[:, 0]))
    distance = np.linalg.norm(flat[edges[:, 0]] - flat[edges[:, 1]], axis=1)
    middles = chart.curved(flat[edges].mean(axis=1))
    chosen: list[int] = []
    for k in np.argsort(-off[edges].sum(axis=1) * distance, kind="stable"):
        if len(chosen) == count or not off[edges[k]].any():
            break
        if not field.region.contains(middles[k])[0]:
            continue
        gaps = np.linalg.norm(middles[chosen] - middles[k], axis=1)
        if not len(gaps) or gaps.min() > _NEW_SAMPLE_GAP * distance[k]:
            chosen.append(int(k))
    nearest = np.linalg.norm(middles[chosen][:, None] - positions[None], axis=2)
    return middles[chosen], nearest.argmin(axis=1) if chosen else np.empty(0, int)


def _solved(grasp_model: GraspModel, positions: np.ndarray, starts: list[np.ndarray],
            workers: int | None) -> list[Solved]:
    shares = np.array_split(np.arange(len(positions)), max(2, -(-len(positions) // _SHARE_PLACES)))
    found = run_tasks(_solve, [(grasp_model, positions[k], [starts[n] for n in k])
                              for k in shares if len(k)],
                      workers=workers, message="adding poses where the field's error is large")
    return [one for share in found for one in share]


def _solve(grasp_model: GraspModel, positions: np.ndarray, starts: list[np.ndarray],
           ) -> list[Solved]:
    return [taken(grasp_model, grasp_model.follow(position[None], start)[0], number)
            for number, (position, start) in enumerate(zip(positions, starts, strict=True))]
