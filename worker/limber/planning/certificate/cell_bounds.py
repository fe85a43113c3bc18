"""Lower bounds of a function in a cell, from its values and slopes at the corners.

A smooth function leaves the trilinear interpolation of its corners by at most

    sum_i M_i h^2 / 8,   M_i the maximum of d^2 f / dx_i^2 there,

and second differences at the corners, times ``CURVATURE_FACTOR``, estimate this maximum. In the
valley that a grasp follows they do not: its floor may be inside a cell, a hundred times as narrow,
and no corner sees it. The corners do show on which side of it they are:

- The energy rises on both sides. A convex function is above its tangents at both ends of an
  edge, and so above the chord less ``x_i (h - x_i) / 2`` times ``2 / h`` times the change of slope:
  exact for a kink, twice what a parabola needs.
- The force reverses. As a vector it is between those at the corners, up to its own curvature: its
  size is at least the distance of zero from their convex hull.
"""

import numpy as np

from limber.core.numerics.compiled import compiled

CURVATURE_FACTOR = 2.0
"""Factor on second differences at a cell's corners that bounds derivatives inside."""

_NEARER = 12  # steps towards the point of a hull nearest to zero


@compiled
def turns(slopes, cells):
    """Return ``M_i h^2`` of convex functions, [3, *shape of cells], in ``cells`` [nx, ny, nz].

    ``slopes`` [nx + 1, ny + 1, nz + 1, 3] are those at the corners, times h; nan counts as no turn.
    """
    out = np.zeros((3,) + cells.shape)
    for i in range(cells.shape[0]):
        for j in range(cells.shape[1]):
            for k in range(cells.shape[2]):
                if not cells[i, j, k]:
                    continue
                for p in range(2):
                    for q in range(2):
                        x = slopes[i + 1, j + p, k + q, 0] - slopes[i, j + p, k + q, 0]
                        y = slopes[i + p, j + 1, k + q, 1] - slopes[i + p, j, k + q, 1]
                        z = slopes[i + p, j + q, k + 1, 2] - slopes[i + p, j + q, k, 2]
                        out[0, i, j, k] = max(out[0, i, j, k], 2.0 * x)
                        out[1, i, j, k] = max(out[1, i, j, k], 2.0 * y)
                        out[2, i, j, k] = max(out[2, i, j, k], 2.0 * z)
    return out


@compiled
def least_between(values, slopes, cells):
    """Return lower bounds in ``cells`` [nx, ny, nz] of functions with ``values`` [nx + 1, ny + 1,
    nz + 1] and ``slopes`` at the corners, as in :func:`turns`; -inf where not known.

    A second difference that includes an unknown value, nan, counts as 0.
    """
    out = np.full(cells.shape, -np.inf)
    turned = turns(slopes, cells)
    indices = np.argwhere(cells)
    curved = np.empty(3)
    for n in range(len(indices)):
        i, j, k = indices[n, 0], indices[n, 1], indices[n, 2]
        least = np.inf
        curved[:] = 0.0
        for p in range(i, i + 2):
            for q in range(j, j + 2):
                for r in range(k, k + 2):
                    here = values[p, q, r]
                    least = here if np.isnan(here) else min(least, here)
                    x = abs(values[p - 1, q, r] - 2.0 * here + values[p + 1, q, r])
                    y = abs(values[p, q - 1, r] - 2.0 * here + values[p, q + 1, r])
                    z = abs(values[p, q, r - 1] - 2.0 * here + values[p, q, r + 1])
                    curved[0] = x if x > curved[0] else curved[0]
                    curved[1] = y if y > curved[1] else curved[1]
                    curved[2] = z if z > curved[2] else curved[2]
        if not np.isnan(least):
            for axis in range(3):
                least -= max(CURVATURE_FACTOR * curved[axis], turned[axis, i, j, k]) / 8.0
            out[i, j, k] = least
    return out


@compiled
def least_size(vectors, cells):
    """Return the least length in ``cells`` [nx, ny, nz] of a vector with values ``vectors`` [nx +
    1, ny + 1, nz + 1, 3] at the corners; 0 where not known.
    """
    out = np.zeros(cells.shape)
    indices = np.argwhere(cells)
    corners, curved, step = np.empty((8, 3)), np.empty(3), np.empty(3, np.int64)
    for n in range(len(indices)):
        i, j, k = indices[n, 0], indices[n, 1], indices[n, 2]
        curved[:] = 0.0
        number = 0
        for p in range(i, i + 2):
            for q in range(j, j + 2):
                for r in range(k, k + 2):
                    corners[number] = vectors[p, q, r]
                    number += 1
                    for axis in range(3):
                        step[:] = 0
                        step[axis] = 1
                        bend = 0.0
                        for c in range(3):
                            second = (vectors[p - step[0], q - step[1], r - step[2], c]
                                      - 2.0 * vectors[p, q, r, c]
                                      + vectors[p + step[0], q + step[1], r + step[2], c])
                            bend += second * second
                        if bend > curved[axis]:
                            curved[axis] = bend
        if not np.isnan(corners).any():
            bends = np.sqrt(curved[0]) + np.sqrt(curved[1]) + np.sqrt(curved[2])
            out[i, j, k] = max(_off_zero(corners) - CURVATURE_FACTOR / 8.0 * bends, 0.0)
    return out


@compiled
def off_zero(corners):
    """Return a lower bound of the distances of zero from the convex hulls of ``corners``
    [n, 8, 3], shape [n]."""
    out = np.empty(len(corners))
    for n in range(len(corners)):
        out[n] = _off_zero(corners[n])
    return out


@compiled
def _off_zero(corners):
    """Gilbert's steps: along any direction, the hull is beyond its least corner."""
    best, least = np.zeros(3), np.inf
    for n in range(len(corners)):
        size = corners[n, 0]**2 + corners[n, 1]**2 + corners[n, 2]**2
        if size < least:
            least = size
            best[:] = corners[n]
    found = 0.0
    for _ in range(_NEARER):
        size = np.sqrt(best[0]**2 + best[1]**2 + best[2]**2)
        if size <= 0.0:
            return 0.0
        nearest, at = np.inf, 0
        for n in range(len(corners)):
            along = (corners[n, 0] * best[0] + corners[n, 1] * best[1]
                     + corners[n, 2] * best[2]) / size
            if along < nearest:
                nearest, at = along, n
        found = max(found, nearest)
        if size - nearest <= 1e-3 * size:
            break
        part, whole = 0.0, 0.0
        for c in range(3):
            component = corners[at, c] - best[c]
            part -= component * best[c]
            whole += component * component
        share = min(max(part / whole, 0.0), 1.0)
        for c in range(3):
            best[c] += share * (corners[at, c] - best[c])
    return found
