"""Check of a skeleton's twigs against their silhouettes in a depth camera's image.

Across the line of sight a depth camera is accurate to a pixel. Along it, readings scatter by
millimetres or centimetres, correlated over whole patches. So a twig that only sticks out along the
line of sight is taken for such scatter.
"""

import numpy as np

from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.skeleton import Skeleton


def without_hidden_twigs(skeleton: Skeleton, view: View, factor: float,
                         ) -> tuple[Skeleton, list[dict]]:
    """Drop twigs that do not leave their carrier's silhouette.

    Args:
        skeleton: Fitted to the cloud.
        view: The camera's view of the cloud.
        factor: A twig stays if, as the camera saw it, it or a twig on it reaches this many radii
            of its carrier beyond the carrier's axis.

    Returns:
        The skeleton, and for each dropped twig its ``length`` [m] and the position ``at`` of its
        tip.
    """
    runs = skeleton.runs()
    keep = np.ones(skeleton.node_count, bool)
    dropped = []
    carriers = {int(skeleton.branch[members[0]]) for members in runs[1:]}
    for run in range(len(runs) - 1, 0, -1):
        # A twig with twigs of its own is never dropped: it carries too much.
        if run in carriers:
            continue
        members = runs[run]
        carrier = runs[int(skeleton.branch[members[0]])]
        reach, radius = _beyond(skeleton, members[1:], carrier, view)
        if reach < factor * radius:
            keep[members[1:]] = False
            dropped.append({"length": _length(skeleton.nodes[members]),
                            "at": skeleton.nodes[members[-1]]})
    return (skeleton.subset(keep), dropped) if dropped else (skeleton, [])


def _beyond(skeleton: Skeleton, twig: np.ndarray, carrier: np.ndarray, view: View,
            ) -> tuple[float, float]:
    """Reach of a twig beside its carrier's axis in the image [m], and the carrier's radius [m]."""
    nodes = skeleton.nodes
    depth = float(np.linalg.norm(nodes[twig].mean(axis=0) - view.eye))
    twig_ray, carrier_ray = _rays(nodes[twig], view), _rays(nodes[carrier], view)
    start, end = carrier_ray[:-1], carrier_ray[1:]
    axis = end - start
    share = np.einsum("tkj,kj->tk", twig_ray[:, None] - start, axis) / np.maximum(
        np.einsum("kj,kj->k", axis, axis), 1e-300)
    foot = start + np.clip(share, 0, 1)[..., None] * axis
    distance = np.linalg.norm(twig_ray[:, None] - foot, axis=2)
    nearest = distance.argmin(axis=1)
    aside = distance[np.arange(len(twig)), nearest] * depth
    best = int(np.argmax(aside / skeleton.radius[carrier[1:]][nearest]))
    return float(aside[best]), float(skeleton.radius[carrier[1:]][nearest[best]])


def _rays(points: np.ndarray, view: View) -> np.ndarray:
    offset = points - view.eye
    return offset / np.linalg.norm(offset, axis=1)[:, None]


def _length(nodes: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(nodes, axis=0), axis=1).sum())
