"""Energy of the branch at sampled grasp positions, by the full model.

Positions come from a Sobol sequence in the ball about the rest position that the deflection
allows, cut by the paper's hemisphere. They are solved along a nearest-neighbour tree: next is the
position nearest to any that has been solved, and it starts from that solution. So every step is
short, also where a tour would have to jump, and the branch stays in the equilibrium that bends
out of rest.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from limber.errors import WorkError
from limber.jobs import run_tasks
from limber.mechanics.status import Status
from limber.planning.field.energy_field import GraspSamples
from limber.planning.field.grasp_model import GraspModel, Reach, refusal
from limber.progress import SILENT, Progress

_LAYER = 0.06  # share of the reach
_TAUT = 2.0  # times the median force
_SHARE_POSES = 40
"""Poses of one tree. How many trees there are must not depend on how many processes work on
them, nor what they find."""
_SECOND_TRIES = 3  # other solutions to start from, for a pose that one could not reach


@dataclass(frozen=True)
class _Solved:
    """What is kept of a solution."""

    target: int
    pose: np.ndarray
    energy: float
    force: np.ndarray
    tip: np.ndarray
    min_det_f: float
    trouble: Status | None
    targets: np.ndarray


def sample_positions(reach: Reach, rest: np.ndarray, count: int, *, deflection: float,
                     stretch: float = 0.2, seed: int = 0) -> np.ndarray:
    """Return ``count`` positions [m] to which the grasp may be taken, shape [count, 3].

    They lie within ``deflection`` times the arc length of ``rest``, above the base, and no
    farther from it than the branch reaches. Half of them lie in a layer just inside that reach:
    there the branch bends without being pushed together or pulled taut, the energy is least and
    changes fastest, and gentle paths run.

    Raises:
        WorkError: the grasp has hardly any room.
    """
    from scipy.stats import qmc

    radius = deflection * reach.arc_length
    taut = reach.chord + stretch * (reach.arc_length - reach.chord)
    taut = max(taut, float(np.linalg.norm(rest - reach.base)))
    sequence = qmc.Sobol(4, seed=seed)
    found: list[np.ndarray] = []
    for _ in range(64):
        draw = sequence.random(512)
        points = rest + radius * (2.0 * draw[:, :3] - 1.0)
        arm = points[1::2] - reach.base
        depth = 1.0 - _LAYER * draw[1::2, 3:]
        points[1::2] = reach.base + arm * (
            taut * depth / np.linalg.norm(arm, axis=1, keepdims=True))
        inside = np.linalg.norm(points - rest, axis=1) <= radius
        inside &= np.linalg.norm(points - reach.base, axis=1) <= taut
        inside &= points[:, 2] >= reach.base[2]
        bulk, layer = points[::2][inside[::2]], points[1::2][inside[1::2]]
        found.append(_alternating(bulk, layer))
        if sum(map(len, found)) >= count:
            return np.concatenate(found)[:count]
    raise WorkError("The grasp has nearly no room to move.",
                    f"Within {radius:.3f} m of rest the branch, {taut:.3f} m long, reaches little.",
                    "Grasp the branch farther out, or allow more --deflection or --stretch.")


def _alternating(first: np.ndarray, second: np.ndarray) -> np.ndarray:
    shared = min(len(first), len(second))
    return np.stack([first[:shared], second[:shared]], axis=1).reshape(-1, 3)


def sample_branch(grasp_model: GraspModel, targets: np.ndarray, *, workers: int | None = None,
                  progress: Progress = SILENT) -> tuple[GraspSamples, dict[str, int]]:
    """Solve the branch with its grasp at each of ``targets`` [n, 3].

    Returns:
        The accepted samples, the rest pose first; and how many were rejected for which reason.
    """
    # Slabs of space: in each a tree of its own out of the rest state.
    share_count = max(2, -(-len(targets) // _SHARE_POSES))
    shares = np.array_split(np.argsort(targets[:, 0], kind="stable"), share_count)
    found = run_tasks(_solve_share, [(grasp_model, targets[share], share) for share in shares],
                      workers=workers, progress=progress, message="solving grasp poses")
    solved = [one for share in found for one in share]
    rest = grasp_model.rest
    at_rest = _Solved(-1, grasp_model.pose(rest.displacement), 0.0, np.zeros(3),
                      grasp_model.tip(rest.displacement), rest.min_det_f, None,
                      grasp_model.branch.target_positions(rest.displacement))
    good = [at_rest, *sorted((s for s in solved if not s.trouble), key=lambda s: s.target)]
    bad = sorted((s for s in solved if s.trouble), key=lambda s: s.target)
    reasons = [s.trouble for s in bad]
    rejected = np.zeros((len(bad), 6))
    rejected[:, :3] = targets[[s.target for s in bad]] if bad else 0.0
    samples = GraspSamples(
        poses=np.array([s.pose for s in good]), energies=np.array([s.energy for s in good]),
        forces=np.array([s.force for s in good]),
        tips=np.array([s.tip for s in good]), min_det_f=np.array([s.min_det_f for s in good]),
        rejected_poses=rejected, targets=np.array([s.targets for s in good]))
    return samples, {str(reason): reasons.count(reason) for reason in sorted(set(reasons))}


def _solve_tree(grasp_model: GraspModel, targets: np.ndarray, numbers: np.ndarray,
                report: Callable[[int], None]) -> list[_Solved]:
    """Solve ``targets``, each from the nearest solution so far; ``numbers`` are their names.

    A pose that cannot be reached from there is tried again at the end, from other sides.
    """
    positions = [grasp_model.rest_position]
    states = [grasp_model.rest.displacement]
    solved: list[_Solved] = []

    def attempt(target: int, source: int) -> _Solved:
        result = grasp_model.follow(targets[target][None], states[source])[0]
        found = _Solved(
            int(numbers[target]), grasp_model.pose(result.displacement),
            grasp_model.energy(result), result.reaction_force,
            grasp_model.tip(result.displacement), float(result.min_det_f), refusal(result),
            grasp_model.branch.target_positions(result.displacement))
        if not found.trouble:
            positions.append(targets[target])
            states.append(result.displacement)
        return found

    waiting, failed = list(range(len(targets))), []
    while waiting:
        gaps = np.linalg.norm(targets[waiting][:, None] - np.array(positions)[None], axis=2)
        place, source = np.unravel_index(np.argmin(gaps), gaps.shape)
        target = waiting.pop(int(place))
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


def _solve_share(grasp_model: GraspModel, targets: np.ndarray, numbers: np.ndarray,
                 progress: Progress = SILENT) -> list[_Solved]:
    def report(done: int) -> None:
        progress(done / len(targets), "solving grasp poses", solved=done)
    return _solve_tree(grasp_model, targets, numbers, report)




def without_taut(samples: GraspSamples) -> tuple[GraspSamples, int]:
    """Return the samples without those that pull the branch taut, and how many those were.

    Bending a branch, even double, takes about the same force anywhere; pulled taut it takes many
    times that within millimetres. Such a wall spoils the field around it, and no gentle path
    goes there: poses over twice the median force stay out, and so out of the trusted region.
    """
    size = np.linalg.norm(samples.forces, axis=1)
    slack = size <= _TAUT * np.median(size)
    slack[0] = True
    return samples.take(np.flatnonzero(slack)), int((~slack).sum())


def energy_inputs(grasp_model: GraspModel) -> dict[str, str]:
    """Return digests of what the field depends on: geometry, grasp, material, weight, targets."""
    import hashlib

    model, material = grasp_model.model, hashlib.sha256()
    for values in (model.young, model.poisson, model.density):
        material.update(np.ascontiguousarray(values, float).tobytes())
    grasp = hashlib.sha256(repr(grasp_model.grasp.key()).encode())
    return {"mesh geometry": grasp_model.mesh.geometry_digest(), "material": material.hexdigest(),
            "grasp": grasp.hexdigest(),
            "weight": str((model.gravity.tolist(), model.point_masses)),
            "targets": str(grasp_model.branch.targets)}
