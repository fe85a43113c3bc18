"""Free ends of a scan's pieces, and where they point."""

from dataclasses import dataclass, field

import numpy as np

_CHAIN = 6.0  # radii of an end over which its direction is measured
_CHAIN_NODES = 4  # and at least this many nodes
UNSURE = 2
"""Number of nodes up to which a piece has no reliable direction."""
_BEYOND, _LONG = 3, 0.9  # nodes past a fork that show the axis's direction; ratio of equal lengths


@dataclass(frozen=True)
class Ends:
    """Free ends of pieces: nodes [k], outward unit vectors [k, 3], zero where there is none, and
    the typical thickness near each [k] [m]."""

    node: np.ndarray
    direction: np.ndarray
    radius: np.ndarray


def free_ends(nodes: np.ndarray, edges: np.ndarray, thickness: np.ndarray,
              joints: np.ndarray | None = None, known: "Known | None" = None,
              ) -> Ends:
    """Find the ends of all pieces and where they point. A twig that joined a stem's end by an edge
    of ``joints`` [j, 2], the bridge's node first, does not close that end. ``known`` comes from
    calls with fewer edges between the same nodes, and gets these results."""
    found = {} if known is None else known.ends
    near: list[list[int]] = [[] for _ in range(len(nodes))]
    for a, b in edges.tolist():
        near[a].append(b)
        near[b].append(a)
    reaching = set()
    for bridge, side in ([] if joints is None else joints.tolist()):
        near[bridge].remove(side)
        near[side].remove(bridge)
        reaching.add(bridge)
    ends = [node for node, others in enumerate(near) if len(others) <= 1 and node not in reaching]
    for end in ends:
        if end not in found or not found[end].holds(near):
            found[end] = _end(nodes, _Neighbours(near), thickness, end)
    return Ends(np.array(ends, np.int64),
                np.array([found[end].direction for end in ends]).reshape(-1, 3),
                np.array([found[end].radius for end in ends], float))


@dataclass
class Known:
    """Results of earlier calls, valid where nothing has changed since: of each end, the sums
    [n, 3, 3] of squares of each node's edges [m^2], and the axes' directions [n, 3] from them."""

    ends: dict[int, "KnownEnd"] = field(default_factory=dict)
    sums: np.ndarray = field(default_factory=lambda: np.empty((0, 3, 3)))
    axes: np.ndarray = field(default_factory=lambda: np.empty((0, 3)))

    def copy(self) -> "Known":
        """The same, to which further results are added."""
        return Known(dict(self.ends), self.sums, self.axes)


@dataclass(frozen=True)
class KnownEnd:
    """Result for an end, and all the neighbours that it depended on."""

    direction: np.ndarray
    radius: float
    asked: dict[int, list[int]]

    def holds(self, near: list[list[int]]) -> bool:
        """Whether those neighbours are still the same."""
        return all(near[node] == others for node, others in self.asked.items())


class _Neighbours:
    """Neighbours of nodes, and a record of which were asked for."""

    def __init__(self, near: list[list[int]]) -> None:
        self._near = near
        self.asked: dict[int, list[int]] = {}

    def __getitem__(self, node: int) -> list[int]:
        self.asked[node] = self._near[node]
        return self._near[node]


def _end(nodes: np.ndarray, near: _Neighbours, thickness: np.ndarray, end: int) -> KnownEnd:
    # Points are also missing beside an end, where it looks thinner than it is.
    chain = _straight_chain(nodes, near, end, _CHAIN * thickness[end])
    chain = _straight_chain(nodes, near, end, _CHAIN * float(thickness[chain].max()))
    # A stub beside a longer axis has neither its thickness nor its direction.
    chain = chain[:_beside(nodes, near, thickness, chain)]
    direction = _direction(nodes[chain]) if len(chain) > UNSURE else np.zeros(3)
    return KnownEnd(direction, float(np.median(thickness[chain])), near.asked)


def _straight_chain(nodes: np.ndarray, near: _Neighbours, end: int, reach: float,
                    before: int = -1) -> list[int]:
    """Nodes inwards from an end, straight on at forks, as far as ``reach`` [m]; with ``before``,
    from a node within a piece and away from that neighbour."""
    chain, length = [end], 0.0
    while length < reach or len(chain) < _CHAIN_NODES:
        ahead = [node for node in near[chain[-1]] if node != before]
        if not ahead:
            break
        if len(ahead) > 1 and len(chain) > 1:
            line = nodes[chain[-1]] - nodes[chain[0]]
            vector = nodes[ahead] - nodes[chain[-1]]
            cosine = vector @ line / np.maximum(np.linalg.norm(vector, axis=1), 1e-300)
            ahead = [ahead[int(np.argmax(cosine))]]
        before = chain[-1]
        length += float(np.linalg.norm(nodes[ahead[0]] - nodes[before]))
        chain.append(ahead[0])
    return chain


def _beside(nodes: np.ndarray, near: _Neighbours, thickness: np.ndarray, chain: list[int],
            ) -> int:
    """Number of an end's nodes that belong to a stub beside a longer axis; all if it is no stub. At
    a fork, that axis goes on along an arm that is longer than the stub and turns less."""
    length = 0.0
    for k in range(1, len(chain) - 1):
        fork, ahead = chain[k], chain[k + 1]
        stub = nodes[chain[0]] - nodes[fork]
        length += float(np.linalg.norm(nodes[fork] - nodes[chain[k - 1]]))
        inwards = nodes[chain[min(k + _BEYOND, len(chain) - 1)]] - nodes[fork]
        for other in near[fork]:
            if other in (chain[k - 1], ahead):
                continue
            reach = max(length, _CHAIN * float(thickness[fork]))
            arm = _straight_chain(nodes, near, other, reach, before=fork)
            goes_on = nodes[arm[-1]] - nodes[fork]
            if float(np.linalg.norm(goes_on)) > _LONG * reach and (
                    _cosine(inwards, goes_on) < _cosine(inwards, stub)):
                return k
    return len(chain)


def _cosine(one: np.ndarray, other: np.ndarray) -> float:
    return float(one @ other) / max(float(np.linalg.norm(one) * np.linalg.norm(other)), 1e-300)


def _direction(chain: np.ndarray) -> np.ndarray:
    """Unit vector of a chain's own line, towards its first node, shape [3]."""
    line = np.linalg.svd(chain - chain.mean(axis=0), full_matrices=False)[2][0]
    out = chain[0] - chain[-1]
    line = line if line @ out >= 0 else -line
    return line if out.any() else np.zeros(3)
