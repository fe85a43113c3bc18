"""Kinks within a branch that wood does not make: folded ends are dropped, others rounded."""

from dataclasses import replace

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import arc_lengths
from limber.geometry.skeleton.uncertain_parts import KINK, turns

_END = 8.0  # radii from a kink to the tip below which the rest is a folded end
_ROUNDED = 4.0  # radii on each side of a kink that are smoothed
_ROUNDS = 60


def without_kinks(skeleton: Skeleton) -> tuple[Skeleton, int]:
    """Repair kinks of over 70 degrees within runs.

    Where a run folds back near its tip and carries nothing beyond, contraction led it back along
    itself: it ends at the kink. Elsewhere nodes around the kink are smoothed to a bend that wood
    can make.

    Returns:
        The skeleton, and the number of repaired kinks.
    """
    count = 0
    while True:
        folded = _folded(skeleton)
        if not folded:
            break
        keep = np.ones(skeleton.node_count, bool)
        keep[np.concatenate(folded)] = False
        skeleton, count = skeleton.subset(keep), count + len(folded)
    nodes = skeleton.nodes.copy()
    for members in skeleton.runs():
        sharp = np.flatnonzero(turns(skeleton, members) > KINK)
        if len(sharp):
            count += int((np.diff(sharp) > 1).sum()) + 1
            _round_off(skeleton, nodes, members)
    return replace(skeleton, nodes=nodes), count


def _folded(skeleton: Skeleton) -> list[np.ndarray]:
    """Nodes of each folded end beyond its kink."""
    children, found = skeleton.child_counts(), []
    for members in skeleton.runs():
        for k in np.flatnonzero(turns(skeleton, members) > KINK):
            rest = members[k:]
            step = np.linalg.norm(np.diff(skeleton.nodes[rest], axis=0), axis=1)
            if k > 1 and len(rest) > 1 and (children[rest] < 2).all() and (
                    step.sum() < _END * skeleton.radius[rest[0]]):
                found.append(rest[1:])
                break
    return found


def _round_off(skeleton: Skeleton, nodes: np.ndarray, members: np.ndarray) -> None:
    """Smooth a run's ``nodes`` around its kinks, in place."""
    for _ in range(_ROUNDS):
        now = skeleton.moved(nodes)
        sharp = np.flatnonzero(turns(now, members) > KINK)
        if len(sharp) == 0:
            return
        along = arc_lengths(nodes[members])
        reach = _ROUNDED * skeleton.radius[members[sharp]]
        near = (np.abs(along[:, None] - along[sharp]) < reach).any(axis=1)
        near[[0, -1]] = False
        inner = np.flatnonzero(near)
        old = nodes[members]
        nodes[members[inner]] = 0.5 * old[inner] + 0.25 * (old[inner - 1] + old[inner + 1])
