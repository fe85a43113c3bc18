"""What a scan leaves open of its skeleton: radii that it does not resolve, gaps, doubtful twigs.

Where a branch is thinner than the points' spacing, or than their noise, its points tell
little of its radius. Then what branches are like says more: a twig is thinner than what carries it
and tapers. Both are weighed, and the interval is as wide as that leaves it.
"""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.radii.axis_fit import nearest_cylinders
from limber.geometry.skeleton.skeleton import BRIDGED, STATES, UNRESOLVED, Skeleton

# Diameter in point spacings, under which a radius is not resolved: too few points a radius.
_SPACINGS = 1.0
_BESIDE = 4  # nodes to each side whose points tell the spacing
_NOISES = 1.0  # radius in standard deviations of the noise, likewise
_GAP = 4.0  # radii without a point that are a gap, not a hole
_TWIG, _TAPER = 0.65, 0.4  # a twig's radius over its carrier's, and its loss to the tip
# Standard deviations of the radius's logarithm: by habit, by points too far apart, by noise alone.
_PRIOR, _FIT, _FIT_NOISE = 0.35, 0.5, 0.25
_BIAS = 0.4  # of the radius: what is left of the noise's bias, over (noise / radius)^2
_MODEL = 0.012  # of the radius: branches are not quite round
_BRIDGED_SIGMA = 0.15  # of the radius
# Logistic in ln(1 + points / 10), ln(1 + reach / carrier's radius) and the bridged share of a twig.
# Chosen, not fitted: the bench `scans` holds the probabilities against what was there.
_DOUBT = (-1.5, 0.9, 1.4, -1.5)


def assessed(skeleton: Skeleton, points: np.ndarray, noise: float) -> Skeleton:
    """Return the skeleton with honest radii, intervals, states and probabilities.

    Args:
        skeleton: Fitted to the points.
        points: The scan [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    segment, residual = nearest_cylinders(skeleton, points)
    near = np.abs(residual) < np.maximum(skeleton.radius[segment], 3 * noise)
    count = np.bincount(segment[near], minlength=skeleton.node_count)
    spacing = _spacing(skeleton, points, segment, noise)
    state, radius = skeleton.radius_state.copy(), skeleton.radius.copy()
    sigma = np.sqrt(skeleton.radius_sigma**2 + (_MODEL * radius)**2
                    + (_BIAS * np.minimum(noise / radius, 1.0)**2 * radius)**2)
    coarse = 2 * radius < _SPACINGS * spacing
    vague = coarse | (radius < _NOISES * noise)
    loose = np.maximum(sigma / radius, np.where(coarse, _FIT, _FIT_NOISE))
    for run, members in enumerate(skeleton.runs()):
        own = members if run == 0 else members[1:]
        _blend(radius, sigma, state, own, members[0] if run else -1, vague, loose)
        step = np.linalg.norm(np.diff(skeleton.nodes[members], axis=0), axis=1)
        empty = np.flatnonzero(_long_gaps(count[members[1:]] == 0, step,
                                          radius[members[1:]], spacing[members[1:]]))
        bridged = members[1:][empty]
        state[bridged] = BRIDGED
        sigma[bridged] = np.maximum(sigma[bridged], _BRIDGED_SIGMA * radius[bridged])
    told = replace(skeleton, radius=radius, radius_sigma=sigma, radius_state=state)
    return replace(told, probability=_probability(told, count))


def shares(skeleton: Skeleton) -> dict[str, float]:
    """Share of the axes' length in each state."""
    step = np.linalg.norm(skeleton.nodes[1:] - skeleton.nodes[skeleton.parent[1:]], axis=1)
    total = max(float(step.sum()), 1e-300)
    return {name: float(step[skeleton.radius_state[1:] == value].sum()) / total
            for name, value in STATES.items()}


def twig_evidence(skeleton: Skeleton, count: np.ndarray) -> np.ndarray:
    """What speaks for each side run, shape [runs, 3]: see ``_DOUBT``; zeros for the main run."""
    told = np.zeros((skeleton.branch_count, 3))
    runs = skeleton.runs()
    for run, members in enumerate(runs[1:], start=1):
        own, carrier = members[1:], runs[int(skeleton.branch[members[0]])]
        away = cKDTree(skeleton.nodes[carrier]).query(skeleton.nodes[own])[0]
        told[run] = (np.log1p(count[own].sum() / 10),
                     np.log1p(away.max() / max(float(skeleton.radius[members[0]]), 1e-12)),
                     float(np.mean(skeleton.radius_state[own] == BRIDGED)))
    return told


def _probability(skeleton: Skeleton, count: np.ndarray) -> np.ndarray:
    """Probability that each node's run is there, given that its carrier is, times the carrier's."""
    start, *slopes = _DOUBT
    own = 1 / (1 + np.exp(-(start + twig_evidence(skeleton, count) @ np.array(slopes))))
    own[0] = 1.0
    runs = skeleton.runs()
    for run in range(1, skeleton.branch_count):
        own[run] *= own[int(skeleton.branch[runs[run][0]])]
    return own[skeleton.branch]


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
    """Weigh unresolved radii of a run with what its carrier and its thicker part let expect."""
    if not vague[own].any():
        return
    start = _TWIG * radius[carrier] if carrier >= 0 else float(np.median(radius[own]))
    known = 0
    for place, node in enumerate(own):
        if not vague[node]:
            start, known = float(radius[node]), place
            continue
        expected = start * (1 - _TAPER * (place - known) / len(own))
        weight = loose[node]**-2, _PRIOR**-2
        radius[node] = np.exp(np.average([np.log(radius[node]), np.log(expected)], weights=weight))
        sigma[node] = radius[node] * max(_PRIOR, sum(weight)**-0.5)
        state[node] = UNRESOLVED


def _long_gaps(empty: np.ndarray, step: np.ndarray, radius: np.ndarray, spacing: np.ndarray,
               ) -> np.ndarray:
    """Which of a run's nodes lie in a stretch without points that is long, shape [n]."""
    long = np.zeros(len(empty), bool)
    edges = np.flatnonzero(np.diff(np.concatenate([[0], empty.astype(int), [0]])))
    for begin, end in zip(edges[::2], edges[1::2], strict=True):
        part = slice(begin, end)
        if step[part].sum() > max(_GAP * float(np.median(radius[part])),
                                  _SPACINGS * float(np.median(spacing[part]))):
            long[part] = True
    return long
