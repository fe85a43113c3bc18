"""Distance of points from a triangle surface: exact, by a grid of cells."""

import numpy as np
from scipy.spatial import cKDTree

from limber.core.numerics.compiled import compiled_exactly
from limber.geometry.surface.face_crossings import by_cell
from limber.geometry.surface.surface import Surface


def distance_to_surface(points: np.ndarray, surface: Surface) -> np.ndarray:
    """Distances [m] of points [n, 3] from a surface, shape [n]."""
    corner = surface.vertices[surface.faces]
    low, high = corner.min(axis=1), corner.max(axis=1)
    origin = low.min(axis=0)
    extent = (high - low).max(axis=1)
    cell = max(1.5 * float(np.median(extent)), float(extent.max()) / 24, 1e-12)
    first = np.floor((low - origin) / cell).astype(np.int64)
    last = np.floor((high - origin) / cell).astype(np.int64)
    counts = last.max(axis=0) + 1
    keys, owner = by_cell(first, last, counts)
    order = np.argsort(keys, kind="stable")
    # No farther than the nearest vertex, so that few cells are searched.
    bound, _ = cKDTree(surface.vertices).query(points)
    return _distances(np.ascontiguousarray(points, np.float64), bound,
                      np.ascontiguousarray(corner), origin, cell, counts, keys[order],
                      owner[order])


@compiled_exactly
def _distances(points: np.ndarray, bound: np.ndarray, corner: np.ndarray, origin: np.ndarray,
               cell: float, counts: np.ndarray, keys: np.ndarray, owner: np.ndarray) -> np.ndarray:
    found = np.empty(len(points))
    low, high = np.empty(3, np.int64), np.empty(3, np.int64)
    for p in range(len(points)):
        best = bound[p] * bound[p]
        for k in range(3):
            low[k] = max(int(np.floor((points[p, k] - bound[p] - origin[k]) / cell)), 0)
            high[k] = min(int(np.floor((points[p, k] + bound[p] - origin[k]) / cell)),
                          counts[k] - 1)
        for i in range(low[0], high[0] + 1):
            for j in range(low[1], high[1] + 1):
                row = (i * counts[1] + j) * counts[2]
                at = np.searchsorted(keys, row + low[2])
                while at < len(keys) and keys[at] <= row + high[2]:
                    best = min(best, _square(points[p], corner[owner[at]]))
                    at += 1
        found[p] = np.sqrt(best)
    return found


@compiled_exactly
def _square(p: np.ndarray, corner: np.ndarray) -> float:
    """Square of the distance of a point from a triangle (Ericson, Real-Time Collision Detection,
    5.1.5)."""
    bx, by, bz = (corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1],
                  corner[1, 2] - corner[0, 2])
    cx, cy, cz = (corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1],
                  corner[2, 2] - corner[0, 2])
    px, py, pz = p[0] - corner[0, 0], p[1] - corner[0, 1], p[2] - corner[0, 2]
    d1, d2 = bx * px + by * py + bz * pz, cx * px + cy * py + cz * pz
    bb, cc = bx * bx + by * by + bz * bz, cx * cx + cy * cy + cz * cz
    bc = bx * cx + by * cy + bz * cz
    # The same products with the point seen from the other two corners.
    d3, d4, d5, d6 = d1 - bb, d2 - bc, d1 - bc, d2 - cc
    v, w = 0.0, 0.0
    va, vb, vc = d3 * d6 - d5 * d4, d5 * d2 - d1 * d6, d1 * d4 - d3 * d2
    if d1 <= 0 and d2 <= 0:
        v, w = 0.0, 0.0
    elif d3 >= 0 and d4 <= d3:
        v, w = 1.0, 0.0
    elif d6 >= 0 and d5 <= d6:
        v, w = 0.0, 1.0
    elif vc <= 0 and d1 >= 0 and d3 <= 0:
        v, w = (d1 / (d1 - d3) if d1 > d3 else 0.0), 0.0
    elif vb <= 0 and d2 >= 0 and d6 <= 0:
        v, w = 0.0, (d2 / (d2 - d6) if d2 > d6 else 0.0)
    elif va <= 0 and d4 - d3 >= 0 and d5 - d6 >= 0:
        total = (d4 - d3) + (d5 - d6)
        w = (d4 - d3) / total if total > 0 else 0.0
        v = 1.0 - w
    else:
        total = va + vb + vc
        v, w = (vb / total, vc / total) if total > 0 else (0.0, 0.0)
    x, y, z = px - v * bx - w * cx, py - v * by - w * cy, pz - v * bz - w * cz
    return x * x + y * y + z * z
