"""From a cloud to points on its axes: Laplacian contraction, level sets, the middle of leaves."""

import time
from dataclasses import dataclass, field, replace
from enum import StrEnum

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import connected_components, dijkstra
from scipy.spatial import cKDTree

from limber.core.progress import SILENT, Progress
from limber.geometry.skeleton.confidence import doubted
from limber.geometry.skeleton.curve_graph import CurveGraph, keep_largest, neighbour_links, spreads
from limber.geometry.skeleton.exact_factor import ExactFactor
from limber.geometry.skeleton.joining import edge_matrix, join_pieces, labels
from limber.geometry.skeleton.repair import PointSpacing, attached, resampled
from limber.geometry.skeleton.run_ends import tapered, with_full_tips
from limber.geometry.skeleton.skeleton import INTERPOLATED, Skeleton

# Laplacian-based contraction: the cloud is drawn together onto the axes of its branches.
#
# Cao, Tagliasacchi, Olson, Zhang, Su: Point Cloud Skeletons via Laplacian-Based Contraction (2010),
# following the paper: each iteration solves, in the least-squares sense,
#
#     [W_L L]        [   0   ]
#     [ W_H ]  P'  = [ W_H P ].
#
# The Laplacian is computed once, on the scan. Recomputed on the contracted points, as is usual, it
# follows every hole of the scan and takes several times as long (`scripts/bench scans`).

NEIGHBOURS = 12
"""Neighbours that the point-cloud Laplacian triangulates; 12 is as good as 30 and faster."""

_LINE_NEIGHBOURS = 20
_SOLVES = 12  # at most
_LINEAR, _FEW_LEFT = 0.95, 0.03  # when a point is contracted; fraction of others at the end
_GROWTH = 3.0
_STILL_THICK = 0.6  # fraction of points not yet on a line down to which the weights grow


class ContractionStatus(StrEnum):
    """How a contraction ended. contracted: nearly all points lie on lines; stalled: points no
    longer moved; iteration_limit: all solves were used; given: there was none, the skeleton was
    given."""

    contracted = "contracted"
    stalled = "stalled"
    iteration_limit = "iteration limit"
    given = "skeleton given"


@dataclass(frozen=True)
class Contraction:
    """Contracted points [n, 3] [m], and their linearity [n]: the share of the variance around each
    along one line, 1/3 to 1 (a curve). ``history`` has for each linear solve ``moved`` [m],
    ``active`` (fraction of points not on a curve yet) and ``seconds``."""

    points: np.ndarray
    linearity: np.ndarray
    iterations: int
    status: ContractionStatus
    history: list[dict[str, float]] = field(default_factory=list)


def contract(points: np.ndarray, *, weight: float = 1.0, progress: Progress = SILENT,
             ) -> Contraction:
    """Contract points [n, 3] [m] to the axes of their branches. ``weight`` is that of W_L relative
    to W_H at the start. WorkError if the linear system cannot be solved."""
    # A point's weight grows while the points around it are on no line, and shrinks once they are:
    # thin twigs are not shortened, and thick ones still close. W_H is constant. On 4 generated
    # branches the growing one of Cao et al. (section 4) was as good where all sides were seen; from
    # one side radii were 2.6 instead of 2.0 % off, and one fork of 12 was lost.
    scale = float(np.ptp(points, axis=0).max())
    centre = points.mean(axis=0)
    positions = (points - centre) / scale
    progress(0.0, "laplacian")
    laplacian, order = cloud_laplacian(positions), None
    weights = np.full(len(points), weight)
    history: list[dict[str, float]] = []
    status, linearity = ContractionStatus.iteration_limit, local_linearity(positions)
    for iteration in range(_SOLVES):
        started = time.perf_counter()
        drawn, order = _drawn(laplacian, weights, positions, order)
        moved = float(np.linalg.norm(drawn - positions, axis=1).mean())
        positions = drawn
        linearity = local_linearity(positions)
        active = linearity < _LINEAR
        # Beyond that fraction, only forks and noise remain, which never become lines. More weight
        # only pulls the rest off its axis.
        growth = _GROWTH if active.mean() > _STILL_THICK else 1.0
        weights *= np.where(active, growth, 0.1)
        history.append({"moved": moved * scale, "active": float(active.mean()),
                        "seconds": time.perf_counter() - started})
        progress((iteration + 1) / _SOLVES, "contracting", iteration=iteration + 1,
                 active=float(active.mean()), moved_m=moved * scale)
        if active.mean() < _FEW_LEFT:
            status = ContractionStatus.contracted
            break
        if iteration > 3 and moved * scale < 0.1 * max(done["moved"] for done in history):
            status = ContractionStatus.stalled
            break
    return Contraction(positions * scale + centre, linearity, len(history), status, history)


def cloud_laplacian(points: np.ndarray) -> sparse.csc_matrix:
    """Return the cotangent Laplacian [n, n] of a cloud (Sharp and Crane 2020); rows sum to 0."""
    import robust_laplacian

    laplacian, _ = robust_laplacian.point_cloud_laplacian(points, n_neighbors=NEIGHBOURS)
    return laplacian.tocsc()


def local_linearity(points: np.ndarray) -> np.ndarray:
    """Fraction of the variance around each point along its main direction, shape [n]."""
    count = min(_LINE_NEIGHBOURS, len(points))
    _, near = cKDTree(points).query(points, k=count)
    offset = points[near] - points[near].mean(axis=1, keepdims=True)
    variance = np.einsum("nki,nkj->nij", offset, offset)  # a library's product rounds otherwise
    total = np.trace(variance, axis1=1, axis2=2)
    return _largest_eigenvalues(variance, total / 3) / np.maximum(total, 1e-300)


def _largest_eigenvalues(matrix: np.ndarray, mean: np.ndarray) -> np.ndarray:
    """Largest eigenvalues of symmetric matrices [n, 3, 3] with mean eigenvalues ``mean`` [n], by
    Smith's closed form (1961, doi:10.1145/355578.366316): a tenth of LAPACK's time."""
    rest = matrix - mean[:, None, None] * np.eye(3)
    spread = np.sqrt((rest**2).sum(axis=(1, 2)) / 6)
    unit = rest / np.maximum(spread, 1e-300)[:, None, None]
    half = np.einsum("ni,ni->n", unit[:, 0], np.cross(unit[:, 1], unit[:, 2])) / 2
    return mean + 2 * spread * np.cos(np.arccos(np.clip(half, -1.0, 1.0)) / 3)


def _drawn(laplacian: sparse.csc_matrix, weights: np.ndarray, points: np.ndarray,
           order: np.ndarray | None) -> tuple[np.ndarray, np.ndarray]:
    """P' of (L' W_L^2 L + 1) P' = P with the diagonal of W_L, [n], and the order of elimination."""
    weighted = sparse.diags(weights) @ laplacian
    factor = ExactFactor((weighted.T @ weighted + sparse.identity(len(points))).tocsr(), order)
    return factor.solve(points), factor.order


# Level sets of the scan's connectivity, measured from the root: for sparse scans and for leaves.
#
# Where twigs are a few points thick, contraction merges neighbouring ones into one branch. A leaf
# is not a cylinder to which an axis could be fitted. Shortest paths along the scan keep twigs apart
# as long as the scan does: connected points at about the same distance from the root along the
# plant form one section of one branch. Verroust and Lazarus: Extracting skeletal curves from 3D
# scattered data (2000); for scanned trees Xu, Gossett and Chen: Knowledge and heuristic-based
# modeling of laser-scanned trees (2007).

POINT_LIMIT = 30_000
"""Most points from which levels are made. More take longer and separate no finer twigs."""

_WIDTH = 3.0  # width of a level, in median distances to the nearest point
_SPARSE = 0.65  # displacement of points, in their own spacing
_SPARSE_QUANTILE = 0.1


def is_sparse(points: np.ndarray, contracted: np.ndarray) -> bool:
    """Whether part of the scan shows branches too sparsely for contraction to separate them: points
    moved to an axis by less than their spacing. For that tenth of the points the ratio is over 0.75
    in scans of single branches, under 0.57 in trees and sparse scans."""
    drawn = np.linalg.norm(points - contracted, axis=1)
    _, near = cKDTree(contracted).query(contracted, k=min(16, len(points)))
    thickness = np.median(drawn[near], axis=1)
    own = np.median(cKDTree(points).query(points, k=min(5, len(points)))[0][:, 1:], axis=1)
    share = thickness / np.maximum(own, 1e-300)
    return float(np.quantile(share, _SPARSE_QUANTILE)) < _SPARSE


def level_graph(points: np.ndarray, source: np.ndarray, *, gap_factor: float,
                bridge_limit: float, up: np.ndarray, join_plants: bool = False,
                width: float | None = None) -> CurveGraph:
    """Make the tree of a scan's levels from the root ``source`` [3] [m]; for the rest see
    :func:`~limber.geometry.skeleton.curve_graph.curve_graph`. ``width`` is a level's [m]; None: as
    narrow as the points' spacing allows."""
    links, spacing = neighbour_links(points)
    distance, before = _along_plant(points, links, source)
    level = np.floor(distance / max(width or 0.0, _WIDTH * spacing)).astype(np.int64)
    same = links[level[links[:, 0]] == level[links[:, 1]]]
    owner = labels(len(points), same)
    support = np.bincount(owner)
    nodes = np.stack([np.bincount(owner, points[:, k]) / support for k in range(3)], axis=1)
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
    """Distance [m] of each point along the scan, and the point before it, -1 at starts. An
    unconnected piece starts where it is nearest to those done."""
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


# Axes through the middle of stems and leaves, where most points lie on no cylinder.

_EVENED = 3  # rounds of smoothing


def through_leaves(skeleton: Skeleton, points: np.ndarray, noise: float) -> Skeleton:
    """Place axes in the middle of stem and leaves without a fit, as leaves are no cylinders. A leaf
    gets its stalk's radius, for lack of a better one, marked as not measured."""
    skeleton = attached(resampled(skeleton, 1.0, PointSpacing.of(points).at(skeleton.nodes)))
    for _ in range(_EVENED):
        nodes = skeleton.nodes.copy()
        for members in skeleton.runs():
            old = skeleton.nodes[members]
            nodes[members[1:-1]] = 0.5 * old[1:-1] + 0.25 * (old[:-2] + old[2:])
        skeleton = skeleton.moved(nodes)
    skeleton = with_full_tips(tapered(skeleton), points, noise)
    skeleton = replace(skeleton, radius_sigma=0.25 * skeleton.radius,
                       radius_state=np.full(skeleton.node_count, INTERPOLATED, np.int8))
    return doubted(skeleton, points, noise)
