"""A scan's skeleton: thin, contract, connect, root, prune, fit."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.canonical_frame import OwnFrame, own_axes
from limber.geometry.settings import SkeletonSettings
from limber.geometry.skeleton.confidence import assessed, doubted, likely, shares
from limber.geometry.skeleton.contraction.curve_graph import (
    CurveGraph,
    curve_graph,
    end_chain,
    prune_spurs,
    rooted,
)
from limber.geometry.skeleton.contraction.laplacian_contraction import (
    Contraction,
    ContractionStatus,
    contract,
)
from limber.geometry.skeleton.contraction.level_sets import POINT_LIMIT, is_sparse, level_graph
from limber.geometry.skeleton.contraction.pieces import second_base
from limber.geometry.skeleton.plausibility import (
    Where,
    check_no_sheet,
    check_one_plant,
    check_round,
    warnings,
)
from limber.geometry.skeleton.radii.along_runs import (
    filled_in,
    limited,
    point_counts,
    steadied,
    tapered,
    unpinched,
)
from limber.geometry.skeleton.radii.axis_fit import (
    AxisFit,
    attached,
    fit_axes,
    median_radii,
    resampled,
)
from limber.geometry.skeleton.radii.cylinders import nearest_cylinders
from limber.geometry.skeleton.repair.backwards import without_backward_starts
from limber.geometry.skeleton.repair.kinks import without_kinks
from limber.geometry.skeleton.skeleton import INTERPOLATED, Skeleton
from limber.geometry.skeleton.totals import totals

FIT_POINT_LIMIT = 60_000
"""More points than that do not make the fit better, only slower."""

_ROOT_SHARE = 0.45  # of the thickest end, from which an end may be the root
_ROOT_THICK, _ROOT_HEIGHT = 0.25, 0.1  # logarithm of thickness, and share of height, that tell
_END_POINTS, _END_REACHES = 30, 4  # that tell how thick an end is; over so many times its reach
# Radii of its carrier up to which a side arm may be a strand around the rim of a ragged foot.
_STRAND = 5.0
_ROOT_EVEN = 1.0  # by which two ends may differ, in these, and be as likely
_NOISY = 0.2  # of the median radius

LEAF_SHARE = 0.5
"""Share of points over two radii off their axis from which a scan shows leaves, not branches."""


@dataclass(frozen=True)
class SkeletonResult:
    """A skeleton, and what was done to get it.

    Attributes:
        skeleton: Axes and radii [m] in the cloud's frame.
        contraction: Contracted points and history.
        node_of_point: Skeleton node of each point, shape [m].
        residual: Distance of each point from its cylinder [m], shape [m].
        noise: Robust standard deviation of the residuals [m].
        bridges: Gaps closed: ``from``, ``to``, ``length`` [m].
        split_off: Pieces left away: ``points``, ``distance`` [m], ``at``.
        loops: Lengths [m] of closed loops that were opened.
        pruned: Number of spurs pruned.
        second_base: Where the plant seems to stand on the ground a second time [m], shape [3].
        other_root: An end that is about as likely the root [m], shape [3].
        unlikely: Twigs dropped as more likely not there: ``length`` [m], ``at`` [m, 3],
            ``probability``.
        leafy: Most points lay on no cylinder, and axes were led through the middle of leaves.
    """

    skeleton: Skeleton
    contraction: Contraction
    node_of_point: np.ndarray
    residual: np.ndarray
    noise: float
    bridges: list[dict] = field(default_factory=list)
    split_off: list[dict] = field(default_factory=list)
    loops: list[float] = field(default_factory=list)
    pruned: int = 0
    second_base: np.ndarray | None = None
    other_root: np.ndarray | None = None
    leafy: bool = False
    unlikely: list[dict] = field(default_factory=list)

    @property
    def warnings(self) -> list[str]:
        """What the user should know, with places in the cloud's frame."""
        return self.warnings_at(lambda place: place)

    def warnings_at(self, where: Where) -> list[str]:
        """What the user should know, with places as ``where`` takes them to other coordinates."""
        return warnings(self, where)

    def moved(self, move: Callable[[np.ndarray], np.ndarray]) -> "SkeletonResult":
        """Return the result in another frame; ``move`` takes points [n, 3] there."""
        bridges = [bridge | {"from": move(bridge["from"][None])[0],
                             "to": move(bridge["to"][None])[0]} for bridge in self.bridges]
        split_off, unlikely = ([part | {"at": move(part["at"][None])[0]} for part in parts]
                               for parts in (self.split_off, self.unlikely))
        base, other = (None if place is None else move(place[None])[0]
                       for place in (self.second_base, self.other_root))
        return replace(self, skeleton=self.skeleton.moved(move(self.skeleton.nodes)),
                       bridges=bridges, split_off=split_off, unlikely=unlikely, second_base=base,
                       other_root=other)

    def report(self) -> dict[str, Any]:
        """Numbers for the stage's result."""
        return totals(self.skeleton, self.unlikely) | {
                "contraction_iterations": self.contraction.iterations,
                "contraction_status": self.contraction.status, "noise_m": self.noise,
                "bridges": self.bridges, "length_shares": shares(self.skeleton),
                "doubtful_run_count": len({int(run) for run in self.skeleton.branch[
                    self.skeleton.probability < 0.5]}), "split_off": self.split_off,
                "unlikely_twigs": self.unlikely,
                "loop_lengths_m": self.loops, "pruned_spur_count": self.pruned}


def skeletonise(points: np.ndarray, settings: SkeletonSettings | None = None, *,
                root: np.ndarray | None = None, up: np.ndarray | None = None,
                camera: bool = False, where: Where | None = None,
                progress: Progress = SILENT) -> SkeletonResult:
    """Find the rooted skeleton of a cloud.

    Args:
        points: Scanned points [m], shape [n, 3].
        settings: How.
        root: Near which point [m] the root is, shape [3]; None: the thick end of the plant.
        up: Which way is up, shape [3]; None: z.
        camera: The points are a depth camera's, and scatter along its sight alone.
        where: Takes places of the cloud to the coordinates of its file, for errors; None: they
            are the same.
        progress: Called as it goes.

    Raises:
        InputError: the cloud is not branch-like.
    """
    # In the cloud's own frame: boxes around it, and the triangles of its Laplacian, would be others
    # for a turned one.
    own = OwnFrame.of(points)
    up = np.array([0.0, 0.0, 1.0]) if up is None else np.asarray(up, float)
    found = _of_ordered(own, settings or SkeletonSettings(),
                        None if root is None else own.inside(root), up @ own.axes, camera,
                        where or (lambda place: place), progress)
    place, drawn = np.argsort(own.order), found.contraction
    return replace(found.moved(own.outside), contraction=replace(
        drawn, points=own.outside(drawn.points), drawn=own.outside(drawn.drawn)),
        node_of_point=found.node_of_point[place], residual=found.residual[place])


def _of_ordered(own: OwnFrame, settings: SkeletonSettings, root: np.ndarray | None,
                up: np.ndarray, camera: bool, where: Where, progress: Progress) -> SkeletonResult:
    """The skeleton of points in the cloud's own frame; ``root`` and ``up`` are in that too."""
    points = own.places
    thin = thinned(points, settings.contraction_points)
    check_no_sheet(points[thin])
    contraction = contract(points[thin], attraction=settings.attraction,
                           progress=progress.part(0.0, 0.6))
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    progress(0.6, "connecting")
    # As drawn: measured on 20 branches, recentred points lose two forks of 46, since circles mix
    # the branches there, and the fit below centres the axes anyhow.
    graph = curve_graph(points[thin], contraction.drawn, gap_factor=settings.gap_factor,
                        bridge_limit=settings.bridge_limit * diagonal, up=up,
                        join_plants=settings.plants == "joined")
    check_one_plant(graph, len(thin), diagonal, settings.plants,
                    lambda place: where(own.outside(place)))
    start, other_root = _root_node(graph, points[thin], root, up, settings.prune)
    if is_sparse(points[thin], contraction.drawn):
        thin, loops, base = thinned(points, POINT_LIMIT), graph.loops, graph.nodes[start]
        graph = level_graph(
            points[thin], base, gap_factor=settings.gap_factor, up=up,
            bridge_limit=settings.bridge_limit * diagonal, join_plants=settings.plants == "joined")
        graph.loops = loops
        start, _ = _root_node(graph, points[thin], base, up, settings.prune)
    first, pruned = _first_skeleton(graph, settings, start)
    some = points if len(points) <= FIT_POINT_LIMIT else points[thinned(points, FIT_POINT_LIMIT)]
    if (graph.owner < 0).any():
        # What was left away must not draw the rest towards it.
        some = some[graph.owner[cKDTree(points[thin]).query(some)[1]] >= 0]
    fitted, more, beside = _fit(first, some, settings, diagonal, camera, progress.part(0.65, 0.95))
    segment, residual = nearest_cylinders(fitted.skeleton, points)
    check_round(fitted.skeleton, points, segment, residual)
    leafy = max(beside, float(np.mean(
        residual > fitted.skeleton.radius[segment]))) > LEAF_SHARE
    if leafy:
        base = graph.nodes[start]
        graph = level_graph(
            points[thin], base, gap_factor=settings.gap_factor, up=up,
            width=float(np.median(graph.thickness)), join_plants=settings.plants == "joined",
            bridge_limit=settings.bridge_limit * diagonal)
        start, _ = _root_node(graph, points[thin], base, up, settings.prune)
        first, pruned = _first_skeleton(graph, settings, start)
        fitted, more = _through_leaves(first, some, fitted, settings, diagonal), 0
        segment, residual = nearest_cylinders(fitted.skeleton, points)
    kept, unlikely = likely(fitted.skeleton, settings.twig_probability)
    if unlikely:
        fitted = replace(fitted, skeleton=kept)
        segment, residual = nearest_cylinders(kept, points)
    if settings.radii == "paper":
        radius = median_radii(fitted.skeleton, points)
        low, high = settings.radius_low * diagonal, settings.radius_high * diagonal
        fitted = replace(fitted, skeleton=limited(
            replace(fitted.skeleton, radius=radius), low, high))
        segment, residual = nearest_cylinders(fitted.skeleton, points)
    result = SkeletonResult(
        fitted.skeleton, contraction, segment, residual, fitted.noise, graph.bridges,
        graph.split_off, graph.loops, pruned + more,
        second_base(fitted.skeleton, up), other_root, leafy, unlikely)
    progress(1.0, "skeleton", nodes=fitted.skeleton.node_count)
    return result


def given_skeleton(skeleton: Skeleton, points: np.ndarray) -> SkeletonResult:
    """Wrap a user's own skeleton, in the cloud's frame; nothing is changed in it."""
    segment, residual = nearest_cylinders(skeleton, points)
    noise = float(1.4826 * np.median(np.abs(residual - np.median(residual))))
    nothing = Contraction(points[:0], np.empty(0), 0, ContractionStatus.given)
    return SkeletonResult(skeleton, nothing, segment, residual, noise)


def thinned(points: np.ndarray, limit: int) -> np.ndarray:
    """Indices of at most ``limit`` points, one from each cell of a grid that fits that number.

    The grid lies along the cloud's own axes, so that a turned one is thinned alike.
    """
    if len(points) <= limit:
        return np.arange(len(points))
    points = points @ own_axes(points)
    low = points.min(axis=0)
    # Points lie on a surface: cells grow with the square root of how many there are too many.
    size = float(np.median(cKDTree(points).query(
        points[:: max(len(points) // 2000, 1)], k=2)[0][:, 1])) * np.sqrt(len(points) / limit)
    size = max(size, 1e-6 * float(np.ptp(points, axis=0).max()), 1e-12)
    for _ in range(40):
        cell = np.floor((points - low) / size).astype(np.int64)
        extent = cell.max(axis=0) + 1
        key = (cell[:, 0] * extent[1] + cell[:, 1]) * extent[2] + cell[:, 2]
        _, first = np.unique(key, return_index=True)
        if len(first) <= limit:
            return np.sort(first)
        size *= max(1.03, np.sqrt(len(first) / limit))
    return np.sort(first)


def _first_skeleton(graph: CurveGraph, settings: SkeletonSettings, start: int,
                    ) -> tuple[Skeleton, int]:
    parent = rooted(graph.nodes, graph.edges, start)
    keep, pruned = prune_spurs(graph.nodes, parent, graph.thickness, settings.prune)
    new_index = np.cumsum(keep) - 1
    moved = np.where(parent[keep] < 0, -1, new_index[parent[keep]])
    radius = np.maximum(graph.thickness[keep], 1e-3 * float(np.median(graph.thickness)) + 1e-12)
    return Skeleton.from_edges(graph.nodes[keep], moved, radius), pruned


def _root_node(graph: CurveGraph, points: np.ndarray, root: np.ndarray | None, up: np.ndarray,
               prune: float) -> tuple[int, np.ndarray | None]:
    """The end nearest to ``root``, or the lowest of the thick ends; and one that is as likely.

    How thick an end is, its smallest extent tells together with how far its points were drawn: a
    leaf is wide, but flat. An end that is shorter than it is thick is a spur, not an end.
    """
    degree = np.bincount(graph.edges.ravel(), minlength=len(graph.nodes))
    tips = np.flatnonzero(degree == 1)
    # Spurs would end the walk from a tip early: pruned as from the lowest tip, for now.
    first = int(tips[np.argmin(graph.nodes[tips] @ up)])
    parent = rooted(graph.nodes, graph.edges, first)
    neighbours = _pruned_neighbours(graph, parent, prune)
    tips = np.array([node for node, near in enumerate(neighbours) if len(near) == 1])
    if root is not None:
        return int(tips[np.argmin(np.linalg.norm(graph.nodes[tips] - root, axis=1))]), None
    thick = _end_thickness(graph, points, neighbours, tips)
    # Of a thick foot that few points show, contraction leaves strands around its rim: each tells
    # as little of it as a twig.
    neighbours = _pruned_neighbours(graph, parent, max(prune, _STRAND))
    whole = np.array([len(neighbours[tip]) == 1 for tip in tips])
    thick[whole] = np.maximum(thick[whole], _end_thickness(graph, points, neighbours, tips[whole]))
    able = thick >= _ROOT_SHARE * thick.max()
    height = graph.nodes[tips] @ up / np.linalg.norm(up)
    chosen = int(np.argmin(np.where(able, height, np.inf)))
    # As likely: about as low and as thick, or thicker by more than it is higher.
    odds = np.log(np.maximum(thick, 1e-12) / max(thick[chosen], 1e-12)) / _ROOT_THICK - (
        height - height[chosen]) / (_ROOT_HEIGHT * max(float(np.ptp(height)), 1e-12))
    odds[chosen] = -np.inf
    rival = int(np.argmax(odds)) if len(tips) > 1 else chosen
    other = graph.nodes[tips[rival]] if odds[rival] > -_ROOT_EVEN else None
    return int(tips[chosen]), other


def _pruned_neighbours(graph: CurveGraph, parent: np.ndarray, prune: float) -> list[list[int]]:
    """Neighbours of each node along what is left without spurs."""
    keep, _ = prune_spurs(graph.nodes, parent, graph.thickness, prune)
    neighbours: list[list[int]] = [[] for _ in graph.nodes]
    for node in np.flatnonzero(keep & (parent >= 0)):
        neighbours[node].append(int(parent[node]))
        neighbours[parent[node]].append(int(node))
    return neighbours


def _end_thickness(graph: CurveGraph, points: np.ndarray, neighbours: list[list[int]],
                   tips: np.ndarray) -> np.ndarray:
    """How thick each end is [m], shape [tips]; 0 for spurs."""
    reach = 0.05 * float(np.linalg.norm(np.ptp(graph.nodes, axis=0)))
    thick = np.zeros(len(tips))
    for place, tip in enumerate(tips):
        # Contraction may draw a few points of an end far beyond it.
        # What few points show of a ragged foot says little: it goes on until there are enough.
        for way in reach * np.arange(1, _END_REACHES + 1) + graph.thickness[tip]:
            chain = end_chain(neighbours, graph.nodes, int(tip), way)
            mine = points[np.isin(graph.owner, chain)]
            if len(mine) >= _END_POINTS:
                break
        # Along the chain: contraction leads what is left of a ragged foot around its rim.
        length = np.linalg.norm(np.diff(graph.nodes[chain], axis=0), axis=1).sum()
        if len(mine) < 4:
            continue
        drawn = float(np.median(np.repeat(graph.thickness[chain], graph.support[chain])))
        if length > 2 * drawn:
            least = np.sqrt(max(np.linalg.eigvalsh(np.cov(mine.T))[0], 0.0))
            thick[place] = np.sqrt(least * drawn)
    return thick


def _fit(skeleton: Skeleton, points: np.ndarray, settings: SkeletonSettings, diagonal: float,
         camera: bool, progress: Progress):
    low, high = settings.radius_low * diagonal, settings.radius_high * diagonal
    first = steadied(skeleton, points)
    fit = fit_axes(resampled(first, 1.5), points, along_sight=camera, uncertainty=False,
                   progress=progress.part(0.0, 0.4))
    # Of leaves too it would make thick stems, that seem to have none.
    may_be_pinched = fit.seen.one_sided and _beside(fit) <= LEAF_SHARE
    if may_be_pinched:
        fit = fit_axes(resampled(unpinched(first, points), 1.5), points, along_sight=camera,
                       uncertainty=False, progress=progress.part(0.4, 0.5))
    hung, _ = without_backward_starts(attached(fit.skeleton))
    skeleton = _with_full_tips(_without_bare_ends(hung, points), points, fit)
    # Noise makes a carrier look thicker, and its outliers look like twigs.
    reach = skeleton.radius + 2 * fit.noise
    keep, pruned = prune_spurs(skeleton.nodes, skeleton.parent, reach, settings.prune)
    skeleton, strands = _without_strands(skeleton.subset(keep))
    first = steadied(skeleton, points)
    if may_be_pinched:
        first = unpinched(first, points)
    skeleton = resampled(limited(first, low, high), 1.0)
    fit = fit_axes(skeleton, points, along_sight=camera, uncertainty=False,
                   progress=progress.part(0.5, 0.8))
    skeleton, late = _without_strands(fit.skeleton)
    # Noise leaves little information a round.
    noisy = fit.noise > _NOISY * float(np.median(skeleton.radius))
    rounds = 18 if noisy else 6 if late else 0
    fit = fit_axes(skeleton, points, rounds=rounds, settled=noisy and not late, seen=fit.seen,
                   along_sight=camera, progress=progress.part(0.8, 1.0))
    pruned += strands + late
    ended = _ends_within(_without_bare_ends(fit.skeleton, points), points)
    # Where leaves swell or starve the axes, what lies beside a blank tells nothing of it either.
    beside = _beside(fit)
    if beside <= LEAF_SHARE:
        ended = filled_in(ended, points)
    ended = limited(ended, low, high)
    told = assessed(tapered(ended, point_counts(ended, points)), points, fit.noise)
    return replace(fit, skeleton=without_kinks(told)[0]), pruned, beside


def _through_leaves(skeleton: Skeleton, points: np.ndarray, fit: AxisFit,
                    settings: SkeletonSettings, diagonal: float) -> AxisFit:
    """Axes in the middle of stem and leaves, without a fit: leaves are no cylinders.

    A leaf's radius is its stalk's, for want of a better one, and marked as not measured.
    """
    skeleton = attached(resampled(skeleton, 1.0))
    for _ in range(3):
        skeleton = skeleton.moved(_evened(skeleton))
    low, high = settings.radius_low * diagonal, settings.radius_high * diagonal
    skeleton = _with_full_tips(tapered(limited(skeleton, low, high)), points, fit)
    skeleton = replace(skeleton, radius_sigma=0.25 * skeleton.radius,
                       radius_state=np.full(skeleton.node_count, INTERPOLATED, np.int8))
    return replace(fit, skeleton=doubted(skeleton, points, fit.noise))


def _evened(skeleton: Skeleton) -> np.ndarray:
    """Each node between others of its run moved half way to their middle [m], shape [n, 3]."""
    nodes = skeleton.nodes.copy()
    for members in skeleton.runs():
        inner, old = members[1:-1], skeleton.nodes
        nodes[inner] = 0.5 * old[inner] + 0.25 * (old[members[:-2]] + old[members[2:]])
    return nodes


def _without_strands(skeleton: Skeleton) -> tuple[Skeleton, int]:
    """Drop side runs that lie mostly inside the others, thinnest twigs first.

    Where a scan has holes, the contraction may leave two strands in one branch.
    """
    count, run = 0, skeleton.branch_count - 1
    while run > 0:
        if _is_strand(skeleton, run):
            skeleton, count = skeleton.subset(skeleton.branch != run), count + 1
            run = skeleton.branch_count
        run -= 1
    return skeleton, count


def _beside(fit: AxisFit) -> float:
    """Share of the points that lie farther off their axis than twice its radius, as leaves do."""
    return float(np.mean(fit.residual > fit.skeleton.radius[fit.segment]))


def _is_strand(skeleton: Skeleton, run: int) -> bool:
    """Whether a side run has no twigs of its own and lies mostly inside the others."""
    own = np.flatnonzero(skeleton.branch == run)
    carried = (skeleton.branch[skeleton.parent[1:]] == run) & (skeleton.branch[1:] != run)
    if carried.any():
        return False
    # Others that could hold it: only those around.
    middle = skeleton.nodes[own].mean(axis=0)
    span = np.linalg.norm(skeleton.nodes[own] - middle, axis=1).max()
    reach = 2 * span + 1.4 * float(skeleton.radius.max())
    others = np.flatnonzero((skeleton.branch != run)
                            & (np.linalg.norm(skeleton.nodes - middle, axis=1) < reach))
    if len(others) == 0:
        return False
    gap = np.linalg.norm(skeleton.nodes[own][:, None] - skeleton.nodes[others], axis=2)
    near = np.argmin(gap, axis=1)
    # A strand may be the thicker one of the two.
    thick = np.maximum(skeleton.radius[others][near], skeleton.radius[own])
    share = gap[np.arange(len(own)), near] / thick
    return float(np.median(share)) < 1.3


def _without_bare_ends(skeleton: Skeleton, points: np.ndarray) -> Skeleton:
    """Drop end nodes that no point belongs to: the contraction can overshoot an end."""
    segment, _ = nearest_cylinders(skeleton, points)
    count = np.bincount(segment, minlength=skeleton.node_count)
    keep = np.ones(skeleton.node_count, bool)
    for members in skeleton.runs():
        if (skeleton.parent == members[-1]).any():
            continue
        own = list(members[1:])
        while len(own) > 2 and count[own[-1]] == 0:
            keep[own.pop()] = False
    # The root end: a bare first segment belongs to its upper node.
    children = skeleton.child_counts()
    root, nodes, parent = 0, skeleton.nodes, skeleton.parent.copy()
    while children[root] == 1:
        following = int(np.flatnonzero(parent == root)[0])
        if count[following] > 0 or children[following] != 1:
            break
        keep[root], parent[following], root = False, -1, following
    new_index = np.cumsum(keep) - 1
    moved = np.where(parent[keep] < 0, -1, new_index[parent[keep]])
    return Skeleton.from_edges(nodes[keep], moved, skeleton.radius[keep],
                               radius_sigma=skeleton.radius_sigma[keep],
                               radius_state=skeleton.radius_state[keep])


def _ends_within(skeleton: Skeleton, points: np.ndarray) -> Skeleton:
    """Draw ends back that a fit let slide along their axis beyond the points."""
    nodes = skeleton.nodes.copy()
    segment, _ = nearest_cylinders(skeleton, points)
    inner = np.flatnonzero(skeleton.parent == 0)
    ends = [(int(tip), int(skeleton.parent[tip])) for tip in skeleton.tips()]
    for end, before in [*ends, *([(0, int(inner[0]))] if len(inner) == 1 else [])]:
        step = nodes[end] - skeleton.nodes[before]
        length = float(np.linalg.norm(step))
        mine = points[np.isin(segment, [end, before] if end else [
            before, *np.flatnonzero(skeleton.parent == before)])]
        if length == 0 or len(mine) < 3:
            continue
        reach = float(np.quantile((mine - skeleton.nodes[before]) @ step / length, 0.98))
        if length > reach + 0.5 * skeleton.radius[end]:
            nodes[end] = skeleton.nodes[before] + step * max(reach / length, 0.1)
    return skeleton.moved(nodes)


def _with_full_tips(skeleton: Skeleton, points: np.ndarray, fit: Any) -> Skeleton:
    """Lengthen the ends that the contraction drew in, as far as there are points."""
    nodes = skeleton.nodes.copy()
    segment, _ = nearest_cylinders(skeleton, points)
    tips = [(int(tip), int(skeleton.parent[tip])) for tip in skeleton.tips()]
    inner = int(np.flatnonzero(skeleton.parent == 0)[0])
    for end, before, is_root in [(t, b, False) for t, b in tips] + [(0, inner, True)]:
        start = before
        for _ in range(2):
            if not is_root and skeleton.parent[start] > 0:
                start = int(skeleton.parent[start])
        direction = nodes[end] - skeleton.nodes[start]
        length = np.linalg.norm(direction)
        if length == 0:
            continue
        direction /= length
        radius = skeleton.radius[end]
        # The contraction may overshoot an end by far: then the next cylinder has its points.
        beside = np.flatnonzero(skeleton.parent == inner) if is_root else [end, before]
        mine = points[np.isin(segment, [inner, *beside] if is_root else beside)]
        offset = mine - nodes[end]
        along = offset @ direction
        across = np.linalg.norm(offset - along[:, None] * direction, axis=1)
        along = np.sort(along[across < 2.0 * radius + 3 * fit.noise])
        # An end does not reach over a gap.
        breaks = np.flatnonzero((np.diff(along) > 2 * radius) & (along[1:] > 0))
        along = along[:breaks[0] + 1] if len(breaks) else along
        if len(along) < 3:
            continue
        reach = float(np.quantile(along, 0.98)) - (0.0 if is_root else radius)
        nodes[end] = nodes[end] + direction * np.clip(reach, -0.8 * length, 20 * radius)
    return skeleton.moved(nodes)

