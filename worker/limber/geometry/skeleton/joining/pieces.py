"""Pieces of a scan: what they are while they are being joined."""

from dataclasses import dataclass, field, replace

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components

from limber.geometry.skeleton.joining.bridges import Hypotheses, filled
from limber.geometry.skeleton.joining.free_ends import Ends, Known, free_ends

# Length in thicknesses, under which a piece tells no direction; and if it has few points.
_SPECK, _SPECK_FEW, _FEW = 5.0, 10.0, 30


@dataclass
class Joined:
    """What joining the pieces gave.

    Attributes:
        nodes: All nodes [m], those along bridges after the given ones, shape [n, 3].
        thickness: First radii [m], shape [n].
        support: Number of points of each node, none along bridges, shape [n].
        spread: How far its points reach from each node [m], 0 along bridges, shape [n].
        edges: All edges, the bridges included, shape [e, 2].
        bridges: Node pairs that were joined, shape [b, 2].
        prices: What each bridge cost over its length: 1 where an end goes straight on into
            another as thick, more the odder the bridge is, shape [b].
        plants: Node pairs between pieces that are plants of their own, shape [p, 2].
        label: Which piece each node belongs to now, shape [n].
        joints: Edges by which bridges joined the side of a piece, the bridge's node first, shape
            [j, 2].
        piece: Which of the given pieces each node is of, -1 along bridges, shape [n].
        known: What was found of ends and axes on the way here.
        rounds: How it came to this, see :class:`Round`.
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

    def copy(self, rounds: list["Round"]) -> "Joined":
        """A state that goes on by itself, after these ``rounds``."""
        return replace(self, known=self.known.copy(), rounds=list(rounds))

    def ends(self) -> Ends:
        """The free ends of the pieces."""
        return free_ends(self.nodes, self.edges, self.thickness, self.joints, self.known)

    def bridge(self, ends: Ends, found: Hypotheses, place: int, step: float) -> None:
        """Add a bridge, with nodes along it that others may be joined to."""
        one, other = int(found.one[place]), int(found.other[place])
        curve, thick = filled(self.nodes, self.thickness, ends, one, other, step)
        chain = np.concatenate([[one], len(self.nodes) + np.arange(len(curve)), [other]])
        self.edges = np.vstack([self.edges, np.stack([chain[:-1], chain[1:]], axis=1)])
        if not found.meets[place]:
            own, met = (_pointing(ends, node) for node in (one, other))
            if met > 0:
                # Of two ends side by side the thicker one goes on.
                joint = chain[[1, 0]] if own > met else chain[[-2, -1]]
                self.joints = np.vstack([self.joints, joint])
        self.nodes = np.vstack([self.nodes, curve])
        self.thickness = np.concatenate([self.thickness, thick])
        self.support = np.concatenate([self.support, np.zeros(len(curve), self.support.dtype)])
        self.spread = np.concatenate([self.spread, np.zeros(len(curve))])
        self.bridges = np.vstack([self.bridges, [one, other]])
        self.piece = np.concatenate([self.piece, np.full(len(curve), -1)])
        self.prices = np.append(self.prices, found.price[place] / found.length[place])

    def lengths(self) -> np.ndarray:
        """Of each bridge [m], shape [b]."""
        return np.linalg.norm(self.nodes[self.bridges[:, 0]] - self.nodes[self.bridges[:, 1]],
                              axis=1)

    def cost(self) -> float:
        """What all bridges cost [m]."""
        return float(self.prices @ self.lengths())


@dataclass(frozen=True)
class Round:
    """A round of bridges.

    Attributes:
        before: What there was before it.
        alone: Whether pieces that tell no direction had to wait.
        decisive: The pairs of given pieces between which a hypothesis mattered. Without those of
            any other pair the round is the same.
        ways: Between ends and nodes, all that could have been hypotheses.
    """

    before: Joined
    alone: bool
    decisive: set[tuple[int, int]]
    ways: int


@dataclass(frozen=True)
class Rules:
    """What bridges may be, as :func:`join_pieces` has it."""

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
    """A number for each node, shape [n]: its own, but one for all of a piece too short to point.

    Of a few points of a branch contraction makes a short line in any direction; whoever is joined
    to it in its middle finds no end to go on from.
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
