"""Pieces, or tips of one, that are on the ground as separate plants."""

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.skeleton import Skeleton

PLANT_SHARE = 0.2
"""Fraction of all points from which a piece may be a separate plant."""
_BASE_SHARE = 0.12  # fraction of a piece's extent within which a bridge starts at its base
_FAR_SHARE = 0.3  # fraction from which it starts far from the base
_THICK = 0.45  # fraction of a piece's largest thickness above which the base may be there
_GROUND = 0.2  # fraction of the scan's height below which a base stands on the ground


def are_plants(nodes: np.ndarray, thickness: np.ndarray, label: np.ndarray,
                bridge: tuple[int, int], up: np.ndarray) -> bool:
    """Whether two pieces are each on the ground, and neither base is on the other's end."""
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


def plants_apart(nodes: np.ndarray, thickness: np.ndarray, support: np.ndarray,
                 label: np.ndarray, up: np.ndarray) -> list[tuple[int, int]]:
    """Nearest nodes between the largest piece and each large one that was not joined to it."""
    weight = np.bincount(label, support)
    main = np.flatnonzero(label == int(np.argmax(weight)))
    found = []
    large = np.flatnonzero(weight > PLANT_SHARE * support.sum())
    for piece in np.setdiff1d(large, np.argmax(weight)):
        own = np.flatnonzero(label == piece)
        distance, near = cKDTree(nodes[main]).query(nodes[own])
        k = int(np.argmin(distance))
        bridge = (int(own[k]), int(main[near[k]]))
        if are_plants(nodes, thickness, label, bridge, up):
            found.append(bridge)
    return found


def _base(nodes: np.ndarray, thickness: np.ndarray, up: np.ndarray) -> np.ndarray:
    """The lowest position where a piece is thick [m], shape [3]."""
    _, near = cKDTree(nodes).query(nodes, k=min(6, len(nodes)))
    thick = np.median(thickness[near.reshape(len(nodes), -1)], axis=1)
    able = np.flatnonzero(thick >= _THICK * np.quantile(thick, 0.9))
    return nodes[able[int(np.argmin(nodes[able] @ up))]]


def second_base(skeleton: Skeleton, up: np.ndarray) -> np.ndarray | None:
    """Position where a tree reaches the ground a second time [m], shape [3]; None if it does not.

    A tip that is about as thick and as low as the root, and that its branch runs down to, is the
    base of another plant or stem.
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
