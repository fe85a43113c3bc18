"""Nodes along runs, at distances proportional to the radius and no closer than the points."""

from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import resample

_NEIGHBOURS = 4  # of a point that show how far apart they are
_NEAR = 8  # points around a node that count


def resampled(skeleton: Skeleton, spacing: float = 1.0, least: np.ndarray | float = 0.0,
              ) -> Skeleton:
    """Return the skeleton with nodes ``spacing`` local radii apart along each run.

    Args:
        skeleton: Any.
        spacing: Distance of nodes in local radii.
        least: Smallest distance of nodes [m] at each node of ``skeleton``, shape [n], or at all.
    """
    least = np.broadcast_to(least, skeleton.node_count)
    nodes: list[np.ndarray] = []
    radius: list[np.ndarray] = []
    parent: list[np.ndarray] = []
    made: dict[int, np.ndarray] = {}
    count = 0
    for run, members in enumerate(skeleton.runs()):
        points, thick = skeleton.curve(run)
        new_points, new_radius = resample(
            points, thick, np.maximum(spacing * thick, least[members]))
        if run == 0:
            hang = np.arange(len(new_points)) - 1
        else:
            carrier = made[int(skeleton.branch[members[0]])]
            node = carrier[int(np.argmin(np.linalg.norm(
                np.vstack(nodes)[carrier] - points[0], axis=1)))]
            new_points, new_radius = new_points[1:], new_radius[1:]
            hang = np.concatenate([[node], count + np.arange(len(new_points) - 1)])
        made[run] = count + np.arange(len(new_points))
        count += len(new_points)
        nodes.append(new_points)
        radius.append(new_radius)
        parent.append(hang)
    return Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))


@dataclass(frozen=True)
class PointSpacing:
    """How far apart the points of a scan are.

    Attributes:
        tree: Of the points [m].
        distance: Mean distance of each point from its nearest neighbours [m], shape [m].
    """

    tree: cKDTree
    distance: np.ndarray

    @classmethod
    def of(cls, points: np.ndarray) -> "PointSpacing":
        """The spacing of points [m], shape [m, 3]."""
        tree = cKDTree(points)
        near = tree.query(points, k=min(_NEIGHBOURS + 1, len(points)))[0]
        return cls(tree, near[:, 1:].mean(axis=1))

    def at(self, places: np.ndarray) -> np.ndarray:
        """The spacing around places [m, shape [n, 3]], shape [n]."""
        near = self.tree.query(places, k=min(_NEAR, len(self.distance)))[1]
        return self.distance[near.reshape(len(places), -1)].mean(axis=1)
