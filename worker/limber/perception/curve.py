"""The main path of a branch as a curve that bends and twists but keeps its length.

The base stays, every piece of the curve turns: a rotation a segment, changed by a rotation field
that is piecewise linear between a few knots. Arc length therefore names a material point.
"""

from dataclasses import dataclass, replace

import numpy as np

from limber.core.numerics.rigid import rotation_matrix
from limber.geometry.skeleton.skeleton import Skeleton


@dataclass(frozen=True)
class RestCurve:
    """A branch at rest: main path [n, 3] and side nodes [s, 3] [m], arc length and radius of the
    path [n] [m], each knot's hat function at segments' middles [n - 1, knots], and the path's node
    that each side node hangs on [s]."""

    nodes: np.ndarray
    arc: np.ndarray
    radius: np.ndarray
    hats: np.ndarray
    side_nodes: np.ndarray
    side_root: np.ndarray

    @property
    def length(self) -> float:
        return float(self.arc[-1])

    @property
    def knot_count(self) -> int:
        return self.hats.shape[1]

    @classmethod
    def of(cls, skeleton: Skeleton, *, node_count: int = 81, knot_count: int = 8) -> "RestCurve":
        """Resample a skeleton's main path; what hangs beside it is carried along."""
        path = skeleton.main_path()
        along = skeleton.arc_length[path]
        arc = np.linspace(0.0, along[-1], node_count)
        nodes = np.column_stack([np.interp(arc, along, axis) for axis in skeleton.nodes[path].T])
        radius = np.interp(arc, along, skeleton.radius[path])
        middle = (arc[1:] + arc[:-1]) / 2
        # No knot at the base: the branch is rooted there and does not turn.
        knots = np.linspace(0.0, along[-1], knot_count + 1)
        hats = np.column_stack([np.interp(middle, knots, row)
                                for row in np.eye(knot_count + 1)[1:]])
        side = np.setdiff1d(np.arange(skeleton.node_count), path)
        root = _fork_arc(skeleton, path)[side]
        side_root = np.clip(np.searchsorted(arc, root), 0, node_count - 1)
        return cls(nodes, arc, radius, hats, skeleton.nodes[side], side_root)

    def start(self) -> "BentCurve":
        """Return the curve at rest."""
        turns = np.broadcast_to(np.eye(3), (len(self.nodes) - 1, 3, 3)).copy()
        return BentCurve(self, turns, np.zeros((self.knot_count, 3)))


@dataclass(frozen=True)
class BentCurve:
    """A state of a :class:`RestCurve`: each segment's rotation against rest [n - 1, 3, 3], and the
    sum of rotation steps at each knot [knots, 3] [rad], which is no rotation vector."""

    rest: RestCurve
    turns: np.ndarray
    knots: np.ndarray

    @property
    def nodes(self) -> np.ndarray:
        """Positions [m], shape [n, 3]."""
        steps = np.einsum("nij,nj->ni", self.turns, np.diff(self.rest.nodes, axis=0))
        return self.rest.nodes[0] + np.vstack([np.zeros(3), np.cumsum(steps, axis=0)])

    @property
    def side_nodes(self) -> np.ndarray:
        """Positions of side branches, carried rigidly [m], shape [s, 3]."""
        at = self.rest.side_root
        arm = self.rest.side_nodes - self.rest.nodes[at]
        turn = self.turns[np.minimum(at, len(self.turns) - 1)]
        return self.nodes[at] + np.einsum("nij,nj->ni", turn, arm)

    def at(self, arc: np.ndarray) -> np.ndarray:
        """Positions [m] at arc lengths [m], shape [m, 3]."""
        nodes = self.nodes
        return np.column_stack([np.interp(arc, self.rest.arc, axis) for axis in nodes.T])

    def turned(self, step: np.ndarray) -> "BentCurve":
        """Return the curve after a rotation step [rad] at the knots, shape [knots, 3]."""
        field = rotation_matrix(self.rest.hats @ step)
        return replace(self, turns=field @ self.turns, knots=self.knots + step)

    def jacobian(self) -> np.ndarray:
        """Derivative [n, 3, knots, 3] of the nodes [m] to a rotation step at the knots. A rotation
        d of a segment moves all nodes after it by d x (the segment's vector)."""
        steps = np.einsum("nij,nj->ni", self.turns, np.diff(self.rest.nodes, axis=0))
        cross = np.zeros((len(steps), 3, 3))
        cross[:, 0, 1], cross[:, 0, 2] = steps[:, 2], -steps[:, 1]
        cross[:, 1, 0], cross[:, 1, 2] = -steps[:, 2], steps[:, 0]
        cross[:, 2, 0], cross[:, 2, 1] = steps[:, 1], -steps[:, 0]
        each = np.einsum("nij,nk->nikj", cross, self.rest.hats)
        return np.concatenate([np.zeros((1, *each.shape[1:])), np.cumsum(each, axis=0)])


def _fork_arc(skeleton: Skeleton, path: np.ndarray) -> np.ndarray:
    """Arc length at which each node's ancestry leaves the main path [m], shape [nodes]."""
    arc = np.full(skeleton.node_count, np.nan)
    arc[path] = skeleton.arc_length[path]
    for node in range(skeleton.node_count):
        if np.isnan(arc[node]):
            arc[node] = arc[skeleton.parent[node]]
    return arc
