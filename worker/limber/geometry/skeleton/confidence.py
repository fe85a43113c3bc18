"""Probabilities of a skeleton's twigs and nodes from the evidence of the scan; gaps in the scan."""

from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.radii.cylinders import match_cylinders, nearest_cylinders
from limber.geometry.skeleton.radii.likeliest_shape import (
    SPACINGS,
    ShapeEvidence,
    likeliest_shape,
    point_spacing,
    typical_radius,
)
from limber.geometry.skeleton.radii.normal_equations import fit_with_steps
from limber.geometry.skeleton.radii.projected_widths import sight_field, width_covariance
from limber.geometry.skeleton.radii.shared_errors import shared_error
from limber.geometry.skeleton.radii.smoothing_sensors import sensor_smoothing
from limber.geometry.skeleton.repair.run_radii import tapered
from limber.geometry.skeleton.skeleton import BRIDGED, LIMITED, STATES, UNRESOLVED, Skeleton
from limber.geometry.skeleton.sweep import stretches

_GAP = 4.0  # radii without a point that make a gap
# Logistic models: a constant, then a slope for each column of the evidence. A twig exists where its
# fork is true, a node where it lies inside the true wood. Both were fitted by maximum likelihood
# (benchmarks.scan_probabilities) to 1,581 side branches of 114 generated scans: the project's own
# generator and the six worlds (seeds 7600 to 7605), of which each in turn was left out.
_TWIG_ODDS = (-5.00, 2.30)
PLACED = 0.98
"""Most of the probability of a fork: however many points show a branch, it may start elsewhere."""
_NODE_ODDS = (5.85, -2.07, -1.00, -1.08)
_STRAY = 3.0  # standard deviations from a carrier's surface beyond which it explains no point
_ROUGH = 0.1  # fraction of its radius by which a carrier's surface is not round
_TOGETHER = 3  # points at one node that count
_BESIDE = 6  # cylinders of the carrier that may be nearest to a point
_NOISE_MOST = 2.0  # noise in radii above which it no longer matters


@dataclass(frozen=True)
class _Shown:
    """What points show of a skeleton: their spacing around each node [m] and their number on each,
    shape [n] each, and the number on each side run that its carrier does not explain, [runs]."""

    spacing: np.ndarray
    count: np.ndarray
    unexplained: np.ndarray

    @classmethod
    def of(cls, skeleton: Skeleton, points: np.ndarray, noise: float) -> "_Shown":
        segment, residual = nearest_cylinders(skeleton, points)
        near = np.abs(residual) < np.maximum(skeleton.radius[segment], 3 * noise)
        return cls(point_spacing(skeleton, points, segment, noise),
                   np.bincount(segment[near], minlength=skeleton.node_count),
                   _unexplained_by_carriers(skeleton, points[near], segment[near], noise))


def assessed(skeleton: Skeleton, points: np.ndarray, noise: float, *, rays: bool = False,
             one_sided: bool = False, view: View | None = None) -> Skeleton:
    """Return the skeleton with the likeliest axes and radii, intervals, states, probabilities.

    Args:
        skeleton: Fitted to the points.
        points: The scan [m], shape [m, 3].
        noise: Standard deviation of the points [m].
        rays: One sensor's rays made the points, whose noise widens no branch.
        one_sided: The points show one side of the branches.
        view: The depth camera's view, if there was one.
    """
    shown = _Shown.of(skeleton, points, noise)
    spacing, count = shown.spacing, shown.count
    # A quarter of a circle is off together; the four average.
    shared = shared_error(skeleton, points, noise) / 2
    pixel = None if view is None else view.pitch * np.linalg.norm(skeleton.nodes - view.eye, axis=1)
    if rays and view is None:
        pixel = spacing
    if rays:
        covariance = width_covariance(skeleton, sight_field(skeleton, points, view), noise)
    else:
        skeleton, covariance = fit_with_steps(skeleton, points)
    smoothing = None
    if not rays:
        smoothing = sensor_smoothing(skeleton, typical_radius(skeleton, skeleton.radius), count,
                                     float(np.median(spacing)))
        skeleton, covariance = smoothing.undone(skeleton, covariance)
    shape = ShapeEvidence(covariance, spacing, 0.0 if rays else noise, shared, rays or one_sided,
                          pixel, smoothing)
    likeliest = likeliest_shape(skeleton, shape)
    # Wood hardly thickens outwards. What does so nevertheless, beyond its interval, is a bunch of
    # twigs or two limbs in one: it counts for nothing.
    swollen = tapered(replace(likeliest, radius_state=skeleton.radius_state),
                      count).radius_state == LIMITED
    if swollen.any():
        likeliest = likeliest_shape(replace(skeleton, radius_state=np.where(
            swollen, LIMITED, skeleton.radius_state).astype(np.int8)), shape)
    return _with_probability(likeliest, shown, noise)


def doubted(skeleton: Skeleton, points: np.ndarray, noise: float) -> Skeleton:
    """Return the skeleton with gaps and the probabilities of its nodes; radii stay as they are.

    Args:
        skeleton: Axes through the points; its radii are not fitted.
        points: The scan [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    return _with_probability(skeleton, _Shown.of(skeleton, points, noise), noise)


def evidence(skeleton: Skeleton, points: np.ndarray, noise: float,
             ) -> tuple[np.ndarray, np.ndarray]:
    """Return the evidence for the probabilities: of runs [runs, 1] and of nodes [n, 3].

    Args:
        skeleton: As :func:`assessed` returned it.
        points: The scan [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    shown = _Shown.of(skeleton, points, noise)
    return np.log1p(shown.unexplained)[:, None], _node_evidence(
        skeleton, _gaps(skeleton, shown), noise)


def likely(skeleton: Skeleton, least: float) -> tuple[Skeleton, list[dict]]:
    """Drop side runs with a probability below ``least``, and what they carry.

    Returns:
        The skeleton, and for each dropped run its ``length`` [m], the positions ``from`` [m] of
        its fork and ``at`` of its tip, its median ``radius`` [m] and its ``probability``.
    """
    runs = skeleton.runs()
    probability = np.ones(len(runs))
    for run, members in enumerate(runs[1:], start=1):
        probability[run] = min(float(skeleton.probability[members[1:]].max()),
                               probability[skeleton.branch[members[0]]])
    dropped = [{
        "length": float(np.linalg.norm(np.diff(skeleton.nodes[runs[run]], axis=0), axis=1).sum()),
        "from": skeleton.nodes[runs[run][0]], "at": skeleton.nodes[runs[run][-1]],
        "radius": float(np.median(skeleton.radius[runs[run][1:]])),
        "probability": float(probability[run])} for run in np.flatnonzero(probability < least)]
    return (skeleton.subset(probability[skeleton.branch] >= least) if dropped
            else skeleton), dropped


def probability_given_carrier(skeleton: Skeleton) -> np.ndarray:
    """Probability of each run, given that its carrier exists, shape [runs]; 1 for the main run.

    The probability of a run's nodes includes that of its carriers.
    """
    runs = skeleton.runs()
    stated = np.array([skeleton.probability[members[1:]].max() for members in runs])
    probability = np.ones(len(runs))
    for run, members in enumerate(runs[1:], start=1):
        carrier = int(skeleton.branch[members[0]])
        probability[run] = stated[run] / (max(float(stated[carrier]), 1e-12) if carrier else 1.0)
    return np.minimum(probability, 1.0)


def shares(skeleton: Skeleton) -> dict[str, float]:
    """Fraction of the axes' length in each state."""
    step = skeleton.steps[1:]
    total = max(float(step.sum()), 1e-300)
    return {name: float(step[skeleton.radius_state[1:] == value].sum()) / total
            for name, value in STATES.items()}


def _unexplained_by_carriers(skeleton: Skeleton, points: np.ndarray, segment: np.ndarray,
                             noise: float) -> np.ndarray:
    """Number of points of each side run that its carrier does not explain, shape [runs].

    They lie farther from the carrier's surface than its scatter. Of those at one node no more than
    ``_TOGETHER`` count: what they are off has one cause.
    """
    count, run = np.zeros(skeleton.branch_count), skeleton.branch[segment]
    order = np.argsort(run, kind="stable")
    first = np.searchsorted(run[order], np.arange(skeleton.branch_count + 1))
    runs = skeleton.runs()
    for number, members in enumerate(runs[1:], start=1):
        own = order[first[number]:first[number + 1]]
        carrier = runs[int(skeleton.branch[members[0]])][1:]
        if len(own) == 0 or len(carrier) == 0:
            continue
        middle = (skeleton.nodes[carrier] + skeleton.nodes[skeleton.parent[carrier]]) / 2
        near = cKDTree(middle).query(points[own], k=min(_BESIDE, len(carrier)))[1]
        match = match_cylinders(skeleton.parent, skeleton.order, skeleton.nodes, skeleton.radius,
                                points[own], carrier[near.reshape(len(own), -1)])
        off = match.residual > _STRAY * np.hypot(noise, _ROUGH * match.thick)
        count[number] = np.minimum(np.unique(segment[own[off]], return_counts=True)[1],
                                   _TOGETHER).sum()
    return count


def _node_evidence(skeleton: Skeleton, gap: np.ndarray, noise: float) -> np.ndarray:
    """Evidence against each node's position on its run, shape [n, 3].

    ln(1 + 5 noise / radius), ln(1 + length of the gap that it bridges / radius), and whether its
    radius is not resolved.
    """
    radius = np.maximum(skeleton.radius, 1e-12)
    return np.column_stack([np.log1p(5 * np.minimum(noise / radius, _NOISE_MOST)),
                            np.log1p(gap / radius), skeleton.radius_state == UNRESOLVED])


def _with_probability(skeleton: Skeleton, shown: _Shown, noise: float) -> Skeleton:
    gap = _gaps(skeleton, shown)
    state = np.where(gap > 0, BRIDGED, skeleton.radius_state).astype(np.int8)
    with_state = replace(skeleton, radius_state=state)
    return replace(with_state, probability=_probability(
        with_state, np.log1p(shown.unexplained)[:, None], _node_evidence(with_state, gap, noise)))


def _probability(skeleton: Skeleton, twig: np.ndarray, node: np.ndarray) -> np.ndarray:
    """Probability that each node exists, with its run and carriers, and is in its position.

    A run's first node stands for its fork. The run's own evidence was fitted to the existence and
    position of that fork. The node's gap and noise would count against it twice.
    """
    own = PLACED * _logistic(twig, _TWIG_ODDS)
    own[0] = 1.0
    placed, runs = _logistic(node, _NODE_ODDS), skeleton.runs()
    for run in range(1, skeleton.branch_count):
        own[run] *= own[int(skeleton.branch[runs[run][0]])]
        placed[runs[run][1]] = 1.0
    return own[skeleton.branch] * placed


def _logistic(evidence: np.ndarray, odds: tuple[float, ...]) -> np.ndarray:
    start, *slopes = odds
    return 1 / (1 + np.exp(-(start + evidence @ np.array(slopes))))


def _gaps(skeleton: Skeleton, shown: _Shown) -> np.ndarray:
    """Length [m] of the long stretch without points that contains each node, or 0, shape [n]."""
    gap, step = np.zeros(skeleton.node_count), skeleton.steps
    for members in skeleton.runs():
        own = members[1:]
        for part in stretches(shown.count[own] == 0):
            bare = own[part]
            length = float(step[bare].sum())
            if length > max(_GAP * float(np.median(skeleton.radius[bare])),
                            SPACINGS * float(np.median(shown.spacing[bare]))):
                gap[bare] = length
    return gap
