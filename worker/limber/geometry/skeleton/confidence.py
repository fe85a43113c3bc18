"""What a scan leaves open of its skeleton: radii that it does not resolve, gaps, doubtful twigs.

Where a branch is thinner than the points' spacing, or than their noise, its points tell
little of its radius. Then what branches are like says more: a twig is thinner than what carries it
and tapers. Both are weighed, and the interval is as wide as that leaves it.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.doubtful_parts import start_angle
from limber.geometry.skeleton.radii.cylinders import nearest_cylinders
from limber.geometry.skeleton.skeleton import (
    BRIDGED,
    INTERPOLATED,
    LIMITED,
    STATES,
    UNRESOLVED,
    Skeleton,
)

# Diameter in point spacings, under which a radius is not resolved: too few points a radius.
_SPACINGS = 1.0
_BESIDE = 4  # nodes to each side whose points tell the spacing
_NOISES = 1.0  # radius in standard deviations of the noise, likewise
_GAP = 4.0  # radii without a point that are a gap, not a hole
_TWIG, _TAPER = 0.65, 0.4  # a twig's radius over its carrier's, and its loss to the tip
# Standard deviations of the radius's logarithm: by habit, by points too far apart, by noise alone.
_PRIOR, _FIT, _FIT_NOISE = 0.35, 0.5, 0.25
# Of the radius, over (noise / radius)^2: the noise itself is told to 4 %, and a side's radius goes
# with 3.7 times that (of half a circle, the scatter is twice the noise's square and 0.54 of the
# radius's).
_BIAS = 0.15
_MODEL = 0.012  # of the radius: branches are not quite round
_BRIDGED_SIGMA, _ROUGH_SIGMA = 0.15, 0.25  # of a radius: in a gap; filled in or limited
_UNRESOLVED_SIGMA = 0.5  # at least, of a radius
# Standard deviation of the logarithm of an unresolved radius that came out under what is expected:
# such fits collapse. On generated scans they were 0.3 to 0.7 too thin.
_COLLAPSED = 1.2
# Logistic: a constant, then a slope for each column of the evidence. A twig is there where its fork
# is a true one, a node where it lies in the true wood: both fitted by likelihood to 1,056 side
# branches of 203 generated scans (seeds 7000 to 7215: round, one-sided with 1 to 3 mm noise, gaps,
# single views, crowns, stray points, and points up to 6 mm apart). On 666 more (112 scans, seeds
# from 910000) tenths of 5 and more came out within 6 points. A backward start tells that a fork is
# elsewhere, not that the wood is not there: while unlikely twigs are dropped it must not count
# (with a slope of -2.5 a sparse crown lost 6 % of its points).
_TWIG_ODDS = (-2.2, 0.97, 0.88, -1.3, -1.35, 0.0)
_NODE_ODDS = (6.6, -0.8, -1.3, -3.4)
_BACK = np.deg2rad(75.0), np.deg2rad(30.0)  # angle from which a twig starts backwards, and wholly
_NOISE_MOST = 2.0  # radii of noise from which more tells nothing more


def assessed(skeleton: Skeleton, points: np.ndarray, noise: float) -> Skeleton:
    """Return the skeleton with honest radii, intervals, states and probabilities.

    Args:
        skeleton: Fitted to the points.
        points: The scan [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    segment, count = _counted(skeleton, points, noise)
    spacing = _spacing(skeleton, points, segment, noise)
    state, radius = skeleton.radius_state.copy(), skeleton.radius.copy()
    sigma = np.sqrt(skeleton.radius_sigma**2 + (_MODEL * radius)**2
                    + (_BIAS * np.minimum(noise / radius, 1.0)**2 * radius)**2)
    coarse = 2 * radius < _SPACINGS * spacing
    vague = coarse | (radius < _NOISES * noise)
    loose = np.maximum(sigma / radius, np.where(coarse, _FIT, _FIT_NOISE))
    rough = np.isin(state, (LIMITED, INTERPOLATED))
    sigma = np.where(rough, np.maximum(sigma, _ROUGH_SIGMA * radius), sigma)
    for run, members in enumerate(skeleton.runs()):
        own = members if run == 0 else members[1:]
        _blend(radius, sigma, state, own, members[0] if run else -1, vague, loose)
    gap = _gaps(skeleton, radius, count, spacing)
    state[gap > 0] = BRIDGED
    sigma = np.where(gap > 0, np.maximum(sigma, _BRIDGED_SIGMA * radius), sigma)
    told = replace(skeleton, radius=radius, radius_sigma=sigma, radius_state=state)
    return replace(told, probability=_probability(told, twig_evidence(told, count, gap, noise),
                                                  node_evidence(told, gap, noise)))


def evidence(skeleton: Skeleton, points: np.ndarray, noise: float,
             ) -> tuple[np.ndarray, np.ndarray]:
    """Return what probabilities are told by: that of runs [runs, 5] and that of nodes [n, 3].

    Args:
        skeleton: As :func:`assessed` returned it.
        points: The scan [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    segment, count = _counted(skeleton, points, noise)
    gap = _gaps(skeleton, skeleton.radius, count, _spacing(skeleton, points, segment, noise))
    return twig_evidence(skeleton, count, gap, noise), node_evidence(skeleton, gap, noise)


def doubted(skeleton: Skeleton, points: np.ndarray, noise: float) -> Skeleton:
    """Return the skeleton with the probabilities of its nodes alone; radii stay as they are.

    Args:
        skeleton: Led through the points; its radii are not fitted.
        points: The scan [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    segment, count = _counted(skeleton, points, noise)
    gap = _gaps(skeleton, skeleton.radius, count, _spacing(skeleton, points, segment, noise))
    state = np.where(gap > 0, BRIDGED, skeleton.radius_state).astype(np.int8)
    told = replace(skeleton, radius_state=state)
    return replace(told, probability=_probability(told, twig_evidence(told, count, gap, noise),
                                                  node_evidence(told, gap, noise)))


def likely(skeleton: Skeleton, least: float) -> tuple[Skeleton, list[dict]]:
    """Drop side runs that are less likely there than ``least``, and what they carry.

    Returns:
        The skeleton, and of each run dropped its ``length`` [m], its tip's place ``at`` [m] and
        its ``probability``.
    """
    runs = skeleton.runs()
    told = np.ones(len(runs))
    for run, members in enumerate(runs[1:], start=1):
        told[run] = min(float(skeleton.probability[members[1:]].max()),
                        told[skeleton.branch[members[0]]])
    dropped = [{"length": float(np.linalg.norm(np.diff(skeleton.nodes[runs[run]], axis=0),
                                               axis=1).sum()),
                "at": skeleton.nodes[runs[run][-1]], "probability": float(told[run])}
               for run in np.flatnonzero(told < least)]
    return (skeleton.subset(told[skeleton.branch] >= least) if dropped else skeleton), dropped


def given_carrier(skeleton: Skeleton) -> np.ndarray:
    """Probability of each run if the run that carries it is there, shape [runs]; the main's is 1.

    The probability of a run's nodes holds its carriers'.
    """
    runs = skeleton.runs()
    stated = np.array([skeleton.probability[members[1:]].max() for members in runs])
    given = np.ones(len(runs))
    for run, members in enumerate(runs[1:], start=1):
        carrier = int(skeleton.branch[members[0]])
        given[run] = stated[run] / (max(float(stated[carrier]), 1e-12) if carrier else 1.0)
    return np.minimum(given, 1.0)


def shares(skeleton: Skeleton) -> dict[str, float]:
    """Share of the axes' length in each state."""
    step = np.linalg.norm(skeleton.nodes[1:] - skeleton.nodes[skeleton.parent[1:]], axis=1)
    total = max(float(step.sum()), 1e-300)
    return {name: float(step[skeleton.radius_state[1:] == value].sum()) / total
            for name, value in STATES.items()}


def twig_evidence(skeleton: Skeleton, count: np.ndarray, gap: np.ndarray, noise: float,
                  ) -> np.ndarray:
    """What speaks for each side run, shape [runs, 5]; zeros for the main run.

    ln(1 + points / 10), ln(1 + how far it reaches / its carrier's radius), the share that is
    bridged, the noise over its radius, and whether it starts backwards, 0 to 1: where a fork is
    misplaced, a twig comes back to it.
    """
    told = np.zeros((skeleton.branch_count, 5))
    runs = skeleton.runs()
    for run, members in enumerate(runs[1:], start=1):
        own, carrier = members[1:], runs[int(skeleton.branch[members[0]])]
        away = cKDTree(skeleton.nodes[carrier]).query(skeleton.nodes[own])[0]
        told[run] = (np.log1p(count[own].sum() / 10),
                     np.log1p(away.max() / max(float(skeleton.radius[members[0]]), 1e-12)),
                     float(np.mean(skeleton.radius_state[own] == BRIDGED)),
                     min(noise / max(float(np.median(skeleton.radius[own])), 1e-12), _NOISE_MOST),
                     np.clip((start_angle(skeleton, members) - _BACK[0]) / _BACK[1], 0.0, 1.0))
    return told


def node_evidence(skeleton: Skeleton, gap: np.ndarray, noise: float) -> np.ndarray:
    """What speaks against each node's place on its run, shape [n, 3].

    The noise over the radius, ln(1 + length of the gap that it bridges / radius), and whether its
    radius is not resolved.
    """
    radius = np.maximum(skeleton.radius, 1e-12)
    return np.column_stack([np.minimum(noise / radius, _NOISE_MOST), np.log1p(gap / radius),
                            skeleton.radius_state == UNRESOLVED])


def _probability(skeleton: Skeleton, twig: np.ndarray, node: np.ndarray) -> np.ndarray:
    """Probability that each node's run is there, its carriers too, and the node in its place.

    A run's first node stands for its fork: that this is there, and where, the run's own evidence
    was fitted to. Its gap and its noise would count against it a second time.
    """
    own = _logistic(twig, _TWIG_ODDS)
    own[0] = 1.0
    placed, runs = _logistic(node, _NODE_ODDS), skeleton.runs()
    for run in range(1, skeleton.branch_count):
        own[run] *= own[int(skeleton.branch[runs[run][0]])]
        placed[runs[run][1]] = 1.0
    return own[skeleton.branch] * placed


def _logistic(evidence: np.ndarray, odds: tuple[float, ...]) -> np.ndarray:
    start, *slopes = odds
    return 1 / (1 + np.exp(-(start + evidence @ np.array(slopes))))


def _counted(skeleton: Skeleton, points: np.ndarray, noise: float,
             ) -> tuple[np.ndarray, np.ndarray]:
    """The node that each point belongs to, shape [m], and how many lie on each, shape [n]."""
    segment, residual = nearest_cylinders(skeleton, points)
    near = np.abs(residual) < np.maximum(skeleton.radius[segment], 3 * noise)
    return segment, np.bincount(segment[near], minlength=skeleton.node_count)


def _gaps(skeleton: Skeleton, radius: np.ndarray, count: np.ndarray, spacing: np.ndarray,
          ) -> np.ndarray:
    """Length [m] of the long stretch without points that each node lies in, or 0, shape [n]."""
    gap = np.zeros(skeleton.node_count)
    for members in skeleton.runs():
        step = np.linalg.norm(np.diff(skeleton.nodes[members], axis=0), axis=1)
        own = members[1:]
        gap[own] = _long_gaps(count[own] == 0, step, radius[own], spacing[own])
    return gap


def _spacing(skeleton: Skeleton, points: np.ndarray, segment: np.ndarray, noise: float,
             ) -> np.ndarray:
    """Mean distance of neighbouring points around each node but for noise [m], shape [n]."""
    distance = cKDTree(points).query(points, k=min(5, len(points)))[0][:, 1:].mean(axis=1)
    total = np.bincount(segment, distance, skeleton.node_count)
    count = np.bincount(segment, minlength=skeleton.node_count).astype(float)
    near = np.full(skeleton.node_count, float(np.median(distance)))
    for run, members in enumerate(skeleton.runs()):
        own = members if run == 0 else members[1:]
        # A node without points is as thinly scanned as those beside it.
        around = np.ones(min(2 * _BESIDE + 1, len(own)))
        points_near = np.convolve(count[own], around, "same")
        known = points_near > 0
        near[own[known]] = np.convolve(total[own], around, "same")[known] / points_near[known]
    return np.sqrt(np.maximum(near**2 - noise**2, (0.5 * near)**2))


def _blend(radius: np.ndarray, sigma: np.ndarray, state: np.ndarray, own: np.ndarray, carrier: int,
           vague: np.ndarray, loose: np.ndarray) -> None:
    """Weigh unresolved radii of a run with what its carrier and its resolved part let expect."""
    if not vague[own].any():
        return
    for node, expected in zip(own, _expected(radius, own, carrier, vague[own]), strict=True):
        if not vague[node]:
            continue
        fit = loose[node] if radius[node] > expected else max(loose[node], _COLLAPSED)
        weight = fit**-2, _PRIOR**-2
        radius[node] = np.exp(np.average([np.log(radius[node]), np.log(expected)], weights=weight))
        sigma[node] = radius[node] * max(_UNRESOLVED_SIGMA, sum(weight)**-0.5)
        state[node] = UNRESOLVED


def _expected(radius: np.ndarray, own: np.ndarray, carrier: int, vague: np.ndarray) -> np.ndarray:
    """What an even taper from the next resolved node, or from the carrier, lets expect [m]."""
    clear = np.flatnonzero(~vague)
    place = np.arange(len(own))
    if len(clear) == 0:
        start = _TWIG * radius[carrier] if carrier >= 0 else float(np.median(radius[own]))
        return start * (1 - _TAPER * place / len(own))
    before = clear[np.maximum(np.searchsorted(clear, place, side="right") - 1, 0)]
    return radius[own[before]] * (1 - _TAPER * (place - before) / len(own))


def _long_gaps(empty: np.ndarray, step: np.ndarray, radius: np.ndarray, spacing: np.ndarray,
               ) -> np.ndarray:
    """Length [m] of the long stretch without points that each of a run's nodes lies in, or 0."""
    long = np.zeros(len(empty))
    edges = np.flatnonzero(np.diff(np.concatenate([[0], empty.astype(int), [0]])))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        part = slice(begin, end)
        length = float(step[part].sum())
        if length > max(_GAP * float(np.median(radius[part])),
                        _SPACINGS * float(np.median(spacing[part]))):
            long[part] = length
    return long
