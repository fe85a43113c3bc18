"""The likeliest tree of a thin scan, from that of its contracted points, by proposals.

Where points are few and scatter as far as twigs are thick, no step can decide for itself what is
wood. So each change is a proposal: leave out a twig, draw an end back, lengthen it, add a twig
towards points that nothing explains. It is kept if the score rises
(:mod:`~limber.geometry.skeleton.tree_likelihood`). Between them axes and radii go to the largest
posterior with the prior of wood: an expectation step asks where on the skin each point was, given
the noise, and a maximisation step moves axes and radii to fit (Dempster, Laird, Rubin 1977).
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import splu
from scipy.spatial import cKDTree
from scipy.special import ive, ndtr

from limber.core.progress import SILENT, Progress
from limber.geometry.skeleton.confidence import assessed, doubted
from limber.geometry.skeleton.radii.axis_fit import TargetDistances, data_terms
from limber.geometry.skeleton.radii.fit_kernels import Match, match_cylinders, nearest_cylinders
from limber.geometry.skeleton.radii.wood import Bends, Wood
from limber.geometry.skeleton.repair import PointSpacing, resampled, without_kinks
from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.tree_likelihood import DIRECTIONS, HIDDEN, PointLikelihood, Scatter

SEARCHED_POINTS = 1_500
"""Most points of a scan that is searched so: a limit of time."""
_SPACING = 1.5  # radii between nodes
_PASSES, _STEPS, _LAST_STEPS = 4, 6, 10  # rounds of proposals; steps of a fit between and after
# Length of the main path over the radius at its base, and the deviation of its logarithm, where
# the scan shows no skin: twelve plants of six generators have 52 to 142.
_SLENDER, _SLENDER_SIGMA = 92.0, 0.5
_ALONG, _HELD = 0.3, 10.0  # radii that a step moves nodes along their axis, and at all
_CHANGE = 0.5  # most that a step changes the logarithm of a radius
_FIRM = 0.02  # least part of a point's weight with which it holds the axis across
_TWIG = 0.6  # radius of a new twig over that of its carrier
_FURTHER = 4.0  # numbers that an axis to a further point costs
_TIPS = 2  # of the nearest ends that may go on to a point
_SIDE_POINTS, _SIDE_STEPS = 600, 3  # points and steps that show from which side a scan was seen
_ANGLE = 2 * np.pi * (np.arange(48) + 0.5) / 48  # of positions around an axis
_EDGE = 8.0  # sharpness of the border between seen and hidden half
_SHARP = 60.0  # concentration from which a point's place on the skin is known


def rival_tree(first: Skeleton, known: Skeleton, points: np.ndarray, progress: Progress = SILENT,
               ) -> tuple[Skeleton, float, int] | None:
    """Return the likeliest tree found from the ``first``, that of the contracted points with all
    its spurs, the noise [m] and the number of twigs left out, if it scores more than the ``known``;
    ``points`` [m, 3] [m] are the scan's."""
    skeleton, side, count = likeliest_tree(first, points, progress)
    residual = nearest_cylinders(skeleton, points)[1]
    noise = float(1.4826 * np.median(np.abs(residual - np.median(residual))))
    found = assessed(skeleton, points, noise, one_sided=side is not None)
    even, kinks = without_kinks(found)
    found = doubted(even, points, noise) if kinks else found
    scan = PointLikelihood.of(points)
    return (found, noise, count) if scan.best(found) > scan.best(known) else None


def likeliest_tree(first: Skeleton, points: np.ndarray, progress: Progress = SILENT,
                   ) -> tuple[Skeleton, np.ndarray | None, int]:
    """The likeliest tree found from the ``first``, the direction [3] from which the scan saw it
    (None: from all around), and the number of twigs left out."""
    scan, apart = PointLikelihood.of(points), PointSpacing.of(points)
    skeleton, count = first, 0
    for number in range(_PASSES):
        progress(number / (_PASSES + 1), "comparing trees")
        skeleton = resampled(skeleton, _SPACING, apart.at(skeleton.nodes))
        state = State.of(fitted(skeleton, scan, _STEPS), scan)
        rest = pruned(state)
        count += state.skeleton.branch_count - rest.skeleton.branch_count
        after = grown(drawn_back(rest), apart)
        skeleton = after.skeleton
        if after is state:
            break
    skeleton = fitted(resampled(skeleton, _SPACING, apart.at(skeleton.nodes)), scan, _STEPS)
    progress(_PASSES / (_PASSES + 1), "which side was seen")
    side = _side(skeleton, points)
    return (skeleton if side is None else fitted(skeleton, scan.seen_from(side), _LAST_STEPS),
            side, count)


def _side(skeleton: Skeleton, points: np.ndarray) -> np.ndarray | None:
    """The direction from which the scan saw the tree, if axes and radii that fit it score more."""
    some = points[:: max(len(points) // _SIDE_POINTS, 1)]
    scan = PointLikelihood.of(some)

    def after(side: np.ndarray | None) -> float:
        seen = scan.seen_from(side)
        return seen.score(fitted(skeleton, seen, _SIDE_STEPS))

    return max((None, *DIRECTIONS), key=after)


# Axes and radii of the largest posterior.


def fitted(skeleton: Skeleton, scan: PointLikelihood, steps: int) -> Skeleton:
    """Return the skeleton after so many steps of its axes and radii to the largest posterior."""
    prior = _Prior.of(skeleton)
    for _ in range(steps):
        skeleton = _step(skeleton, scan, prior)
    return skeleton


def _step(skeleton: Skeleton, scan: PointLikelihood, prior: "_Prior") -> Skeleton:
    match = scan.match(skeleton)
    distance = np.maximum(match.residual + match.thick, 1e-12)
    density = scan.across(distance, match.thick, scan.facing(skeleton, match, match.normal))
    scatter = scan.scattered(skeleton, match, density)
    share = density * scatter.shares / skeleton.length
    share /= (share.sum(axis=1) + scatter.background / scan.volume)[:, None]
    weight = (share / scan.noises**2).sum(axis=1)
    across = np.cross(scan.axes(skeleton, match), match.normal)
    place = _places(skeleton, match, distance * match.thick * weight, scan, across)
    outwards = np.einsum("mj,mj->m", place, match.normal)
    firm = np.maximum(1 - match.thick * outwards / distance, _FIRM)
    own, right, _ = data_terms(skeleton.parent, skeleton.nodes, match, weight, place,
                               TargetDistances(match.thick, match.thick),
                               np.sqrt(firm)[:, None] * across)
    # In logarithms of radii.
    unit = np.column_stack([np.ones_like(skeleton.nodes), skeleton.radius]).ravel()
    step = prior.solved(own.multiply(unit).T.multiply(unit), unit * right,
                        np.column_stack([skeleton.nodes, np.log(skeleton.radius)]))
    far = np.linalg.norm(step[:, :3], axis=1) / np.maximum(skeleton.radius, scatter.scale)
    move = step[:, :3] / np.maximum(far, 1.0)[:, None]
    return replace(skeleton.moved(skeleton.nodes + move),
                   radius=skeleton.radius * np.exp(np.clip(step[:, 3], -_CHANGE, _CHANGE)))


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
    size = matrix.shape[0] + more
    return sparse.csr_matrix((matrix.data, matrix.indices, np.append(
        matrix.indptr, np.full(more, matrix.indptr[-1]))), (size, size))


def _places(skeleton: Skeleton, match: Match, sharpness: np.ndarray, scan: PointLikelihood,
            across: np.ndarray) -> np.ndarray:
    """Mean direction [m, 3] from the axis to where each point is on the skin, given where it was
    measured: a von Mises distribution of this ``sharpness``, and the half that was seen. ``across``
    [m, 3] is the direction around the axis."""
    facing, aside = (scan.facing(skeleton, match, ways) for ways in (match.normal, across))
    if facing is None or aside is None:
        return (ive(1, sharpness) / ive(0, sharpness))[:, None] * match.normal
    seen = ndtr(_EDGE * (facing[:, None] * np.cos(_ANGLE) + aside[:, None] * np.sin(_ANGLE)))
    density = (HIDDEN + (1 - HIDDEN) * 2 * seen) * np.exp(
        np.minimum(sharpness, _SHARP)[:, None] * (np.cos(_ANGLE) - 1))
    density /= density.sum(axis=1)[:, None]
    known = sharpness > _SHARP
    out = np.where(known, 1 - 0.5 / np.maximum(sharpness, 1.0), density @ np.cos(_ANGLE))
    beside = np.where(known, 0.0, density @ np.sin(_ANGLE))
    return out[:, None] * match.normal + beside[:, None] * across


# Proposals: each changes the density of few points and the length.


@dataclass(frozen=True)
class State:
    """A tree, the density of the scan's points across its axes [1/m^2], shape [m], their cylinders
    [m] and distances from those [m], shape [m], under a scatter that the proposals leave."""

    skeleton: Skeleton
    scan: PointLikelihood
    scatter: Scatter
    wood: np.ndarray
    segment: np.ndarray
    residual: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, scan: PointLikelihood, scatter: Scatter | None = None,
           ) -> "State":
        """The state of a tree; with the likeliest scatter if none is given."""
        match = scan.match(skeleton)
        density = scan.across(np.maximum(match.residual + match.thick, 0.0), match.thick)
        scatter = scatter or scan.scattered(skeleton, match, density)
        return cls(skeleton, scan, scatter, density @ scatter.shares, match.segment, match.residual)

    def after(self, skeleton: Skeleton) -> "State":
        """The state of another tree with the same scatter."""
        return State.of(skeleton, self.scan, self.scatter)

    @property
    def log(self) -> float:
        """Its score."""
        return self.scan.log(self.wood, self.scatter, self.skeleton.length,
                             self.skeleton.branch_count)

    def without(self, nodes: np.ndarray, runs: int = 0) -> float:
        """The score without nodes, a mask [n], whose children are all among them; ``runs`` of them
        are whole."""
        skeleton, own = self.skeleton, np.flatnonzero(nodes[self.segment])
        wood = self.wood
        if len(own):
            ends = np.flatnonzero(~nodes[1:]) + 1
            middle = (skeleton.nodes[ends] + skeleton.nodes[skeleton.parent[ends]]) / 2
            near = cKDTree(middle).query(self.scan.points[own], k=min(6, len(ends)))[1]
            match = match_cylinders(skeleton.parent, skeleton.order, skeleton.nodes,
                                    skeleton.radius, self.scan.points[own],
                                    ends[near.reshape(len(own), -1)])
            wood = wood.copy()
            wood[own] = self.scan.across(np.maximum(match.residual + match.thick, 0.0),
                                         match.thick) @ self.scatter.shares
        return self.scan.log(wood, self.scatter,
                             skeleton.length - float(skeleton.steps[nodes].sum()),
                             skeleton.branch_count - runs)

    def with_cylinder(self, start: np.ndarray, end: np.ndarray, radius: float, runs: int) -> float:
        """The score with one more cylinder from ``start`` to ``end`` [m], shape [3] each."""
        step, points = end - start, self.scan.points
        share = np.clip((points - start) @ step / max(float(step @ step), 1e-300), 0.0, 1.0)
        distance = np.linalg.norm(points - start - share[:, None] * step, axis=1)
        nearer = np.flatnonzero(distance - radius < self.residual)
        wood = self.wood.copy()
        wood[nearer] = self.scan.across(distance[nearer], np.full(len(nearer), radius),
                                        ) @ self.scatter.shares
        return self.scan.log(wood, self.scatter,
                             self.skeleton.length + float(np.linalg.norm(step)),
                             self.skeleton.branch_count + runs)


def pruned(state: State) -> State:
    """Leave out the twigs without which the score rises, the largest rise first."""
    while state.skeleton.branch_count > 1:
        skeleton, run = state.skeleton, state.skeleton.branch
        carriers = np.unique(run[skeleton.parent[1:]][run[1:] != run[skeleton.parent[1:]]])
        bare = np.setdiff1d(np.arange(1, skeleton.branch_count), carriers)
        scores = [state.without(run == each, 1) for each in bare]
        if max(scores, default=-np.inf) <= state.log:
            break
        state = state.after(skeleton.subset(run != bare[int(np.argmax(scores))]))
    return state


def drawn_back(state: State) -> State:
    """Shorten ends node by node while the score rises."""
    skeleton, best = state.skeleton, state.log
    gone, children = np.zeros(skeleton.node_count, bool), skeleton.child_counts()
    for tip in skeleton.tips():
        node = int(tip)
        while skeleton.parent[node] > 0 and children[skeleton.parent[node]] == 1:
            gone[node] = True
            score = state.without(gone)
            if score <= best:
                gone[node] = False
                break
            best, node = score, int(skeleton.parent[node])
    return state.after(skeleton.subset(~gone)) if gone.any() else state


def grown(state: State, apart: PointSpacing) -> State:
    """Lengthen ends, or add twigs, to points that the background explains best, the nearest first,
    while the score rises."""
    given_up = np.zeros(len(state.scan.points), bool)
    while True:
        background = state.scatter.background / state.scan.volume
        left = np.flatnonzero((state.wood / state.skeleton.length < background) & ~given_up)
        for point, starts in _nearest_first(state.skeleton, state.scan.points, left):
            longer = _longer(state, state.scan.points[point], starts, apart)
            if longer is not None:
                state = longer
                break
            given_up[point] = True
        else:
            return state


def _nearest_first(skeleton: Skeleton, points: np.ndarray, left: np.ndarray,
                   ) -> Iterable[tuple[int, list[int]]]:
    """Points left over, each with the nodes from which an axis may lead to it."""
    if len(left) == 0:
        return []
    distance, node = cKDTree(skeleton.nodes).query(points[left])
    tips = skeleton.tips()
    _, tip = cKDTree(skeleton.nodes[tips]).query(points[left], k=min(_TIPS, len(tips)))
    tip = tips[tip.reshape(len(left), -1)]
    return [(int(left[k]), list(dict.fromkeys([int(node[k]), *tip[k].tolist()])))
            for k in np.argsort(distance, kind="stable")]


def _longer(state: State, to: np.ndarray, starts: list[int], apart: PointSpacing) -> State | None:
    """The state with an axis ``to`` a point [m] from the best of the ``starts``; None if the score
    does not rise."""
    skeleton, children = state.skeleton, state.skeleton.child_counts()
    radius = skeleton.radius * np.where(children > 0, _TWIG, 1.0)
    scores = [state.with_cylinder(skeleton.nodes[node], to, radius[node], int(children[node] > 0))
              for node in starts]
    best = int(np.argmax(scores))
    if scores[best] <= state.log + _FURTHER / 2 * np.log(len(state.scan.points)):
        return None
    node = starts[best]
    way = to - skeleton.nodes[node]
    spacing = _SPACING * max(float(apart.at(to[None])[0]), 1e-6)
    count = max(round(float(np.linalg.norm(way)) / spacing), 1)
    added = skeleton.nodes[node] + way * (np.arange(1, count + 1) / count)[:, None]
    parent = np.concatenate([[node], skeleton.node_count + np.arange(count - 1)])
    return state.after(Skeleton.from_edges(
        np.vstack([skeleton.nodes, added]), np.concatenate([skeleton.parent, parent]),
        np.concatenate([skeleton.radius, np.full(count, radius[node])])))
