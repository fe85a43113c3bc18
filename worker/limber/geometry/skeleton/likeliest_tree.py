"""The likeliest tree of a thin scan, by proposals.

Where points are few and scatter as far as twigs are thick, no step can decide for itself what is
wood. So each change is a proposal: leave out a twig, draw an end back, lengthen it, add a twig
towards points that are badly explained, or one of another search. It is kept if the score rises
(:mod:`~limber.geometry.skeleton.tree_likelihood`). Between them axes and radii go to the largest
posterior with the prior of wood: an expectation step asks where on the skin each point was, given
the noise, and a maximisation step moves axes and radii to fit (Dempster, Laird, Rubin 1977).
"""

from dataclasses import dataclass, replace
from operator import itemgetter

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from scipy.special import i0e, i1e

from limber.core.progress import SILENT, Progress
from limber.geometry.cloud.leaves import ALIKE
from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.confidence import assessed, doubted
from limber.geometry.skeleton.likelihood_kernels import densities, falling, left
from limber.geometry.skeleton.path_tree import path_tree
from limber.geometry.skeleton.radii.axis_fit import held_by_points
from limber.geometry.skeleton.radii.fit_kernels import Match, cylinders_around, nearest_cylinders
from limber.geometry.skeleton.radii.projected_widths import by_projected_widths
from limber.geometry.skeleton.radii.wood import Bends, Wood, turn_cost, turn_variance
from limber.geometry.skeleton.repair import PointSpacing, resampled, without_kinks
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.tree_likelihood import PointLikelihood, Scatter
from limber.kernels import Kernel

_SPACING = 1.5  # radii between nodes
_PASSES, _STEPS, _LAST_STEPS = 6, 6, 10  # rounds of proposals; steps of a fit between and after
# Length of the main path over the radius at its base, and the deviation of its logarithm, where
# the scan shows no skin: twelve plants of six generators have 52 to 142.
_SLENDER, _SLENDER_SIGMA = 92.0, 0.5
_ALONG, _HELD = 0.3, 10.0  # radii that a step moves nodes along their axis, and at all
_CHANGE = 0.5  # most that a step changes the logarithm of a radius
_FIRM = 0.02  # least part of a point's weight with which it holds the axis across
_TWIG = 0.4  # radius of a new twig over that of its carrier
_PARTS = 4  # of a run of another search, from each of which on its end may be a twig
_BADLY, _FEET, _TIPS = 400, 8, 2  # points explained worst; nodes and ends from which twigs may lead
# Deviation of the logarithm of a tree's length, besides that between searches and by what twigs
# cost (42 scans of the worlds).
_APART = 0.08
# A deviation of what a twig costs, as a factor: points of twigs side by side are not independent,
# nor is their noise the same everywhere, so what a twig must explain is not known well.
_DEARER = 4.0
_BESIDE, _KNOWN = 6, 32  # cylinders a point may be of, of so many around it
_SHARP = (0.5, 0.25, 0.12, 0.06)  # noise across a sensor's sight over that along it, in turn
_STEEP = 0.3  # least height of a front in radii by which that goes with the radius
# Distances and angles at which the density of a new twig is known, and steps of the logarithm of
# its radius.
_TABLE, _FACINGS, _LEVEL = 48, 9, 0.05

def rival_tree(known: Skeleton, points: np.ndarray, view: View | None = None,
               progress: Progress = SILENT) -> tuple[Skeleton, float, int, float]:
    """Return the likeliest tree found from the ``known``, from paths through the ``points`` [m, 3]
    [m], or from the better of both with twigs of the other; the noise [m], the number of twigs
    left out, and the standard deviation of the logarithm of its length."""
    apart = PointSpacing.of(points)
    # A beam wider than twigs shows them like thick axes; a thin one shows skins by their area.
    scan = max((replace(PointLikelihood.of(points), power=power) for power in (0.0, 0.5, 1.0)),
               key=lambda one: one.score(known))
    searches = sorted((likeliest_tree(first, scan, apart, part) for first, part in (
        (known, progress.part(0.0, 0.3)),
        (path_tree(points, known.nodes[0], apart), progress.part(0.3, 0.6)))), key=itemgetter(2))
    both = grafted(State.of(searches[1][0], scan), searches[0][0]).skeleton
    if both is not searches[1][0]:
        searches.append(likeliest_tree(both, scan, apart, progress.part(0.6, 0.7)))
    skeleton, count, score, _ = max(searches, key=itemgetter(2))
    # Whether one sensor saw them is asked of whole searches: twigs that hang to one side of a
    # thick axis look so too, and a thin axis beside a branch's middle hides it.
    wide, seen, starts = skeleton, scan.where_seen(skeleton), []
    for sharp in _SHARP:  # at once, thin axes would stay where their points are
        seen = replace(seen.turned(wide), sharp=sharp)
        wide = fitted(_spaced(wide, apart), seen, _STEPS)
        starts.append((seen.score(wide), wide, seen))
    sighted, wide, seen = max(starts, key=itemgetter(0))
    other = wide
    if sighted > score:
        other, more, sighted, seen = likeliest_tree(wide, seen, apart, progress.part(0.7, 1.0))
    if sighted > score + scan.twig_cost:  # it has numbers too
        scan, skeleton, other, count = seen, other, skeleton, count + more
    skeleton = fitted(_spaced(skeleton, apart), scan, _LAST_STEPS)
    spaced, cost = _spaced(skeleton, apart), scan.twig_numbers
    few, many = (State.of(spaced, replace(scan, twig_numbers=each)) for each in (
        _DEARER * cost, cost / _DEARER))
    unknown = np.log(grown(many, apart).skeleton.length / drawn_back(pruned(few)).skeleton.length)
    last = drawn_back(pruned(State.of(skeleton, scan)))
    skeleton, chances = last.skeleton, last.chances
    residual = nearest_cylinders(skeleton, points)[1]
    noise = float(1.4826 * np.median(np.abs(residual - np.median(residual))))
    if rays := scan.sight is not None:
        # One sensor's rays show widths, which the noise along its sight leaves as they are.
        skeleton, _ = by_projected_widths(skeleton, points, view)
    found = assessed(skeleton.on_grid(), points, noise, rays=rays, view=view if rays else None)
    even, _ = without_kinks(replace(found, probability=chances[skeleton.branch]))
    there = even.probability[[own[0] for own in even.own_runs()]]
    return doubted(even, points, noise, there), noise, count, float(np.linalg.norm(
        [_APART, unknown / 2, np.log(other.length / skeleton.length) / 2]))


def likeliest_tree(skeleton: Skeleton, scan: PointLikelihood, apart: PointSpacing,
                   progress: Progress = SILENT) -> tuple[Skeleton, int, float, PointLikelihood]:
    """The likeliest tree found from a first one, the number of twigs left out, the score, and the
    scan as its sensor then sees it."""
    count, found = 0, (-np.inf, skeleton, scan)
    for number in range(_PASSES):
        progress(number / _PASSES, "comparing trees")
        skeleton = fitted(_spaced(skeleton, apart), scan, _STEPS)
        rest = drawn_back(pruned(State.of(skeleton, scan.turned(skeleton))))
        count += skeleton.branch_count - rest.skeleton.branch_count
        score = rest.scan.score(rest.skeleton)
        if score > found[0]:
            found = score, rest.skeleton, rest.scan
        after = grown(rest, apart)
        if after is rest:
            break
        skeleton, scan = after.skeleton, after.scan
    return found[1], count, found[0], found[2]


def _spaced(skeleton: Skeleton, apart: PointSpacing) -> Skeleton:
    """The skeleton with nodes as far apart as radii and points allow."""
    return resampled(skeleton, _SPACING, apart.at(skeleton.nodes))


# Axes and radii of the largest posterior.


def fitted(skeleton: Skeleton, scan: PointLikelihood, steps: int) -> Skeleton:
    """Return the skeleton after so many steps of its axes and radii to the largest posterior."""
    prior = _Prior.of(skeleton)
    for _ in range(steps):
        skeleton = _step(skeleton, scan, prior)
    return skeleton


def _step(skeleton: Skeleton, scan: PointLikelihood, prior: "_Prior") -> Skeleton:
    match = scan.match(skeleton)
    density = scan.densities(skeleton, match)
    scatter = scan.scattered(skeleton, density)
    share = density * scatter.shares / scan.skin(skeleton).sum()
    share /= (share.sum(axis=1) + scatter.background / scan.volume)[:, None]
    weight = (share / scan.noises**2).sum(axis=1)
    axes, count = scan.axes(skeleton, match), share.sum(axis=1)
    # Of points that no axis explains it is the common one.
    variance = (count + 1e-12) / (weight + 1e-12 / scatter.scale**2)
    own, right = _all_around(skeleton, match, axes, weight) if scan.sight is None else _by_rays(
        skeleton, match, axes, count, variance, scan)
    # In logarithms of radii.
    unit = np.column_stack([np.ones_like(skeleton.nodes), skeleton.radius]).ravel()
    own = own.multiply(unit).T.multiply(unit)
    step = prior.solved(own, unit * right,
                        np.column_stack([skeleton.nodes, np.log(skeleton.radius)]))
    far = np.linalg.norm(step[:, :3], axis=1) / np.maximum(skeleton.radius, scatter.scale)
    move = step[:, :3] / np.maximum(far, 1.0)[:, None]
    log_radius = np.log(skeleton.radius) + np.clip(step[:, 3], -_CHANGE, _CHANGE)
    return replace(skeleton.moved(skeleton.nodes + move), radius=np.exp(
        falling(log_radius, own.diagonal()[3::4] + 1.0, skeleton.parent))).on_grid()


@dataclass(frozen=True)
class _Prior:
    """The prior of wood of n nodes (x, y, z [m], logarithm of the radius) and k trends, as it is
    at the start of a fit: precision [4 n + k, 4 n + k], precision times mean [4 n + k], and how
    firmly a step holds its nodes [4 n, 4 n]."""

    precision: sparse.csc_matrix
    pull: np.ndarray
    hold: sparse.csc_matrix

    @classmethod
    def of(cls, skeleton: Skeleton) -> "_Prior":
        """That of a tree, with a weak one of the thickness where no skin shows it."""
        count, wood = skeleton.node_count, Wood.of(skeleton, skeleton.radius)
        start, weight = wood.start.copy(), wood.weight.copy()
        start[0] = np.log(float(skeleton.arc_length.max()) / _SLENDER)
        weight[0] = _SLENDER_SIGMA**-2
        wood = replace(wood, start=start, weight=weight)
        trends = len(wood.known)
        row = np.concatenate([4 * np.arange(count) + 3, 4 * count + np.arange(trends)])
        place = sparse.coo_matrix((np.ones(count + trends), (row, np.arange(count + trends))),
                                  (4 * count + trends, count + trends)).tocsr()
        bends = Bends.of(skeleton).after(skeleton.nodes).precision()
        axes, block = skeleton.axes(), np.zeros((count, 4, 4))
        block[:, :3, :3] = (axes[:, :, None] * axes[:, None, :]
                            / (_ALONG * skeleton.radius)[:, None, None]**2)
        block[:, :3, :3] += np.eye(3) / (_HELD * skeleton.radius)[:, None, None]**2
        block[:, 3, 3] = 1.0
        hold = sparse.bsr_matrix((block, np.arange(count), np.arange(count + 1)))
        return cls((place @ wood.precision @ place.T + _padded(bends, trends)).tocsc(),
                   place @ wood.pull, _padded(hold.tocsr(), trends))

    def solved(self, own: sparse.spmatrix, right: np.ndarray, state: np.ndarray) -> np.ndarray:
        """The step [n, 4] from a ``state`` [n, 4] by the normal equations of the points."""
        trends = len(self.pull) - state.size
        flat = np.concatenate([state.ravel(), np.zeros(trends)])
        matrix = self.precision + self.hold + _padded(own.tocsr(), trends)
        factor = splu(matrix.tocsc(), permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        return factor.solve(np.append(right, np.zeros(trends)) + self.pull - self.precision @ flat,
                            )[:state.size].reshape(-1, 4)


def _padded(matrix: sparse.csr_matrix, more: int) -> sparse.csr_matrix:
    """A matrix with so many more rows and columns of zeros."""
    matrix = matrix.copy()
    matrix.resize(matrix.shape[0] + more, matrix.shape[0] + more)
    return matrix


def _all_around(skeleton: Skeleton, match: Match, axes: np.ndarray, weight: np.ndarray,
                ) -> tuple[sparse.csc_matrix, np.ndarray]:
    """Normal equations of axes and radii, given where on the skin each point was: the mean of a von
    Mises distribution about where it was measured, with ``weight`` [1/m^2], shape [m]."""
    distance = np.maximum(match.residual + match.thick, 1e-12)
    sharpness = distance * match.thick * weight
    mean = i1e(sharpness) / i0e(sharpness)
    firm = np.maximum(1 - match.thick * mean / distance, _FIRM)
    return held_by_points(
        skeleton.parent, match, weight, match.normal,
        np.sqrt(firm)[:, None] * np.cross(axes, match.normal),
        (distance - match.thick * mean)[:, None] * match.normal, distance * mean - match.thick)


def _by_rays(skeleton: Skeleton, match: Match, axes: np.ndarray, weight: np.ndarray,
             variance: np.ndarray, scan: PointLikelihood) -> tuple[sparse.csc_matrix, np.ndarray]:
    """Normal equations of axes and radii by moments of a sensor's rays: across its sight they are
    even from edge to edge, and along it at the front. ``variance`` [m^2] is that along the sight,
    and points have weights, shape [m] each."""
    towards, open_ = scan.across(axes)
    towards = np.where(np.isnan(towards), match.normal, towards)
    beside, thick = np.cross(axes, towards), match.thick
    aside, deep = ((match.residual + thick) * np.einsum("mj,mj->m", match.normal, way)
                   for way in (beside, towards))
    across = scan.sharp**2 * variance
    along = open_**2 * variance + (1 - open_**2) * across
    # The mean of a point's distance beside the axis, how that goes with the radius, its variance.
    mean = np.sqrt(thick**2 / 4 + 2 / np.pi * across)
    slope = thick / (4 * mean)
    spread = thick**2 / 12 + (1 - 2 / np.pi) * across
    firm = spread / slope**2 / (thick**2 / 3 + across)
    known = 1 / (1 + 3 * across / thick**2)
    front = np.sqrt(1 - known * np.minimum((aside / thick)**2, 1.0) - (1 - known) / 3)
    rise = (2 + known) / (3 * np.maximum(front, _STEEP))
    miss = (deep - thick * front) / rise
    one, other = (held_by_points(skeleton.parent, match, *terms) for terms in (
        (weight * slope**2 / spread, 0 * beside, np.sqrt(firm)[:, None] * beside,
         (firm * aside)[:, None] * beside, (np.abs(aside) - mean) / slope),
        (weight * rise**2 / along, towards / rise[:, None], 0 * towards,
         (miss / rise)[:, None] * towards, miss)))
    return one[0] + other[0], one[1] + other[1]


# Proposals: each changes the density of few points, the length, and the bends.


@dataclass(frozen=True)
class State:
    """A tree, the density of the scan's points on its skin [1/m], shape [m], under a scatter that
    the proposals leave; the skin of each cylinder [m^2], shape [n]; the cylinders around each point
    [m, k], nearest first, its own [m] and distance from that [m], shape [m]; and what the turn
    before each node costs [n]."""

    skeleton: Skeleton
    scan: PointLikelihood
    scatter: Scatter
    wood: np.ndarray
    skin: np.ndarray
    near: np.ndarray
    segment: np.ndarray
    residual: np.ndarray
    turns: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, scan: PointLikelihood, scatter: Scatter | None = None,
           ) -> "State":
        """The state of a tree; with the likeliest scatter if none is given."""
        near = cylinders_around(skeleton.parent, skeleton.nodes, scan.points, _KNOWN)
        match = scan.match(skeleton, near[:, :_BESIDE])
        density = scan.densities(skeleton, match)
        scatter = scatter or scan.scattered(skeleton, density)
        return cls(skeleton, scan, scatter, density @ scatter.shares, scan.skin(skeleton), near,
                   match.segment, match.residual, Bends.of(skeleton).costs(skeleton.nodes))

    @property
    def log(self) -> float:
        """Its score."""
        return self.scan.log(self.wood, self.scatter, float(self.skin.sum()),
                             self.skeleton.branch_count) - float(self.turns.sum())

    @property
    def chances(self) -> np.ndarray:
        """Probability [runs] that each run exists where its carrier does, by how much the score
        falls without it and what it carries: neighbouring points count once for all."""
        run, carrier = self.skeleton.branch, self.skeleton.branch[self.skeleton.parent]
        mine = run == np.arange(self.skeleton.branch_count)[:, None]
        odds = np.full(len(mine), np.inf)
        for each in range(len(mine) - 1, 0, -1):  # a run carried by another has a higher number
            odds[each] = (self.log - self.without(mine[each], len(np.unique(run[mine[each]])))
                          ) / ALIKE
            mine[carrier[np.argmax(run == each)]] |= mine[each]
        return 1 / (1 + np.exp(-odds))

    def without(self, nodes: np.ndarray, runs: int = 0) -> float:
        """The score without nodes, a mask [n], whose children are all among them; ``runs`` of them
        are whole."""
        skeleton, own = self.skeleton, np.flatnonzero(nodes[self.segment])
        wood = self.wood
        if len(own):
            near, wood = left(self.near[own], nodes, _BESIDE), wood.copy()
            wood[own] = 0.0  # what is farther off is background
            some, near = own[near[:, 0] > 0], near[near[:, 0] > 0]
            match = self.scan.match(skeleton, near, some)
            wood[some] = self.scan.densities(skeleton, match, some) @ self.scatter.shares
        return self.scan.log(wood, self.scatter,
                             float(self.skin[~nodes].sum()),
                             skeleton.branch_count - runs) - float(self.turns[~nodes].sum())


def pruned(state: State) -> State:
    """Leave out the twigs without which the score rises, the largest rise first."""
    while True:
        skeleton, run, best = state.skeleton, state.skeleton.branch, state.log
        carriers = np.unique(run[skeleton.parent[1:]][run[1:] != run[skeleton.parent[1:]]])
        bare = np.setdiff1d(np.arange(1, skeleton.branch_count), carriers)
        scores = np.array([state.without(run == each, 1) for each in bare])
        gone, count = np.zeros(skeleton.node_count, bool), 0
        for each in bare[np.argsort(-scores, kind="stable")][:int((scores > best).sum())]:
            score = state.without(gone | (run == each), count + 1)
            if score > best:
                best, gone, count = score, gone | (run == each), count + 1
        if not count:
            return state
        state = State.of(skeleton.subset(~gone), state.scan, state.scatter)


def drawn_back(state: State) -> State:
    """Shorten ends to where the score is highest."""
    skeleton, best = state.skeleton, state.log
    gone, children = np.zeros(skeleton.node_count, bool), skeleton.child_counts()
    for tip in skeleton.tips():
        node, tried, shorter = int(tip), gone.copy(), gone
        while skeleton.parent[node] > 0 and children[skeleton.parent[node]] == 1:
            tried[node] = True
            score = state.without(tried)
            if score > best:
                best, shorter = score, tried.copy()
            node = int(skeleton.parent[node])
        gone = shorter
    return State.of(skeleton.subset(~gone), state.scan, state.scatter) if gone.any() else state


def grown(state: State, apart: PointSpacing) -> State:
    """Lengthen ends, or add twigs, to points that are badly explained, where the score rises most
    first."""
    while True:
        twigs, chosen = _Twigs.of(state, apart), []
        gain = twigs.gains(state)
        used = np.zeros(len(state.scan.points), bool)
        for k in np.argsort(-gain, kind="stable"):
            if gain[k] <= 0:
                break
            if used[twigs.to[k]]:
                continue
            nearer = twigs.nearer(int(k), state)
            if not used[nearer].any():
                used |= nearer
                chosen.append(int(k))
        after = State.of(twigs.added(chosen, state.skeleton, apart), state.scan,
                         state.scatter) if chosen else state
        if after.log <= state.log:
            return state
        state = after


def grafted(state: State, other: Skeleton) -> State:
    """Add runs of another tree, or only their ends, where the score rises."""
    for run in range(other.branch_count):
        nodes, radius = other.curve(run)
        firsts = np.unique(np.arange(_PARTS) * (len(nodes) - 1) // _PARTS) + 1
        state = max([state, *(State.of(_hung(state.skeleton, nodes[first:], radius[first:]),
                                       state.scan, state.scatter) for first in firsts)],
                    key=lambda one: one.log)
    return state


def _hung(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray) -> Skeleton:
    """The skeleton with a chain of nodes [k, 3] [m] with radii [m] that hangs on its nearest."""
    foot, made = cKDTree(skeleton.nodes).query(nodes[0])[1], skeleton.node_count
    parent = np.concatenate([skeleton.parent, [foot], made + np.arange(len(nodes) - 1)])
    return Skeleton.from_edges(np.vstack([skeleton.nodes, nodes]), parent,
                               np.append(skeleton.radius, radius))


@dataclass(frozen=True)
class _Twigs:
    """Straight twigs that may be added, or that lengthen ends: their feet, nodes [t]; the points
    that they lead to [t], and where these are [m], shape [t, 3]; radii [m], shape [t]; and what
    fork or turn at the foot costs [t]."""

    foot: np.ndarray
    to: np.ndarray
    end: np.ndarray
    radius: np.ndarray
    cost: np.ndarray

    @classmethod
    def of(cls, state: State, apart: PointSpacing) -> "_Twigs":
        """Those to the points explained worst, from the nearest nodes and ends."""
        skeleton, points = state.skeleton, state.scan.points
        badly = np.sort(np.argsort(state.wood, kind="stable")[:_BADLY])
        tips, children = skeleton.tips(), skeleton.child_counts()
        near = [all_of[cKDTree(skeleton.nodes[all_of]).query(points[badly], k=min(
            count, len(all_of)))[1].reshape(len(badly), -1)]
                for all_of, count in ((np.arange(skeleton.node_count), _FEET), (tips, _TIPS))]
        pairs = np.unique(np.column_stack([np.hstack(near).ravel(), np.repeat(
            badly, sum(each.shape[1] for each in near))]), axis=0)
        way = points[pairs[:, 1]] - skeleton.nodes[pairs[:, 0]]
        length = np.linalg.norm(way, axis=1)
        apart_from = length > skeleton.radius[pairs[:, 0]]
        (foot, to), way, length = pairs[apart_from].T, way[apart_from], length[apart_from]
        before = skeleton.nodes[foot] - skeleton.nodes[np.maximum(skeleton.parent[foot], 0)]
        step = np.linalg.norm(before, axis=1)
        turn = way / length[:, None] - before / np.maximum(step, 1e-300)[:, None]
        mean = (step + np.minimum(length, _SPACING * apart.at(points[to]))) / 2
        bend = turn_cost(np.sum(turn**2, axis=1) / turn_variance(mean, skeleton.radius[foot]))
        goes_on = children[foot] == 0
        return cls(foot, to, points[to], skeleton.radius[foot] * np.where(goes_on, 1.0, _TWIG),
                   np.where(goes_on, bend, state.scan.twig_cost))

    def gains(self, state: State) -> np.ndarray:
        """By how much each raises the score, shape [t]."""
        scan, skeleton = state.scan, state.skeleton
        level, table_of = np.unique(np.round(np.log(self.radius) / _LEVEL), return_inverse=True)
        distance = np.append(0.0, np.geomspace(scan.noises[0] / 2, 33 * scan.noises[-1], _TABLE))
        facing = np.linspace(-1, 1, _FACINGS) if scan.sight is not None else np.full(1, np.nan)
        grid = np.array(np.meshgrid(np.exp(level * _LEVEL), facing, distance, indexing="ij"))
        density = densities(grid[2].ravel(), grid[0].ravel(), grid[1].ravel(),
                            np.ones(grid[0].size), scan.noises, scan.power, scan.sharp,
                            ) @ state.scatter.shares
        table = np.log(np.maximum(density, 1e-300)).reshape(grid.shape[1:])
        return _raised(
            skeleton.nodes[self.foot], self.end, self.radius, table_of, scan.power, table,
            np.log(distance[1:3]), scan.points, np.zeros((0, 3)) if scan.sight is None
            else scan.sight,
            state.wood, state.residual, float(state.skin.sum()),
            state.scatter.background / scan.volume) - self.cost

    def nearer(self, k: int, state: State) -> np.ndarray:
        """Which points would be a twig's, a mask [m]."""
        start, points = state.skeleton.nodes[self.foot[k]], state.scan.points
        way = self.end[k] - start
        share = np.clip((points - start) @ way / (way @ way), 0.0, 1.0)
        distance = np.linalg.norm(points - start - share[:, None] * way, axis=1)
        return distance - self.radius[k] < state.residual

    def added(self, chosen: list[int], skeleton: Skeleton, apart: PointSpacing) -> Skeleton:
        """The skeleton with those chosen."""
        spacing = _SPACING * np.maximum(apart.at(self.end[chosen]), 1e-6)
        nodes, parent, radius = [skeleton.nodes], [skeleton.parent], [skeleton.radius]
        made = skeleton.node_count
        for k, step in zip(chosen, spacing, strict=True):
            start = skeleton.nodes[self.foot[k]]
            count = max(round(float(np.linalg.norm(self.end[k] - start) / step)), 1)
            share = np.arange(1, count + 1)[:, None] / count
            nodes.append(start + (self.end[k] - start) * share)
            parent.append(np.append(self.foot[k], made + np.arange(count - 1)))
            radius.append(np.full(count, self.radius[k]))
            made += count
        return Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))


_RAISED = Kernel(
    "likelihood_raised", "foot float64[cylinders, 3]", "end float64[cylinders, 3]",
    "radius float64[cylinders]", "table_of int64[cylinders]",
    "table float64[tables, facings, distances]", "first float64[2]", "points float64[points, 3]",
    "sight float64[sighted, 3]", "wood float64[points]", "residual float64[points]",
    "out rise float64[cylinders]", "power float", "skin float", "elsewhere float")


def _raised(foot: np.ndarray, end: np.ndarray, radius: np.ndarray, table_of: np.ndarray,
            power: float, table: np.ndarray, first: np.ndarray, points: np.ndarray,
            sight: np.ndarray, wood: np.ndarray, residual: np.ndarray, skin: float,
            elsewhere: float) -> np.ndarray:
    """By how much each of t cylinders raises the logarithm of the likelihood of points [m, 3] with
    densities ``wood`` [m] on a ``skin``. ``table`` [tables, facings, distances] holds logarithms of
    that on theirs, at 0 and at distances whose logarithms are evenly spaced."""
    rise = np.empty(len(foot))
    _RAISED.of(foot, end, radius, table_of, table, first[:2], points, sight.reshape(-1, 3), wood,
               residual, rise, power, skin, elsewhere)
    return rise
