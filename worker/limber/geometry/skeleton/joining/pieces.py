"""Pieces of a scan and their state during joining."""

from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components

from limber.geometry.skeleton.joining.bridges import Hypotheses, filled
from limber.geometry.skeleton.joining.free_ends import Ends, Known, free_ends

# Length in thicknesses below which a piece has no direction; that for few points; fewer points are
# few.
_SPECK, _SPECK_FEW, _FEW = 5.0, 10.0, 30


@dataclass
class Joined:
    """Result of joining the pieces.

    Attributes:
        nodes: All nodes [m], those along bridges after the given ones, shape [n, 3].
        thickness: First radii [m], shape [n].
        support: Number of points of each node, none along bridges, shape [n].
        spread: Largest distance of each node's points from it [m], 0 along bridges, shape [n].
        edges: All edges, the bridges included, shape [e, 2].
        bridges: Node pairs that were joined, shape [b, 2].
        prices: Cost of each bridge over its length, shape [b]: 1 where an end continues straight
            into another of equal thickness, higher for less plausible bridges.
        plants: Node pairs between pieces that are plants of their own, shape [p, 2].
        label: Which piece each node belongs to now, shape [n].
        joints: Edges by which bridges joined the side of a piece, the bridge's node first, shape
            [j, 2].
        piece: The given piece of each node, -1 along bridges, shape [n].
        known: Results for ends and axes found during joining.
        rounds: The rounds that led to this state, see :class:`Round`.
        rivals: For each bridge the other place for the piece that it attaches, if there is one.
    """

    nodes: np.ndarray
    thickness: np.ndarray
    support: np.ndarray
    spread: np.ndarray
    edges: np.ndarray
    bridges: np.ndarray
    prices: np.ndarray
    plants: np.ndarray
    label: np.ndarray
    joints: np.ndarray
    piece: np.ndarray
    known: Known = field(default_factory=Known)
    rounds: list["Round"] = field(default_factory=list)
    rivals: list[Any] = field(default_factory=list)

    def copy(self, rounds: list["Round"]) -> "Joined":
        """A copy of the state that changes independently, after these ``rounds``."""
        return replace(self, known=self.known.copy(), rounds=list(rounds))

    def ends(self) -> Ends:
        """The free ends of the pieces."""
        return free_ends(self.nodes, self.edges, self.thickness, self.joints, self.known)

    def bridge(self, ends: Ends, found: Hypotheses, index: int, step: float) -> None:
        """Add a bridge, with nodes along it that others may be joined to."""
        one, other = int(found.one[index]), int(found.other[index])
        curve, thick = filled(self.nodes, self.thickness, ends, one, other, step)
        chain = np.concatenate([[one], len(self.nodes) + np.arange(len(curve)), [other]])
        self.edges = np.vstack([self.edges, np.stack([chain[:-1], chain[1:]], axis=1)])
        if not found.meets[index]:
            own, met = (_pointing(ends, node) for node in (one, other))
            if met > 0:
                # Of two ends side by side, the thicker one continues.
                joint = chain[[1, 0]] if own > met else chain[[-2, -1]]
                self.joints = np.vstack([self.joints, joint])
        self.nodes = np.vstack([self.nodes, curve])
        self.thickness = np.concatenate([self.thickness, thick])
        self.support = np.concatenate([self.support, np.zeros(len(curve), self.support.dtype)])
        self.spread = np.concatenate([self.spread, np.zeros(len(curve))])
        self.bridges = np.vstack([self.bridges, [one, other]])
        self.piece = np.concatenate([self.piece, np.full(len(curve), -1)])
        self.prices = np.append(self.prices, found.price[index] / found.length[index])

    def lengths(self) -> np.ndarray:
        """Length of each bridge [m], shape [b]."""
        return np.linalg.norm(self.nodes[self.bridges[:, 0]] - self.nodes[self.bridges[:, 1]],
                              axis=1)

    def cost(self) -> float:
        """Cost of all bridges [m]."""
        return float(self.prices @ self.lengths())


@dataclass(frozen=True)
class Round:
    """A round of bridges.

    Attributes:
        before: The state before it.
        alone: Whether pieces without a direction had to wait.
        decisive: The pairs of given pieces between which a hypothesis mattered. Without the
            hypotheses of any other pair, the round is the same.
        found: All hypotheses, those of refused pairs included.
        work: Its work, in paths between ends and nodes: these, and what each node costs besides.
    """

    before: Joined
    alone: bool
    decisive: set[tuple[int, int]]
    found: Hypotheses
    work: int


@dataclass(frozen=True)
class Rules:
    """Limits on bridges, as in :func:`join_pieces`."""

    gap: float
    bridge_limit: float
    up: np.ndarray
    join_plants: bool


def _pointing(ends: Ends, node: int) -> float:
    """Radius [m] of a node that is an end with a direction of its own, else 0."""
    own = (ends.node == node) & ends.direction.any(axis=1)
    return float(ends.radius[own].sum())


def labels(count: int, edges: np.ndarray) -> np.ndarray:
    """Which piece each of ``count`` nodes belongs to, by ``edges`` [e, 2], shape [count]."""
    return connected_components(edge_matrix(count, edges), directed=False)[1]


def edge_matrix(count: int, edges: np.ndarray, weight: np.ndarray | None = None,
                ) -> sparse.csr_matrix:
    """Weights of the edges between ``count`` nodes, or ones; each edge once."""
    values = np.ones(len(edges)) if weight is None else weight
    return sparse.coo_matrix((values, (edges[:, 0], edges[:, 1])), (count, count)).tocsr()


def specks(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray, support: np.ndarray,
           ) -> np.ndarray:
    """A number for each node, shape [n]: its own, but one per piece too short for a direction.

    From a few points of a branch, contraction makes a short line in a random direction. A piece
    joined to its middle finds no end to continue from.
    """
    label = labels(len(nodes), edges)
    low, high = np.full((label.max() + 1, 3), np.inf), np.full((label.max() + 1, 3), -np.inf)
    np.minimum.at(low, label, nodes)
    np.maximum.at(high, label, nodes)
    thick = np.zeros(label.max() + 1)
    np.maximum.at(thick, label, thickness)
    few = np.bincount(label, support) < _FEW
    short = np.linalg.norm(high - low, axis=1) < np.where(few, _SPECK_FEW, _SPECK) * thick
    return np.where(short[label], len(nodes) + label, np.arange(len(nodes)))
