"""Energy of the branch at sampled grasp positions, by the full model, which a rod leads.

Some poses follow the shell on which a free grasp moves, and go a little beyond. The positions of
the others come from a Sobol sequence in the ball about the rest position that the deflection
allows, inside that shell, cut by the paper's hemisphere. The rod
(:mod:`limber.planning.field.rod`) reaches them along a nearest-neighbour tree: the next position is
the one nearest to any reached one, and starts from that state. So every step is short, also where a
tour would have to jump, and the branch stays in the equilibrium that bends out of rest. It takes
milliseconds a pose, finds folds, and says where more poses are needed. Then the full model solves
every pose, in two or three iterations from the rod's shape and strain.
"""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy
from scipy.spatial import Delaunay

from limber.core.errors import Command, ConvergenceError, Option, WorkError
from limber.core.processes import run_tasks
from limber.core.progress import SILENT, Progress
from limber.planning.field.chart import Chart
from limber.planning.field.grasp_model import GraspModel, Reach, refusal
from limber.planning.field.rod import Rod, RodState
from limber.planning.field.stored_states import Solution, States
from limber.planning.settings import EnergySettings

# Neighbouring samples that disagree, and the states of the branch between them.
#
# Pushed together below its rest position, a branch buckles to one side or the other, within
# millimetres, and with its grasp at one position it may be in either of two shapes, depending on
# the path there. A field fitted to both gives a mean that the branch never takes. So where the
# shapes of two neighbours differ by more than their slopes explain, the rod is moved half-way from
# both: first where it matters most, by the difference of the shapes and the number of poses around
# the two. If it arrives in one state, that is a further sample. If there is a fold on the way, or
# it arrives in two, no path may lead there: the position counts as refused.

_JUMP = 0.01  # fraction of the branch's length by which predictions of two neighbours differ
_ONE = 0.003  # fraction of it below which shapes are the same
_LEAST = 0.02  # fraction of it; nearer neighbours are not examined further
_ROUNDS = 4  # each uses what the earlier ones found
_CORNERS = [(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)]


class RodField:
    """The rod's ``states`` so far, with ``positions`` of the grasp [n, 3] [m], ``shapes`` [n, p, 3]
    (tip and targets [m]) and their ``slopes`` [n, 3, p, 3]; and places [t, 3] with two shapes."""

    def __init__(self, grasp_model: GraspModel):
        self.rod, self.length = grasp_model.rod, grasp_model.reach.arc_length
        still = np.zeros_like(grasp_model.mesh.nodes)
        self._points = self.rod.points(np.concatenate([
            grasp_model.tip(still)[None], grasp_model.branch.target_positions(still)]))
        self.states: list[RodState] = []
        self.bistable = np.empty((0, 3))
        self.add([self.rod.rest])

    def add(self, states: Sequence[RodState]) -> None:
        """Take up states of the rod."""
        self.states += states
        self.positions = np.array([state.places[-1] for state in self.states])
        moved = [self.rod.moved(state, self._points) for state in self.states]
        self.shapes, self.slopes = (np.array(values) for values in zip(*moved, strict=True))

    def sample_between(self, chart: Chart, usual: np.ndarray, most: int, *,
                       progress: Progress = SILENT) -> None:
        """Add at most ``most`` samples and places with two shapes between neighbours that disagree
        in a plain chart. ``usual`` [n, 3] are as dense as queries to the field: errors near many
        matter more."""
        asked = 0
        for number in range(_ROUNDS):
            budget = round(most * (number + 1) / _ROUNDS) - asked
            chosen = self._apart(self.disagreeing(chart, usual), chart)[:budget]
            if not chosen:
                break
            found = []
            for (first, second), middle in chosen:
                progress(asked / most, "between neighbouring poses")
                asked += 1
                state = self._shared(first, second, middle[0])
                if state is None:
                    self.bistable = np.concatenate([self.bistable, middle])
                else:
                    found.append(state)
            self.add(found)

    def _shared(self, first: int, second: int, middle: np.ndarray) -> RodState | None:
        """Return the state at ``middle`` [3] that two neighbours reach without a snap, None if
        there is none."""
        ends = [self.rod.followed(self.states[k], middle)[0] for k in (first, second)]
        if ends[0] is None or ends[1] is None:
            return None
        off = np.abs(ends[0].places - ends[1].places).max()
        return ends[0] if off <= _ONE * self.length else None

    def disagreeing(self, chart: Chart, usual: np.ndarray) -> list[tuple[int, int, np.ndarray]]:
        """Return pairs of neighbours that disagree, the most important first, by jump times
        ``usual`` places in the tetrahedra that share them, whose numbers [k] come too."""
        flat = chart.map(self.positions)
        tetrahedra = Delaunay(flat)
        inside = tetrahedra.find_simplex(chart.map(usual))
        crowd = np.bincount(inside[inside >= 0], minlength=len(tetrahedra.simplices))
        sides = np.sort(tetrahedra.simplices[:, _CORNERS], axis=2)
        edges, number = np.unique(sides.reshape(-1, 2), axis=0, return_inverse=True)
        number = number.reshape(len(sides), 6)
        weight = np.bincount(number.ravel(), np.repeat(crowd, 6), len(edges))
        first, second = edges.T
        change = np.einsum("ek,ekpc->epc", self.positions[second] - self.positions[first],
                           0.5 * (self.slopes[first] + self.slopes[second]))
        off = self.shapes[second] - self.shapes[first] - change
        jumps = np.linalg.norm(off, axis=2).max(axis=1)
        distance = np.linalg.norm(flat[first] - flat[second], axis=1)
        worth = np.where((jumps > _JUMP * self.length) & (distance > _LEAST * self.length),
                         jumps * weight, 0.0)
        return [(int(edges[k, 0]), int(edges[k, 1]), np.flatnonzero((number == k).any(axis=1)))
                for k in np.argsort(-worth, kind="stable")[:int((worth > 0.0).sum())]]

    def _apart(self, pairs: list[tuple[int, int, np.ndarray]], chart: Chart,
               ) -> list[tuple[tuple[int, int], np.ndarray]]:
        """Return pairs of numbers and the places [1, 3] half-way, one pair per tetrahedron; none
        where a place with two shapes is nearer than any known one."""
        flat = chart.map(self.positions)
        used: set[int] = set()
        chosen = []
        for first, second, about in pairs:
            if not used.isdisjoint(about.tolist()):
                continue
            middle = chart.curved(flat[[first, second]].mean(axis=0)[None])
            if len(self.bistable) and _nearest(middle, self.bistable) < _nearest(
                    middle, self.positions):
                continue
            used.update(about.tolist())
            chosen.append(((first, second), middle))
        return chosen


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

_RIM = 1.1  # factor on the force of linear bending at the largest deflection
_GOLDEN = np.pi * (3.0 - np.sqrt(5.0))
_WORST = 0.02  # rms deviation of the states from the sphere, over the radius


@dataclass(frozen=True)
class LowEnergySurface:
    """A sphere: ``pivot`` [m] of shape [3] and ``radius`` [m]."""

    pivot: np.ndarray
    radius: float


def walk_energy_surface(grasp_model: GraspModel, count: int, *, deflection: float, seed: int = 0,
                        ) -> tuple[LowEnergySurface, list[RodState]]:
    """Return the shell, and states on it and a little beyond: per direction one under a force
    across, one also drawn outward. ``deflection`` is over arc length, ``seed`` turns the
    directions. A branch that is no cantilever gets the sphere about its base."""
    rod, reach = grasp_model.rod, grasp_model.reach
    stiffness, axes = np.linalg.eigh(rod.held(rod.rest)[1])
    force = float(np.sqrt(max(stiffness[0] * stiffness[1], 0.0))) * deflection * reach.arc_length
    turn = float(np.random.default_rng([seed, 11]).uniform(0.0, 2.0 * np.pi))
    angles = turn + _GOLDEN * np.arange(count)
    across = _RIM * force * np.sqrt((np.arange(count) + 0.5) / count)[:, None] * (
        np.cos(angles)[:, None] * axes[:, 0] + np.sin(angles)[:, None] * axes[:, 1])
    slack = [rod.rest, *filter(None, (rod.pulled(rod.rest, push) for push in across))]
    drawn = [rod.pulled(state, rod.held(state)[0] + force * _unit(state.places[-1] - reach.base))
             for state in slack]
    positions = np.array([state.places[-1] for state in slack])
    return _sphere(positions, reach.base, grasp_model.rest_position), [
        *slack[1:], *filter(None, drawn)]


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
_OTHER_SHAPE = 0.02  # fraction of the length by which the full model is in another shape
_OUTLYING = 4.0  # the same, times what the rod is off in half of the poses
_FEW = 400_000  # poses by tetrahedra that are solved before further processes would have started
_SHARE_POSES = 30
"""Poses of one task; must not depend on the number of processes."""
_OTHER_SIDES = 3  # other states tried as start for a pose that was not reached
TWO_SHAPES = "two shapes"
"""One of the reasons for refusing poses: which of two shapes results depends on the path."""


@dataclass(frozen=True)
class Sampled:
    """Results of the branch model, the rest pose first, the shell that they follow, and rejected
    poses by reason; taut ones were left out."""

    samples: States
    energy_surface: LowEnergySurface
    reasons: dict[str, int]
    taut_count: int


def sample_field(grasp_model: GraspModel, settings: EnergySettings, *, workers: int | None = None,
                 progress: Progress = SILENT) -> Sampled:
    """Solve the branch at ``settings.samples`` poses: two thirds of them spread over the allowed
    positions of its grasp, the others between neighbours that disagree.

    Raises:
        WorkError: the grasp has hardly any room. ConvergenceError: the branch has no rest state.
    """
    spread = round(settings.samples * _SPREAD)
    rest = grasp_model.rest_position
    field = RodField(grasp_model)
    energy_surface, walked = walk_energy_surface(
        grasp_model, max(_FEWEST_DIRECTIONS, round(spread * _WALK)),
        deflection=settings.deflection, seed=settings.seed)
    count = max(spread - len(walked), 1)
    usual = sample_positions(
        grasp_model.reach, rest, max(_USUAL, count), energy_surface,
        deflection=settings.deflection, seed=settings.seed, fewest=count)
    targets = usual[:count]
    reached = grown(field.rod, targets, [field.rod.rest, *walked], progress.part(0.05, 0.15))
    lost = targets[[state is None for state in reached]]
    found = list(filter(None, reached))
    slack = _slack(*(np.array([np.linalg.norm(field.rod.held(state)[0]) for state in states])
                     for states in (found, walked)))
    field.add([*walked, *(one for one, kept in zip(found, slack, strict=True) if kept)])
    chart = Chart.about(energy_surface.pivot, energy_surface.radius, rest)
    field.sample_between(chart, usual, settings.samples - spread,
                         progress=progress.part(0.15, 0.3))
    asked = np.concatenate([field.positions[1:], lost])
    solved = solved_from(grasp_model, asked, [*field.states[1:], *([None] * len(lost))],
                     workers, progress.part(0.3, 1.0))
    # In another shape than the rod: which results depends on the path.
    troubles = [one.trouble and str(one.trouble) for one in solved]
    led = [k for k, one in enumerate(solved) if not one.trouble and (
        one.target < len(field.states) - 1)]
    for k in np.flatnonzero(other_shapes(grasp_model, [solved[k].state for k in led], [
            field.shapes[1 + solved[k].target].ravel() for k in led])):
        troubles[led[k]] = TWO_SHAPES
    good = (one.state for one, why in zip(solved, troubles, strict=True) if not why)
    samples = States.of(grasp_model, [grasp_model.rest], sloped=True).joined(*good)
    rejected = np.concatenate([asked[[why is not None for why in troubles]], field.bistable])
    reasons = Counter([*filter(None, troubles), *[TWO_SHAPES] * len(field.bistable)])
    return Sampled(replace(samples, rejected_poses=np.pad(rejected, [(0, 0), (0, 3)])),
                   energy_surface, dict(sorted(reasons.items())), int((~slack).sum()))


def other_shapes(grasp_model: GraspModel, states: Sequence[States],
                 foretold: Sequence[np.ndarray]) -> np.ndarray:
    """Return in which ``states``, of a pose each, tip and targets are not where they were
    ``foretold``, shape [n]. Where moduli vary much along the branch, a rod is off everywhere."""
    off = np.array([np.abs(state.shape[0, 3:] - places).max()
                    for state, places in zip(states, foretold, strict=True)])
    usual = float(np.median(off)) if len(off) else 0.0
    return off > max(_OTHER_SHAPE * grasp_model.reach.arc_length, _OUTLYING * usual)


def _slack(forces: np.ndarray, walked: np.ndarray) -> np.ndarray:
    """Return which poses' forces [m] are not of a wall. Pulled taut, a branch takes many times its
    usual force within millimetres; this spoils the field, and no gentle path goes there. So over
    twice the median is a wall, except up to those of ``walked`` states, also drawn outward."""
    middle = np.median(forces) if len(forces) else 0.0
    return forces <= max(_TAUT * middle, walked.max(initial=0.0))


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


def solve_branch(grasp_model: GraspModel, targets: np.ndarray, *, workers: int | None = None,
                 progress: Progress = SILENT) -> tuple[list[Solution], list[Solution]]:
    """Return the full model's accepted solutions and refused ones."""
    reached = grown(grasp_model.rod, targets, [grasp_model.rod.rest], progress.part(0.0, 0.1))
    solved = solved_from(grasp_model, targets, reached, workers, progress.part(0.1, 1.0))
    return ([one for one in solved if not one.trouble], [one for one in solved if one.trouble])


def solved_from(grasp_model: GraspModel, targets: np.ndarray, states: Sequence[RodState | None],
            workers: int | None, progress: Progress) -> list[Solution]:
    """Return the full model's solutions at ``targets``, where the rod is in ``states``."""
    if len(targets) * grasp_model.mesh.tet_count < _FEW:
        workers = workers or 1
    shares = np.array_split(np.arange(len(targets)), max(2, -(-len(targets) // _SHARE_POSES)))
    found = run_tasks(_solve_share, [(grasp_model, targets[share], [states[k] for k in share],
                                      share) for share in shares],
                      workers=workers, progress=progress, message="solving grasp poses")
    return [one for share in found for one in share]


def grown(rod: Rod, targets: np.ndarray, known: Sequence[RodState], progress: Progress = SILENT,
          ) -> list[RodState | None]:
    """Return the rod's states at ``targets`` [n, 3], each from the nearest one so far, ``known``
    ones first. One that is not reached without a snap is tried again at the end, from other sides;
    None if it is not reached at all."""
    states, positions = list(known), [one.places[-1] for one in known]
    found: list[RodState | None] = [None] * len(targets)

    def attempt(target: int, source: int) -> bool:
        state, _ = rod.followed(states[source], targets[target])
        if state is not None:
            found[target] = state
            positions.append(targets[target])
            states.append(state)
        return state is not None

    gaps = np.linalg.norm(targets[:, None] - np.array(positions)[None], axis=2)
    least, source, failed = gaps.min(axis=1), gaps.argmin(axis=1), []
    for number in range(len(targets)):
        progress(number / len(targets), "grasp poses of the rod")
        target = int(np.argmin(least))
        if attempt(target, int(source[target])):
            away = np.linalg.norm(targets - targets[target], axis=1)
            nearer = (away < least) & np.isfinite(least)
            least[nearer], source[nearer] = away[nearer], len(states) - 1
        else:
            failed.append(target)
        least[target] = np.inf
    for target in failed:
        near = np.argsort(np.linalg.norm(np.array(positions) - targets[target], axis=1),
                          kind="stable")[:_OTHER_SIDES].tolist()
        any(attempt(target, k) for k in near)
    return found


def displacements_at(grasp_model: GraspModel, positions: np.ndarray, *,
                     workers: int | None = None, progress: Progress = SILENT) -> np.ndarray:
    """Return states [m, node_count, 3] at ``positions`` [m, 3] that were solved before.
    ConvergenceError if one cannot be solved again."""
    good, bad = solve_branch(grasp_model, positions, workers=workers, progress=progress)
    if bad:
        position = ", ".join(f"{x:.3f}" for x in positions[bad[0].target])
        raise ConvergenceError(f"No acceptable solution ({bad[0].trouble}) with the grasp at "
                               f"({position}) m.", "This pose is a sample of the energy field and "
                               "had a solution before.", "Run ", Command("energy"), " again with ",
                               Option("force", True), ".").at(positions[bad[0].target])
    return np.array([one.state.displacements[0] for one in good])


def _solve_share(grasp_model: GraspModel, targets: np.ndarray, states: Sequence[RodState | None],
                 numbers: np.ndarray, progress: Progress = SILENT) -> list[Solution]:
    """Solve ``targets`` from the rod's states there, from rest where there is none or it leads
    nowhere."""
    solved = []
    for number, (position, state) in enumerate(zip(targets, states, strict=True)):
        progress(number / len(targets), "solving grasp poses", solved=number)
        result = None if state is None else grasp_model.confirm(state)
        if result is None or refusal(result):
            result = grasp_model.follow(position[None], grasp_model.rest.displacement)[0]
        solved.append(Solution(int(numbers[number]), refusal(result),
                               States.of(grasp_model, [result], sloped=True)))
    return solved


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
