"""Pictures of a reconstruction: cloud, skeleton with radii, surface, side by side."""

from pathlib import Path

import numpy as np

from limber.geometry.skeleton.skeleton import Skeleton
from limber.geometry.surface.surface import Surface


def draw_reconstruction(path: Path, points: np.ndarray, skeleton: Skeleton,
                        surface: Surface | None, title: str) -> None:
    """Write a PNG with the cloud, the skeleton over it and the surface, from two sides.

    Args:
        path: Output file.
        points: The cloud in the branch's frame [m], shape [n, 3].
        skeleton: The skeleton.
        surface: The surface, or None.
        title: Shown on top.
    """
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt
    from matplotlib.collections import LineCollection, PolyCollection

    figure, axes = plt.subplots(2, 3, figsize=(15, 13), constrained_layout=True)
    some = points[:: max(len(points) // 30_000, 1)]
    wide = _main_plane(skeleton.nodes)
    for row, (right, up) in zip(axes, ((wide[0], wide[1]), (wide[2], wide[1])), strict=True):
        cloud = np.stack([some @ right, some @ up], axis=1)
        nodes = np.stack([skeleton.nodes @ right, skeleton.nodes @ up], axis=1)
        row[0].scatter(*cloud.T, s=0.4, c="0.2", linewidths=0)
        row[1].scatter(*cloud.T, s=0.3, c="0.75", linewidths=0)
        lines = np.stack([nodes[skeleton.parent[1:]], nodes[1:]], axis=1)
        drawn = row[1].add_collection(LineCollection(
            lines, array=skeleton.order[1:], cmap="tab10", clim=(0, 9), linewidths=1.2))
        forks, tips = skeleton.forks(), skeleton.tips()
        row[1].plot(*nodes[forks].T, "k^", ms=4, label=f"{len(forks)} forks")
        row[1].plot(*nodes[tips].T, "rx", ms=4, label=f"{len(tips)} tips")
        row[1].plot(*nodes[0], "bs", ms=6, label="root")
        row[1].legend(loc="best", fontsize=8)
        del drawn
        if surface is not None:
            _shaded(row[2], surface, right, up, PolyCollection)
        for axis in row:
            axis.set_aspect("equal")
            axis.set_xlim(cloud[:, 0].min(), cloud[:, 0].max())
            axis.set_ylim(cloud[:, 1].min(), cloud[:, 1].max())
            axis.margins(0.03)
            axis.set_xlabel("m")
    figure.suptitle(title)
    figure.savefig(path, dpi=75)
    plt.close(figure)


def _main_plane(nodes: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Horizontal direction of the widest spread, z, and the horizontal direction across."""
    flat = nodes[:, :2] - nodes[:, :2].mean(axis=0)
    first = np.linalg.svd(flat, full_matrices=False)[2][0]
    right = np.array([first[0], first[1], 0.0])
    up = np.array([0.0, 0.0, 1.0])
    return right, up, np.cross(up, right)


def _shaded(axis, surface: Surface, right: np.ndarray, up: np.ndarray, collection) -> None:
    view = np.cross(right, up)
    corner = surface.vertices[surface.faces]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1), 1e-300)[:, None]
    facing = normal @ view
    seen = np.flatnonzero(facing > 0)
    seen = seen[np.argsort(corner[seen].mean(axis=1) @ view)]
    flat = np.stack([corner[seen] @ right, corner[seen] @ up], axis=2)
    shade = 0.25 + 0.65 * facing[seen]
    color = np.stack([shade * 0.75, shade * 0.62, shade * 0.45], axis=1)
    axis.add_collection(collection(flat, facecolors=color, edgecolors="none"))
