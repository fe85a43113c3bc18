"""Energy of the branch at sampled grasp positions, by the full model.

Some poses follow the shell on which a free grasp moves, and go a little beyond
(:mod:`limber.planning.field.low_energy_surface`). The positions of the others come from a Sobol
sequence in the ball about the rest position that the deflection allows, inside that shell, cut by
the paper's hemisphere. They are solved along a nearest-neighbour tree: the next position is the one
nearest to any solved one, and starts from that solution. So every step is short, also where a tour
would have to jump, and the branch stays in the equilibrium that bends out of rest.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
import scipy

from limber.core.errors import ConvergenceError, WorkError
from limber.core.progress import SILENT, Progress
from limber.planning.field.disagreeing_neighbours import sample_between
from limber.planning.field.grasp_model import GraspModel, Reach
from limber.planning.field.grasp_samples import GraspSamples
from limber.planning.field.initial_guess import guess_of
from limber.planning.field.interpolation.chart import Chart
from limber.planning.field.low_energy_surface import LowEnergySurface, walk_energy_surface
from limber.planning.field.solver_pool import SolverPool
from limber.planning.field.stored_states import Solved, samples_of, taken
from limber.planning.settings import EnergySettings

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
    """Results of the branch model.

    Attributes:
        samples: Samples for the fit, the rest pose first.
        displacements: Displacements of all nodes at those [m], shape [node_count, 3] each.
        valley: The shell that they follow.
        reasons: Number of rejected poses by reason.
        taut_count: Number of poses left out as taut.
    """

    samples: GraspSamples
    displacements: list[np.ndarray]
    energy_surface: LowEnergySurface
    reasons: dict[str, int]
    taut_count: int


def sample_field(grasp_model: GraspModel, settings: EnergySettings, *, workers: int | None = None,
                 progress: Progress = SILENT) -> Sampled:
    """Solve the branch at ``settings.samples`` poses: two thirds of them spread over the allowed
    positions of its grasp, the others between neighbours that disagree
    (:mod:`limber.planning.field.disagreeing_neighbours`).

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
                    "Grasp the branch farther from its base, or raise --deflection.")


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
    reasons = [one.trouble for one in bad]
    return {str(reason): reasons.count(reason) for reason in sorted(set(reasons))}


def _solve_tree(grasp_model: GraspModel, targets: np.ndarray, numbers: np.ndarray,
                known: Sequence[Solved], report: Callable[[int], None]) -> list[Solved]:
    """Solve ``targets``, each from the nearest solution so far; ``numbers`` are their numbers.

    A pose that cannot be reached from there is tried again at the end, from other sides.
    """
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
    """Return the branch's states with its grasp at ``positions`` [m, 3] that were solved before.

    Shape [m, node_count, 3]; each from the nearest one before.

    Raises:
        ConvergenceError: one cannot be solved again.
    """
    with SolverPool(grasp_model, workers) as solvers:
        good, bad = solve_branch(solvers, positions, progress=progress)
    if bad:
        position = ", ".join(f"{x:.3f}" for x in positions[bad[0].target])
        raise ConvergenceError(
            f"No acceptable solution ({bad[0].trouble}) with the grasp at ({position}) m.",
            "This pose is a sample of the energy field and had a solution before.",
            "Run `limber energy` again with --force.")
    return np.array([one.displacement for one in good[1:]])


def _solve_share(grasp_model: GraspModel, targets: np.ndarray, numbers: np.ndarray,
                 known: Sequence[Solved], progress: Progress = SILENT) -> list[Solved]:
    def report(done: int) -> None:
        progress(done / len(targets), "solving grasp poses", solved=done)
    return _solve_tree(grasp_model, targets, numbers, known, report)


def _slack(forces: np.ndarray, usual: np.ndarray, drawn: float) -> np.ndarray:
    """Return which of ``forces`` [m] are not of a wall; ``usual`` are those of evenly spread poses.

    Bending a branch, even double, takes about the same force anywhere; pulling it taut takes many
    times that within millimetres. Such a wall spoils the field around it, and no gentle path goes
    there. Poses over twice the median force are therefore left out, and are thus outside the
    trusted region, except those that take no more than ``drawn`` [N], the force that the branch was
    drawn outward with.
    """
    middle = np.median(usual) if len(usual) else 0.0
    slack = forces <= max(_TAUT * middle, drawn * (1.0 + 1e-9))
    slack[0] = True
    return slack


def energy_inputs(grasp_model: GraspModel) -> dict[str, str]:
    """Return digests of what the field depends on: geometry, grasp, material, weight, targets.

    Only of stored or counted data: a grasp's weights are computed, and their last digits differ
    between machines, to which a branch folder may be moved.
    """
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
