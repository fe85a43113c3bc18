"""From contracted points to a tree of nodes: cover, connect, bridge gaps, root, prune."""

from dataclasses import dataclass, field
from typing import cast

import numpy as np
from scipy.sparse.csgraph import breadth_first_order, dijkstra, minimum_spanning_tree
from scipy.spatial import cKDTree

from limber.geometry.skeleton.joining import (
    Joined,
    bridge_evidence,
    bridge_probability,
    edge_matrix,
    join_pieces,
    specks,
)

_Z = np.array([0.0, 0.0, 1.0])


@dataclass
class CurveGraph:
    """Nodes [n, 3] [m] on the axes and the edges [e, 2] of the forest between them.

    Attributes:
        thickness: Distance [m] by which a node's points were contracted: a first radius, shape [n].
        support: Number of points of each node, shape [n].
        bridges: Each closed gap: ``from``, ``to`` [m, 3], ``length`` [m], ``price`` (1: a straight
            continuation of an end; higher: less plausible), ``thickness`` [m] of the thinner end,
            ``probability``; and another place for the piece that it attaches: ``rival_from``,
            ``rival_to`` [m, 3], ``rival_price`` [m], or None.
        split_off: Each discarded piece: ``points``, ``distance`` [m], ``at``.
        loops: Length of each closed loop that was opened [m].
        plants: Pieces that look like plants of their own, as ``split_off``; the smaller's points.
        owner: The node that each point belongs to, -1 for a discarded point, shape [m].
    """

    nodes: np.ndarray
    edges: np.ndarray
    thickness: np.ndarray
    support: np.ndarray
    bridges: list[dict] = field(default_factory=list)
    split_off: list[dict] = field(default_factory=list)
    loops: list[float] = field(default_factory=list)
    owner: np.ndarray = field(default=cast(np.ndarray, None))
    plants: list[dict] = field(default_factory=list)


def curve_graph(points: np.ndarray, contracted: np.ndarray, *, gap_factor: float,
                bridge_limit: float, up: np.ndarray = _Z, join_plants: bool = False,
                ) -> CurveGraph:
    """Cover contracted points by nodes and connect them to one tree. A gap is a step over
    ``gap_factor`` (the paper's gamma) median steps. Gaps up to ``bridge_limit`` [m] are bridged;
    beyond it the smaller piece is discarded."""
    links, spacing = neighbour_links(points)
    drawn = np.linalg.norm(points - contracted, axis=1)
    thickness = _smoothed(drawn, contracted)
    owner = cover(contracted, np.maximum(0.8 * thickness, 1.5 * spacing))
    merged = specks(means(owner, contracted), _node_links(owner, links),
                    means(owner, thickness[:, None])[:, 0], np.bincount(owner))
    _, owner = np.unique(merged[owner], return_inverse=True)
    support = np.bincount(owner)
    nodes, radius = means(owner, contracted), means(owner, thickness[:, None])[:, 0]
    edges = _node_links(owner, links)
    length = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    graph = CurveGraph(nodes, edges, radius, support)
    graph.edges, graph.loops = _spanning_forest(nodes, edges, length, radius)
    typical = float(np.median(np.linalg.norm(
        nodes[graph.edges[:, 0]] - nodes[graph.edges[:, 1]], axis=1))) if len(edges) else spacing
    joined = join_pieces(graph.nodes, graph.edges, radius, support, spreads(points, owner, nodes),
                         gap=gap_factor * typical, bridge_limit=bridge_limit, up=up,
                         join_plants=join_plants)
    kept = keep_largest(graph, joined, gap_factor * typical)
    graph.owner = np.where(kept, np.cumsum(kept) - 1, -1)[owner]
    return graph


def spreads(points: np.ndarray, owner: np.ndarray, nodes: np.ndarray) -> np.ndarray:
    """Largest distance of each node's points from it [m], shape [n]."""
    spread = np.zeros(len(nodes))
    np.maximum.at(spread, owner, np.linalg.norm(points - nodes[owner], axis=1))
    return spread


def neighbour_links(points: np.ndarray) -> tuple[np.ndarray, float]:
    """Pairs [m, 2] of near points, and the median distance [m] to the nearest. A link is at most
    four times as long as its ends' neighbourhoods are wide, so neighbouring twigs stay apart."""
    count = min(11, len(points))
    distance, near = cKDTree(points).query(points, k=count)
    spacing = float(np.median(distance[:, 1]))
    own = np.median(distance[:, 1:5], axis=1)
    limit = 4.0 * np.minimum(np.maximum(own, 0.5 * spacing)[:, None], np.maximum(
        own[near], 0.5 * spacing))
    near_enough = (distance <= limit)
    near_enough[:, 0] = False
    first, column = np.nonzero(near_enough)
    return np.stack([first, near[first, column]], axis=1), spacing


def rooted(nodes: np.ndarray, edges: np.ndarray, root: int) -> np.ndarray:
    """Parents in the tree of ``edges`` rooted at ``root``; -1 for the root, -2 if not reached."""
    _, before = breadth_first_order(edge_matrix(len(nodes), edges), root, directed=False)
    parent = np.where(before < 0, -2, before).astype(np.int64)
    parent[root] = -1
    return parent


def _smoothed(drawn: np.ndarray, contracted: np.ndarray) -> np.ndarray:
    _, near = cKDTree(contracted).query(contracted, k=min(16, len(contracted)))
    return np.median(drawn[near], axis=1)


def cover(contracted: np.ndarray, reach: np.ndarray) -> np.ndarray:
    """Greedy cover by balls of radius ``reach``; returns the node that owns each point."""
    tree = cKDTree(contracted)
    free = np.ones(len(contracted), bool)
    centres = []
    # Densest contraction first would need sorting by density; a fixed stride is as good here,
    # since points are reassigned to the nearest centre below.
    for point in range(len(contracted)):
        if free[point]:
            free[tree.query_ball_point(contracted[point], reach[point])] = False
            centres.append(point)
    _, owner = cKDTree(contracted[centres]).query(contracted)
    _, owner = np.unique(owner, return_inverse=True)
    return owner


def means(owner: np.ndarray, points: np.ndarray) -> np.ndarray:
    support = np.bincount(owner)
    return np.stack([np.bincount(owner, column) for column in points.T], axis=1) / support[:, None]


def _node_links(owner: np.ndarray, links: np.ndarray) -> np.ndarray:
    pairs = np.sort(owner[links], axis=1)
    return np.unique(pairs[pairs[:, 0] != pairs[:, 1]], axis=0).reshape(-1, 2)


def _spanning_forest(nodes: np.ndarray, edges: np.ndarray, length: np.ndarray,
                     radius: np.ndarray) -> tuple[np.ndarray, list[float]]:
    """Shortest edges first; an edge that closes a long cycle is a loop of the plant."""
    if len(edges) == 0:
        return edges, []
    tree = minimum_spanning_tree(edge_matrix(len(nodes), edges, np.maximum(length, 1e-300))).tocoo()
    kept = np.stack([tree.row, tree.col], axis=1).astype(np.int64)
    known = {tuple(sorted(edge)) for edge in kept.tolist()}
    extra = np.array([e for e in edges.tolist() if tuple(e) not in known], np.int64).reshape(-1, 2)
    if len(extra) == 0:
        return kept, []
    # Only edges between nodes that the tree holds far apart can close a loop.
    graph = edge_matrix(len(nodes), kept, tree.data)
    loops: list[float] = []
    seen = np.zeros(len(nodes), bool)
    for a, b in extra:
        if seen[a] or seen[b]:
            continue
        distance = dijkstra(graph, directed=False, indices=int(a), limit=1e3)[b]
        around = 12.0 * max(radius[a], radius[b], float(np.median(length)))
        if distance > around:
            loops.append(float(distance + np.linalg.norm(nodes[a] - nodes[b])))
            near = np.linalg.norm(nodes - nodes[a], axis=1) < around
            seen |= near
    return kept, loops


def keep_largest(graph: CurveGraph, joined: Joined, gap: float) -> np.ndarray:
    """Take the bridges of the largest piece, discard the others, return the mask [n] of kept
    nodes."""
    weight = np.bincount(joined.label, joined.support)
    main = joined.label == int(np.argmax(weight))
    graph.nodes, graph.thickness, graph.support = joined.nodes, joined.thickness, joined.support
    graph.edges = joined.edges
    for number in np.flatnonzero(main[joined.bridges[:, 0]] & (joined.lengths() > gap)):
        graph.bridges.append(_bridge(joined, int(number)))
    graph.plants = [{"points": int(weight[joined.label[pair]].min()),
                     "distance": float(np.linalg.norm(np.subtract(*graph.nodes[pair]))),
                     "at": graph.nodes[pair].mean(axis=0)} for pair in joined.plants]
    if not main.all():
        _leave_away(graph, main, joined.label)
    return main


RIVAL = ("rival_from", "rival_to", "rival_price")
"""Of a bridge in a report: where else it may lead."""


def _bridge(joined: Joined, number: int) -> dict:
    """The report on a bridge, as in :class:`CurveGraph`."""
    one, other = joined.bridges[number]
    length, price = float(joined.lengths()[number]), float(joined.prices[number])
    thick, rival = float(joined.thickness[[one, other]].min()), joined.rivals[number]
    places = (rival.end, rival.to, rival.price) if rival else (None, None, None)
    return {"from": joined.nodes[one], "to": joined.nodes[other], "length": length, "price": price,
            "thickness": thick, "probability": bridge_probability(bridge_evidence(
                price, length, thick, places[2])), **dict(zip(RIVAL, places, strict=True))}


def _leave_away(graph: CurveGraph, main: np.ndarray, label: np.ndarray) -> None:
    tree = cKDTree(graph.nodes[main])
    for piece in np.unique(label[~main]):
        members = label == piece
        distance, _ = tree.query(graph.nodes[members])
        graph.split_off.append({"points": int(graph.support[members].sum()),
                                "distance": float(distance.min()),
                                "at": graph.nodes[members].mean(axis=0)})
    new_index = np.cumsum(main) - 1
    inside = main[graph.edges[:, 0]]
    graph.edges = new_index[graph.edges[inside]]
    graph.nodes, graph.thickness = graph.nodes[main], graph.thickness[main]
    graph.support = graph.support[main]
