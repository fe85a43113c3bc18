"""Kinks within a branch that wood does not make: folded ends go, others are rounded."""

from dataclasses import replace

import numpy as np

from limber.geometry.skeleton.doubts import KINK, turns
from limber.geometry.skeleton.skeleton import Skeleton

_END = 8.0  # radii from a kink to the tip, up to which what lies beyond is a folded end
_ROUNDED = 4.0  # radii to each side of a kink that are evened out
_ROUNDS = 60


def without_kinks(skeleton: Skeleton) -> tuple[Skeleton, int]:
    """Mend kinks of over 70 degrees within runs.

    Where a run folds back near its tip and carries nothing beyond, contraction led it back along
    itself: it ends at the kink. Elsewhere nodes around the kink are evened out, as far as wood
    bends.

    Returns:
        The skeleton, and how many kinks were mended.
    """
    keep, count = np.ones(skeleton.node_count, bool), 0
    children = skeleton.child_counts()
    for members in skeleton.runs():
        sharp = np.flatnonzero(turns(skeleton, members) > KINK)
        for place in sharp:
            beyond = members[place + 1:]
            step = np.linalg.norm(np.diff(skeleton.nodes[members[place:]], axis=0), axis=1)
            if place > 1 and step.sum() < _END * skeleton.radius[members[place]] and (
                    children[members[place:]] < 2).all():
                keep[beyond] = False
                count += 1
                break
    if not keep.all():
        skeleton = skeleton.subset(keep)
    nodes = skeleton.nodes.copy()
    for members in skeleton.runs():
        sharp = np.flatnonzero(turns(skeleton, members) > KINK)
        if len(sharp):
            count += int((np.diff(sharp) > 1).sum()) + 1
            _round_off(skeleton, nodes, members)
    return replace(skeleton, nodes=nodes), count


def _round_off(skeleton: Skeleton, nodes: np.ndarray, members: np.ndarray) -> None:
    """Even out a run's ``nodes`` around its kinks, in place."""
    for _ in range(_ROUNDS):
        now = skeleton.moved(nodes)
        sharp = np.flatnonzero(turns(now, members) > KINK)
        if len(sharp) == 0:
            return
        along = np.concatenate([[0], np.cumsum(np.linalg.norm(
            np.diff(nodes[members], axis=0), axis=1))])
        reach = _ROUNDED * skeleton.radius[members[sharp]]
        near = (np.abs(along[:, None] - along[sharp]) < reach).any(axis=1)
        near[[0, -1]] = False
        inner = np.flatnonzero(near)
        old = nodes[members]
        nodes[members[inner]] = 0.5 * old[inner] + 0.25 * (old[inner - 1] + old[inner + 1])
