"""Parts of a skeleton that its user should check: unlikely, vague, swollen, bridged, kinked."""

from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from limber.geometry.skeleton.radii.smoothness import FORK
from limber.geometry.skeleton.radii.wood import WANDER
from limber.geometry.skeleton.skeleton import BRIDGED, LIMITED, UNRESOLVED, Skeleton
from limber.geometry.skeleton.sweep import arc_lengths, stretches

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
    """One uncertain part.

    Attributes:
        kind: Why it is uncertain.
        branch: Its run.
        at: A position on it [m], shape [3].
        length: Length of the part [m]; 0 for a single node.
        radius: Median radius there [m].
        value: Probability of an unlikely branch, an attachment or a root; standard deviation over
            radius of an unresolved or limited one; factor of a radius jump outwards; angle [rad]
            of a kink; NaN for a gap.
    """

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
        probability = float(skeleton.probability[own].min())
        if probability < _LIKELY:
            found.append(_part(skeleton, DoubtfulKind.unlikely, run, own, probability))
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
    return sorted(
        found, key=lambda uncertain_part: (order.index(uncertain_part.kind), -uncertain_part.length)
    )


def _part(
    skeleton: Skeleton, kind: DoubtfulKind, run: int, nodes: np.ndarray, value: float
) -> DoubtfulPart:
    length = float(skeleton.steps[nodes].sum()) if len(nodes) > 1 else 0.0
    return DoubtfulPart(kind, run, skeleton.nodes[nodes[len(nodes) // 2]], length,
                 float(np.median(skeleton.radius[nodes])), value)


def _stretches(nodes: np.ndarray, chosen: np.ndarray) -> list[np.ndarray]:
    """Consecutive nodes where ``chosen`` is true."""
    return [nodes[part] for part in stretches(chosen)]


def jumps(skeleton: Skeleton, own: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Factor by which the radius changes outwards around each node of a run, and whether wood
    hardly does so, shape [k] each.

    Measured over two radii to each side. At a fork a radius may change more.
    """
    along, log = skeleton.arc_length[own], np.log(skeleton.radius[own])
    reach = _CHORD * skeleton.radius[own]
    change = np.interp(along + reach, along, log) - np.interp(along - reach, along, log)
    forks = along[skeleton.child_counts()[own] > 1]
    count = (np.abs(along[:, None] - forks) < 1.1 * reach[:, None]).sum(axis=1)
    sigma = np.sqrt(2 * _CHORD * WANDER + FORK**2 * count)
    return np.exp(change), np.abs(change) > _JUMP * sigma


def turns(skeleton: Skeleton, members: np.ndarray) -> np.ndarray:
    """Angle [rad] between the axis before and after each node of a run, shape [k].

    Measured over two radii to each side, so that the roughness of single nodes is not a kink. Nodes
    nearer than that to an end have no turn.
    """
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
