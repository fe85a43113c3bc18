"""Two parallel axes in one branch, which the contraction leaves where a scan has holes."""

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton


def without_duplicate_axes(skeleton: Skeleton) -> tuple[Skeleton, int]:
    """Drop side runs that lie mostly inside others, thinnest first; also return their number."""
    count, run = 0, skeleton.branch_count - 1
    while run > 0:
        if _is_duplicate(skeleton, run):
            skeleton, count = skeleton.subset(skeleton.branch != run), count + 1
            run = skeleton.branch_count
        run -= 1
    return skeleton, count


def _is_duplicate(skeleton: Skeleton, run: int) -> bool:
    """Whether a side run has no twigs of its own and is mostly inside the others."""
    own = np.flatnonzero(skeleton.branch == run)
    carried = (skeleton.branch[skeleton.parent[1:]] == run) & (skeleton.branch[1:] != run)
    if carried.any():
        return False
    # Other runs that could contain it: only those nearby.
    middle = skeleton.nodes[own].mean(axis=0)
    span = np.linalg.norm(skeleton.nodes[own] - middle, axis=1).max()
    reach = 2 * span + 1.4 * float(skeleton.radius.max())
    others = np.flatnonzero((skeleton.branch != run)
                            & (np.linalg.norm(skeleton.nodes - middle, axis=1) < reach))
    if len(others) == 0:
        return False
    gap = np.linalg.norm(skeleton.nodes[own][:, None] - skeleton.nodes[others], axis=2)
    near = np.argmin(gap, axis=1)
    # A duplicate may be the thicker one of the two.
    thick = np.maximum(skeleton.radius[others][near], skeleton.radius[own])
    share = gap[np.arange(len(own)), near] / thick
    return float(np.median(share)) < 1.3
