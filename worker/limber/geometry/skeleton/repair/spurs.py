"""Spurs: side twigs that hardly reach out of their carrier."""

from heapq import heappop, heappush

import numpy as np

SPUR_REACH = 2.5
"""A twig is kept if it reaches this many radii of its carrier beyond the carrier's axis."""


def prune_spurs(nodes: np.ndarray, parent: np.ndarray, thickness: np.ndarray, factor: float,
                ) -> tuple[np.ndarray, int]:
    """Mark the nodes to keep when twigs shorter than ``factor`` radii of their carrier are dropped.

    Args:
        nodes: Positions [m], shape [n, 3].
        parent: Parents, -1 for the root, shape [n].
        thickness: Radii [m], shape [n].
        factor: A side twig is kept if it reaches this many times the radius of the node it starts
            from beyond that node.

    Returns:
        Mask [n], and the number of dropped spurs.
    """
    keep, pruned = np.ones(len(nodes), bool), 0
    step = np.where(parent >= 0, np.linalg.norm(nodes - nodes[parent], axis=1), 0.0)
    children = np.bincount(parent[parent >= 0], minlength=len(nodes))
    spurs: list[tuple[float, int, list[int], int]] = []
    tips_of: dict[int, set[int]] = {}

    def follow(tip: int) -> None:
        """Note the end of a tip's twig, and the twig if it is a spur."""
        chain, length, node = [], 0.0, tip
        while parent[node] >= 0 and children[node] <= 1:
            chain.append(node)
            length += step[node]
            node = int(parent[node])
        tips_of.setdefault(node, set()).add(tip)
        if children[node] > 1 and length < factor * max(
                thickness[node], float(np.median(thickness[chain]))):
            heappush(spurs, (length, tip, chain, node))

    for tip in np.flatnonzero((children == 0) & (parent >= 0)):
        follow(int(tip))
    while spurs:
        # The shortest first: the fork may no longer be one afterwards.
        _, tip, chain, fork = heappop(spurs)
        if tip not in tips_of.get(fork, ()):
            continue
        keep[chain] = False
        pruned += 1
        children[fork] -= 1
        tips_of[fork].remove(tip)
        if children[fork] == 1:
            for other in tips_of.pop(fork):
                follow(other)
    return keep, pruned
