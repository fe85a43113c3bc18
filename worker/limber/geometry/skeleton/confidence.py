"""Probabilities of a skeleton's twigs and nodes from the evidence of the scan; gaps in the scan."""

from dataclasses import dataclass, replace
from enum import StrEnum

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.cloud.single_view import View
from limber.geometry.skeleton.radii.axis_fit import FORK, fit_with_steps
from limber.geometry.skeleton.radii.fit_kernels import match_cylinders, nearest_cylinders
from limber.geometry.skeleton.radii.projected_widths import sight_field, width_covariance
from limber.geometry.skeleton.radii.sensor_effects import sensor_smoothing
from limber.geometry.skeleton.radii.wood import (
    SPACINGS,
    WANDER,
    ShapeEvidence,
    likeliest_shape,
    point_spacing,
    typical_radius,
)
from limber.geometry.skeleton.run_ends import tapered
from limber.geometry.skeleton.skeleton import BRIDGED, LIMITED, STATES, UNRESOLVED, Skeleton
from limber.geometry.skeleton.sweep import arc_lengths, stretches

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
             one_sided: bool = False, view: View | None = None, common: float = 0.0) -> Skeleton:
    """Return the skeleton with the likeliest axes and radii, intervals, states, probabilities.
    Points scatter by ``noise`` [m]; that of one sensor's ``rays`` widens no branch. All radii are
    off together by ``common`` [m] besides."""
    shown = _Shown.of(skeleton, points, noise)
    spacing, count = shown.spacing, shown.count
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
    shape = ShapeEvidence(covariance, spacing, 0.0 if rays else noise, rays or one_sided,
                          pixel, smoothing, common)
    likeliest = likeliest_shape(skeleton, shape)
    # Wood hardly thickens outwards. What does so nevertheless, beyond its interval, is a bunch of
    # twigs or two limbs in one: it counts for nothing.
    swollen = tapered(replace(likeliest, radius_state=skeleton.radius_state),
                      count).radius_state == LIMITED
    if swollen.any():
        likeliest = likeliest_shape(replace(skeleton, radius_state=np.where(
            swollen, LIMITED, skeleton.radius_state).astype(np.int8)), shape)
    return _with_probability(likeliest, shown, noise)


def doubted(skeleton: Skeleton, points: np.ndarray, noise: float,
            there: np.ndarray | None = None) -> Skeleton:
    """Return the skeleton with gaps and its nodes' probabilities; radii, which were not fitted,
    stay. ``noise`` is the standard deviation of the points [m, 3] [m]; ``there`` the probability
    [runs] that each run exists where its carrier does, if it is known."""
    return _with_probability(skeleton, _Shown.of(skeleton, points, noise), noise, there)


def evidence(skeleton: Skeleton, points: np.ndarray, noise: float,
             ) -> tuple[np.ndarray, np.ndarray]:
    """Return the evidence for the probabilities of an assessed skeleton: of runs [runs, 1] and of
    nodes [n, 3]. ``noise`` is the standard deviation of the points [m, 3] [m]."""
    shown = _Shown.of(skeleton, points, noise)
    return np.log1p(shown.unexplained)[:, None], _node_evidence(
        skeleton, _gaps(skeleton, shown), noise)


def likely(skeleton: Skeleton, least: float) -> tuple[Skeleton, list[dict]]:
    """Drop side runs with a probability below ``least``, and what they carry. Lists each:
    ``length``, fork ``from``, tip ``at``, median ``radius``, all [m], and ``probability``."""
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
    """Probability [runs] of each run, forked off there or elsewhere, given that its carrier exists;
    1 for the main run. That of a run's nodes includes its carriers'."""
    runs = skeleton.runs()
    stated = np.array([skeleton.probability[members[1:]].max() for members in runs])
    carrier = skeleton.branch[[members[0] for members in runs]]
    chance = stated / PLACED / np.where(carrier > 0, np.maximum(stated[carrier], 1e-12), 1.0)
    chance[0] = 1.0
    return np.minimum(chance, 1.0)


def shares(skeleton: Skeleton) -> dict[str, float]:
    """Fraction of the axes' length in each state."""
    step = skeleton.steps[1:]
    total = max(float(step.sum()), 1e-300)
    return {name: float(step[skeleton.radius_state[1:] == value].sum()) / total
            for name, value in STATES.items()}


def _unexplained_by_carriers(skeleton: Skeleton, points: np.ndarray, segment: np.ndarray,
                             noise: float) -> np.ndarray:
    """Number [runs] of points of each side run farther from its carrier's surface than that
    scatters. At most ``_TOGETHER`` count at one node: what they are off has one cause."""
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
        match = match_cylinders(skeleton, points[own], carrier[near.reshape(len(own), -1)])
        off = match.residual > _STRAY * np.hypot(noise, _ROUGH * match.thick)
        count[number] = np.minimum(np.unique(segment[own[off]], return_counts=True)[1],
                                   _TOGETHER).sum()
    return count


def _node_evidence(skeleton: Skeleton, gap: np.ndarray, noise: float) -> np.ndarray:
    """Evidence [n, 3] against each node's position on its run: ln(1 + 5 noise / radius), ln(1 +
    length of the gap that it bridges / radius), and whether its radius is not resolved."""
    radius = np.maximum(skeleton.radius, 1e-12)
    return np.column_stack([np.log1p(5 * np.minimum(noise / radius, _NOISE_MOST)),
                            np.log1p(gap / radius), skeleton.radius_state == UNRESOLVED])


def _with_probability(skeleton: Skeleton, shown: _Shown, noise: float,
                      there: np.ndarray | None = None) -> Skeleton:
    gap = _gaps(skeleton, shown)
    state = np.where(gap > 0, BRIDGED, skeleton.radius_state).astype(np.int8)
    with_state = replace(skeleton, radius_state=state)
    if there is None:
        there = _logistic(np.log1p(shown.unexplained)[:, None], _TWIG_ODDS)
    return replace(with_state, probability=_probability(
        with_state, there, _node_evidence(with_state, gap, noise)))


def _probability(skeleton: Skeleton, there: np.ndarray, node: np.ndarray) -> np.ndarray:
    """Probability that each node exists, with its run and carriers, and is in its position. A run's
    first node stands for its fork: the run's own evidence was fitted to that, and the node's gap
    and noise would count twice."""
    own = PLACED * there
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


# Parts of a skeleton that its user should check: unlikely, vague, swollen, bridged, kinked.

_LIKELY = 0.8  # probability above which a branch is not listed
KINK = np.deg2rad(70.0)  # wood does not turn this sharply within a branch
_BACKWARDS = np.deg2rad(110.0)  # the same for a twig against its carrier
_JUMP = 3.0  # standard deviations of a radius's change from which it is listed
_CHORD = 2.0  # radii on each side of a node over which its turn is measured


class DoubtfulKind(StrEnum):
    """Why a part is uncertain."""

    unlikely = "unlikely branch"
    unresolved = "unresolved radius"
    limited = "limited radius"
    bridged = "bridged gap"
    jump = "radius jump"
    kink = "kink"
    backwards = "starts backwards"
    attachment = "attachment"
    root = "root"


@dataclass(frozen=True)
class DoubtfulPart:
    """An uncertain part, ``at`` [3], with length (0: a node) and median radius [m]. An unlikely
    branch is what would be deleted at its place. ``value`` is the probability of a branch,
    attachment or root, a radius's deviation over it, the factor of a jump outwards, the angle of a
    kink [rad], or NaN for a gap."""

    kind: DoubtfulKind
    branch: int
    at: np.ndarray
    length: float
    radius: float
    value: float


def doubtful_parts(skeleton: Skeleton) -> list[DoubtfulPart]:
    """Return the parts to check, the longest of each kind first."""
    found: list[DoubtfulPart] = []
    for run, (members, own) in enumerate(
            zip(skeleton.runs(), skeleton.own_runs(), strict=True)):
        # Nodes in gaps, or off by more than the radius, are doubted besides: the branch is there.
        there = float(skeleton.probability[own].max())
        if there < _LIKELY:
            found.append(_part(skeleton, DoubtfulKind.unlikely, run, own, there))
        share = skeleton.radius_sigma / np.maximum(skeleton.radius, 1e-300)
        # Limited: points show more than wood has there, as a bunch of twigs or two limbs in one.
        for state, kind in ((UNRESOLVED, DoubtfulKind.unresolved),
                            (LIMITED, DoubtfulKind.limited)):
            found += [_part(skeleton, kind, run, part, float(share[part].max()))
                      for part in _stretches(own, skeleton.radius_state[own] == state)]
        for part in _stretches(own, skeleton.radius_state[own] == BRIDGED):
            found.append(_part(skeleton, DoubtfulKind.bridged, run, part, float("nan")))
        factor, is_jump = jumps(skeleton, own)
        for part in _stretches(own, is_jump):
            changes = factor[np.searchsorted(own, part)]
            found.append(_part(skeleton, DoubtfulKind.jump, run, part, float(
                changes[np.argmax(np.abs(np.log(changes)))])))
        turn = turns(skeleton, members)
        for part in _stretches(np.arange(len(members)), turn > KINK):
            worst = part[np.argmax(turn[part])]
            found.append(_part(skeleton, DoubtfulKind.kink, run, members[worst:worst + 1],
                               float(turn[worst])))
        back = start_angle(skeleton, members) if run else 0.0
        if back > _BACKWARDS:
            found.append(_part(skeleton, DoubtfulKind.backwards, run, own[:1], back))
    order = list(DoubtfulKind)
    return sorted(found, key=lambda part: (order.index(part.kind), -part.length))


def _part(skeleton: Skeleton, kind: DoubtfulKind, run: int, nodes: np.ndarray,
          value: float) -> DoubtfulPart:
    length = float(skeleton.steps[nodes].sum()) if len(nodes) > 1 else 0.0
    place = nodes[0 if kind is DoubtfulKind.unlikely else len(nodes) // 2]
    return DoubtfulPart(kind, run, skeleton.nodes[place], length,
                        float(np.median(skeleton.radius[nodes])), value)


def _stretches(nodes: np.ndarray, chosen: np.ndarray) -> list[np.ndarray]:
    """Consecutive nodes where ``chosen`` is true."""
    return [nodes[part] for part in stretches(chosen)]


def jumps(skeleton: Skeleton, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factor [k] by which the radius changes outwards around each node of a run, over two radii to
    each side, and whether wood hardly does so [k]. At a fork a radius may change more."""
    along, log = skeleton.arc_length[own], np.log(skeleton.radius[own])
    reach = _CHORD * skeleton.radius[own]
    change = np.interp(along + reach, along, log) - np.interp(along - reach, along, log)
    forks = along[skeleton.child_counts()[own] > 1]
    count = (np.abs(along[:, None] - forks) < 1.1 * reach[:, None]).sum(axis=1)
    sigma = np.sqrt(2 * _CHORD * WANDER + FORK**2 * count)
    return np.exp(change), np.abs(change) > _JUMP * sigma


def turns(skeleton: Skeleton, members: np.ndarray) -> np.ndarray:
    """Angle [k] [rad] between the axis two radii before and after each node of a run, so that the
    roughness of single nodes is no kink. Nodes nearer to an end have no turn."""
    nodes = skeleton.nodes[members]
    along = arc_lengths(nodes)
    chord = _CHORD * skeleton.radius[members]

    def at(position: np.ndarray) -> np.ndarray:
        return np.stack([np.interp(position, along, nodes[:, k]) for k in range(3)], axis=1)
    before, after = nodes - at(along - chord), at(along + chord) - nodes
    angle = _angles(before, after)
    angle[(along < chord) | (along > along[-1] - chord)] = 0.0
    return angle


def start_angle(skeleton: Skeleton, members: np.ndarray) -> float:
    """Angle [rad] between a side run's start and its carrier, which runs outwards."""
    fork = int(members[0])
    before = int(skeleton.parent[fork])
    if before < 0:
        return 0.0
    along = np.linalg.norm(skeleton.nodes[members] - skeleton.nodes[fork], axis=1)
    far = int(np.argmax(along > _CHORD * skeleton.radius[fork])) or len(members) - 1
    return float(_angles((skeleton.nodes[fork] - skeleton.nodes[before])[None],
                         (skeleton.nodes[members[far]] - skeleton.nodes[fork])[None])[0])


def _angles(one: np.ndarray, other: np.ndarray) -> np.ndarray:
    size = np.linalg.norm(one, axis=1) * np.linalg.norm(other, axis=1)
    cosine = np.einsum("kj,kj->k", one, other) / np.maximum(size, 1e-300)
    return np.where(size > 0, np.arccos(np.clip(cosine, -1, 1)), 0.0)
