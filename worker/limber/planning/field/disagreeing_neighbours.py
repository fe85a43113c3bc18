"""Neighbouring samples that disagree, and the states of the branch between them.

Pushed together below its rest position, a branch buckles to one side or the other, within
millimetres, and with its grasp at one position it may be in either of two shapes, depending on the
path there. A field fitted to both gives a mean that the branch never takes. So where the shapes of
two neighbours differ by more than their slopes explain, the branch is moved half-way between them:
first where it matters most, by the difference of the shapes and the number of poses around the two.
If it arrives in one state, that is a further sample. If it arrives in two, or would have to snap,
no path may lead there: the position counts as refused.
"""

from collections.abc import Sequence

import numpy as np
from scipy.spatial import Delaunay

from limber.core.progress import SILENT, Progress
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.field.initial_guess import extrapolated, midpoint_blend
from limber.planning.field.interpolation.chart import Chart
from limber.planning.field.solver_pool import SolverPool
from limber.planning.field.stored_states import Solved, taken

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
    """Return samples between neighbours that disagree, and places [t, 3] with two shapes.

    Args:
        known: Accepted states.
        chart: Chart in which the samples are neighbours; plain.
        usual: Places [n, 3] at the density of queries to the field: errors near many of them matter
            more.
        most: Most places to solve.
    """
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
    """Return the pairs of neighbours that disagree, the most important first.

    As numbers in ``known``, with those of the tetrahedra [k] that share them. The weight of a pair
    is its jump times the number of ``usual`` places in those. ``length`` [m] is the branch's.
    """
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
    """Return the distance between two neighbours' predictions of tip or target half-way [m].

    By the slopes of each; if one has none, by the other's alone.
    """
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
    with two shapes is nearer than any known one.
    """
    flat = chart.map(np.array([one.pose[:3] for one in known]))
    positions, used, chosen = np.array([one.pose[:3] for one in known]), set(), []
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
