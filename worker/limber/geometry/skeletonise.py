"""A scan's skeleton: thin, contract, connect, root, prune, fit."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field
from scipy.spatial import cKDTree

from limber.errors import InputError
from limber.geometry.axis_fit import (
    attached,
    clamped,
    fit_axes,
    nearest_cylinders,
    resampled,
    tapered,
)
from limber.geometry.contraction import Contraction, contract
from limber.geometry.curve_graph import CurveGraph, curve_graph, end_chain, prune_spurs, rooted
from limber.geometry.skeleton import Skeleton
from limber.progress import SILENT, Progress

GIVEN = "skeleton given"
FIT_POINT_LIMIT = 60_000
"""More points than that do not make the fit better, only slower."""


class SkeletonSettings(BaseModel):
    """How the skeleton is made."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    contraction_points: int = Field(
        12_000, ge=50, description="Contract at most so many points (thinned evenly).")
    gap_factor: float = Field(
        3.0, gt=1, description="The paper's gamma: longer than so many median steps is a gap.")
    bridge_limit: float = Field(
        0.15, ge=0, le=1, description="Bridge gaps up to this share of the cloud's diagonal.")
    prune: float = Field(
        2.5, ge=0, description="A twig stays if it reaches so many radii of its carrier beyond "
        "the carrier's axis.")
    radius_low: float = Field(
        5e-4, ge=0, description="Radii are clamped from below at this share of the diagonal.")
    radius_high: float = Field(
        0.1, gt=0, le=1, description="Radii are clamped from above at this share.")


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

    @property
    def warnings(self) -> list[str]:
        """What the user should know, with places in the cloud's frame."""
        return _warnings(self)

    def moved(self, move: Callable[[np.ndarray], np.ndarray]) -> "SkeletonResult":
        """Return the result in another frame; ``move`` takes points [n, 3] there."""
        bridges = [bridge | {"from": move(bridge["from"][None])[0],
                             "to": move(bridge["to"][None])[0]} for bridge in self.bridges]
        split_off = [piece | {"at": move(piece["at"][None])[0]} for piece in self.split_off]
        return replace(self, skeleton=self.skeleton.moved(move(self.skeleton.nodes)),
                       bridges=bridges, split_off=split_off)

    def report(self) -> dict[str, Any]:
        """Numbers for the stage's result."""
        return {"contraction_iterations": self.contraction.iterations,
                "contraction_status": self.contraction.status, "noise_m": self.noise,
                "bridges": self.bridges, "split_off": self.split_off,
                "loop_lengths_m": self.loops, "pruned_spur_count": self.pruned}


def skeletonise(points: np.ndarray, settings: SkeletonSettings | None = None, *,
                root: np.ndarray | None = None, up: np.ndarray | None = None,
               progress: Progress = SILENT) -> SkeletonResult:
    """Find the rooted skeleton of a cloud.

    Args:
        points: Scanned points [m], shape [n, 3].
        settings: How.
        root: Near which point [m] the root is, shape [3]; None: the thick end of the plant.
        up: Which way is up, shape [3]; None: z.
        progress: Called as it goes.

    Raises:
        InputError: the cloud is not branch-like.
    """
    settings = settings or SkeletonSettings()
    thin = thinned(points, settings.contraction_points)
    _check_no_sheet(points[thin])
    contraction = contract(points[thin], progress=progress.part(0.0, 0.6))
    diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
    progress(0.6, "connecting")
    graph = curve_graph(points[thin], contraction.points, gap_factor=settings.gap_factor,
                        bridge_limit=settings.bridge_limit * diagonal)
    _check_one_plant(graph, len(thin), diagonal)
    start = _root_node(graph, points[thin], root,
                       np.array([0.0, 0.0, 1.0]) if up is None else up, settings.prune)
    first, pruned = _first_skeleton(graph, settings, start)
    some = points if len(points) <= FIT_POINT_LIMIT else points[thinned(points, FIT_POINT_LIMIT)]
    if (graph.owner < 0).any():
        # What was left away must not draw the rest towards it.
        some = some[graph.owner[cKDTree(points[thin]).query(some)[1]] >= 0]
    fitted, more = _fit(first, some, settings, diagonal, progress.part(0.65, 0.95))
    segment, residual = nearest_cylinders(fitted.skeleton, points)
    _check_round(fitted.skeleton, points, segment, residual)
    result = SkeletonResult(
        fitted.skeleton, contraction, segment, residual, fitted.noise, graph.bridges,
        graph.split_off, graph.loops, pruned + more)
    progress(1.0, "skeleton", nodes=fitted.skeleton.node_count)
    return result


def given_skeleton(skeleton: Skeleton, points: np.ndarray) -> SkeletonResult:
    """Wrap a user's own skeleton, in the cloud's frame; nothing is changed in it."""
    segment, residual = nearest_cylinders(skeleton, points)
    noise = float(1.4826 * np.median(np.abs(residual - np.median(residual))))
    nothing = Contraction(points[:0], np.empty(0), 0, GIVEN)
    return SkeletonResult(skeleton, nothing, segment, residual, noise)


def thinned(points: np.ndarray, limit: int) -> np.ndarray:
    """Indices of at most ``limit`` points, one from each cell of a grid that fits that number."""
    if len(points) <= limit:
        return np.arange(len(points))
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
               prune: float) -> int:
    """The tip nearest to ``root``, or the tip of the thickest end; of several the lowest.

    How thick an end is, its smallest extent tells together with how far its points were drawn: a
    leaf is wide, but flat. An end that is shorter than it is thick is a spur, not an end.
    """
    degree = np.bincount(graph.edges.ravel(), minlength=len(graph.nodes))
    tips = np.flatnonzero(degree == 1)
    if root is not None:
        return int(tips[np.argmin(np.linalg.norm(graph.nodes[tips] - root, axis=1))])
    # Spurs would end the walk from a tip early: pruned as from the lowest tip, for now.
    parent = rooted(graph.nodes, graph.edges, int(tips[np.argmin(graph.nodes[tips] @ up)]))
    keep, _ = prune_spurs(graph.nodes, parent, graph.thickness, prune)
    neighbours: list[list[int]] = [[] for _ in graph.nodes]
    for node in np.flatnonzero(keep & (parent >= 0)):
        neighbours[node].append(int(parent[node]))
        neighbours[parent[node]].append(int(node))
    tips = np.array([node for node, near in enumerate(neighbours) if len(near) == 1])
    reach = 0.05 * float(np.linalg.norm(np.ptp(graph.nodes, axis=0)))
    thick = np.zeros(len(tips))
    for place, tip in enumerate(tips):
        chain = end_chain(neighbours, graph.nodes, int(tip), reach)
        mine = points[np.isin(graph.owner, chain)]
        length = np.linalg.norm(graph.nodes[chain[-1]] - graph.nodes[tip])
        if len(mine) >= 4 and length > 2 * float(np.median(graph.thickness[chain])):
            least = np.sqrt(max(np.linalg.eigvalsh(np.cov(mine.T))[0], 0.0))
            thick[place] = np.sqrt(least * float(np.median(graph.thickness[chain])))
    candidates = tips[thick >= 0.45 * thick.max()]
    return int(candidates[np.argmin(graph.nodes[candidates] @ up)])


def _fit(skeleton: Skeleton, points: np.ndarray, settings: SkeletonSettings, diagonal: float,
         progress: Progress):
    low, high = settings.radius_low * diagonal, settings.radius_high * diagonal
    skeleton = resampled(skeleton, 1.5)
    fit = fit_axes(skeleton, points, progress=progress.part(0.0, 0.5))
    skeleton = _with_full_tips(_without_bare_ends(attached(fit.skeleton), points), points, fit)
    # Noise makes a carrier look thicker, and its outliers look like twigs.
    reach = skeleton.radius + 2 * fit.noise
    keep, pruned = prune_spurs(skeleton.nodes, skeleton.parent, reach, settings.prune)
    skeleton, strands = _without_strands(skeleton.subset(keep))
    skeleton = resampled(clamped(skeleton, low, high), 1.0)
    fit = fit_axes(skeleton, points, progress=progress.part(0.5, 0.8))
    skeleton, late = _without_strands(fit.skeleton)
    if late:
        fit = fit_axes(skeleton, points, rounds=6, progress=progress.part(0.8, 1.0))
    pruned += strands + late
    return replace(fit, skeleton=tapered(clamped(fit.skeleton, low, high))), pruned


def _without_strands(skeleton: Skeleton) -> tuple[Skeleton, int]:
    count = 0
    while (inside := _embedded_run(skeleton)) is not None:
        skeleton, count = skeleton.subset(skeleton.branch != inside), count + 1
    return skeleton, count


def _embedded_run(skeleton: Skeleton) -> int | None:
    """A side run without twigs of its own that lies mostly inside the others, if there is one.

    Where a scan has holes, the contraction may leave two strands in one branch.
    """
    carriers = set(skeleton.branch[skeleton.parent[1:]][
        skeleton.branch[1:] != skeleton.branch[skeleton.parent[1:]]].tolist())
    for run in range(skeleton.branch_count - 1, 0, -1):
        own = skeleton.branch == run
        if run in carriers:
            continue
        distance, near = cKDTree(skeleton.nodes[~own]).query(skeleton.nodes[own])
        if float(np.median(distance / skeleton.radius[~own][near])) < 1.3:
            return run
    return None


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
        mine = points[(segment == end) | (segment == (before if not is_root else inner))]
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




_FIX = "Cut out one branch (--crop-low, --crop-high), or bring a skeleton (--skeleton)."


def _check_one_plant(graph: CurveGraph, count: int, diagonal: float) -> None:
    if len(graph.nodes) < 4:
        raise InputError(f"The cloud contracts to {len(graph.nodes)} points.",
                         "It is not branch-like: no axis was found (a ball or a blob?).", _FIX)
    length = float(np.linalg.norm(
        graph.nodes[graph.edges[:, 0]] - graph.nodes[graph.edges[:, 1]], axis=1).sum())
    thick = float(np.median(graph.thickness))
    if length < 4 * thick:
        raise InputError(
            f"The axes are {length:.3g} m long at {thick:.3g} m radius.",
            "It is not branch-like: too stout for an axis (a ball or a fruit?).", _FIX)
    for piece in graph.split_off:
        share = piece["points"] / count
        if share > 0.2 and piece["distance"] > 0.25 * diagonal:
            raise InputError(
                f"There are two far-apart clusters: {100 * share:.0f} % of the points lie "
                f"{piece['distance']:.3g} m from the rest.", "A branch is in one piece.", _FIX)


def _check_round(skeleton: Skeleton, points: np.ndarray, segment: np.ndarray,
                 residual: np.ndarray) -> None:
    """Refuse what has an axis but no roundness at all: a ball, a heap of foliage."""
    extent = float(np.linalg.norm(np.ptp(points, axis=0)))
    round_share = float(np.mean(np.abs(residual) < 0.4 * skeleton.radius[segment]))
    away = float(np.median(np.abs(residual + skeleton.radius[segment])))
    if round_share < 0.15 and away > 0.08 * extent:
        raise InputError(
            f"Only {100 * round_share:.0f} % of the points lie on round axes; the others are "
            f"{away:.3g} m away (median).", "It is not branch-like.", _FIX)
def _check_no_sheet(points: np.ndarray) -> None:
    share = _sheet_share(points, 0.06 * float(np.linalg.norm(np.ptp(points, axis=0))))
    if share > 0.9:
        raise InputError(
            f"{100 * share:.0f} % of the points lie in wide flat sheets.",
            "It is not branch-like (a wall or the ground?).", _FIX)


def _sheet_share(points: np.ndarray, reach: float) -> float:
    """Share of points whose surroundings within ``reach`` [m] are wide and flat, on a sample."""
    tree = cKDTree(points)
    sample = points[:: max(len(points) // 300, 1)]
    flat = []
    for near in tree.query_ball_point(sample, reach):
        if len(near) > 10:
            values = np.linalg.eigvalsh(np.cov(points[near].T))
            flat.append(values[0] < 0.01 * values[1] and values[1] > 0.3 * values[2])
    return float(np.mean(flat)) if flat else 0.0


def _warnings(result: SkeletonResult) -> list[str]:
    texts = []
    if result.contraction.status == GIVEN:
        far = float(np.mean(np.abs(result.residual) > 3 * result.skeleton.radius[
            result.node_of_point]))
        if far > 0.5:
            texts.append(f"{100 * far:.0f} % of the points are far from the given skeleton: is it "
                         "in the cloud's coordinates and unit?")
        return texts
    for bridge in result.bridges:
        texts.append(f"A gap of {1000 * bridge['length']:.0f} mm was bridged at "
                     f"{_place(bridge['to'])}.")
    lost = sum(piece["points"] for piece in result.split_off)
    if lost:
        share = 100 * lost / len(result.contraction.points)
        texts.append(f"{len(result.split_off)} pieces ({share:.1f} % of the points) were left "
                     "away: too far from the rest to be bridged.")
    for loop in result.loops:
        texts.append(f"A closed loop of {1000 * loop:.0f} mm was opened: branches touch there.")
    misfit = float(np.mean(np.abs(result.residual) > np.maximum(
        3 * result.noise, 0.4 * result.skeleton.radius[result.node_of_point])))
    if misfit > 0.15:
        texts.append(f"{100 * misfit:.0f} % of the points lie on no round axis: leaves, flying "
                     "pixels or a second plant? Radii there mean little.")
    return texts


def _place(point: np.ndarray) -> str:
    return "(" + ", ".join(f"{v:.3f}" for v in point) + ")"
