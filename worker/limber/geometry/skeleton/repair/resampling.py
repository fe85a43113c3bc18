"""Nodes along runs, at distances proportional to the radius."""

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.skeleton.sweep import resample


def resampled(skeleton: Skeleton, spacing: float = 1.0) -> Skeleton:
    """Return the skeleton with nodes ``spacing`` local radii apart along each run."""
    nodes: list[np.ndarray] = []
    radius: list[np.ndarray] = []
    parent: list[np.ndarray] = []
    made: dict[int, np.ndarray] = {}
    count = 0
    for run, members in enumerate(skeleton.runs()):
        points, thick = skeleton.curve(run)
        new_points, new_radius = resample(points, thick, spacing * thick)
        if run == 0:
            hang = np.arange(len(new_points)) - 1
        else:
            carrier = made[int(skeleton.branch[members[0]])]
            node = carrier[int(np.argmin(np.linalg.norm(
                np.vstack(nodes)[carrier] - points[0], axis=1)))]
            new_points, new_radius = new_points[1:], new_radius[1:]
            hang = np.concatenate([[node], count + np.arange(len(new_points) - 1)])
        made[run] = count + np.arange(len(new_points))
        count += len(new_points)
        nodes.append(new_points)
        radius.append(new_radius)
        parent.append(hang)
    return Skeleton.from_edges(np.vstack(nodes), np.concatenate(parent), np.concatenate(radius))
