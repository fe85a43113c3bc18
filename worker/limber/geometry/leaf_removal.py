"""Leaves of a scan: removed before the wood is reconstructed, then attached to it as mass."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree
from scipy.special import expit

from limber.core.errors import InputError, Option, Place, Text
from limber.geometry.cloud.cloud import thinned
from limber.geometry.cloud.leaves import Leaf, find_leaves, leaf_log_odds
from limber.geometry.cloud.preparation import POINT_MINIMUM, Prepared
from limber.geometry.cloud.surroundings import Part
from limber.geometry.skeleton.search_result import SkeletonResult
from limber.geometry.skeleton.skeleton import LIMITED, Skeleton
from limber.geometry.skeleton.skeletonise import FIT_POINT_LIMIT

UNASKED = 0.1
"""Fraction of the points up to which leaves are removed without the user's consent."""

LEAF_DENSITY = 0.2
"""Mass of leaves per area of one side [kg/m^2]."""

_LEAST = 0.05  # smallest fraction of points that is removed as leaves
# Distance in radii up to which a point is on a round axis; a filled blade to which a rod was fitted
# has a third of its points there.
_ON_AXIS = 0.15
_MOST = 0.5  # fraction of points that decides
# Mean of the unit vectors from the axis, for an evenly seen arc of 120 degrees. One view of a stem
# gives pi/4, since a sensor's points thin out towards the rim; a rod through a blade 0.83 to 0.97.
_ARC = np.sin(np.pi / 3) / (np.pi / 3)


def point_odds(points: np.ndarray) -> np.ndarray:
    """Logarithm of the odds that each of points [n, 3] [m] is on a leaf, shape [n], found on as
    many as a fit of axes uses; others have their nearest's. On closer points neighbourhoods a few
    spacings wide show the scan's noise, and take too much memory."""
    some = thinned(points, FIT_POINT_LIMIT)
    return leaf_log_odds(points[some])[cKDTree(points[some]).query(points)[1]]


def without_leaves(prepared: Prepared, found: SkeletonResult | None = None,
                   supports: Sequence[Part] = (), odds: np.ndarray | None = None,
                   ) -> tuple[Prepared, list[Leaf]]:
    """Return the wood of a scan, and the removed leaves: none if they have under 5 % of the
    points. ``supports``, and what is round by ``found``, the whole scan's skeleton, are no leaves.
    ``odds`` [n] are :func:`point_odds`, if known."""
    points = prepared.cloud.points
    odds = point_odds(points) if odds is None else odds
    none = np.zeros(len(points), bool) if found is None else _on_round_axes(found, points)
    for support in supports:
        none[support.points] = True
    leaves = [leaf for leaf in _leaves_of(points, odds) if none[leaf.points].mean() < _MOST]
    if leaf_mask(leaves, len(points)).mean() < _LEAST:
        return prepared, []
    return cut_off(prepared, leaves)


def cut_off(prepared: Prepared, leaves: list[Leaf]) -> tuple[Prepared, list[Leaf]]:
    """Return a scan without these leaves, and the leaves; no change if too little remains."""
    wood = ~leaf_mask(leaves, len(prepared.cloud))
    if wood.sum() < POINT_MINIMUM:
        return prepared, []
    return replace(prepared, cloud=prepared.cloud.subset(wood)), leaves


def _leaves_of(points: np.ndarray, odds: np.ndarray) -> list[Leaf]:
    """Leaves found on as many points; others go with the nearest."""
    some = thinned(points, FIT_POINT_LIMIT)
    near = cKDTree(points[some]).query(points)[1]
    return [replace(leaf, points=np.flatnonzero(np.isin(near, leaf.points)))
            for leaf in find_leaves(points[some], odds[some])]


def leafy_spread(odds: np.ndarray, leaves: list[Leaf]) -> float:
    """Standard deviation of the logarithm of the length of axes from which ``leaves`` were cut off:
    how many of the scan's points of log ``odds`` [n] are likely misjudged, over those of wood."""
    leaf = expit(odds)
    return float(np.where(leaf_mask(leaves, len(odds)), 1 - leaf, leaf).sum() / (1 - leaf).sum())


def show_leaves(prepared: Prepared, off: np.ndarray) -> bool:
    """Whether most of a scan's points off all axes, of mask ``off`` [n], look like leaves."""
    return bool(off.any()) and float(np.mean(point_odds(prepared.cloud.points)[off] > 0)) > _MOST


def check_agreed(prepared: Prepared, leaves: list[Leaf]) -> None:
    """Raise InputError if removing the leaves takes more than ``UNASKED`` of the scan."""
    share = float(leaf_mask(leaves, len(prepared.cloud)).mean())
    if share <= UNASKED:
        return
    largest = max(leaves, key=lambda leaf: leaf.area)
    # The median point: the middle of a curled blade is not on a point.
    blade = prepared.cloud.points[largest.points]
    nearest = blade[np.argmin(np.linalg.norm(blade - np.median(blade, axis=0), axis=1))]
    count = f"{len(leaves)} {'leaf' if len(leaves) == 1 else 'leaves'}"
    raise InputError(
        Text(f"{100 * share:.0f} % of the points look like {count}: they are flat and not round. "
             "The largest leaf is at ", Place(nearest), f" and has {1e4 * largest.area:.3g} cm2."),
        "Flat wood may look like a leaf, so Limber removes more "
        f"than {100 * UNASKED:.0f} % of a scan only on request.", "If these are leaves, remove "
        "them and keep their mass (", Option("leaves", "cut"), "). If they are wood, keep all "
        "points (", Option("leaves", "keep"), ").")


def _on_round_axes(found: SkeletonResult, points: np.ndarray) -> np.ndarray:
    """Mask [n] of points [n, 3] on a surface whose points cover enough of its circumference. Any
    narrow strip fits some cylinder, and a radius at its limit was not measured."""
    skeleton, node = found.skeleton, found.node_of_point
    axis = skeleton.nodes[node] - skeleton.nodes[skeleton.parent[node]]
    axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]
    aside = points - skeleton.nodes[node]
    aside -= np.einsum("ij,ij->i", aside, axis)[:, None] * axis
    aside /= np.maximum(np.linalg.norm(aside, axis=1), 1e-300)[:, None]
    count = np.maximum(np.bincount(node, minlength=skeleton.node_count), 1)
    mean = np.stack([np.bincount(node, column, skeleton.node_count) for column in aside.T], axis=1)
    is_round = (np.linalg.norm(mean / count[:, None], axis=1) < _ARC) & (
        skeleton.radius_state != LIMITED)
    return is_round[node] & (np.abs(found.residual) < _ON_AXIS * skeleton.radius[node])


def leaf_mask(leaves: list[Leaf], count: int) -> np.ndarray:
    """Return which of ``count`` points are on leaves, shape [count]."""
    found = np.zeros(count, bool)
    for leaf in leaves:
        found[leaf.points] = True
    return found


def leaf_masses(leaves: list[Leaf], points: np.ndarray, skeleton: Skeleton,
                ) -> list[dict[str, Any]]:
    """Return a row of ``point_masses.json`` for each leaf: an even sheet that hangs on the node
    nearest to any of its points; points [m, 3] [m] are in the skeleton's frame."""
    tree, masses = cKDTree(skeleton.nodes), []
    for leaf in leaves:
        blade = points[leaf.points]
        distance, node = tree.query(blade)
        centre = blade.mean(axis=0)
        second = leaf.area * LEAF_DENSITY * np.cov(blade.T, bias=True)
        masses.append({
            "kind": "leaf", "mass_kg": leaf.area * LEAF_DENSITY, "area_m2": leaf.area,
            "centre_m": centre.tolist(),
            "attached_m": skeleton.nodes[node[np.argmin(distance)]].tolist(),
            "inertia_kg_m2": (np.trace(second) * np.eye(3) - second).tolist()})
    return masses


def leaves_text(masses: list[dict[str, Any]], share: float) -> str:
    """Warning about removed leaves, the fraction ``share`` of the points."""
    count = f"{len(masses)} {'leaf' if len(masses) == 1 else 'leaves'}"
    return Text(f"Limber detected and removed {count} ({100 * share:.0f} % of the points, "
                f"{1e4 * sum(m['area_m2'] for m in masses):.0f} cm2). Their mass of "
                f"{1e3 * sum(m['mass_kg'] for m in masses):.3g} g is attached to the stems "
                f"({LEAF_DENSITY:g} kg/m^2). ", Option("leaves", "keep"), " treats all points as "
                "wood.")
