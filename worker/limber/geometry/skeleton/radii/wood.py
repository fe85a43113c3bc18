"""The prior of wood: how axes bend and radii change along runs and at forks.

In logarithms of radii. Along a run they change slowly and fall towards its tip. At a fork the
carrier becomes thinner in a step, by the wood that its side branches take (pipe model: Shinozaki et
al. 1964; da Vinci's rule, Murray's law): the sum of r^p of all children is that of their parent.
"""

from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import SuperLU, splu
from scipy.spatial import cKDTree

from limber.geometry.skeleton.radii.axis_fit import DISTINCT, FORK, second_differences
from limber.geometry.skeleton.radii.sensor_effects import Smoothing
from limber.geometry.skeleton.skeleton import MEASURED, UNRESOLVED, Skeleton

# In logarithms of radii: a side branch against its carrier and the fall along a whole run (mean and
# deviation each); deviation of a root from any radius.
_SIDE, _SIDE_SIGMA = -1.0, 0.8
_TAPER, _TAPER_SIGMA, _ROOT = -0.5, 0.7, 3.0
_GOES_ON = -0.15  # mean at forks, where a run goes on
WANDER = 5e-3
"""Variance of a radius's logarithm per radius of length."""
# Power of the pipe model, and deviations from it as logarithms of a radius: of all forks of a plant
# together, and of each. Over 1,350 forks of seven sources, whose powers are 1.9 to 3.0 and two of
# which have no steps, they are 0.07 and 0.03; with each source left out in turn 0.06 to 0.07, and
# 0.02 to 0.03.
_POWER, _PIPE_SIGMA, _FORK_SIGMA = 2.7, 0.08, 0.04
# An axis: variance of the direction per radius of length [rad^2], deviation at a fork [rad].
_BEND, _KINK = 1e-3, 0.25
FREEDOM = 4.0
"""Of Student's distribution of what fits and forks are off: some fail."""


def turn_cost(square: np.ndarray) -> np.ndarray:
    """How much less likely than none turns are, as a logarithm; ``square`` is over the variance."""
    return (FREEDOM + 2) / 2 * np.log1p(square / FREEDOM)


def turn_variance(length: np.ndarray, radius: np.ndarray) -> np.ndarray:
    """Variance by component [rad^2] of an axis's turn between pieces of this mean length [m]."""
    return _BEND * length / radius


@dataclass(frozen=True)
class Wood:
    """The prior of the logarithms of n radii and of k trends: the taper of each run, and what the
    forks of the plant are off the pipe model together.

    Attributes:
        changes: As a matrix over nodes, [m, n]: the root's radius, each node's change from its
            parent, then at each fork that from the parent to the wood of all children.
        trends: How they go with the trends, shape [m, k].
        start: Their means without trends, shape [m].
        weight: Their inverse variances, shape [m].
        known: Inverse variances of the trends, shape [k].
        mean: Means of the trends, shape [k].
    """

    changes: sparse.csr_matrix
    trends: sparse.csr_matrix
    start: np.ndarray
    weight: np.ndarray
    known: np.ndarray
    mean: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, radius: np.ndarray) -> "Wood":
        """Its lengths are counted, and its forks linearised, in current radii [m], shape [n]."""
        count, runs, run, step = (len(radius), skeleton.branch_count, skeleton.branch,
                                  skeleton.steps)
        node, parent = np.arange(1, count), skeleton.parent[1:]
        side = run[1:] != run[parent]
        at_fork = ~side & (skeleton.child_counts()[parent] > 1)
        one_by_one = sparse.identity(count) - sparse.coo_matrix(
            (np.ones(count - 1), (node, parent)), (count, count))
        variance = WANDER * step[1:] / radius[parent] + np.where(at_fork, FORK**2, 0.0)
        pipes, start, off = _pipes(skeleton.parent, radius, parent[at_fork])
        length = np.bincount(run[1:], step[1:], runs)
        fall = np.where(side, 0.0, step[1:] / np.maximum(length[run[1:]], 1e-300))
        trends = sparse.block_diag([
            sparse.coo_matrix((fall, (node, run[1:])), (count, runs)), np.ones((len(start), 1))])
        return cls(
            sparse.vstack([one_by_one, pipes]).tocsr(), trends.tocsr(),
            np.concatenate([[np.log(radius[0])], np.where(
                side, _SIDE, np.where(at_fork, _GOES_ON, 0.0)), start]),
            1 / np.concatenate([[_ROOT**2], np.where(
                side, _SIDE_SIGMA**2, np.maximum(variance, 1e-12)), off]),
            np.append(np.full(runs, _TAPER_SIGMA**-2), _PIPE_SIGMA**-2),
            np.append(np.full(runs, _TAPER), 0.0))

    @property
    def precision(self) -> sparse.csr_matrix:
        """Of nodes and trends, shape [n + k, n + k]."""
        both = sparse.hstack([self.changes, -self.trends])
        return (both.T @ sparse.diags(self.weight) @ both + sparse.diags(np.concatenate(
            [np.zeros(self.changes.shape[1]), self.known]))).tocsr()

    @property
    def pull(self) -> np.ndarray:
        """Precision times mean of nodes and trends, shape [n + k]."""
        start = self.weight * self.start
        return np.concatenate([self.changes.T @ start,
                               self.known * self.mean - self.trends.T @ start])


def _pipes(parent: np.ndarray, radius: np.ndarray, forks: np.ndarray,
           ) -> tuple[sparse.csr_matrix, np.ndarray, np.ndarray]:
    """Changes from ``forks`` [f], where runs go on and others start, to the wood of their children,
    as a matrix over nodes [f, n], and their means and variances [f]."""
    count, child = len(radius), np.flatnonzero(np.isin(parent, forks))
    row, log, wood = np.full(count, -1), np.log(radius), radius[child]**_POWER
    row[forks] = np.arange(len(forks))
    own = row[parent[child]]
    total = np.bincount(own, wood, len(forks))
    part, pipe = wood / total[own], np.log(total) / _POWER
    pipes = sparse.coo_matrix((
        np.concatenate([part, np.full(len(forks), -1.0)]),
        (np.concatenate([own, row[forks]]), np.concatenate([child, forks]))),
                              (len(forks), count)).tocsr()
    miss = pipe - log[forks]
    if len(forks):
        miss -= np.clip(np.median(miss), -_PIPE_SIGMA, _PIPE_SIGMA)
    # Some forks swell, and at some a branch was cut off.
    return (pipes, np.bincount(own, part * log[child], len(forks)) - pipe,
            (FREEDOM * _FORK_SIGMA**2 + miss**2) / (FREEDOM + 1))


@dataclass(frozen=True)
class Bends:
    """The prior of the axes, which turn slowly with a few sharp bends: changes of direction at
    runs' inner nodes as a matrix over nodes [k, n], the nodes after them [k], their variances by
    component [rad^2], and their weights by Student's distribution."""

    turns: sparse.csr_matrix
    after_turn: np.ndarray
    variance: np.ndarray
    trust: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton) -> "Bends":
        # Between nodes at one place there is no direction.
        long = skeleton.steps
        apart = long > DISTINCT * skeleton.radius
        chains = [np.append(own[:1], own[1:][apart[own[1:]]]) for own in skeleton.own_runs()]
        chains = [chain for chain in chains if len(chain) > 2]
        steps = [long[chain[1:]] for chain in chains]
        length = np.concatenate([np.empty(0), *((step[:-1] + step[1:]) / 2 for step in steps)])
        inner = np.concatenate([np.empty(0, np.int64), *(chain[1:-1] for chain in chains)])
        second = second_differences(chains, steps, skeleton.node_count) if chains else (
            sparse.csr_matrix((0, skeleton.node_count)))
        variance = turn_variance(length, skeleton.radius[inner]) + np.where(
            skeleton.child_counts()[inner] > 1, _KINK**2, 0.0)
        after = np.concatenate([np.empty(0, np.int64), *(chain[2:] for chain in chains)])
        return cls(sparse.diags(length) @ second, after, variance, np.ones(len(inner)))

    def after(self, nodes: np.ndarray) -> "Bends":
        """The same with the weights that axes [m], shape [n, 3], give."""
        square = np.sum((self.turns @ nodes)**2, axis=1) / self.variance
        return replace(self, trust=(FREEDOM + 2) / (FREEDOM + square))

    def costs(self, nodes: np.ndarray) -> np.ndarray:
        """How much less likely than straight axes [m, 3] [m] make the turn before each node, as a
        logarithm, shape [m]."""
        square = np.sum((self.turns @ nodes)**2, axis=1) / self.variance
        return np.bincount(self.after_turn, turn_cost(square), len(nodes))

    def precision(self) -> sparse.csr_matrix:
        """Of nodes (x, y, z [m], logarithm of the radius), shape [4 n, 4 n]."""
        bend = self.turns.T @ sparse.diags(self.trust / self.variance) @ self.turns
        return sparse.kron(bend, sparse.diags([1.0, 1.0, 1.0, 0.0])).tocsr()


# The likeliest axes and radii of all branches together, given their fits and how wood is shaped.
#
# One Gaussian posterior of all positions across the axes and of the logarithms of all radii. The
# fit at each node is one observation of both, with its own covariance and with errors that it
# shares: what a sensor smooths or widens at the scale of its points and which diameter one side
# shows (the whole scan), the effect of noise and of sections that are not round (a run). A shared
# error moves axis and radius together, as far as the points leave both open: from one side they
# show the sum of depth and radius, not each. The prior is how wood grows (:mod:`wood`): an axis
# bends little; a radius changes slowly along a run and falls towards its tip, at a fork by the wood
# of the side branches. Where points determine a radius, it is theirs. Where they hardly do, it
# follows from the carrier and the resolved part, with a wide interval.

SPACINGS = 1.0
"""Diameter in point spacings, under which a radius is not resolved: too few points around it."""
_BESIDE = 4  # nodes on each side whose points show the spacing
_NOISES = 1.0  # radius in standard deviations of the noise, under which it is not resolved
_ALONG = 0.01  # radii that nodes may move along their axis, where no point holds them
_APART = 8.0  # radii along a run from which fits are independent
# Fraction of the radius by which fits scatter about the steady radius of wood: least, most, first.
_LOCAL = (0.01, 0.1, 0.05)
# Pixels by which a sensor may widen each side of all branches: half a one where any part of a pixel
# on the branch gives a reading, less than none where mixed ones are dropped. The scan does not show
# it: a front widened so is that of a thicker branch, to a tenth of a pixel.
_EDGE = 0.25
# Fraction of the points' spacing by which a sensor may widen or thin all branches of a scan; and by
# which the radius of a run may be off besides.
_RESOLUTION, _COARSE = 0.1, 0.05
# Fraction of the radius, over (noise / radius)^2: the noise itself is known to 4 %, and the radius
# of one side changes by 3.7 times that (of half a circle, the scatter is twice the square of the
# noise and 0.54 of the radius's).
_BIAS = 0.15
# Fraction of the radius by which a section that is not round differs: that of a run seen from all
# around; of all branches from one side, which shows one diameter of sections whose weight makes
# them oval in one way. Those 1.1 to 1.35 times as long as wide are 0.035 to 0.1 off their mean.
_OVAL, _OVAL_SIDE = 0.012, 0.06
_VAGUE = 1.0  # the same, of fits that the points do not resolve
_LINEAR = 0.3  # the largest for which a change of the axis is one of the logarithm, in proportion
_ROUNDS = 5
_AT_ONCE, _EACH = 256, 4  # columns of an inverse; nodes of a run between them


@dataclass(frozen=True)
class ShapeEvidence:
    """What a scan shows of its branches besides the fits of their radii.

    Attributes:
        covariance: Of each node's fitted position and radius [m^2], shape [n, 4, 4].
        spacing: Spacing of the points around each node [m], shape [n].
        noise: Standard deviation of the points across the branches [m].
        pixel: Distance of neighbouring rays at each node [m], shape [n], if the edges of branches
            determine the radii, as in one sensor's scan; None: they do not.
        smoothing: What the sensor's smoothing did, which the radii are without; None: nothing.
        common: Standard deviation of what all radii are off together besides [m].
    """

    covariance: np.ndarray
    spacing: np.ndarray
    noise: float
    one_sided: bool = False
    pixel: np.ndarray | None = None
    smoothing: Smoothing | None = None
    common: float = 0.0


def likeliest_shape(skeleton: Skeleton, evidence: ShapeEvidence) -> Skeleton:
    """Return the fitted skeleton with the likeliest axes and radii, deviations of the radii, and
    states. Nodes whose state is not measured count for nothing."""
    first = radius = skeleton.radius
    fitted = np.column_stack([skeleton.nodes, np.log(first)])
    resolution = np.hypot(evidence.common, _RESOLUTION * evidence.spacing if (
        evidence.pixel is None) else _EDGE * evidence.pixel)
    measured = skeleton.radius_state == MEASURED
    evidence = replace(evidence, covariance=_coupled(evidence.covariance, first, measured))
    independent = np.clip(skeleton.steps / first, DISTINCT, _APART) / _APART
    # As the points show it: what a sensor drew in may have too few around it.
    seen = first if evidence.smoothing is None else evidence.smoothing.drawn_in(first)
    vague = np.where(_is_coarse(seen, evidence), _VAGUE**2, 0.0)
    trust, local, bends = np.ones(len(radius)), _LOCAL[2], Bends.of(skeleton)
    for _ in range(_ROUNDS):
        own = evidence.covariance[:, 3, 3] / first**2 + local**2 + vague
        # A fit that came out too thin or too thick is as unsure as the thinner one.
        thin = np.minimum(radius, first)
        errors = _of_runs(skeleton, evidence, thin)
        known = _information(skeleton, evidence, own / trust, measured, independent)
        posterior = _Posterior.of(Wood.of(skeleton, radius), bends, known, fitted,
                                  errors)
        radius = np.exp(posterior.mean[:, 3])
        miss = np.abs(posterior.miss(fitted)[:, 3])
        trust = (FREEDOM + 1) / (FREEDOM + independent * miss**2 / own)
        bends = bends.after(posterior.mean[:, :3])
        if measured.any():
            local = float(np.clip(1.4826 * np.median(miss[measured]), *_LOCAL[:2]))
    # A fit that collapsed resolves nothing; one that does not count is no evidence of thin wood.
    coarse = _is_coarse(np.where(measured, seen, radius), evidence)
    scan = np.hypot(resolution / thin, _OVAL_SIDE if evidence.one_sided else 0.0)
    if evidence.smoothing is not None:
        scan = np.hypot(scan, evidence.smoothing.uncertainty(thin))
    scan = np.minimum(scan, 1.0)
    sigma = np.hypot(posterior.deviations(skeleton), posterior.moved_by(np.column_stack(
        [_of_axes(evidence.covariance, first * scan), scan])))
    moves, along = posterior.mean[:, :3] - skeleton.nodes, skeleton.axes()
    moves -= _of_axes(evidence.covariance, first * (errors @ posterior.errors)[3::4])
    moves -= np.einsum("nj,nj->n", moves, along)[:, None] * along
    return replace(skeleton.moved(skeleton.nodes + moves), radius=radius,
                   radius_sigma=radius * sigma,
                   radius_state=np.where(coarse, UNRESOLVED, skeleton.radius_state))


def _coupled(covariance: np.ndarray, radius: np.ndarray, measured: np.ndarray) -> np.ndarray:
    """Return the covariances, shape [n, 4, 4], without the part that ties axes to radii [m] where a
    fit counts for nothing, and with little of it where the radius is hardly known: there the bend
    of an axis would decide the radius."""
    relative = np.sqrt(covariance[:, 3, 3]) / radius
    share = np.where(measured, np.minimum(_LINEAR / np.maximum(relative, 1e-12), 1.0)**2, 0.0)
    out = covariance.copy()
    out[:, :3, 3] *= share[:, None]
    out[:, 3, :3] *= share[:, None]
    return out


def _is_coarse(radius: np.ndarray, evidence: ShapeEvidence) -> np.ndarray:
    """Whether points are too far apart, or scatter too far, to resolve radii [m], shape [n]."""
    return (2 * radius < SPACINGS * evidence.spacing) | (radius < _NOISES * evidence.noise)


def point_spacing(skeleton: Skeleton, points: np.ndarray, segment: np.ndarray, noise: float,
                  ) -> np.ndarray:
    """Mean distance of neighbouring points around each node, corrected for noise [m], shape [n]."""
    distance = cKDTree(points).query(points, k=min(5, len(points)))[0][:, 1:].mean(axis=1)
    total = np.bincount(segment, distance, skeleton.node_count)
    count = np.bincount(segment, minlength=skeleton.node_count).astype(float)
    near = np.full(skeleton.node_count, float(np.median(distance)))
    for own in skeleton.own_runs():
        # A node without points has the point spacing of its neighbours.
        around = np.ones(min(2 * _BESIDE + 1, len(own)))
        points_near = np.convolve(count[own], around, "same")
        known = points_near > 0
        near[own[known]] = np.convolve(total[own], around, "same")[known] / points_near[known]
    return np.sqrt(np.maximum(near**2 - noise**2, (0.5 * near)**2))


def _information(skeleton: Skeleton, evidence: ShapeEvidence, variance: np.ndarray,
                 measured: np.ndarray, share: np.ndarray) -> sparse.bsr_matrix:
    """Information [4 n, 4 n] of the fits on nodes (x, y, z [m], ln radius). ``variance`` is that of
    ln radius, ``share`` that of an independent fit which a node is. Nodes that are not ``measured``
    hold their axis to a radius."""
    radius, count = skeleton.radius, skeleton.node_count
    scale = np.column_stack([np.ones((count, 3)), 1 / radius])
    covariance = evidence.covariance * scale[:, :, None] * scale[:, None, :]
    # A radius surer than its fit says moves the axis as far, or information would be negative.
    surer = np.minimum(variance / np.maximum(covariance[:, 3, 3], 1e-300), 1.0)[:, None]
    covariance[:, [0, 1, 2, 3, 3, 3], [3, 3, 3, 0, 1, 2]] *= surer
    covariance[:, 3, 3] = variance
    covariance[:, [0, 1, 2], [0, 1, 2]] += (1e-3 * radius[:, None])**2
    block = np.linalg.inv(covariance) * share[:, None, None]
    block[~measured] = 0.0
    block[~measured, :3, :3] = np.eye(3) / radius[~measured, None, None]**2
    along = skeleton.axes()
    block[:, :3, :3] += along[:, :, None] * along[:, None, :] / (_ALONG * radius[:, None, None])**2
    return sparse.bsr_matrix((block, np.arange(count), np.arange(count + 1)))


def _of_axes(covariance: np.ndarray, error: np.ndarray) -> np.ndarray:
    """Errors of the axes that go with errors of the radii [m], shape [n], as the points leave both
    open, shape [n, 3]."""
    return covariance[:, :3, 3] * (error / np.maximum(covariance[:, 3, 3], 1e-300))[:, None]


def _of_runs(skeleton: Skeleton, evidence: ShapeEvidence, radius: np.ndarray,
             ) -> sparse.csr_matrix:
    """Effect [4 n, runs] on nodes of what each run's fits are off together, per standard deviation.
    It is of the radii; how an axis bends must not decide it."""
    # Their sum must not depend on single fits, or it would level their scatter.
    radius = typical_radius(skeleton, radius)
    noise = _BIAS * np.minimum(evidence.noise / radius, 1.0)**2
    coarse = np.minimum(_COARSE * evidence.spacing / radius, 1.0)
    off = np.sqrt(_OVAL**2 + noise**2 + coarse**2)
    return sparse.coo_matrix((off, (4 * np.arange(len(off)) + 3, skeleton.branch)),
                             (4 * len(off), skeleton.branch_count)).tocsr()


def typical_radius(skeleton: Skeleton, radius: np.ndarray) -> np.ndarray:
    """Radii [m] that change by one rate along each run, shape [n]."""
    typical, arc_length = np.log(radius), skeleton.arc_length
    for own in skeleton.own_runs():
        along = arc_length[own] - arc_length[own].mean()
        rate = float(along @ typical[own]) / max(float(along @ along), 1e-300)
        typical[own] = typical[own].mean() + rate * along
    return np.exp(typical)


@dataclass(frozen=True)
class _Posterior:
    """Means of the nodes, shape [n, 4], and of the shared errors, shape [runs]; the factorised
    precision of nodes, shared errors and trends of wood."""

    mean: np.ndarray
    errors: np.ndarray
    factor: SuperLU
    known: sparse.bsr_matrix
    together: sparse.csr_matrix

    @classmethod
    def of(cls, wood: Wood, bends: Bends, known: sparse.bsr_matrix, fitted: np.ndarray,
           together: sparse.csr_matrix) -> "_Posterior":
        cross, flat, count = (known @ together).tocsc(), fitted.ravel(), len(fitted)
        own = sparse.identity(together.shape[1]) + together.T @ cross
        last = sparse.coo_matrix((np.ones(count), (4 * np.arange(count) + 3, np.arange(count))),
                                 (4 * count, count)).tocsr()
        of_wood, pull = wood.precision, wood.pull
        with_trends = last @ of_wood[:count, count:]
        matrix = sparse.bmat([
            [last @ of_wood[:count, :count] @ last.T + bends.precision() + known, cross,
             with_trends], [cross.T, own, None],
            [with_trends.T, None, of_wood[count:, count:]]]).tocsc()
        factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})
        solved = factor.solve(np.concatenate([last @ pull[:count] + known @ flat, cross.T @ flat,
                                              pull[count:]]))
        return cls(solved[:len(flat)].reshape(-1, 4),
                   solved[len(flat):len(flat) + together.shape[1]], factor, known, together)

    def miss(self, fitted: np.ndarray) -> np.ndarray:
        """What is left of the fits beyond the means and the shared errors, shape [n, 4]."""
        return fitted - self.mean - (self.together @ self.errors).reshape(-1, 4)

    def moved_by(self, error: np.ndarray) -> np.ndarray:
        """How far errors of all fits, which the prior must not decide, move the radii's means, [n].
        """
        pull = self.known @ error.ravel()
        shared = self.together.T @ pull
        trends = np.zeros(self.factor.shape[0] - len(pull) - len(shared))
        return self.factor.solve(np.concatenate([pull, shared, trends]))[3:len(pull):4]

    def deviations(self, skeleton: Skeleton) -> np.ndarray:
        """Standard deviation of each radius's logarithm, shape [n]."""
        runs = skeleton.own_runs()
        # It changes little from node to node: some are solved for, the others interpolated.
        solved = np.concatenate([np.union1d(own[::_EACH], own[-1:]) for own in runs])
        variance = np.empty(len(self.mean))
        for start in range(0, len(solved), _AT_ONCE):
            own = solved[start:start + _AT_ONCE]
            unit = np.zeros((self.factor.shape[0], len(own)))
            unit[4 * own + 3, np.arange(len(own))] = 1.0
            variance[own] = self.factor.solve(unit)[4 * own + 3, np.arange(len(own))]
        for own in runs:
            among = np.intersect1d(own, solved)
            variance[own] = np.interp(own, among, variance[among])
        return np.sqrt(np.maximum(variance, 0.0))
