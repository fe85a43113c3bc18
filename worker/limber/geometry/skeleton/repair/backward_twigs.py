"""Twigs that start backwards, attached again directly to their carrier.

Where a scan lacks a twig's foot, the twig is attached to what was nearest: often a position farther
out on its
carrier, from which it first runs back. Wood forks forwards: extended back along its own line, such
a twig meets its carrier nearer to the root.
"""

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.uncertain_parts import start_angle

_BACKWARDS = np.deg2rad(80.0)  # angle to the carrier above which a twig is examined
_FORWARDS = np.deg2rad(75.0)  # largest angle after the repair
_SKIPPED, _STRAIGHT = 6.0, 10.0  # carrier radii skipped at its start, and led straight
_AHEAD, _LEAST = 8, 4  # nodes that show its own direction; fewest
_NEAR = 1.2  # carrier radii by which that line may miss the carrier's axis


def without_backward_starts(skeleton: Skeleton) -> tuple[Skeleton, int]:
    """Return the skeleton with such twigs attached again, and their number."""
    parent, keep, count = skeleton.parent.copy(), np.ones(skeleton.node_count, bool), 0
    runs = skeleton.runs()
    carried = set(np.flatnonzero(skeleton.child_counts() > 1).tolist())
    for members in runs[1:]:
        if start_angle(skeleton, members) < _BACKWARDS:
            continue
        found = _straight_back(skeleton, members, runs[int(skeleton.branch[members[0]])])
        if found is None:
            continue
        start, fork = found
        # If other runs are attached to the start that would be dropped, it stays.
        if carried.isdisjoint(members[1:start].tolist()):
            keep[members[1:start]] = False
            parent[members[start]] = fork
            count += 1
    return (skeleton.subset(keep, parent) if count else skeleton), count


def _straight_back(skeleton: Skeleton, members: np.ndarray, carrier: np.ndarray,
                   ) -> tuple[int, int] | None:
    """The position in a run from which it is straight, and the carrier's node behind it."""
    nodes, radius = skeleton.nodes, skeleton.radius
    inner = carrier[1:]
    outwards = nodes[inner] - nodes[skeleton.parent[inner]]
    start, length = float(radius[members[0]]), 0.0
    best, least = None, _NEAR
    for k in range(1, len(members) - _LEAST):
        length += float(np.linalg.norm(nodes[members[k]] - nodes[members[k - 1]]))
        if k > 1 and length > _SKIPPED * start:
            break
        first = nodes[members[k]]
        vector = nodes[members[min(k + _AHEAD, len(members) - 1)]] - first
        vector /= max(float(np.linalg.norm(vector)), 1e-300)
        to_twig = first - nodes[inner]
        back = to_twig @ vector
        missed = np.linalg.norm(to_twig - back[:, None] * vector, axis=1) / radius[inner]
        size = np.linalg.norm(outwards, axis=1) * np.linalg.norm(to_twig, axis=1)
        cosine = np.einsum("kj,kj->k", outwards, to_twig) / np.maximum(size, 1e-300)
        able = (back > 0) & (back < _STRAIGHT * start) & (cosine > np.cos(_FORWARDS))
        near = int(np.argmin(np.where(able, missed, np.inf)))
        if able[near] and missed[near] < least:
            best, least = (k, int(inner[near])), float(missed[near])
    return best
