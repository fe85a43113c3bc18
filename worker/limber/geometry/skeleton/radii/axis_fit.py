"""Axes and radii fitted to the scan together: one robust least-squares problem for the tree.

The contraction finds which branches there are; where their axes run, and how thick they are, is
fitted to the scanned points. Each point should lie at the radius from the axis of the cylinder
that it is nearest to; axes and radii vary smoothly along a run. The fit is right where only one
side was seen: a circle is known from its arc, and what the arc leaves open, the neighbours along
the branch settle.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree

from limber.core.progress import SILENT, Progress
from limber.geometry.skeleton.radii.cylinders import Match, cylinders_around, match_cylinders
from limber.geometry.skeleton.radii.fit_kernels import normal_blocks
from limber.geometry.skeleton.radii.noisy_rings import (
    Aims,
    held_across,
    mean_places,
    place_doubt,
    weighted_aims,
)
from limber.geometry.skeleton.radii.sides_seen import (
    SCATTERED_ALONG_SIGHT,
    SeenSides,
    across_sight,
    seen_sides,
    side_doubt,
    side_told,
)
from limber.geometry.skeleton.skeleton import INTERPOLATED, MEASURED, Skeleton
from limber.geometry.skeleton.sweep import resample, tangents

# Of the median radius: the grid that each round starts from. A fifth of the step that ends a fit,
# and far coarser than what libraries round differently.
_GRID = 1e-5
_MOVED = 0.2  # of their radii: nodes that moved less have the same cylinders around each point
_REACH = 2.0  # how far an axis may move from where the contraction saw it, in its radii
_SLOPE = 1.0  # smoothing length of the radius against slopes, in local radii
_PROBE = 128  # nodes between two whose radii are taken as independent of each other
_TUKEY = 4.685  # 95 % efficiency for normal noise
_HOOK, _AHEAD = 5, 7  # nodes at a twig's start that may point elsewhere, and that tell where
_KINK = np.deg2rad(50.0)
# A twig's start may be as long as so many radii of its carrier, and end in such a kink.
_HOOK_REACH, _SHARP_KINK, _BESIDE = 6.0, np.deg2rad(45.0), 3
_LINE = 2.0  # radii of its carrier that a twig's start is long, which tells where that leads
_ENOUGH = 200  # points that tell the noise
# Points scattered around a circle by noise s lie at distances after Rice's law. What _robust_sigma
# measures of those within a radius of it, over that radius, and s over what was measured.
_MEASURED = (0.1655, 0.2461, 0.3234, 0.3802, 0.4506, 0.4810, 0.5102, 0.5360)
_TRUE = (1.007, 1.016, 1.031, 1.052, 1.110, 1.155, 1.225, 1.333)
_BAND, _BAND_LIMIT = 1.2, 3.5  # smoothing length in local radii, without noise and at most
# Radii to either side whose points tell how evenly a side is seen, each at least so many noises.
_WINDOW, _NOISY_WINDOW = 4.0, 2.0
_HELD = 2  # trusted rounds in which the limit stays that of most sensors
_TELLING = 80  # points there that tell
_ASKEW, _NARROW = 0.25, 0.33  # mean of the sine from the sight, and of its square: half a circle's


@dataclass(frozen=True)
class AxisFit:
    """A fitted skeleton and what the points said.

    Attributes:
        skeleton: Axes, radii, their standard deviations and states.
        segment: The node whose cylinder (to its parent) each point belongs to, shape [m].
        residual: Distance of each point from that cylinder [m], positive outside, shape [m].
        noise: Robust standard deviation of the residuals [m].
        seen: From which side the branches were seen.
    """

    skeleton: Skeleton
    segment: np.ndarray
    residual: np.ndarray
    noise: float
    seen: SeenSides


def fit_axes(skeleton: Skeleton, points: np.ndarray, *, rounds: int = 12,
             settled: bool = False, along_sight: bool = False, uncertainty: bool = True,
             seen: SeenSides | None = None, progress: Progress = SILENT) -> AxisFit:
    """Fit axes and radii of a skeleton's runs to points.

    Args:
        skeleton: Where the axes about are, with first radii; its topology is kept.
        points: Scanned points [m], shape [m, 3].
        rounds: Gauss-Newton rounds; points choose their cylinder anew in each.
        settled: The axes are where they belong: what is left to find is fine.
        along_sight: The points are a depth camera's: they scatter along its sight alone.
        uncertainty: Find each radius's standard deviation too; without, it and the states stay
            as they were.
        seen: What an earlier fit found was seen; None: told anew in each round. Where noise hides
            the rings, a side that is told anew follows what the axes made of the last one, and
            radii shrink from round to round.
        progress: Called each round.
    """
    # Leaves, which lie on no axis, lead a fit astray; then a last digit that differs grows from
    # round to round until other cylinders are chosen. On a grid it does not outlive its round.
    grid = 2.0**np.floor(np.log2(_GRID * float(np.median(skeleton.radius))))
    skeleton = replace(skeleton, nodes=_on_grid(skeleton.nodes, grid),
                       radius=np.maximum(_on_grid(skeleton.radius, grid), grid))
    nodes, radius = skeleton.nodes, skeleton.radius
    spread = 0.35 * float(np.median(radius))
    floor = 0.05 * float(np.median(radius))
    near, found_at = None, nodes
    # Once a fit is too thin, scatter along the sight no longer shows as such: what is known counts.
    known = SCATTERED_ALONG_SIGHT if along_sight else seen
    even, told, told_rounds = None, None, 0
    for number in range(rounds):
        # The cylinders around a point are looked up anew once axes have moved.
        moved = np.linalg.norm(nodes - found_at, axis=1)
        if near is None or (moved > _MOVED * radius).any():
            near, found_at = cylinders_around(skeleton.parent, nodes, points), nodes
        match = match_cylinders(skeleton.parent, skeleton.order, nodes, radius, points, near)
        # Wide at first, since a one-sided scan starts with its axis far off; then as the noise is.
        noise = max(_robust_sigma(match.residual, match.thick), 1e-4 * floor)
        spread = noise if settled else max(noise, 0.6 * spread)
        # While axes are still far off, the misfit is no noise that smoothing could help against.
        trusted = noise if settled or number > rounds // 2 else 0.0
        limit = partial(_limit, spread, noise, 0.0 if along_sight else trusted)
        weight = _tukey(match.residual, limit(match.thick))
        place, aims, across = match.normal, Aims(match.thick, match.thick), None
        if trusted:
            now, axis, sharpness, stout = _sides(
                skeleton.parent, nodes, match, weight, noise, known)
            if now.one_sided and known is None:
                shown = weight if even is None else weight * even[match.segment]
                told = now = side_told(match.normal, axis, sharpness, shown, now.view, told or now,
                                       limit_free=told_rounds >= _HELD)
                told_rounds += 1
            place = mean_places(match.normal, axis, sharpness, stout, now)
            if not now.along_sight:
                aims, nearest = weighted_aims(match.thick, noise, limit)
            if now.one_sided:
                if even is None:
                    # Told once, of axes that the nearest places have led to: a strip makes a thin
                    # cylinder of its own, all of whose side it seems to show.
                    even = _evenly_seen(skeleton, nodes, radius, match, weight,
                                        across_sight(match.normal, axis, now), noise)
                whole = even[match.segment]
                place = np.where(whole[:, None], place, match.normal)
                aims = Aims(np.where(whole, aims.axis, nearest.axis),
                            np.where(whole, aims.radius, nearest.radius))
            if not now.along_sight:
                across = held_across(match.normal, axis, place, stout)
        system = _system(skeleton, nodes, radius, match, weight, trusted, place, aims, across)
        step = system.solve()
        size = np.linalg.norm(step[:, :3], axis=1)
        shrink = np.minimum(1.0, 0.5 * radius / np.maximum(size, 1e-300))
        nodes = nodes + step[:, :3] * shrink[:, None]
        radius = radius + np.clip(step[:, 3], -0.4 * radius, 0.8 * radius)
        nodes, radius = _near_start(skeleton, nodes, radius)
        nodes, radius = _on_grid(nodes, grid), np.maximum(_on_grid(radius, grid), grid)
        progress((number + 1) / rounds, "fitting axes", noise_m=noise)
        if number > rounds // 2 + 1 and size.max() < 1e-3 * floor and spread <= 1.01 * noise:
            break
    match = match_cylinders(skeleton.parent, skeleton.order, nodes, radius, points)
    noise = _robust_sigma(match.residual, match.thick)
    weight = _tukey(match.residual, np.full(len(points), _TUKEY * max(noise, 1e-12)))
    seen, *_ = _sides(skeleton.parent, nodes, match, weight, noise, known)
    if told is not None and seen.one_sided:
        seen = told
    sigma, state = skeleton.radius_sigma, skeleton.radius_state
    if uncertainty:
        sigma, pooled = _uncertainty(skeleton, nodes, radius, match, weight, max(noise, 1e-12))
        sigma = np.hypot(sigma * place_doubt(seen, radius, noise), side_doubt(seen, radius, noise))
        state = np.where(pooled, MEASURED, INTERPOLATED).astype(np.int8)
    fitted = replace(skeleton, nodes=nodes, radius=np.maximum(radius, 0.1 * floor),
                     radius_sigma=sigma, radius_state=state)
    return AxisFit(fitted, match.segment, match.residual, noise, seen)


def _on_grid(values: np.ndarray, grid: float) -> np.ndarray:
    """Values [m] of any shape, rounded to multiples of ``grid`` [m]."""
    return np.round(values / grid) * grid


def _limit(spread: float, noise: float, trusted: float, radius: np.ndarray) -> np.ndarray:
    """Residual [m] from which a point belongs to something else, shape [m].

    Noise that is not trusted yet widens none by more than its radius.
    """
    return np.minimum(_TUKEY * spread,
                      0.9 * radius + 3 * np.maximum(trusted, np.minimum(noise, radius)))


def _sides(parent: np.ndarray, nodes: np.ndarray, match: Match, weight: np.ndarray, noise: float,
           known: SeenSides | None) -> tuple[SeenSides, np.ndarray, np.ndarray, np.ndarray]:
    """What was seen, and of each point the axis [m, 3], how sharp its place is and how stout."""
    axis = nodes[match.segment] - nodes[parent[match.segment]]
    axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]
    sharpness = match.thick * (match.residual + match.thick) / max(noise, 1e-12)**2
    stout = (match.thick / max(noise, 1e-12))**2
    seen = known or seen_sides(match.normal, axis, match.residual, sharpness, stout, weight)
    return seen, axis, sharpness, stout


def _evenly_seen(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray, match: Match,
                 weight: np.ndarray, across: np.ndarray, noise: float) -> np.ndarray:
    """Whether enough points around each node show all of the side that was seen, shape [n].

    Where a point comes from is weighed by which sides were seen. Of a strip along a branch whose
    rest is hidden, or of a few points, that makes a cylinder as thin as the strip is wide: measured
    from the truth as start, twigs with under 7 points a radius of length shrank to 0.8 of theirs,
    and hidden stems to a third. There the nearest places are the better guess (0.95). Where noise
    is as wide as the branch they tell little of it, and points from farther along speak.
    """
    sums = np.stack([np.bincount(match.segment, weight * value, len(nodes))
                     for value in (np.ones(len(across)), across, across**2)], axis=1)
    even = np.zeros(len(nodes), bool)
    for run, members in enumerate(skeleton.runs()):
        own = members if run == 0 else members[1:]
        step = np.linalg.norm(nodes[own] - nodes[np.maximum(skeleton.parent[own], 0)], axis=1)
        along, total = np.cumsum(step), np.vstack([np.zeros(3), np.cumsum(sums[own], axis=0)])
        reach = _WINDOW * np.maximum(radius[own], _NOISY_WINDOW * noise)
        first, last = (np.searchsorted(along, along + way, side) for way, side in (
            (-reach, "left"), (reach, "right")))
        count, mean, square = (total[last] - total[first]).T
        even[own] = (count > _TELLING) & (np.abs(mean) < _ASKEW * count) & (
            square > _NARROW * count)
    return even


def _near_start(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray,
                ) -> tuple[np.ndarray, np.ndarray]:
    """Keep axes within reach of the contracted ones, which lie inside the branch or on its skin.

    Without that, a run with few points may drift off and take those of others with it.
    """
    moved = nodes - skeleton.nodes
    size = np.linalg.norm(moved, axis=1)
    reach = _REACH * skeleton.radius
    moved *= np.minimum(1.0, reach / np.maximum(size, 1e-300))[:, None]
    return skeleton.nodes + moved, np.clip(
        radius, skeleton.radius / (2 * _REACH), 2 * _REACH * skeleton.radius)


def resampled(skeleton: Skeleton, spacing: float = 1.0) -> Skeleton:
    """Return the skeleton with nodes ``spacing`` local radii apart along each run."""
    nodes: list[np.ndarray] = []
    radius: list[np.ndarray] = []
    parent: list[np.ndarray] = []
    made: dict[int, np.ndarray] = {}
    count = 0
    for run, members in enumerate(skeleton.runs()):
        points, thick = skeleton.nodes[members], skeleton.radius[members].copy()
        if run > 0:
            thick[0] = thick[1]
        new_points, new_radius = resample(points, thick, spacing * thick)
        if run == 0:
            hang = np.arange(len(new_points)) - 1
        else:
            carrier = made[int(skeleton.branch[members[0]])]
            place = carrier[int(np.argmin(np.linalg.norm(
                np.vstack(nodes)[carrier] - points[0], axis=1)))]
            new_points, new_radius = new_points[1:], new_radius[1:]
            hang = np.concatenate([[place], count + np.arange(len(new_points) - 1)])
        made[run] = count + np.arange(len(new_points))
        count += len(new_points)
        nodes.append(new_points)
        radius.append(new_radius)
        parent.append(hang)
    return Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))


def attached(skeleton: Skeleton) -> Skeleton:
    """Hang each side run where its own direction meets the carrier's axis.

    The contraction draws a fork towards the twig. The twig's nodes inside the carrier are
    dropped, and its line is followed back to the carrier's axis.
    """
    parent, keep = skeleton.parent.copy(), np.ones(skeleton.node_count, bool)
    runs = skeleton.runs()
    for run in range(1, len(runs)):
        members = runs[run][1:]
        carrier = runs[int(skeleton.branch[skeleton.parent[members[0]]])]
        distance, near = cKDTree(skeleton.nodes[carrier]).query(skeleton.nodes[members])
        outside = distance > 1.05 * skeleton.radius[carrier[near]]
        first = int(np.argmax(outside)) if outside.any() else len(members) - 1
        first = _past_hook(skeleton, members, min(first, max(len(members) - 2, 0)))
        keep[members[:first]] = False
        # A hair's first nodes lie so near each other that only noise is between them.
        along = np.cumsum(np.linalg.norm(np.diff(skeleton.nodes[members[first:]], axis=0), axis=1))
        least = int(np.searchsorted(along, _LINE * skeleton.radius[carrier[near[first]]])) + 2
        ahead = members[first:first + max(least, 5)]
        if len(ahead) < 2:
            parent[members[first]] = carrier[near[first]]
            continue
        direction = skeleton.nodes[ahead[-1]] - skeleton.nodes[ahead[0]]
        direction /= np.linalg.norm(direction)
        parent[members[first]] = _meeting(skeleton, carrier, members[first], direction)
    # A run that hung on dropped nodes hangs on the next kept ancestor.
    for node in range(skeleton.node_count):
        while parent[node] >= 0 and not keep[parent[node]]:
            parent[node] = parent[parent[node]]
    new_index = np.cumsum(keep) - 1
    moved = np.where(parent[keep] < 0, -1, new_index[parent[keep]])
    return Skeleton.from_edges(skeleton.nodes[keep], moved, skeleton.radius[keep],
                               radius_sigma=skeleton.radius_sigma[keep],
                               radius_state=skeleton.radius_state[keep])


def _past_hook(skeleton: Skeleton, members: np.ndarray, first: int) -> int:
    """The place in a twig from which it goes the way that it goes on: its start may be a hook.

    Where the scan lacks a twig's base, it hangs on its carrier by a short way across, and kinks
    where its own axis begins.
    """
    nodes = skeleton.nodes
    last = min(first + _HOOK, len(members) - _AHEAD)
    start = max(first, last)
    for place in range(first, last):
        step = nodes[members[place + 1]] - nodes[members[place]]
        ahead = nodes[members[place + _AHEAD - 1]] - nodes[members[place + 1]]
        size = np.linalg.norm(step) * np.linalg.norm(ahead)
        if size > 0 and step @ ahead > np.cos(_KINK) * size:
            start = place
            break
    reach = _HOOK_REACH * skeleton.radius[skeleton.parent[members[0]]]
    length = 0.0
    for place in range(start + 1, len(members) - _AHEAD):
        step = nodes[members[place]] - nodes[members[place - 1]]
        length += float(np.linalg.norm(step))
        if length > reach:
            break
        before = nodes[members[place]] - nodes[members[max(place - _BESIDE, start)]]
        ahead = nodes[members[place + _AHEAD - 1]] - nodes[members[place]]
        size = np.linalg.norm(before) * np.linalg.norm(ahead)
        if size > 0 and before @ ahead < np.cos(_SHARP_KINK) * size:
            start = place
    return start


def median_radii(skeleton: Skeleton, points: np.ndarray, neighbours: int = 24) -> np.ndarray:
    """The paper's radii: median distance of the k nearest points to each node [m], shape [n]."""
    distance, _ = cKDTree(points).query(skeleton.nodes, k=min(neighbours, len(points)))
    return np.median(distance, axis=1)


def fit_precision(skeleton: Skeleton, points: np.ndarray) -> tuple[sparse.csc_matrix, float]:
    """How firmly points hold a fitted skeleton, and their noise [m].

    The covariance of (x, y, z, radius) of all nodes is noise^2 times the inverse of the matrix,
    shape [4 n, 4 n]: of a smoothing spline as Wahba (1983) has it. Its noise is that of single
    points, independent of each other. True errors of generated scans, averaged over ninths of the
    main axis, came to 1.0 of the deviations so foretold (medians over 0.6745) on 8 scans of both
    kinds, to 1.2 to 1.4 on 6 more of one side only. Where the axis ran into a twig and back, at a
    fork that one side hides, they were far larger.
    """
    match = match_cylinders(skeleton.parent, skeleton.order, skeleton.nodes, skeleton.radius,
                            points)
    noise = max(_robust_sigma(match.residual, match.thick), 1e-12)
    weight = _tukey(match.residual, np.full(len(points), _TUKEY * noise))
    return _system(skeleton, skeleton.nodes, skeleton.radius, match, weight, noise).matrix, noise


def _robust_sigma(residual: np.ndarray, radius: np.ndarray) -> float:
    """Noise [m] of points on the thicker half: around thin twigs, part of it passes for radius.

    Points that are farther than a radius from the surface may be something else's. Where noise
    reaches so far, those left out are made up for.
    """
    near = np.abs(residual) < radius
    if near.sum() < 10:
        near = np.ones(len(residual), bool)
    thick = near & (radius >= np.median(radius[near]))
    if thick.sum() >= _ENOUGH:
        near = thick
    middle = np.median(residual[near])
    told = 1.4826 * np.median(np.abs(residual[near] - middle))
    share = told / max(float(np.median(radius[near])), 1e-300)
    return float(told * np.interp(share, _MEASURED, _TRUE))


def _tukey(residual: np.ndarray, limit: np.ndarray) -> np.ndarray:
    return np.clip(1 - (residual / limit)**2, 0, None)**2


@dataclass
class _System:
    matrix: sparse.csc_matrix
    right: np.ndarray

    def solve(self) -> np.ndarray:
        """Step of each node: x, y, z, radius [m], shape [n, 4]."""
        return splu(self.matrix, permc_spec="MMD_AT_PLUS_A",
                    options={"SymmetricMode": True}).solve(self.right).reshape(-1, 4)


def _system(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray, match: Match,
            weight: np.ndarray, noise: float, place: np.ndarray | None = None,
            aims: Aims | None = None, across: np.ndarray | None = None) -> _System:
    data, right, per_node = _data_terms(skeleton.parent, nodes, match, weight, place, aims, across)
    smooth = _smoothness(skeleton, nodes, radius, per_node, noise)
    state = np.column_stack([nodes, radius]).ravel()
    anchor = _anchor(skeleton, nodes, per_node)
    matrix = (data + smooth + anchor).tocsc()
    return _System(matrix, right - smooth @ state)


def _data_terms(parent: np.ndarray, nodes: np.ndarray, match: Match, weight: np.ndarray,
                place: np.ndarray | None = None, aims: Aims | None = None,
                across: np.ndarray | None = None,
                ) -> tuple[sparse.csc_matrix, np.ndarray, np.ndarray]:
    """Normal equations of the residuals in (x, y, z, r) of both ends, and weight a node.

    Args:
        place: Mean direction of each point's true place (:mod:`noisy_rings`), shape [m, 3]; None:
            the nearest place on the circle is the true one.
        aims: How far out the points should lie; None: at the radius.
        across: How firmly points hold the axis across their own direction, shape [m, 3]; None: not.
    """
    count = len(nodes)
    aims = Aims(match.thick, match.thick) if aims is None else aims
    across = np.zeros_like(match.normal) if across is None else across
    place = match.normal if place is None else place
    low = np.where(match.own_radius, 0.0, 1 - match.share)
    high = np.where(match.own_radius, 1.0, match.share)
    distance = match.residual + match.thick
    pull = distance[:, None] * match.normal - aims.axis[:, None] * place
    grow = distance * np.einsum("mj,mj->m", match.normal, place) - aims.radius
    gradient = np.column_stack([
        (1 - match.share)[:, None] * pull, low * grow, match.share[:, None] * pull, high * grow])
    block, right = normal_blocks(match.segment, match.share, low, high, match.normal, across,
                                 gradient, weight, count)
    ends = np.arange(1, count)
    index = (4 * np.stack([parent[ends], ends], axis=1)[:, :, None] + np.arange(4)).reshape(-1, 8)
    rows = np.repeat(index, 8, axis=1).ravel()
    columns = np.tile(index, (1, 8)).ravel()
    matrix = sparse.coo_matrix((block[1:].ravel(), (rows, columns)), (4 * count, 4 * count))
    vector = np.bincount(index.ravel(), right[1:].ravel(), 4 * count)
    per_node = np.bincount(match.segment, weight * match.share, count)
    per_node += np.bincount(parent[match.segment], weight * (1 - match.share), count)
    return matrix.tocsc(), vector, per_node


def _smoothness(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray, per_node: np.ndarray,
                noise: float) -> sparse.csc_matrix:
    """Second differences along each run, weighted as a smoothing spline of a given bandwidth.

    A spline with penalty lambda on the squared second derivative and rho data a length averages
    over (lambda / rho)^(1/4); that length grows with the noise, in local radii.
    """
    rows, columns, values, scale_axis, scale_radius, slopes = [], [], [], [], [], []
    count = 0
    density = float(per_node.sum()) / max(skeleton.length, 1e-300)
    forks = skeleton.child_counts() > 1
    for run, members in enumerate(skeleton.runs()):
        chain = members if run == 0 else members[1:]
        if len(chain) < 3:
            continue
        step = np.maximum(np.linalg.norm(np.diff(nodes[chain], axis=0), axis=1), 1e-12)
        before, after = step[:-1], step[1:]
        mean = (before + after) / 2
        # The first radii, since a radius that grows by mistake must not blur its own axis.
        thick = skeleton.radius[chain[1:-1]]
        # Thinner than the noise, it bends no finer than if it were as thick as that: free to, its
        # axis would follow single points, until nothing is left of its radius.
        band = np.clip(_BAND * thick + 8.0 * noise, _BAND * thick,
                       _BAND_LIMIT * np.maximum(thick, noise))
        # Axes kink at forks: a branch's leader gives way to a strong twig.
        band *= np.where(forks[chain[1:-1]], 0.6, 1.0) * _straightness(skeleton.nodes[chain])
        index = count + np.arange(len(chain) - 2)
        rows += [index, index, index]
        columns += [chain[:-2], chain[1:-1], chain[2:]]
        values += [1 / before / mean, -(1 / before + 1 / after) / mean, 1 / after / mean]
        scale_axis.append(0.5 * density * band**4 * mean)
        scale_radius.append(density * (2.0 * band)**4 * mean)
        slopes.append((chain, step))
        count += len(chain) - 2
    size = len(nodes)
    if count == 0:
        return sparse.csc_matrix((4 * size, 4 * size))
    second = sparse.coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        (count, size)).tocsr()
    along = second.T @ sparse.diags(np.concatenate(scale_axis)) @ second
    thick = (second.T @ sparse.diags(np.concatenate(scale_radius)) @ second
             + _slope_terms(slopes, radius, density))
    return (sparse.kron(along, sparse.diags([1.0, 1, 1, 0]))
            + sparse.kron(thick, sparse.diags([0.0, 0, 0, 1]))).tocsc()


def _straightness(nodes: np.ndarray) -> np.ndarray:
    """1 where the contracted axis is straight, down to 0.3 at its kinks, shape [n - 2]."""
    place = np.arange(1, len(nodes) - 1)
    before = nodes[place] - nodes[np.maximum(place - 2, 0)]
    after = nodes[np.minimum(place + 2, len(nodes) - 1)] - nodes[place]
    cosine = np.einsum("ij,ij->i", before, after) / np.maximum(
        np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1), 1e-300)
    return np.clip(1.3 - np.arccos(np.clip(cosine, -1, 1)), 0.3, 1.0)


def _slope_terms(chains: list[tuple[np.ndarray, np.ndarray]], radius: np.ndarray,
                 density: float) -> sparse.csr_matrix:
    """Weak penalty on a radius's slope: branches are no cones, whatever stray points say."""
    low = np.concatenate([chain[:-1] for chain, _ in chains])
    high = np.concatenate([chain[1:] for chain, _ in chains])
    step = np.concatenate([step for _, step in chains])
    index = np.arange(len(step))
    first = sparse.coo_matrix(
        (np.concatenate([-1 / step, 1 / step]), (np.tile(index, 2), np.concatenate([low, high]))),
        (len(step), len(radius))).tocsr()
    thick = (radius[high] + radius[low]) / 2
    return first.T @ sparse.diags(density * (_SLOPE * thick)**2 * step) @ first


def _anchor(skeleton: Skeleton, nodes: np.ndarray, per_node: np.ndarray) -> sparse.csc_matrix:
    """Hold nodes along their axis, where points say nothing, and weakly elsewhere."""
    typical = float(np.median(per_node[per_node > 0])) if (per_node > 0).any() else 1.0
    direction = np.zeros_like(nodes)
    for members in skeleton.runs():
        direction[members[1:]] = tangents(nodes[members])[1:]
    direction[0] = tangents(nodes[skeleton.runs()[0]])[0]
    block = np.zeros((len(nodes), 4, 4))
    block[:, :3, :3] = typical * direction[:, :, None] * direction[:, None, :]
    block[:, range(4), range(4)] += 1e-3 * typical
    return sparse.bsr_matrix((block, np.arange(len(nodes)), np.arange(len(nodes) + 1))).tocsc()


def _uncertainty(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray, match: Match,
                 weight: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation of each radius [m], and whether the node has points of its own."""
    system = _system(skeleton, nodes, radius, match, weight, noise)
    _, _, per_node = _data_terms(skeleton.parent, nodes, match, weight)
    factor = splu(system.matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
    # Nodes so far apart say nothing about each other: the inverse's diagonal is read off one
    # solve for all of them. Nodes of a run have consecutive numbers.
    period = min(_PROBE, len(nodes))
    unit = np.zeros((4 * len(nodes), period))
    own = np.arange(len(nodes))
    unit[4 * own + 3, own % period] = 1.0
    variance = factor.solve(unit)[4 * own + 3, own % period]
    return noise * np.sqrt(np.maximum(variance, 0)), per_node > 2.0


def _meeting(skeleton: Skeleton, carrier: np.ndarray, first: int, direction: np.ndarray) -> int:
    """Carrier node nearest to the twig's line followed back from its first node outside.

    A twig grows away from its fork: a node that its line meets ahead is none, unless all are.
    """
    offset = skeleton.nodes[carrier] - skeleton.nodes[first]
    back = -(offset @ direction)
    across = np.linalg.norm(offset + back[:, None] * direction, axis=1)
    # No farther back than the carrier is thick: at a small angle the lines meet far away.
    reach = np.linalg.norm(offset, axis=1).min() * 2.5
    allowed = np.linalg.norm(offset, axis=1) <= reach
    if (allowed & (back > 0)).any():
        allowed &= back > 0
    return int(carrier[np.argmin(np.where(allowed, across, np.inf))])
