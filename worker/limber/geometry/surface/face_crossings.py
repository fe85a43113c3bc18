"""Crossings of a surface's faces: a grid of cells, and Moeller and Trumbore's test within them."""

import numpy as np

from limber.core.numerics.compiled import compiled_exactly

_EDGE = 1e-7  # touching is not crossing: faces of a union meet at rounding distance


@compiled_exactly
def by_cell(first: np.ndarray, last: np.ndarray, counts: np.ndarray,
            ) -> tuple[np.ndarray, np.ndarray]:
    """Grid cells that the boxes of faces overlap.

    Args:
        first: Lowest cell of each face, shape [n, 3].
        last: Highest cell, shape [n, 3].
        counts: Number of cells in each direction, shape [3].

    Returns:
        The number of each cell that contains part of a face, shape [k], and the face, shape [k].
    """
    total = 0
    for f in range(len(first)):
        total += ((last[f, 0] - first[f, 0] + 1) * (last[f, 1] - first[f, 1] + 1)
                  * (last[f, 2] - first[f, 2] + 1))
    keys, owner = np.empty(total, np.int64), np.empty(total, np.int64)
    at = 0
    for f in range(len(first)):
        for i in range(first[f, 0], last[f, 0] + 1):
            for j in range(first[f, 1], last[f, 1] + 1):
                for k in range(first[f, 2], last[f, 2] + 1):
                    keys[at] = (i * counts[1] + j) * counts[2] + k
                    owner[at] = f
                    at += 1
    return keys, owner


@compiled_exactly
def pierced(vertices: np.ndarray, faces: np.ndarray, low: np.ndarray, high: np.ndarray,
            first: np.ndarray, counts: np.ndarray, keys: np.ndarray, owner: np.ndarray,
            ) -> np.ndarray:
    """Points [m] where an edge of one face passes through another one, shape [c, 3].

    Faces that share an edge are not compared; for faces that share a corner, only the edges
    opposite to it are.

    Args:
        vertices: Positions [m], shape [v, 3].
        faces: Corners, shape [n, 3].
        low: Lowest corner of each face's box [m], shape [n, 3].
        high: Highest corner [m].
        first: Lowest cell of each face, shape [n, 3].
        counts: Number of cells in each direction, shape [3].
        keys: Cells in ascending order, shape [k], as :func:`by_cell` numbers them.
        owner: The face in each.
    """
    found = [(0.0, 0.0, 0.0) for _ in range(0)]
    begin = 0
    while begin < len(keys):
        end = begin + 1
        while end < len(keys) and keys[end] == keys[begin]:
            end += 1
        for i in range(begin, end):
            for j in range(i + 1, end):
                one, other = owner[i], owner[j]
                near = True
                for k in range(3):
                    near &= low[one, k] <= high[other, k] and low[other, k] <= high[one, k]
                # Of all cells that contain both, only the lowest compares them.
                if near and keys[begin] == (
                        (max(first[one, 0], first[other, 0]) * counts[1]
                         + max(first[one, 1], first[other, 1])) * counts[2]
                        + max(first[one, 2], first[other, 2])):
                    _compare(vertices, faces, one, other, found)
                    _compare(vertices, faces, other, one, found)
        begin = end
    points = np.empty((len(found), 3))
    for k in range(len(found)):
        points[k, 0], points[k, 1], points[k, 2] = found[k]
    return points


@compiled_exactly
def _compare(vertices: np.ndarray, faces: np.ndarray, one: int, other: int, found: list) -> None:
    """Add the points where edges of ``one`` pass through ``other`` (Moeller and Trumbore 1997)."""
    o, p, q = faces[other, 0], faces[other, 1], faces[other, 2]
    common, number = 0, 0  # shared corners of ``one`` and ``other``, a bit each
    for i in range(3):
        corner = faces[one, i]
        if corner == o or corner == p or corner == q:
            common |= 1 << i
            number += 1
    if number > 1:
        return
    ox, oy, oz = vertices[o, 0], vertices[o, 1], vertices[o, 2]
    sx, sy, sz = vertices[p, 0] - ox, vertices[p, 1] - oy, vertices[p, 2] - oz
    ex, ey, ez = vertices[q, 0] - ox, vertices[q, 1] - oy, vertices[q, 2] - oz
    for i in range(3):
        after = (i + 1) % 3
        if common & (1 << i | 1 << after):
            continue
        a, b = faces[one, i], faces[one, after]
        ax, ay, az = vertices[a, 0], vertices[a, 1], vertices[a, 2]
        bx, by, bz = vertices[b, 0], vertices[b, 1], vertices[b, 2]
        dx, dy, dz = bx - ax, by - ay, bz - az
        cx, cy, cz = dy * ez - dz * ey, dz * ex - dx * ez, dx * ey - dy * ex
        det = sx * cx + sy * cy + sz * cz
        size = np.sqrt((sx * sx + sy * sy + sz * sz) * (dx * dx + dy * dy + dz * dz)
                       * (ex * ex + ey * ey + ez * ez))
        if abs(det) <= 1e-9 * size:
            continue
        fx, fy, fz = ax - ox, ay - oy, az - oz
        u = (fx * cx + fy * cy + fz * cz) / det
        tx, ty, tz = fy * sz - fz * sy, fz * sx - fx * sz, fx * sy - fy * sx
        v = (dx * tx + dy * ty + dz * tz) / det
        t = (ex * tx + ey * ty + ez * tz) / det
        if u > _EDGE and v > _EDGE and u + v < 1 - _EDGE and _EDGE < t < 1 - _EDGE:
            found.append((ax + t * dx, ay + t * dy, az + t * dz))
