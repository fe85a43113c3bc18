"""Leaves of a scan, cut off before its wood is made, and hung on it again as mass."""

from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.cloud.leaves import Leaf, find_leaves
from limber.geometry.cloud.preparation import POINT_MINIMUM, Prepared
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.skeletonise import FIT_POINT_LIMIT, thinned

_LEAST = 0.05  # of the points, that leaves must be to be cut off


def without_leaves(prepared: Prepared, least: float = _LEAST) -> tuple[Prepared, list[Leaf]]:
    """Cut the leaves off a prepared scan; all of it and no leaf where they are less than ``least``.
    """
    leaves = _leaves_of(prepared.cloud.points)
    wood = ~leaf_mask(leaves, len(prepared.cloud))
    if (~wood).mean() < least or wood.sum() < POINT_MINIMUM:
        return prepared, []
    return replace(prepared, cloud=prepared.cloud.subset(wood)), leaves


def _leaves_of(points: np.ndarray) -> list[Leaf]:
    """Find the leaves of a scan, among as many of its points as its axes are fitted to.

    Leaves are told by neighbourhoods some spacings wide. Where points lie closer than a leaf needs
    these show the scan's noise, and pairs of neighbours take memory without end. Every other point
    goes with the nearest of those looked at.
    """
    some = thinned(points, FIT_POINT_LIMIT)
    leaves = find_leaves(points[some])
    if len(some) == len(points) or not leaves:
        return leaves
    leaf_of = np.full(len(some), -1)
    for number, leaf in enumerate(leaves):
        leaf_of[leaf.points] = number
    own = leaf_of[cKDTree(points[some]).query(points)[1]]
    return [Leaf(np.flatnonzero(own == number), leaf.area) for number, leaf in enumerate(leaves)]


def leaf_mask(leaves: list[Leaf], count: int) -> np.ndarray:
    """Return which of ``count`` points lie on leaves, shape [count]."""
    found = np.zeros(count, bool)
    for leaf in leaves:
        found[leaf.points] = True
    return found


def leaf_masses(leaves: list[Leaf], points: np.ndarray, skeleton: Skeleton, density: float,
                ) -> list[dict[str, Any]]:
    """Return what leaves weigh and where: sheets of even thickness on the nearest axes.

    Args:
        leaves: Of the scan.
        points: The scan [m], shape [n, 3], in the skeleton's frame.
        skeleton: The wood.
        density: Mass of a leaf's area [kg/m^2].

    Returns:
        For each leaf ``kind`` ("leaf"), ``mass_kg``, ``area_m2``, ``centre_m``, ``attached_m``
        (the node nearest to any of its points) and ``inertia_kg_m2`` about its centre.
    """
    tree, masses = cKDTree(skeleton.nodes), []
    for leaf in leaves:
        blade = points[leaf.points]
        distance, node = tree.query(blade)
        centre = blade.mean(axis=0)
        second = leaf.area * density * np.cov(blade.T, bias=True)
        masses.append({
            "kind": "leaf", "mass_kg": leaf.area * density, "area_m2": leaf.area,
            "centre_m": centre.tolist(),
            "attached_m": skeleton.nodes[node[np.argmin(distance)]].tolist(),
            "inertia_kg_m2": (np.trace(second) * np.eye(3) - second).tolist()})
    return masses


def leaves_text(masses: list[dict[str, Any]], share: float) -> str:
    """What to tell of leaves that were cut off, ``share`` of the points."""
    return (f"{len(masses)} leaves ({100 * share:.0f} % of the points, "
            f"{1e4 * sum(m['area_m2'] for m in masses):.0f} cm2) were told from the stems and cut "
            f"off. Their mass, {1e3 * sum(m['mass_kg'] for m in masses):.3g} g, hangs on the stems "
            "(--leaf-density; --leaves keep takes them as wood).")
