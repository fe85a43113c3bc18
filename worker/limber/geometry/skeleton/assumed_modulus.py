"""Young's modulus of a branch that nobody has pulled yet: one at which it can carry itself."""

from collections.abc import Sequence

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton

YOUNG_PA = 1e8
"""Of young wood, as the paper's branches begin; assumed of a branch that stands with it."""
MOST_TURN = 0.2
"""Turn of an end by the branch's own weight [rad] up to which a modulus is assumed."""


def assumed_young(skeleton: Skeleton, density: float,
                  gravity: Sequence[float] | np.ndarray) -> float:
    """Return :data:`YOUNG_PA`, or as many times more as the branch needs to carry itself [Pa].

    Args:
        density: [kg/m^3].
        gravity: [m/s^2], shape [3].
    """
    turn = turn_by_weight(skeleton, np.full(skeleton.node_count, YOUNG_PA), density, gravity)
    return float(f"{YOUNG_PA * max(1.0, turn / MOST_TURN):.2g}")


def turn_by_weight(skeleton: Skeleton, young: np.ndarray, density: float,
                   gravity: Sequence[float] | np.ndarray) -> float:
    """The most that the weight of a branch turns one of its ends [rad], by beam theory.

    Args:
        young: Young's modulus at the nodes [Pa], shape [n].
        density: [kg/m^3].
        gravity: [m/s^2], shape [3].
    """
    steps = skeleton.steps
    weight = density * np.pi * skeleton.radius**2 * steps
    moment, turn = weight[:, None] * skeleton.nodes, np.zeros(skeleton.node_count)
    for node in range(skeleton.node_count - 1, 0, -1):
        weight[skeleton.parent[node]] += weight[node]
        moment[skeleton.parent[node]] += moment[node]
    bending = np.cross(moment - weight[:, None] * skeleton.nodes, gravity)
    stiffness = young * np.pi * skeleton.radius**4 / 4
    for node in range(1, skeleton.node_count):
        turn[node] = turn[skeleton.parent[node]] + (
            np.linalg.norm(bending[node]) / stiffness[node] * steps[node])
    return float(turn.max())
