"""Check of a skeleton against a depth camera's image: twigs and radii against silhouettes.

Across the line of sight a depth camera is accurate to a pixel. Along it, readings scatter by
millimetres or centimetres, correlated over whole patches. So a twig that only sticks out along the
line of sight is taken for such scatter, and no branch is thicker than its silhouette.
"""

from dataclasses import replace

import numpy as np

from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.radii.cylinders import nearest_cylinders
from limber.geometry.skeleton.skeleton import LIMITED, MEASURED, UNRESOLVED, Skeleton

_ASIDE = 0.5  # sine of the smallest angle to the sight at which a silhouette shows the width
_WINDOW = 3  # nodes on each side whose silhouettes are combined
_SLACK = 1.2  # largest thickness over that of the silhouette
_LEAST = 8  # fewest pixels of a silhouette
_WIDE = 0.35  # deviation of a silhouette's radius; leaves and crossing branches are in it too
# Pixels that a silhouette is wider to each side: images that assign a pixel to the branch if any
# part of it is on the branch are half a pixel wider, those that decide by its middle are not.
_FATTER = 0.25
_EDGE = 0.3  # pixels; smallest deviation of a radius: each edge is known to one pixel


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


def without_edges(skeleton: Skeleton, view: View) -> Skeleton:
    """Return the skeleton with radii of whole silhouettes less what their edges may have added.

    Args:
        skeleton: With radii by the width of its points across the sight.
        view: The camera's view of the cloud.
    """
    pixel = view.pitch * np.linalg.norm(skeleton.nodes - view.eye, axis=1)
    added = np.where(skeleton.radius_state == MEASURED, _FATTER * pixel, 0.0)
    return replace(skeleton, radius=np.maximum(skeleton.radius - added, 0.5 * skeleton.radius))


def within_silhouette(skeleton: Skeleton, points: np.ndarray, view: View,
                      ) -> tuple[Skeleton, int]:
    """Limit radii to the width of the silhouettes, and widen their intervals by the pixels.

    The pixels of a piece of branch cover its length, as the camera sees it, times its width. Where
    the scatter of the depth hides the thickness of a branch, they determine its radius, which stays
    marked as not resolved.

    Args:
        skeleton: Fitted to the cloud.
        points: The cloud [m], shape [n, 3], one point per pixel that it has.
        view: The camera's view of the cloud.

    Returns:
        The skeleton, and the number of limited radii.
    """
    segment, _ = nearest_cylinders(skeleton, points)
    pixel = view.pitch * np.linalg.norm(points - view.eye, axis=1)
    area = np.bincount(segment, pixel**2, skeleton.node_count) / view.fill
    count = np.bincount(segment, minlength=skeleton.node_count)
    width = np.bincount(segment, pixel, skeleton.node_count) / np.maximum(count, 1)
    radius, state = skeleton.radius.copy(), skeleton.radius_state.copy()
    sigma = skeleton.radius_sigma.copy()
    for run, members in enumerate(skeleton.runs()):
        step = np.diff(skeleton.nodes[members], axis=0)
        seen, aside = _seen_lengths(step, skeleton.nodes[members[1:]], view)
        own = members[1:]
        seen = np.where(count[own] > 0, seen, 0.0)
        for k, node in enumerate(own):
            near = slice(max(k - _WINDOW, 0), k + _WINDOW + 1)
            total = float(seen[near].sum())
            if count[own[near]].sum() < _LEAST or total <= 0 or aside[near].min() < _ASIDE:
                continue
            half, pixels = float(area[own[near]].sum()) / (2 * total), width[own[near]].max()
            # Half a pixel to each side for what the edge may have lost, and as much for its
            # position.
            cap = _SLACK * half + pixels
            if state[node] == UNRESOLVED:
                radius[node] = max(half - _FATTER * pixels, _FATTER * pixels)
                sigma[node] = max(_WIDE * radius[node], 0.5 * pixels)
            elif radius[node] > cap:
                radius[node], state[node] = cap, LIMITED
        if run == 0 and radius[0] > 1.1 * radius[members[1]]:
            radius[0], state[0] = 1.1 * radius[members[1]], LIMITED
    limited = int(((radius < skeleton.radius) & (state == LIMITED)).sum())
    sigma = np.hypot(sigma, _EDGE * np.where(count > 0, width, np.median(pixel)))
    return replace(skeleton, radius=radius, radius_sigma=sigma, radius_state=state), limited


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


def _seen_lengths(step: np.ndarray, points: np.ndarray, view: View,
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Lengths of steps [m] as the camera sees them, and the sine of their angle to its sight."""
    ray = _rays(points, view)
    along = np.einsum("nj,nj->n", step, ray)
    seen = np.linalg.norm(step - along[:, None] * ray, axis=1)
    return seen, seen / np.maximum(np.linalg.norm(step, axis=1), 1e-300)


def _length(nodes: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(nodes, axis=0), axis=1).sum())
