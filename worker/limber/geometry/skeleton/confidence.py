"""Probabilities of a skeleton's twigs and nodes from the evidence of the scan; gaps in the scan."""

from dataclasses import replace

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.radii.cylinders import nearest_cylinders
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
# (benchmarks.scan_probabilities) to 769 side branches of 62 generated scans: the project's own
# generator and five of the six worlds (seeds 7400 to 7501). With each source left out in turn, bins
# of a tenth agreed with the outcome within 8 percentage points and their binomial error.
_TWIG_ODDS = (-1.55, 0.57, 1.20, -2.88, -1.51)
_NODE_ODDS = (5.80, -1.96, -1.09, -0.91)
_POINTS_MOST = 3.0  # ln(1 + points / 10) above which more points are no more evidence
_NOISE_MOST = 2.0  # noise in radii above which it no longer matters


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
    spacing, count = _shown(skeleton, points, noise)
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
    shown = ShapeEvidence(covariance, spacing, 0.0 if rays else noise, shared, rays or one_sided,
                          pixel, smoothing)
    likeliest = likeliest_shape(skeleton, shown)
    # Wood hardly thickens outwards. What does so nevertheless, beyond its interval, is a bunch of
    # twigs or two limbs in one: it counts for nothing.
    swollen = tapered(replace(likeliest, radius_state=skeleton.radius_state),
                      count).radius_state == LIMITED
    if swollen.any():
        likeliest = likeliest_shape(replace(skeleton, radius_state=np.where(
            swollen, LIMITED, skeleton.radius_state).astype(np.int8)), shown)
    return _with_probability(likeliest, count, _gaps(likeliest, count, spacing), noise)


def doubted(skeleton: Skeleton, points: np.ndarray, noise: float) -> Skeleton:
    """Return the skeleton with gaps and the probabilities of its nodes; radii stay as they are.

    Args:
        skeleton: Axes through the points; its radii are not fitted.
        points: The scan [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    spacing, count = _shown(skeleton, points, noise)
    return _with_probability(skeleton, count, _gaps(skeleton, count, spacing), noise)


def evidence(skeleton: Skeleton, points: np.ndarray, noise: float,
             ) -> tuple[np.ndarray, np.ndarray]:
    """Return the evidence for the probabilities: of runs [runs, 4] and of nodes [n, 3].

    Args:
        skeleton: As :func:`assessed` returned it.
        points: The scan [m], shape [m, 3].
        noise: Standard deviation of the points [m].
    """
    spacing, count = _shown(skeleton, points, noise)
    gap = _gaps(skeleton, count, spacing)
    return _twig_evidence(skeleton, count, noise), _node_evidence(skeleton, gap, noise)


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


def _twig_evidence(skeleton: Skeleton, count: np.ndarray, noise: float) -> np.ndarray:
    """Evidence for each side run, shape [runs, 4]; zeros for the main run.

    ln(1 + points / 10), ln(1 + reach / its carrier's radius), the bridged fraction, and the noise
    over its radius.
    """
    rows = np.zeros((skeleton.branch_count, 4))
    runs = skeleton.runs()
    for run, members in enumerate(runs[1:], start=1):
        own, carrier = members[1:], runs[int(skeleton.branch[members[0]])]
        away = cKDTree(skeleton.nodes[carrier]).query(skeleton.nodes[own])[0]
        rows[run] = (min(np.log1p(count[own].sum() / 10), _POINTS_MOST),
                     np.log1p(away.max() / max(float(skeleton.radius[members[0]]), 1e-12)),
                     float(np.mean(skeleton.radius_state[own] == BRIDGED)),
                     min(noise / max(float(np.median(skeleton.radius[own])), 1e-12), _NOISE_MOST))
    return rows


def _node_evidence(skeleton: Skeleton, gap: np.ndarray, noise: float) -> np.ndarray:
    """Evidence against each node's position on its run, shape [n, 3].

    ln(1 + 5 noise / radius), ln(1 + length of the gap that it bridges / radius), and whether its
    radius is not resolved.
    """
    radius = np.maximum(skeleton.radius, 1e-12)
    return np.column_stack([np.log1p(5 * np.minimum(noise / radius, _NOISE_MOST)),
                            np.log1p(gap / radius), skeleton.radius_state == UNRESOLVED])


def _with_probability(skeleton: Skeleton, count: np.ndarray, gap: np.ndarray, noise: float,
                      ) -> Skeleton:
    state = np.where(gap > 0, BRIDGED, skeleton.radius_state).astype(np.int8)
    with_state = replace(skeleton, radius_state=state)
    return replace(with_state, probability=_probability(
        with_state, _twig_evidence(with_state, count, noise),
        _node_evidence(with_state, gap, noise)))


def _probability(skeleton: Skeleton, twig: np.ndarray, node: np.ndarray) -> np.ndarray:
    """Probability that each node exists, with its run and carriers, and is in its position.

    A run's first node stands for its fork. The run's own evidence was fitted to the existence and
    position of that fork. The node's gap and noise would count against it twice.
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


def _shown(skeleton: Skeleton, points: np.ndarray, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Spacing of the points around each node [m], and number of points on each, shape [n] each."""
    segment, residual = nearest_cylinders(skeleton, points)
    near = np.abs(residual) < np.maximum(skeleton.radius[segment], 3 * noise)
    return (point_spacing(skeleton, points, segment, noise),
            np.bincount(segment[near], minlength=skeleton.node_count))


def _gaps(skeleton: Skeleton, count: np.ndarray, spacing: np.ndarray) -> np.ndarray:
    """Length [m] of the long stretch without points that contains each node, or 0, shape [n]."""
    gap, step = np.zeros(skeleton.node_count), skeleton.steps
    for members in skeleton.runs():
        own = members[1:]
        for part in stretches(count[own] == 0):
            bare = own[part]
            length = float(step[bare].sum())
            if length > max(_GAP * float(np.median(skeleton.radius[bare])),
                            SPACINGS * float(np.median(spacing[bare]))):
                gap[bare] = length
    return gap
