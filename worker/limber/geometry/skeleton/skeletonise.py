"""A scan's skeleton: thin, contract, connect, root, prune, fit."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from limber.core.errors import InputError, places_moved
from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.cloud import OwnFrame, thinned
from limber.geometry.cloud.leaves import ALIKE, leaf_evidence
from limber.geometry.cloud.single_view import View
from limber.geometry.settings import OPEN, SkeletonSettings
from limber.geometry.skeleton.confidence import assessed, likely
from limber.geometry.skeleton.contraction import (
    POINT_LIMIT,
    contract,
    is_sparse,
    level_graph,
    through_leaves,
)
from limber.geometry.skeleton.curve_graph import RIVAL, CurveGraph, curve_graph, rooted
from limber.geometry.skeleton.edits import SetRoot, edited
from limber.geometry.skeleton.joining import second_base
from limber.geometry.skeleton.likeliest_tree import rival_tree
from limber.geometry.skeleton.plausibility import check_no_sheet, check_one_plant, check_slender
from limber.geometry.skeleton.radii.fit_kernels import nearest_cylinders
from limber.geometry.skeleton.repair import SPUR_REACH, Repaired, prune_spurs, repaired
from limber.geometry.skeleton.root_end import RootChoice, root_node
from limber.geometry.skeleton.search_result import SkeletonResult
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.tree_likelihood import PointLikelihood

Apart = Callable[[np.ndarray], None]
"""Receives which points of a cloud belong to another plant or cluster, shape [n]."""

SEARCHED = 1_500
"""Most points of a scan whose likeliest tree is searched: a limit of time."""
FIT_POINT_LIMIT = 30_000
"""More points do not improve the fit; they only slow it down."""
_BRIDGE_LIMIT = 0.15  # longest bridge over a gap, as a fraction of the cloud's diagonal
_TWIG_PROBABILITY = 0.5  # twigs that are less probable are dropped
_CONTRACTED_POINTS = 12_000  # more are thinned evenly: the fit, not contraction, is precise
# Most points of a sparse scan that are contracted. Of three generated crowns of 1,500 to 3,000
# points contraction finds 93 to 99 % of the length and levels 86 to 99 %, and levels make false
# twigs of a real branch of 784. Of 9,000 and 20,000 points contraction makes more false twigs, or
# finds less.
_FEW = 5_000


def skeletonise(points: np.ndarray, settings: SkeletonSettings | None = None, *,
                root: np.ndarray | None = None, up: np.ndarray | None = None,
                view: View | None = None, show_apart: Apart | None = None,
                twig_probability: float = _TWIG_PROBABILITY, progress: Progress = SILENT,
                ) -> SkeletonResult:
    """Find the rooted skeleton of points [n, 3] [m]; InputError if they are no branch's. ``root``
    [3] [m] is near the root; None: the likeliest end. ``show_apart`` receives another plant's
    points if they are the reason."""
    # In the cloud's own frame: bounding boxes and the triangles of the Laplacian would differ for a
    # rotated one.
    own = OwnFrame.of(points)
    up = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, float)
    original_order = np.argsort(own.order)
    with places_moved(own.outside):
        found = _of_ordered(own.coordinates, settings or SkeletonSettings(),
                            None if root is None else own.inside(root), up @ own.axes,
                            None if view is None else replace(view, eye=own.inside(view.eye)),
                            None if show_apart is None else (
                                lambda apart: show_apart(apart[original_order])),
                            twig_probability, progress)
    contraction, moved = found.contraction, found.moved(own.outside)
    return replace(moved, skeleton=moved.skeleton.on_grid(), contraction=replace(
        contraction, points=own.outside(contraction.points)),
        node_of_point=found.node_of_point[original_order], residual=found.residual[original_order])


@dataclass(frozen=True)
class _Search:
    """A cloud in its own frame, ``diagonal`` [m] in size, and the search for its skeleton."""

    points: np.ndarray
    settings: SkeletonSettings
    up: np.ndarray
    diagonal: float

    def connected(self, points: np.ndarray, contracted: np.ndarray) -> CurveGraph:
        """The tree of points contracted to their axes."""
        return curve_graph(points, contracted, **self._joining())

    def root(self, graph: CurveGraph, points: np.ndarray, near: np.ndarray | None,
             ) -> RootChoice:
        """The root's node, and the likeliest ends."""
        return root_node(graph, points, near, self.up)

    def in_levels(self, points: np.ndarray, base: np.ndarray, width: float | None = None,
                  ) -> tuple[CurveGraph, int]:
        """The tree of the scan's own levels from ``base`` [m], and its root's node."""
        graph = level_graph(points, base, width=width, **self._joining())
        return graph, self.root(graph, points, base).node

    def pruned(self, graph: CurveGraph, start: int) -> tuple[Skeleton, int]:
        """A skeleton with first radii and without spurs, and the number of dropped spurs."""
        least = 1e-3 * float(np.median(graph.thickness)) + 1e-12
        first = Skeleton.from_edges(graph.nodes, rooted(graph.nodes, graph.edges, start),
                                    np.maximum(graph.thickness, least))
        keep, count = prune_spurs(first.nodes, first.parent, first.radius, SPUR_REACH)
        return first.subset(keep), count

    def to_fit(self, graph: CurveGraph, thin: np.ndarray) -> np.ndarray:
        """Points for the fit [m]: points that the graph discarded must not attract the rest."""
        some = self.points[thinned(self.points, FIT_POINT_LIMIT)]
        if (graph.owner < 0).any():
            some = some[graph.owner[cKDTree(thin).query(some)[1]] >= 0]
        return some

    def through_leaves(self, first: Skeleton, fitted: Repaired, wood: Skeleton, graph: CurveGraph,
                       start: int) -> Skeleton | None:
        """Axes through the middle of leaves, the ``first`` or those of levels; None if points are
        likelier about the cylinders that were fitted and those of ``wood``, by distances and the
        shape of their surroundings."""
        # A fit makes fat cylinders of leaves, and a search many thin twigs: that either is likely
        # is no evidence of wood, and a fit alone misses twigs of a thin scan. But one side of a
        # branch is likely about a thin axis, where nothing shows that it is one side. A depth
        # camera's readings are flat where they graze wood.
        if fitted.view is not None:
            return None
        some = fitted.points[::len(fitted.points) // SEARCHED + 1]
        scan, shape, rivals = PointLikelihood.of(some), float(leaf_evidence(some).sum()), [first]
        if shape > 0:
            rivals.append(self.pruned(*self.in_levels(fitted.points, graph.nodes[start], float(
                np.median(graph.thickness))))[0])
        best = max((through_leaves(one, some, fitted.noise) for one in rivals), key=scan.score)

        def lead(scan: PointLikelihood) -> float:
            return scan.score(best) - (scan.score(fitted.skeleton) + scan.score(wood)) / 2

        if lead(scan) > 0 and (seen := scan.where_seen(wood)).score(wood) > scan.score(wood):
            scan = seen
        return best if lead(scan) / ALIKE + shape > 0 else None  # neighbours count once

    def _joining(self) -> dict[str, Any]:
        settings = self.settings
        return {"gap_factor": settings.gap_factor, "up": self.up,
                "bridge_limit": _BRIDGE_LIMIT * self.diagonal,
                "join_plants": settings.plants == "joined"}


def _of_ordered(points: np.ndarray, settings: SkeletonSettings, root: np.ndarray | None,
                up: np.ndarray, view: View | None, show_apart: Apart | None,
                twig_probability: float, progress: Progress) -> SkeletonResult:
    """The skeleton of points in the cloud's own frame, as are ``root`` and ``up``."""
    search = _Search(points, settings, up, float(np.linalg.norm(np.ptp(points, axis=0))))
    thin = points[thinned(points, _CONTRACTED_POINTS)]
    check_no_sheet(thin)
    contraction = contract(thin, weight=settings.contraction_weight,
                           progress=progress.part(0.0, 0.6))
    progress(0.6, "connecting")
    graph = search.connected(thin, contraction.points)
    try:
        check_one_plant(graph, len(thin), search.diagonal, settings.plants)
    except InputError:
        if show_apart is not None and (graph.plants or graph.split_off):
            show_apart(graph.owner[cKDTree(thin).query(points)[1]] < 0)
        raise
    start, ends = search.root(graph, thin, root)
    if len(points) > _FEW and is_sparse(thin, contraction.points):
        thin, loops = points[thinned(points, POINT_LIMIT)], graph.loops
        graph, start = search.in_levels(thin, graph.nodes[start])
        graph.loops = loops
    first, pruned = search.pruned(graph, start)
    some = search.to_fit(graph, thin)
    fitted = repaired(first, some, view, progress.part(0.65, 0.95))
    wood, (skeleton, unlikely) = fitted.skeleton, likely(fitted.skeleton, twig_probability)
    noise, count, spread, bridges = fitted.noise, pruned, None, graph.bridges
    if len(points) <= SEARCHED:
        wood, noise, count, spread = rival_tree(skeleton, some, view, progress.part(0.95, 1.0))
        skeleton, unlikely = wood, []
        # It has compared paths over gaps: of the first ones' odds none are left.
        bridges = [bridge | dict.fromkeys(RIVAL) for bridge in bridges]
    segment, residual = nearest_cylinders(wood, points)
    check_slender(wood, points, segment, residual)
    if leafy := (middle := search.through_leaves(first, fitted, wood, graph, start)) is not None:
        skeleton, unlikely = likely(middle, twig_probability)
        noise, count, spread, bridges = fitted.noise, pruned, None, graph.bridges
    if skeleton is not wood:
        segment, residual = nearest_cylinders(skeleton, points)
    if len(ends) > 1 and ends[0]["probability"] < OPEN and not leafy:
        skeleton = _of_either_root(skeleton, fitted, ends)
    progress(1.0, "skeleton", nodes=skeleton.node_count)
    return SkeletonResult(skeleton, contraction, segment, residual, noise, bridges, graph.split_off,
                          graph.loops, count, second_base(skeleton, up), ends,
                          leafy, unlikely, spread)


def _of_either_root(skeleton: Skeleton, fitted: Repaired, ends: list[dict[str, Any]]) -> Skeleton:
    """The skeleton with deviations of the radii that hold for the next likely root too: wood tapers
    away from it."""
    seen = fitted.last_fit.seen
    rooted_there = edited(fitted.skeleton, [SetRoot(at=tuple(ends[1]["at"].tolist()))], [])
    other = assessed(rooted_there, fitted.points, fitted.noise, rays=fitted.rays,
                     one_sided=seen.one_sided, view=fitted.view, common=fitted.common)
    off = other.radius[cKDTree(other.nodes).query(skeleton.nodes)[1]] - skeleton.radius
    return replace(skeleton, radius_sigma=np.hypot(
        skeleton.radius_sigma, np.sqrt(1 - ends[0]["probability"]) * off))
