"""Neighbouring samples that do not agree: what the branch does between them.

Pushed together below its rest, a branch goes aside one way or the other, and with its grasp in one
place it may stand in either of two shapes; which one is a matter of the way there. A field fitted
to both says a mean that the branch never takes. So where the shapes of two neighbours differ by
more than their slopes say, the branch is taken half-way between them, from each. If it arrives in
one state, that is a sample more, where the shape changes fast. If it arrives in two, or not at all,
no path may lead there: the place counts as refused.
"""

import heapq
from collections.abc import Sequence

import numpy as np
from scipy.spatial import Delaunay

from limber.jobs import run_tasks
from limber.planning.field.chart import Chart
from limber.planning.field.grasp_model import GraspModel, refusal
from limber.planning.field.solved import Solved, taken
from limber.progress import SILENT, Progress

_JUMP = 0.03  # of the branch's length, by which neighbours' slopes foretell differently
_ONE = 0.003  # of it: nearer shapes are one
_NEARER = 0.4  # of a jump is left half-way, at most, where the branch surely is the neighbour's
_LEAST = 0.02  # of it: neighbours nearer than this are asked no more
_SHARE_PAIRS = 20
"""Pairs of one task; must not depend on how many processes there are."""

Pair = tuple[Solved, Solved]


def ask_between(grasp_model: GraspModel, known: Sequence[Solved], chart: Chart, most: int, *,
                workers: int | None = None, progress: Progress = SILENT,
                ) -> tuple[list[Solved], np.ndarray]:
    """Return samples between neighbours that do not agree, and places [t, 3] of two shapes.

    Args:
        known: Accepted states.
        chart: In which the samples are neighbours; plain.
        most: So many places are asked at most, those first that agree least.
    """
    pairs = disagreeing(known, chart, grasp_model.reach.arc_length)[:most]
    if not pairs:
        return [], np.empty((0, 3))
    # Slabs of space: what one finds spares it others near.
    middles = [0.5 * (a.pose[0] + b.pose[0]) for a, b in pairs]
    count = max(2, -(-len(pairs) // _SHARE_PAIRS))
    shares = [[pairs[k] for k in sorted(share)]
              for share in np.array_split(np.argsort(middles, kind="stable"), count) if len(share)]
    positions = np.array([one.pose[:3] for one in known])
    found = run_tasks(_ask, [(grasp_model, share, positions, chart, round(most / len(shares)))
                             for share in shares],
                      workers=workers, progress=progress, message="between neighbouring poses")
    return ([one for added, _ in found for one in added],
            np.concatenate([torn for _, torn in found]))


def disagreeing(known: Sequence[Solved], chart: Chart, length: float) -> list[Pair]:
    """Return the pairs of neighbours that do not agree, those first that agree least.

    ``length`` [m] is the branch's.
    """
    flat = chart.map(np.array([one.pose[:3] for one in known]))
    edges = neighbours(flat)
    jumps = np.array([jump(known[a], known[b]) for a, b in edges])
    apart = np.linalg.norm(flat[edges[:, 0]] - flat[edges[:, 1]], axis=1)
    wrong = (jumps > _JUMP * length) & (apart > _LEAST * length)
    order = np.flatnonzero(wrong)[np.argsort(-jumps[wrong], kind="stable")]
    return [(known[edges[k, 0]], known[edges[k, 1]]) for k in order]


def neighbours(flat: np.ndarray) -> np.ndarray:
    """Return the pairs of ``flat`` places [m, 3] that share an edge of the Delaunay tetrahedra,
    shape [e, 2]."""
    corners = Delaunay(flat).simplices
    return np.unique(np.sort(np.concatenate(
        [corners[:, [a, b]] for a in range(4) for b in range(a + 1, 4)]), axis=1), axis=0)


def jump(first: Solved, second: Solved) -> float:
    """Return how far apart two neighbours foretell the tip, or a target, half-way [m].

    By the slopes of each; where one has none, by the other's alone.
    """
    way = second.pose[:3] - first.pose[:3]
    slopes = np.array([first.shape_slopes[:, 3:], second.shape_slopes[:, 3:]])
    sure = np.isfinite(slopes).all(axis=(1, 2))
    change = way @ slopes[sure].mean(axis=0) if sure.any() else 0.0
    off = (second.shape[3:] - first.shape[3:] - change).reshape(-1, 3)
    return float(np.linalg.norm(off, axis=1).max())


def _ask(grasp_model: GraspModel, pairs: list[Pair], positions: np.ndarray, chart: Chart,
         most: int, progress: Progress = SILENT) -> tuple[list[Solved], np.ndarray]:
    length = grasp_model.reach.arc_length
    waiting = [(-jump(*pair), number, pair) for number, pair in enumerate(pairs)]
    heapq.heapify(waiting)
    asked, added, torn = 0, [], np.empty((0, 3))
    while waiting and asked < most:
        _, _, (first, second) = heapq.heappop(waiting)
        middle = chart.curved(chart.map(np.array([first.pose[:3], second.pose[:3]]))
                              .mean(axis=0)[None])
        if len(torn) and _nearest(middle, torn) < _nearest(middle, positions):
            continue
        asked += 1
        progress(asked / most, "between neighbouring poses")
        found = _half_way(grasp_model, first, second, middle)
        if found is None:
            torn = np.concatenate([torn, middle])
            continue
        added.append(found)
        positions = np.concatenate([positions, middle])
        for pair in ((first, found), (found, second)):
            if (off := jump(*pair)) > _JUMP * length and np.linalg.norm(
                    pair[1].pose[:3] - pair[0].pose[:3]) > _LEAST * length:
                heapq.heappush(waiting, (-off, len(pairs) + 2 * asked + (pair[0] is found), pair))
    return added, torn


def _half_way(grasp_model: GraspModel, first: Solved, second: Solved, middle: np.ndarray,
              ) -> Solved | None:
    """Return the state at ``middle`` [1, 3] that both neighbours come to, None if there is none."""
    there = grasp_model.follow(middle, first.displacement)[0]
    if refusal(there):
        return None
    found = taken(grasp_model, there)
    if jump(found, second) < _NEARER * jump(first, second):
        return found
    back = grasp_model.follow(middle, second.displacement)[0]
    apart = grasp_model.shape(back.displacement)[3:] - found.shape[3:]
    same = not refusal(back) and np.abs(apart).max() <= _ONE * grasp_model.reach.arc_length
    return found if same else None


def _nearest(place: np.ndarray, others: np.ndarray) -> float:
    return float(np.linalg.norm(others - place, axis=1).min())
