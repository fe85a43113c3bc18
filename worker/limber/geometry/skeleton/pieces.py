"""Pieces of a scan: which belong to one plant and are bridged, and which are left away."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from limber.geometry.skeleton.skeleton import Skeleton

_NEAR = 5  # nodes of other pieces that each node is tried with
_SHORT = 0.5  # of the longest bridge allowed, up to which a piece may be of any size
_REACH = 5.0  # the longest bridge beyond, in what the smaller piece reaches
_PLANT_SHARE = 0.2  # of all points, from which a piece may be a plant of its own
_BASE_SHARE = 0.12  # of a piece's reach, up to which a bridge starts at its base
_FAR_SHARE = 0.3  # from which it starts far from its base
_THICK = 0.45  # of a piece's thickest part, from which the base may be there
_GROUND = 0.2  # of the scan's height, up to which a base stands on the ground


@dataclass
class Joined:
    """What joining the pieces gave.

    Attributes:
        edges: All edges, the bridges included, shape [e, 2].
        bridges: Node pairs that were joined, shape [b, 2].
        plants: Node pairs between pieces that are plants of their own, shape [p, 2].
        label: Which piece each node belongs to now, shape [n].
    """

    edges: np.ndarray
    bridges: np.ndarray
    plants: np.ndarray
    label: np.ndarray


def join_pieces(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray, support: np.ndarray,
                *, gap: float, bridge_limit: float, up: np.ndarray, join_plants: bool) -> Joined:
    """Join pieces over gaps, nearest first.

    The smaller piece of a long bridge must have some length itself: so a severed twig comes back to
    its branch, and a stray clump of pixels is joined to nothing far away.

    Two large pieces that each stand on the ground are two plants, and are not joined.

    Args:
        nodes: Positions [m], shape [n, 3].
        edges: Node pairs of a forest, shape [e, 2].
        thickness: First radii [m], shape [n].
        support: Number of points of each node, shape [n].
        gap: Steps up to this length [m] are no gap (the paper's gamma rule).
        bridge_limit: No bridge is longer [m].
        up: Which way is up, shape [3].
        join_plants: Join even what looks like two plants.
    """
    bridges: list[tuple[int, int]] = []
    while True:
        label = _labels(len(nodes), edges)
        weight = np.bincount(label, support)
        if len(weight) == 1:
            break
        made = []
        for one, other, length in _candidates(nodes, label, weight, bridge_limit):
            a, b = label[one], label[other]
            if a == b:
                continue
            small = np.flatnonzero(label == (a if weight[a] <= weight[b] else b))
            end = one if weight[a] <= weight[b] else other
            reach = float(np.linalg.norm(nodes[small] - nodes[end], axis=1).max()) + thickness[end]
            large = min(weight[a], weight[b]) > _PLANT_SHARE * support.sum()
            if length > max(_REACH * reach, _SHORT * bridge_limit) or (
                    large and length > gap and not join_plants
                    and _are_plants(nodes, thickness, label, (one, other), up)):
                continue
            made.append((one, other))
            label = np.where(label == b, a, label)
            weight[a], weight[b] = weight[a] + weight[b], 0
        if not made:
            break
        bridges += made
        edges = np.vstack([edges, made])
    plants = _apart(nodes, thickness, support, label, up)
    return Joined(edges, np.array(bridges, np.int64).reshape(-1, 2),
                  np.array(plants, np.int64).reshape(-1, 2), label)


def second_base(skeleton: Skeleton, up: np.ndarray) -> np.ndarray | None:
    """Where a tree stands on the ground a second time [m], shape [3]; None if it does not.

    A tip about as thick and as low as the root, that its branch comes down to, is the base of
    another plant, or of another stem.
    """
    nodes, parent, radius = skeleton.nodes, skeleton.parent, skeleton.radius
    height = nodes @ up / np.linalg.norm(up)
    extent = float(np.ptp(height))
    best = None
    for tip in skeleton.tips():
        chain, length = [int(tip)], 0.0
        while parent[chain[-1]] >= 0 and length < 0.1 * extent:
            length += float(np.linalg.norm(nodes[chain[-1]] - nodes[parent[chain[-1]]]))
            chain.append(int(parent[chain[-1]]))
        comes_down = height[chain[-1]] - height[tip] > 0.7 * length > 0
        thick = float(np.median(radius[chain])) > 0.6 * float(np.median(radius[:len(chain)]))
        low = height[tip] - height.min() < 0.1 * extent
        if comes_down and thick and low and (best is None or height[tip] < height[best]):
            best = int(tip)
    return None if best is None else nodes[best]


def _labels(count: int, edges: np.ndarray) -> np.ndarray:
    matrix = sparse.coo_matrix((np.ones(len(edges)), (edges[:, 0], edges[:, 1])), (count, count))
    return connected_components(matrix, directed=False)[1]


def _candidates(nodes: np.ndarray, label: np.ndarray, weight: np.ndarray, limit: float,
                ) -> list[tuple[int, int, float]]:
    """Possible bridges from each piece to others: both nodes and length, shortest first."""
    found = []
    for piece in np.setdiff1d(np.flatnonzero(weight > 0), np.argmax(weight)):
        inside = label == piece
        own, others = np.flatnonzero(inside), np.flatnonzero(~inside)
        distance, near = cKDTree(nodes[others]).query(
            nodes[own], k=min(_NEAR, len(others)), distance_upper_bound=limit)
        distance, near = distance.reshape(len(own), -1), near.reshape(len(own), -1)
        place, which = np.nonzero(distance < np.inf)
        found += zip(own[place].tolist(), others[near[place, which]].tolist(),
                     distance[place, which].tolist(), strict=True)
    return sorted(found, key=lambda bridge: bridge[2])


def _base(nodes: np.ndarray, thickness: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The lowest place where a piece is thick [m], shape [3]."""
    _, near = cKDTree(nodes).query(nodes, k=min(6, len(nodes)))
    thick = np.median(thickness[near.reshape(len(nodes), -1)], axis=1)
    able = np.flatnonzero(thick >= _THICK * np.quantile(thick, 0.9))
    return nodes[able[int(np.argmin(nodes[able] @ up))]]


def _are_plants(nodes: np.ndarray, thickness: np.ndarray, label: np.ndarray,
                bridge: tuple[int, int], up: np.ndarray) -> bool:
    """Whether two pieces each stand on the ground, not one of them on the other's end."""
    height = nodes @ up
    ground = height.min() + _GROUND * np.ptp(height)
    share = []
    for node in bridge:
        own = nodes[label == label[node]]
        base = _base(own, thickness[label == label[node]], up)
        if base @ up > ground:
            return False
        reach = float(np.linalg.norm(own - base, axis=1).max())
        share.append(float(np.linalg.norm(nodes[node] - base)) / max(reach, 1e-300))
    # The base of one on the other's far end: a stem cut near the ground.
    return min(share) > _BASE_SHARE or max(share) < _FAR_SHARE


def _apart(nodes: np.ndarray, thickness: np.ndarray, support: np.ndarray, label: np.ndarray,
           up: np.ndarray) -> list[tuple[int, int]]:
    """Nearest nodes between the largest piece and each large one that was not joined to it."""
    weight = np.bincount(label, support)
    main = np.flatnonzero(label == int(np.argmax(weight)))
    found = []
    large = np.flatnonzero(weight > _PLANT_SHARE * support.sum())
    for piece in np.setdiff1d(large, np.argmax(weight)):
        own = np.flatnonzero(label == piece)
        distance, near = cKDTree(nodes[main]).query(nodes[own])
        place = int(np.argmin(distance))
        bridge = (int(own[place]), int(main[near[place]]))
        if _are_plants(nodes, thickness, label, bridge, up):
            found.append(bridge)
    return found
