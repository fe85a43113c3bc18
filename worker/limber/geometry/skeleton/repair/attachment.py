"""Attachment of twigs to their carriers: the contraction draws a fork towards the twig."""

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.skeleton import Skeleton

_HOOK, _AHEAD = 5, 7  # nodes at a twig's start that may mislead; nodes that show its direction
_KINK = np.deg2rad(50.0)
# Longest start of a twig, in radii of its carrier; least kink at its end; nodes to each side.
_HOOK_REACH, _SHARP_KINK, _BESIDE = 6.0, np.deg2rad(45.0), 3
_LINE = 2.0  # length of a twig's start in carrier radii over which its direction is measured


def attached(skeleton: Skeleton) -> Skeleton:
    """Attach each side run where its own direction meets the carrier's axis.

    The contraction draws a fork towards the twig. The twig's nodes inside the carrier are dropped,
    and its line is extended back to the carrier's axis.
    """
    parent, keep = skeleton.parent.copy(), np.ones(skeleton.node_count, bool)
    runs = skeleton.runs()
    for run in range(1, len(runs)):
        members = runs[run][1:]
        carrier = runs[int(skeleton.branch[skeleton.parent[members[0]]])]
        distance, near = cKDTree(skeleton.nodes[carrier]).query(skeleton.nodes[members])
        outside = distance > 1.05 * skeleton.radius[carrier[near]]
        first = int(np.argmax(outside)) if outside.any() else len(members) - 1
        first = _past_hook(skeleton, members, min(first, max(len(members) - 2, 0)))
        keep[members[:first]] = False
        # A very thin run's first nodes are so close together that there is only noise between them.
        along = np.cumsum(np.linalg.norm(np.diff(skeleton.nodes[members[first:]], axis=0), axis=1))
        least = int(np.searchsorted(along, _LINE * skeleton.radius[carrier[near[first]]])) + 2
        ahead = members[first:first + max(least, 5)]
        if len(ahead) < 2:
            parent[members[first]] = carrier[near[first]]
            continue
        direction = skeleton.nodes[ahead[-1]] - skeleton.nodes[ahead[0]]
        direction /= np.linalg.norm(direction)
        parent[members[first]] = _meeting(skeleton, carrier, members[first], direction)
    # A run attached to dropped nodes is attached to the next kept ancestor.
    for node in range(skeleton.node_count):
        while parent[node] >= 0 and not keep[parent[node]]:
            parent[node] = parent[parent[node]]
    return skeleton.subset(keep, parent)


def _past_hook(skeleton: Skeleton, members: np.ndarray, first: int) -> int:
    """The position in a twig from which its direction continues: its start may be a hook.

    Where the scan lacks a twig's base, the twig is attached to its carrier by a short path across,
    with a kink where its own axis begins.
    """
    nodes = skeleton.nodes
    last = min(first + _HOOK, len(members) - _AHEAD)
    start = max(first, last)
    for k in range(first, last):
        step = nodes[members[k + 1]] - nodes[members[k]]
        ahead = nodes[members[k + _AHEAD - 1]] - nodes[members[k + 1]]
        size = np.linalg.norm(step) * np.linalg.norm(ahead)
        if size > 0 and step @ ahead > np.cos(_KINK) * size:
            start = k
            break
    reach = _HOOK_REACH * skeleton.radius[skeleton.parent[members[0]]]
    length = 0.0
    for k in range(start + 1, len(members) - _AHEAD):
        step = nodes[members[k]] - nodes[members[k - 1]]
        length += float(np.linalg.norm(step))
        if length > reach:
            break
        before = nodes[members[k]] - nodes[members[max(k - _BESIDE, start)]]
        ahead = nodes[members[k + _AHEAD - 1]] - nodes[members[k]]
        size = np.linalg.norm(before) * np.linalg.norm(ahead)
        if size > 0 and before @ ahead < np.cos(_SHARP_KINK) * size:
            start = k
    return start


def _meeting(skeleton: Skeleton, carrier: np.ndarray, first: int, direction: np.ndarray) -> int:
    """Carrier node nearest to the twig's line, extended back from its first node outside.

    A twig grows away from its fork: a node that its line meets ahead is excluded, unless all are
    ahead.
    """
    offset = skeleton.nodes[carrier] - skeleton.nodes[first]
    back = -(offset @ direction)
    across = np.linalg.norm(offset + back[:, None] * direction, axis=1)
    # No farther back than the carrier's thickness: at a small angle the lines meet far away.
    reach = np.linalg.norm(offset, axis=1).min() * 2.5
    allowed = np.linalg.norm(offset, axis=1) <= reach
    if (allowed & (back > 0)).any():
        allowed &= back > 0
    return int(carrier[np.argmin(np.where(allowed, across, np.inf))])
