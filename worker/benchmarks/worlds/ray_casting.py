"""Rays through the pixels of a view against triangles: the nearest hit of each."""

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class Hits:
    """First hits of a view's rays.

    Attributes:
        eye: Position of the sensor [m], shape [3].
        axes: Right, down and forward of the view, shape [3, 3].
        way: Unit direction of each ray, shape [n, 3].
        distance: To the hit [m], shape [n].
        incidence: Cosine between ray and surface normal, 0 to 1, shape [n].
        triangle: Index of the hit triangle, shape [n].
        edge: Whether a neighbouring ray misses, or hits a centimetre or more off, shape [n].
    """

    eye: np.ndarray
    axes: np.ndarray
    way: np.ndarray
    distance: np.ndarray
    incidence: np.ndarray
    triangle: np.ndarray
    edge: np.ndarray


def cast(triangles: np.ndarray, eye: np.ndarray, at: np.ndarray, pitch: float,
         jitter: np.ndarray | None = None) -> Hits:
    """Look from ``eye`` towards ``at`` [m] with rays ``pitch`` apart (of a distance of 1).

    Args:
        triangles: Shape [t, 3, 3].
        eye: Shape [3]. at: Shape [3].
        pitch: Distance of neighbouring rays in the plane one unit ahead.
        jitter: Shift of the grid of rays in pitches, shape [2].
    """
    axes = _view(at - eye)
    seen = (triangles - eye) @ axes.T
    facing = np.flatnonzero((seen[:, :, 2] > 0.02).all(axis=1))
    seen = seen[facing]
    flat = seen[:, :, :2] / seen[:, :, 2:] / pitch - (0.0 if jitter is None else jitter)
    low = np.ceil(flat.min(axis=1)).astype(np.int64)
    size = np.maximum(np.floor(flat.max(axis=1)).astype(np.int64) - low + 1, 0)
    count = size.prod(axis=1)
    owner = np.repeat(np.arange(len(seen)), count)
    inside = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
    pixel = low[owner] + np.stack([inside // size[owner, 1], inside % size[owner, 1]], axis=1)
    shift = 0.0 if jitter is None else jitter
    ray = np.column_stack([(pixel + shift) * pitch, np.ones(len(pixel))])
    depth, normal = _crossing(seen, owner, ray)
    hit = depth > 0
    owner, pixel, ray, depth = owner[hit], pixel[hit], ray[hit], depth[hit]
    order = np.lexsort([depth, pixel[:, 1], pixel[:, 0]])
    first = np.ones(len(order), bool)
    first[1:] = (np.diff(pixel[order], axis=0) != 0).any(axis=1)
    kept = order[first]
    pixel, ray, depth, owner = pixel[kept], ray[kept], depth[kept], owner[kept]
    long = np.linalg.norm(ray, axis=1)
    towards = np.abs(np.einsum("ij,ij->i", ray / long[:, None], normal[owner]))
    return Hits(eye, axes, ray / long[:, None] @ axes, depth * long, towards, facing[owner],
                _edges(pixel, depth))


def _crossing(seen: np.ndarray, owner: np.ndarray, ray: np.ndarray,
              ) -> tuple[np.ndarray, np.ndarray]:
    """Depth [m] at which each ray crosses its triangle, -1 where it misses; triangle normals."""
    one, two = seen[:, 1] - seen[:, 0], seen[:, 2] - seen[:, 0]
    normal = np.cross(one, two)
    size = np.linalg.norm(normal, axis=1)
    across = np.cross(ray, two[owner])
    scale = np.einsum("ij,ij->i", one[owner], across)
    scale = np.where(np.abs(scale) < 1e-18, 1e-18, scale)
    start = -seen[owner, 0]
    u = np.einsum("ij,ij->i", start, across) / scale
    turned = np.cross(start, one[owner])
    v = np.einsum("ij,ij->i", ray, turned) / scale
    depth = np.einsum("ij,ij->i", two[owner], turned) / scale
    good = (u >= 0) & (v >= 0) & (u + v <= 1) & (depth > 0)
    return np.where(good, depth, -1.0), normal / np.maximum(size, 1e-18)[:, None]


def _edges(pixel: np.ndarray, depth: np.ndarray) -> np.ndarray:
    """Pixels beside a miss or a step of a centimetre."""
    corner = pixel.min(axis=0) - 1
    image = np.full(pixel.max(axis=0) - corner + 2, np.inf)
    row, column = (pixel - corner).T
    image[row, column] = depth
    found = np.zeros(len(pixel), bool)
    for down, right in ((1, 0), (-1, 0), (0, 1), (0, -1)):
        found |= np.abs(image[row + down, column + right] - depth) > 0.01
    return found


def _view(forward: np.ndarray) -> np.ndarray:
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, [0.0, 0.0, 1.0] if abs(forward[2]) < 0.95 else [0.0, 1.0, 0.0])
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(forward, right), forward])
