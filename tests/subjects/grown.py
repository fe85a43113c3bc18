"""Skeletons of straight runs, and points around them."""

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton


def grown(*runs) -> Skeleton:
    """Runs with the node that each hangs on (-1: none), start and end [m], the number of nodes from
    the one that it hangs on, and the radius, or those of both ends [m].
    """
    nodes, parent, radius, count = [], [], [], 0
    for at, start, end, steps, thick in runs:
        own = slice(int(at >= 0), None)
        nodes.append(np.linspace(np.array(start, float), np.array(end, float), steps)[own])
        radius.append(np.linspace(*np.broadcast_to(thick, 2), steps)[own])
        parent.append(np.r_[at, count + np.arange(len(nodes[-1]) - 1)])
        count += len(nodes[-1])
    return Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))


def tube(start, end, radius: float, count: int, rng: np.random.Generator) -> np.ndarray:
    """Points all around a straight run [m], shape [count, 3]."""
    start, end = np.array(start, float), np.array(end, float)
    axis = (end - start) / np.linalg.norm(end - start)
    side = np.cross(axis, [0.3, 0.5, 0.8])
    side /= np.linalg.norm(side)
    angle = rng.uniform(0, 2 * np.pi, count)[:, None]
    return (start + rng.uniform(0, 1, count)[:, None] * (end - start) + radius * (
        np.cos(angle) * side + np.sin(angle) * np.cross(axis, side)))
