"""Axes and radii fitted to the scan together: one robust least-squares problem for the tree.

The contraction finds the branches. Their axes and radii are fitted to the scanned points. Each
point should lie at the radius from the axis of its nearest cylinder; axes and radii vary smoothly
along a run. The fit is right where only one side was seen: a circle follows from its arc, and the
neighbours along the branch determine what the arc leaves open.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.linalg import SuperLU, splu

from limber.core.progress import SILENT, Progress
from limber.geometry.skeleton.radii.fit_kernels import (
    Match,
    cylinders_around,
    match_cylinders,
    normal_blocks,
)
from limber.geometry.skeleton.radii.sensor_effects import (
    TargetDistances,
    held_across,
    mean_positions,
    position_uncertainty,
    weighted_target_distances,
)
from limber.geometry.skeleton.radii.visible_sides import (
    SCATTERED_ALONG_SIGHT,
    SeenSides,
    across_sight,
    evenly_seen,
    fit_seen_side,
    seen_sides,
    side_uncertainty,
)
from limber.geometry.skeleton.skeleton import INTERPOLATED, MEASURED, Skeleton

# Smoothness of axes and radii: second differences along each run, by their bandwidth.

FORK = 0.3
"""Deviation of a radius's logarithm from that before a fork."""
DISTINCT = 1e-3
"""Radii between nodes at different places."""
_SLOPE = 1.0  # smoothing length of the radius against slopes, in local radii
_NEAREST = 0.5  # least distance of nodes over that at the start of a fit
_BAND, _BAND_LIMIT = 1.2, 3.5  # smoothing length in local radii, without noise and at most


def smoothness(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray, per_node: np.ndarray,
               noise: float, stepped: bool = False) -> sparse.csc_matrix:
    """Second differences along each run, weighted as a smoothing spline: with penalty lambda and
    rho data per length it averages over (lambda / rho)^(1/4), which grows with ``noise`` [m]. With
    ``stepped``, the radius of a run that goes on from a fork may fall in a step there."""
    size = len(nodes)
    chains = [own for own in skeleton.own_runs() if len(own) > 2]
    if not chains:
        return sparse.csc_matrix((4 * size, 4 * size))
    density = float(per_node.sum()) / max(skeleton.length, 1e-300)
    forks = skeleton.child_counts() > 1
    # The nearer two nodes, the more smoothness would draw them together, until they coincide.
    least = np.maximum(_NEAREST * skeleton.steps, DISTINCT * skeleton.radius)
    steps = [np.maximum(np.linalg.norm(np.diff(nodes[chain], axis=0), axis=1), least[chain[1:]])
             for chain in chains]
    mean = np.concatenate([(step[:-1] + step[1:]) / 2 for step in steps])
    band = np.concatenate([_bandwidth(skeleton, chain, forks, noise) for chain in chains])
    second = second_differences(chains, steps, size)
    along = second.T @ sparse.diags(0.5 * density * band**4 * mean) @ second
    jumps = [np.where(forks[chain[:-1]] & stepped, FORK * radius[chain[:-1]], 0.0) / step
             for chain, step in zip(chains, steps, strict=True)]
    bends = np.concatenate([jump[:-1]**2 + jump[1:]**2 for jump in jumps]) / mean**2
    firm = _despite(bends, density * (2.0 * band)**4 * mean, noise)
    thick = (second.T @ sparse.diags(firm) @ second
             + _slope_terms(chains, steps, radius, density, np.concatenate(jumps)**2, noise))
    return (sparse.kron(along, sparse.diags([1.0, 1, 1, 0]))
            + sparse.kron(thick, sparse.diags([0.0, 0, 0, 1]))).tocsc()


def _despite(jumps: np.ndarray, weight: np.ndarray, noise: float) -> np.ndarray:
    """Weights of terms to which steps at forks add variances ``jumps``, all of one shape."""
    return weight / (1 + weight * jumps / max(noise, 1e-12)**2)


def _bandwidth(skeleton: Skeleton, chain: np.ndarray, forks: np.ndarray, noise: float,
               ) -> np.ndarray:
    """Smoothing length [m] at the inner nodes of a chain, shape [k - 2]."""
    # The first radii are used, since a radius that grows by mistake must not blur its own axis.
    thick = skeleton.radius[chain[1:-1]]
    # A branch thinner than the noise bends no finer than one as thick as the noise. Otherwise its
    # axis would follow single points until its radius vanished.
    band = np.clip(_BAND * thick + 8.0 * noise, _BAND * thick,
                   _BAND_LIMIT * np.maximum(thick, noise))
    # Axes kink at forks, where a branch's leader deflects at a strong twig.
    return band * (np.where(forks[chain[1:-1]], 0.6, 1.0) * _straightness(skeleton.nodes[chain]))


def second_differences(chains: list[np.ndarray], steps: list[np.ndarray], size: int,
                        ) -> sparse.csr_matrix:
    """Second differences at the inner nodes of all chains, shape [inner nodes, size]."""
    rows, columns, values, count = [], [], [], 0
    for chain, step in zip(chains, steps, strict=True):
        before, after = step[:-1], step[1:]
        mean = (before + after) / 2
        rows += 3 * [count + np.arange(len(chain) - 2)]
        columns += [chain[:-2], chain[1:-1], chain[2:]]
        values += [1 / before / mean, -(1 / before + 1 / after) / mean, 1 / after / mean]
        count += len(chain) - 2
    return sparse.coo_matrix(
        (np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))),
        (count, size)).tocsr()


def _straightness(nodes: np.ndarray) -> np.ndarray:
    """1 where the contracted axis is straight, down to 0.3 at its kinks, shape [n - 2]."""
    index = np.arange(1, len(nodes) - 1)
    before = nodes[index] - nodes[np.maximum(index - 2, 0)]
    after = nodes[np.minimum(index + 2, len(nodes) - 1)] - nodes[index]
    cosine = np.einsum("ij,ij->i", before, after) / np.maximum(
        np.linalg.norm(before, axis=1) * np.linalg.norm(after, axis=1), 1e-300)
    return np.clip(1.3 - np.arccos(np.clip(cosine, -1, 1)), 0.3, 1.0)


def _slope_terms(chains: list[np.ndarray], steps: list[np.ndarray], radius: np.ndarray,
                 density: float, jumps: np.ndarray, noise: float) -> sparse.csr_matrix:
    """Weak penalty on a radius's slope: branches are not cones, whatever stray points suggest."""
    low = np.concatenate([chain[:-1] for chain in chains])
    high = np.concatenate([chain[1:] for chain in chains])
    step = np.concatenate(steps)
    index = np.arange(len(step))
    first = sparse.coo_matrix(
        (np.concatenate([-1 / step, 1 / step]), (np.tile(index, 2), np.concatenate([low, high]))),
        (len(step), len(radius))).tocsr()
    thick = (radius[high] + radius[low]) / 2
    firm = _despite(jumps, density * (_SLOPE * thick)**2 * step, noise)
    return first.T @ sparse.diags(firm) @ first


# Scatter of points around fitted cylinders, and the points that belong to something else.

_TUKEY = 4.685  # 95 % efficiency for normal noise
_ENOUGH = 200  # points that determine the noise
# Distances of points scattered around a circle by noise s follow Rice's law. _MEASURED: estimate
# from points within a radius of the circle, over that radius. _TRUE: s over that estimate.
_MEASURED = (0.1655, 0.2461, 0.3234, 0.3802, 0.4506, 0.4810, 0.5102, 0.5360)
_TRUE = (1.007, 1.016, 1.031, 1.052, 1.110, 1.155, 1.225, 1.333)


def robust_sigma(residual: np.ndarray, radius: np.ndarray) -> float:
    """Noise [m] of points on the thicker half, as thin twigs' radii absorb part of it. Points over
    a radius off may be something else's: the result is corrected for those left out."""
    near = np.abs(residual) < radius
    if near.sum() < 10:
        near = np.ones(len(residual), bool)
    thick = near & (radius >= np.median(radius[near]))
    if thick.sum() >= _ENOUGH:
        near = thick
    middle = np.median(residual[near])
    sigma = 1.4826 * np.median(np.abs(residual[near] - middle))
    share = sigma / max(float(np.median(radius[near])), 1e-300)
    return float(sigma * np.interp(share, _MEASURED, _TRUE))


def tukey(residual: np.ndarray, limit: np.ndarray | float) -> np.ndarray:
    """Weight of each residual [m], 0 from ``limit`` [m] on, shape [m]."""
    return np.clip(1 - (residual / limit)**2, 0, None)**2


def settled_weights(residual: np.ndarray, noise: float) -> np.ndarray:
    """Weight of each residual [m] once the noise [m] is known, shape [m]."""
    return tukey(residual, _TUKEY * max(noise, 1e-12))


def residual_limit(spread: float, noise: float, trusted: float, radius: np.ndarray) -> np.ndarray:
    """Residual [m] from which a point belongs to something else, shape [m]. Noise that is not
    trusted yet widens no limit by more than its radius."""
    return np.minimum(_TUKEY * spread,
                      0.9 * radius + 3 * np.maximum(trusted, np.minimum(noise, radius)))


# The least-squares problem of a fit: terms of points, axes, radii and smoothness.

_SURE = (1e-4, 3.0)  # radii: least and largest deviation of a fitted node
_STEP = 0.5  # radii that steps at forks may change
_PROBE = 128  # distance in nodes at which radii count as independent


@dataclass(frozen=True)
class NormalEquations:
    """Normal equations [4 n, 4 n] of one round in x, y, z and radius of n nodes, and the weight of
    the points at each node [n]."""

    matrix: sparse.csc_matrix
    right: np.ndarray
    per_node: np.ndarray

    def factor(self) -> SuperLU:
        """Return the factorisation of the matrix."""
        return splu(self.matrix, permc_spec="MMD_AT_PLUS_A", options={"SymmetricMode": True})

    def solve(self) -> np.ndarray:
        """Step of each node: x, y, z, radius [m], shape [n, 4]."""
        return self.factor().solve(self.right).reshape(-1, 4)

    def inverse_blocks(self, chosen: np.ndarray) -> np.ndarray:
        """Blocks [n, k, k] of the inverse at each node, of the ``chosen`` k of x, y, z, radius. Far
        nodes do not affect each other, and a run's numbers are consecutive: one solve gives all."""
        own = np.arange(len(self.per_node))
        period = min(_PROBE, len(own))
        rows = 4 * own[:, None] + chosen
        factor, columns = self.factor(), []
        for each in chosen:
            unit = np.zeros((4 * len(own), period))
            unit[4 * own + each, own % period] = 1.0
            columns.append(factor.solve(unit)[rows, (own % period)[:, None]])
        return np.stack(columns, axis=2)


def normal_equations(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray, match: Match,
                     weight: np.ndarray, noise: float, positions: np.ndarray | None = None,
                     targets: TargetDistances | None = None, across: np.ndarray | None = None,
                     stepped: bool = False) -> NormalEquations:
    """Set up a round: points, smoothness of runs, constraints on bare nodes. ``positions`` [m, 3]
    are mean directions of true positions (None: the nearest), ``targets`` where points should lie
    (None: at the radius), ``across`` [m, 3] how firmly they hold the axis across (None: not)."""
    parent, count, distance = skeleton.parent, len(nodes), match.residual + match.thick
    targets = TargetDistances(match.thick, match.thick) if targets is None else targets
    positions = match.normal if positions is None else positions
    data, right = held_by_points(
        parent, match, weight, match.normal, 0 * match.normal if across is None else across,
        distance[:, None] * match.normal - targets.axis[:, None] * positions,
        distance * np.einsum("mj,mj->m", match.normal, positions) - targets.radius)
    per_node = np.bincount(match.segment, weight * match.share, count)
    per_node += np.bincount(parent[match.segment], weight * (1 - match.share), count)
    smooth = smoothness(skeleton, nodes, radius, per_node, noise, stepped)
    state = np.column_stack([nodes, radius]).ravel()
    matrix = (data + smooth + _anchor(skeleton, nodes, per_node)).tocsc()
    return NormalEquations(matrix, right - smooth @ state, per_node)


def fitted_system(skeleton: Skeleton, points: np.ndarray) -> tuple[NormalEquations, float]:
    """The normal equations at the end of a fit, and the noise [m] of single, independent points.
    Noise^2 times the inverse is the covariance of (x, y, z, radius), as for splines (Wahba
    1983)."""
    # True errors of generated scans, averaged over ninths of the main axis, came to 1.0 of the
    # predicted deviations (medians over 0.6745) on 8 scans of both kinds, and to 1.2 to 1.4 on 6
    # more of one side only. Where the axis ran into a twig and back, at a fork that one side hides,
    # they were far larger.
    (system,), noise = _systems(skeleton, points, (False,))
    return system, noise


def _systems(skeleton: Skeleton, points: np.ndarray, stepped: tuple[bool, ...],
             ) -> tuple[list[NormalEquations], float]:
    """The normal equations at the end of a fit, without or with steps at forks; their noise [m]."""
    match = match_cylinders(skeleton, points)
    noise = max(robust_sigma(match.residual, match.thick), 1e-12)
    weight = settled_weights(match.residual, noise)
    return [normal_equations(skeleton, skeleton.nodes, skeleton.radius, match, weight, noise,
                             stepped=each) for each in stepped], noise


def radius_deviations(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray, match: Match,
                      weight: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Standard deviation of each radius [m], and whether the node has points of its own."""
    system = normal_equations(skeleton, nodes, radius, match, weight, noise)
    variance = system.inverse_blocks(np.array([3]))[:, 0, 0]
    return noise * np.sqrt(np.maximum(variance, 0)), system.per_node > 2.0


def noise_covariance(system: NormalEquations, noise: float, radius: np.ndarray) -> np.ndarray:
    """Covariance [n, 4, 4] [m^2] of each node's position and radius by the noise [m] alone, for the
    ``system`` at the end of a fit."""
    covariance = noise**2 * system.inverse_blocks(np.arange(4))
    # Nodes that no points hold are nearly free: their inverses are rounding errors.
    values, vectors = np.linalg.eigh((covariance + covariance.transpose(0, 2, 1)) / 2)
    least, most = (np.outer(_SURE, radius)**2)[:, :, None]
    return np.einsum("nik,nk,njk->nij", vectors, np.clip(values, least, most), vectors)


def fit_with_steps(skeleton: Skeleton, points: np.ndarray) -> tuple[Skeleton, np.ndarray]:
    """Return the skeleton with what steps of the radius at forks change in its fit to points, and
    the covariance [n, 4, 4] of each node's position and radius [m^2]."""
    # The rounds of a fit have no steps: before the side branches are found, they would follow
    # noise. Where the skeleton states a larger deviation of the radius than noise with known
    # positions on the circle gives, the axis goes with the difference as it goes with the noise.
    (smooth, stepped), noise = _systems(skeleton, points, (False, True))
    covariance = noise_covariance(stepped, noise, skeleton.radius)
    way = covariance[:, :, 3] / covariance[:, 3, 3, None]
    more = np.maximum(skeleton.radius_sigma**2 - covariance[:, 3, 3], 0.0)
    change = stepped.solve() - smooth.solve()
    size = np.linalg.norm(change, axis=1)
    change *= np.minimum(1.0, _STEP * skeleton.radius / np.maximum(size, 1e-300))[:, None]
    return (replace(skeleton.moved(skeleton.nodes + change[:, :3]),
                    radius=skeleton.radius + change[:, 3]),
            covariance + more[:, None, None] * way[:, :, None] * way[:, None, :])


def held_by_points(parent: np.ndarray, match: Match, weight: np.ndarray, normal: np.ndarray,
                   across: np.ndarray, pull: np.ndarray, grow: np.ndarray,
                   ) -> tuple[sparse.csc_matrix, np.ndarray]:
    """Normal equations of residuals in (x, y, z, r) of n nodes, [4 n, 4 n] and [4 n]: each point
    holds its axis along ``normal`` [m, 3], there with its radius, and ``across`` [m, 3], and pulls
    the axis [m, 3] and the radius [m]."""
    count = len(parent)
    low = np.where(match.own_radius, 0.0, 1 - match.share)
    high = np.where(match.own_radius, 1.0, match.share)
    gradient = np.column_stack([
        (1 - match.share)[:, None] * pull, low * grow, match.share[:, None] * pull, high * grow])
    block, right = normal_blocks(match.segment, match.share, low, high, normal, across,
                                 gradient, weight, count)
    ends = np.arange(1, count)
    index = (4 * np.stack([parent[ends], ends], axis=1)[:, :, None] + np.arange(4)).reshape(-1, 8)
    rows = np.repeat(index, 8, axis=1).ravel()
    columns = np.tile(index, (1, 8)).ravel()
    matrix = sparse.coo_matrix((block[1:].ravel(), (rows, columns)), (4 * count, 4 * count))
    return matrix.tocsc(), np.bincount(index.ravel(), right[1:].ravel(), 4 * count)


def _anchor(skeleton: Skeleton, nodes: np.ndarray, per_node: np.ndarray) -> sparse.csc_matrix:
    """Hold nodes along their axis, where points give no information, and weakly elsewhere."""
    typical = float(np.median(per_node[per_node > 0])) if (per_node > 0).any() else 1.0
    direction = skeleton.moved(nodes).axes()
    block = np.zeros((len(nodes), 4, 4))
    block[:, :3, :3] = typical * direction[:, :, None] * direction[:, None, :]
    block[:, range(4), range(4)] += 1e-3 * typical
    return sparse.bsr_matrix((block, np.arange(len(nodes)), np.arange(len(nodes) + 1))).tocsc()


_MOVED = 0.2  # fraction of the radius; nodes that moved less keep their points' cylinders
_REACH = 2.0  # largest distance of an axis from its contracted position, in radii
_HELD = 2  # trusted rounds in which the limit keeps that of most sensors


@dataclass(frozen=True)
class AxisFit:
    """A fitted skeleton; each point's ``segment``, the node whose cylinder (to its parent) it is
    on, and ``residual`` from that [m], positive outside, of robust deviation ``noise`` [m]."""

    skeleton: Skeleton
    segment: np.ndarray
    residual: np.ndarray
    noise: float
    seen: SeenSides


def fit_axes(skeleton: Skeleton, points: np.ndarray, *, rounds: int = 12,
             settled: bool = False, along_sight: bool = False, uncertainty: bool = True,
             seen: SeenSides | None = None, progress: Progress = SILENT) -> AxisFit:
    """Fit axes and radii of runs to points [m, 3] [m]; the topology stays. ``settled``: only fine
    changes remain. ``along_sight``: a depth camera's points. Without ``uncertainty``, deviations
    and states stay. None for ``seen``: sides are estimated in each round."""
    fit = _Rounds(skeleton, points, rounds, settled, along_sight, seen)
    for number in range(rounds):
        size = fit.step(number)
        progress((number + 1) / rounds, "fitting axes", noise_m=fit.noise)
        if number > rounds // 2 + 1 and fit.has_settled(size):
            break
    return fit.result(uncertainty)


class _Rounds:
    """Axes and radii from round to round of a fit, and the evidence of the points so far."""

    def __init__(self, skeleton: Skeleton, points: np.ndarray, rounds: int, settled: bool,
                 along_sight: bool, seen: SeenSides | None) -> None:
        # Leaves, which lie on no axis, mislead a fit. A difference in the last digit then grows
        # from round to round until other cylinders are chosen. On a grid it does not outlast its
        # round.
        self._start = skeleton.on_grid()
        self._nodes, self._radius = nodes, radius = self._start.nodes, self._start.radius
        self._rounds, self._settled, self._along_sight = rounds, settled, along_sight
        self._spread = 0.35 * float(np.median(radius))
        self._floor = 0.05 * float(np.median(radius))
        # Once a fit is too thin, scatter along the sight is no longer recognisable: prior knowledge
        # is used.
        self._known = SCATTERED_ALONG_SIGHT if along_sight else seen
        self._near: np.ndarray | None = None
        self._points, self._found_at = points, nodes
        self._even: np.ndarray | None = None
        self._fitted_side: SeenSides | None = None
        self._side_fit_count, self.noise = 0, 0.0

    def step(self, number: int) -> float:
        """Move axes and radii by one round; returns the longest step of a node [m]."""
        match = self._match()
        # Wide at first, since a one-sided scan starts with its axis far off; later as wide as the
        # noise.
        noise = max(robust_sigma(match.residual, match.thick), 1e-4 * self._floor)
        self.noise = noise
        self._spread = noise if self._settled else max(noise, 0.6 * self._spread)
        # While axes are still far off, the misfit is not noise that smoothing could reduce.
        trusted = noise if self._settled or number > self._rounds // 2 else 0.0
        limit = partial(residual_limit, self._spread, noise, 0.0 if self._along_sight else trusted)
        weight = tukey(match.residual, limit(match.thick))
        asked = self._asked(match, weight, limit) if trusted else (
            match.normal, TargetDistances(match.thick, match.thick), None)
        step = normal_equations(self._start, self._nodes, self._radius, match, weight, trusted,
                                *asked).solve()
        size = np.linalg.norm(step[:, :3], axis=1)
        self._move(step, size)
        return float(size.max())

    def has_settled(self, size: float) -> bool:
        """Whether a round's longest step [m] is negligible, and all noise is trusted."""
        return size < 1e-3 * self._floor and self._spread <= 1.01 * self.noise

    def result(self, uncertainty: bool) -> AxisFit:
        """Result of the fit; with ``uncertainty`` each radius's standard deviation too."""
        nodes, radius, start = self._nodes, self._radius, self._start
        match = match_cylinders(replace(start, nodes=nodes, radius=radius), self._points)
        noise = robust_sigma(match.residual, match.thick)
        weight = settled_weights(match.residual, noise)
        seen, *_ = self._sides(match, weight, noise)
        if self._fitted_side is not None and seen.one_sided:
            seen = self._fitted_side
        sigma, state = start.radius_sigma, start.radius_state
        if uncertainty:
            sigma, pooled = radius_deviations(start, nodes, radius, match, weight,
                                              max(noise, 1e-12))
            sigma = np.hypot(sigma * position_uncertainty(seen, radius, noise),
                             side_uncertainty(seen, radius, noise))
            state = np.where(pooled, MEASURED, INTERPOLATED).astype(np.int8)
        fitted = replace(start, nodes=nodes, radius=np.maximum(radius, 0.1 * self._floor),
                         radius_sigma=sigma, radius_state=state)
        return AxisFit(fitted, match.segment, match.residual, noise, seen)

    def _match(self) -> Match:
        """The cylinder of each point; candidates are searched again once axes have moved."""
        start, nodes = self._start, self._nodes
        moved = np.linalg.norm(nodes - self._found_at, axis=1)
        if self._near is None or (moved > _MOVED * self._radius).any():
            self._near = cylinders_around(start.parent, nodes, self._points)
            self._found_at = nodes
        return match_cylinders(replace(start, nodes=nodes, radius=self._radius), self._points,
                               self._near)

    def _sides(self, match: Match, weight: np.ndarray, noise: float,
               ) -> tuple[SeenSides, np.ndarray, np.ndarray, np.ndarray]:
        """The sides seen; for each point the axis [m, 3], ``sharpness`` and ``stout``.
        """
        axis = self._nodes[match.segment] - self._nodes[self._start.parent[match.segment]]
        axis /= np.maximum(np.linalg.norm(axis, axis=1), 1e-300)[:, None]
        sharpness = match.thick * (match.residual + match.thick) / max(noise, 1e-12)**2
        stout = (match.thick / max(noise, 1e-12))**2
        seen = self._known or seen_sides(match.normal, axis, match.residual, sharpness, stout,
                                         weight)
        return seen, axis, sharpness, stout

    def _asked(self, match: Match, weight: np.ndarray, limit: partial,
               ) -> tuple[np.ndarray, TargetDistances, np.ndarray | None]:
        """Where noise hides positions: each point's mean position, how far out it should lie, and
        how firmly it holds the axis across."""
        now, axis, sharpness, stout = self._sides(match, weight, self.noise)
        if now.one_sided and self._known is None:
            shown_weight = weight if self._even is None else weight * self._even[match.segment]
            self._fitted_side = now = fit_seen_side(
                match.normal, axis, sharpness, shown_weight, now.view, self._fitted_side or now,
                limit_free=self._side_fit_count >= _HELD)
            self._side_fit_count += 1
        positions = mean_positions(match.normal, axis, sharpness, stout, now)
        targets = TargetDistances(match.thick, match.thick)
        if not now.along_sight:
            targets, nearest = weighted_target_distances(match.thick, self.noise, limit)
        if now.one_sided:
            if self._even is None:
                # Estimated once, from axes fitted to the nearest positions: a strip makes a thin
                # cylinder of its own and seems to show all of its side.
                self._even = evenly_seen(self._start, self._nodes, self._radius, match, weight,
                                         across_sight(match.normal, axis, now), self.noise)
            whole = self._even[match.segment]
            positions = np.where(whole[:, None], positions, match.normal)
            targets = TargetDistances(np.where(whole, targets.axis, nearest.axis),
                                      np.where(whole, targets.radius, nearest.radius))
        return positions, targets, None if now.along_sight else held_across(
            match.normal, axis, positions, stout)

    def _move(self, step: np.ndarray, size: np.ndarray) -> None:
        """Take a round's step [n, 4], limited for lengths ``size`` [n]."""
        shrink = np.minimum(1.0, 0.5 * self._radius / np.maximum(size, 1e-300))
        nodes = self._nodes + step[:, :3] * shrink[:, None]
        radius = self._radius + np.clip(step[:, 3], -0.4 * self._radius, 0.8 * self._radius)
        after = _near_start(self._start, nodes, radius).on_grid()
        self._nodes, self._radius = after.nodes, after.radius


def _near_start(skeleton: Skeleton, nodes: np.ndarray, radius: np.ndarray) -> Skeleton:
    """Keep axes within reach of the contracted ones, which are inside the branch or on its skin: a
    run with few points may drift off and take other runs' points with it."""
    moved = nodes - skeleton.nodes
    size = np.linalg.norm(moved, axis=1)
    reach = _REACH * skeleton.radius
    moved *= np.minimum(1.0, reach / np.maximum(size, 1e-300))[:, None]
    return replace(skeleton.moved(skeleton.nodes + moved), radius=np.clip(
        radius, skeleton.radius / (2 * _REACH), 2 * _REACH * skeleton.radius))
