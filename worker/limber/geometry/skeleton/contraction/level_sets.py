"""Level sets of the scan's connectivity, measured from the root: for sparse scans and for leaves.

Where twigs are a few points thick, contraction merges neighbouring ones into one branch. A leaf is
not a cylinder to which an axis could be fitted. Shortest paths along the scan keep twigs apart as
long as the scan does: connected points at about the same distance from the root along the plant
form one section of one branch. Verroust and Lazarus: Extracting skeletal curves from 3D scattered
data (2000); for scanned trees Xu, Gossett and Chen: Knowledge and heuristic-based modeling of
laser-scanned trees (2007).
"""

import numpy as np
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from limber.geometry.skeleton.contraction.curve_graph import (
    CurveGraph,
    keep_largest,
    neighbour_links,
    spreads,
)
from limber.geometry.skeleton.joining.join_pieces import join_pieces
from limber.geometry.skeleton.joining.pieces import edge_matrix, labels

POINT_LIMIT = 30_000
"""Most points from which levels are made. More take longer and separate no finer twigs."""

_WIDTH = 3.0  # width of a level, in median distances to the nearest point
_SPARSE = 0.65  # displacement of points, in their own spacing
_SPARSE_QUANTILE = 0.1


def is_sparse(points: np.ndarray, contracted: np.ndarray) -> bool:
    """Whether part of the scan shows branches too sparsely for contraction to separate them.

    There, points moved towards an axis by less than their spacing. For that tenth of the points the
    ratio is over 0.75 in scans of single branches, under 0.57 in trees and in sparse scans.

    Args:
        points: Scanned points [m], shape [n, 3].
        contracted: The same points after contraction [m], shape [n, 3].
    """
    drawn = np.linalg.norm(points - contracted, axis=1)
    _, near = cKDTree(contracted).query(contracted, k=min(16, len(points)))
    thickness = np.median(drawn[near], axis=1)
    own = np.median(cKDTree(points).query(points, k=min(5, len(points)))[0][:, 1:], axis=1)
    share = thickness / np.maximum(own, 1e-300)
    return float(np.quantile(share, _SPARSE_QUANTILE)) < _SPARSE


def level_graph(points: np.ndarray, source: np.ndarray, *, gap_factor: float,
                bridge_limit: float, up: np.ndarray, join_plants: bool = False,
                width: float | None = None) -> CurveGraph:
    """Make the tree of a scan's levels.

    Args:
        points: Scanned points [m], shape [n, 3].
        source: Position of the root [m], shape [3].
        gap_factor: The paper's gamma: a step longer than this many median steps is a gap.
        bridge_limit: Gaps up to this length [m] are bridged; beyond it, the smaller piece is
        discarded.
        up: The up direction, shape [3].
        join_plants: Join even pieces that look like two plants.
        width: Width of a level [m]; None: as narrow as the points' spacing allows.
    """
    links, spacing = neighbour_links(points)
    distance, before = _along_plant(points, links, source)
    level = np.floor(distance / max(width or 0.0, _WIDTH * spacing)).astype(np.int64)
    same = links[level[links[:, 0]] == level[links[:, 1]]]
    owner = labels(len(points), same)
    support = np.bincount(owner)
    nodes = np.stack([np.bincount(owner, points[:, k]) for k in range(3)], axis=1)
    nodes /= support[:, None]
    parent = _parents(owner, before)
    thickness = np.maximum(_thickness(points, owner, nodes, parent, support), 0.3 * spacing)
    below = np.flatnonzero(parent >= 0)
    edges = np.stack([below, parent[below]], axis=1)
    graph = CurveGraph(nodes, edges, thickness, support)
    step = np.linalg.norm(nodes[edges[:, 0]] - nodes[edges[:, 1]], axis=1)
    gap = gap_factor * (float(np.median(step)) if len(step) else spacing)
    joined = join_pieces(nodes, edges, thickness, support, spreads(points, owner, nodes), gap=gap,
                         bridge_limit=bridge_limit, up=up, join_plants=join_plants)
    kept = keep_largest(graph, joined, gap)
    graph.owner = np.where(kept, np.cumsum(kept) - 1, -1)[owner]
    return graph


def _along_plant(points: np.ndarray, links: np.ndarray, source: np.ndarray,
                 ) -> tuple[np.ndarray, np.ndarray]:
    """Distance of each point along the scan, and the previous point on its path, -1 at starts.

    An unconnected piece starts again where it is nearest to those already processed.
    """
    length = np.linalg.norm(points[links[:, 0]] - points[links[:, 1]], axis=1)
    graph = edge_matrix(len(points), links, np.maximum(length, 1e-12))
    graph = graph.maximum(graph.T)
    _, piece = connected_components(graph, directed=False)
    distance, before = np.full(len(points), np.inf), np.full(len(points), -1)
    # A single start, although levels near it are oblique. Starting from all points around a cut
    # gave more spurs.
    starts = np.array([np.argmin(np.linalg.norm(points - source, axis=1))])
    while True:
        from_start, previous, _ = dijkstra(graph, directed=False, indices=starts, min_only=True,
                                           return_predecessors=True)
        fresh = np.isfinite(from_start)
        distance[fresh], before[fresh] = from_start[fresh], previous[fresh]
        rest = np.flatnonzero(np.isinf(distance))
        if len(rest) == 0:
            return distance, np.where(before < 0, -1, before)
        gap, _ = cKDTree(points[np.isfinite(distance)]).query(points[rest])
        order = np.argsort(gap, kind="stable")
        _, first = np.unique(piece[rest[order]], return_index=True)
        nearest = order[first]
        starts = rest[nearest[gap[nearest] <= 1.5 * gap[nearest].min()]]


def _parents(owner: np.ndarray, before: np.ndarray) -> np.ndarray:
    """The node from which most of each node's points were reached, -1 at starts."""
    across = np.flatnonzero(before >= 0)
    across = across[owner[before[across]] != owner[across]]
    pairs, count = np.unique(np.stack([owner[across], owner[before[across]]], axis=1), axis=0,
                             return_counts=True)
    parent = np.full(int(owner.max()) + 1, -1)
    order = np.argsort(count, kind="stable")
    parent[pairs[order, 0]] = pairs[order, 1]  # the last one written stays: the most frequent
    return parent


def _thickness(points: np.ndarray, owner: np.ndarray, nodes: np.ndarray, parent: np.ndarray,
               support: np.ndarray) -> np.ndarray:
    """Mean distance of each node's points from the line to its neighbours [m], shape [n]."""
    own = np.arange(len(nodes))
    upper = np.where(parent >= 0, parent, own)
    lower = own.copy()
    order = np.argsort(support, kind="stable")
    order = order[parent[order] >= 0]
    lower[parent[order]] = order
    axis = nodes[lower] - nodes[upper]
    axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]
    offset = points - nodes[owner]
    along = np.einsum("ij,ij->i", offset, axis[owner])
    across = np.linalg.norm(offset - along[:, None] * axis[owner], axis=1)
    thick = np.bincount(owner, across) / support
    return np.median([thick, thick[upper], thick[lower]], axis=0)
