"""Spurs: side twigs that hardly reach out of their carrier."""

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
    while True:
        children = np.bincount(parent[keep & (parent >= 0)], minlength=len(nodes))
        spurs = []
        for tip in np.flatnonzero(keep & (children == 0) & (parent >= 0)):
            chain, length, node = [], 0.0, tip
            while parent[node] >= 0 and children[node] <= 1:
                chain.append(node)
                length += step[node]
                node = parent[node]
            if children[node] > 1 and length < factor * max(
                    thickness[node], float(np.median(thickness[chain]))):
                spurs.append((length, chain))
        if not spurs:
            return keep, pruned
        # Only the shortest: the fork may no longer be one afterwards.
        _, chain = min(spurs, key=lambda spur: spur[0])
        keep[chain] = False
        pruned += 1
