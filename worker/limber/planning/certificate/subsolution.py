"""A function on a grid that no path can beat: the proof of a lower bound.

A path's cost is the integral of c over its length. If |grad u| <= c along the path, its cost is at
least u(start) - u(end): integrate grad u along it. So any u that satisfies the inequality proves a
bound; how u was found does not matter.

Here u is a quadratic B-spline (its gradient is continuous, so that the loss is of second order in
the edge h of a cell; with trilinear u it was of first order, 8 % instead of 2 % on one grid), one
coefficient a cell. In a cell

- each component of grad u is a polynomial in Bernstein form of degree 2 along each axis. At any
  point grad u is a mean of the 27 Bernstein coefficients with the basis as weights, so |grad u| is
  at most the same mean of their magnitudes;
- c is at least the trilinear interpolation of its values at the corners, less
  ``sum_i M_i x_i (h - x_i) / 2`` with ``M_i`` the maximum of d^2 c / dx_i^2 there. The Bernstein
  coefficients of the former are its values at the 27 points, those of the latter ``M_i h^2 / 4``
  where the point is half-way along axis i, else 0.

So it is enough that |g_m| is at most the difference of the two at the 27 points of an open cell; or
at most the former less the maximum of the latter, ``sum_i M_i h^2 / 8``; or at most the minimum of
c anywhere, the cost of length alone. (With the squares of both, the slope of c would count as well:
four times as much about a narrow valley.) Only the second derivatives are not proven. They are
taken as at most the largest second difference of c at the cell's corners and the next ones along
the axis, plus the difference between these; or as ``CURVATURE_FACTOR`` times the largest size of
those at its corners, if that is less. They are never less than 0, nor than the change of slope
between the corners requires (:mod:`limber.planning.certificate.subsolution`): the floor of a valley
may be between them. Where c has a kink of the other kind inside a cell (the energy is cut off at
zero), the cost of length counts.
"""

from typing import NamedTuple

import numpy as np
import scipy

from limber.core.numerics.compiled import compiled

# Fast marching on a masked grid: arrival costs from a set of nodes, second order where possible.
#
# Solves |grad u| = rate on the nodes of a regular grid (Sethian 1999, "Fast marching methods",
# SIAM Review 41, sections 5 and 6). The result is only a candidate:
# the subsolution below checks what a proof needs, however the candidate
# was found.

@compiled
def neighbours(active):
    """Return numbers of the nodes ``active`` [nx, ny, nz], -1 elsewhere, their indices in the flat
    grid [n], and the numbers of their neighbours below and above along each axis [n, 6]."""
    shape = np.array(active.shape)
    steps = np.array([shape[1] * shape[2], shape[2], 1])
    flat = active.ravel()
    numbers = np.full(flat.size, -1, np.int32)
    indices = np.flatnonzero(flat)
    for k in range(len(indices)):
        numbers[indices[k]] = k
    near = np.full((len(indices), 6), -1, np.int32)
    for k in range(len(indices)):
        for axis in range(3):
            at = indices[k] // steps[axis] % shape[axis]
            if at > 0:
                near[k, 2 * axis] = numbers[indices[k] - steps[axis]]
            if at + 1 < shape[axis]:
                near[k, 2 * axis + 1] = numbers[indices[k] + steps[axis]]
    return numbers.reshape(active.shape), indices, near


@compiled
def march(rate, near, known, values, edges):
    """Return arrival costs [n], infinite where unreachable, from cost per metre [n], neighbours [n,
    6], values [n] at ``known`` nodes, and the grid's edges [3] [m]."""
    count = len(rate)
    u = np.full(count, np.inf)
    done = np.zeros(count, np.bool_)
    heap = np.empty(count, np.int32)
    heap_index = np.full(count, -1, np.int32)
    used = np.empty((4, 3))
    size = 0
    for node in range(count):
        if known[node]:
            u[node] = values[node]
            size = _push(heap, heap_index, u, size, node)
    while size > 0:
        node = heap[0]
        size = _pop(heap, heap_index, u, size)
        done[node] = True
        for side in range(6):
            other = near[node, side]
            if other < 0 or done[other] or known[other]:
                continue
            cost = _arrival(other, u, done, rate[other], edges, near, used)
            if cost < u[other]:
                u[other] = cost
                if heap_index[other] < 0:
                    size = _push(heap, heap_index, u, size, other)
                else:
                    _rise(heap, heap_index, u, heap_index[other])
    return u


@compiled
def _arrival(node, u, done, rate, edges, near, used):
    """Solve sum_i w_i (u - t_i)^2 = rate^2 over the axes whose upwind neighbour is done. ``used``
    [4, 3] is room for t, w, the neighbour's value and the edge of each axis."""
    count = 0
    for axis in range(3):
        best, value = -1, np.inf
        for side in (2 * axis, 2 * axis + 1):
            other = near[node, side]
            if other >= 0 and done[other] and u[other] < value:
                best, value = side, u[other]
        if best < 0:
            continue
        weight = 1.0 / (edges[axis] * edges[axis])
        used[0, count], used[1, count], used[2, count] = value, weight, value
        used[3, count] = edges[axis]
        far = near[near[node, best], best]
        if far >= 0 and done[far] and u[far] <= value:
            used[0, count], used[1, count] = (4.0 * value - u[far]) / 3.0, 2.25 * weight
        count += 1
    # Drop the axis with the highest neighbour until the solution exceeds all used neighbours.
    while count > 0:
        a, b, c, top = 0.0, 0.0, -rate * rate, -np.inf
        last = 0
        for i in range(count):
            t, w = used[0, i], used[1, i]
            a += w
            b += w * t
            c += w * t * t
            if used[2, i] > top:
                top, last = used[2, i], i
        root = b * b - a * c
        if root >= 0.0:
            solution = (b + np.sqrt(root)) / a
            if solution >= top:
                return solution
        if count == 1:
            return used[2, 0] + rate * used[3, 0]
        count -= 1
        for k in range(4):
            used[k, last] = used[k, count]
    return np.inf


@compiled
def _push(heap, heap_index, u, size, node):
    heap[size] = node
    heap_index[node] = size
    _rise(heap, heap_index, u, size)
    return size + 1


@compiled
def _rise(heap, heap_index, u, index):
    node = heap[index]
    while index > 0:
        parent = (index - 1) // 2
        if u[heap[parent]] <= u[node]:
            break
        heap[index] = heap[parent]
        heap_index[heap[index]] = index
        index = parent
    heap[index] = node
    heap_index[node] = index


@compiled
def _pop(heap, heap_index, u, size):
    size -= 1
    heap_index[heap[0]] = -2
    node = heap[size]
    index = 0
    while True:
        child = 2 * index + 1
        if child >= size:
            break
        if child + 1 < size and u[heap[child + 1]] < u[heap[child]]:
            child += 1
        if u[node] <= u[heap[child]]:
            break
        heap[index] = heap[child]
        heap_index[heap[index]] = index
        index = child
    if size > 0:
        heap[index] = node
        heap_index[node] = index
    return size


# Lower bounds of a function in a cell, from its values and slopes at the corners.
#
# A smooth function leaves the trilinear interpolation of its corners by at most
#
#     sum_i M_i h^2 / 8,   M_i the maximum of d^2 f / dx_i^2 there,
#
# and second differences at the corners, times ``CURVATURE_FACTOR``, estimate this maximum. In the
# valley that a grasp follows they do not: its floor may be inside a cell, a hundred times as
# narrow, and no corner sees it. The corners do show on which side of it they are:
#
# - The energy rises on both sides. A convex function is above its tangents at both ends of an
#   edge, and so above the chord less ``x_i (h - x_i) / 2`` times ``2 / h`` times the change of
#   slope:
#   exact for a kink, twice what a parabola needs.
# - The force reverses. As a vector it is between those at the corners, up to its own curvature: its
#   size is at least the distance of zero from their convex hull.

CURVATURE_FACTOR = 2.0
"""Factor on second differences at a cell's corners that bounds derivatives inside."""

_NEARER = 12  # steps towards the point of a hull nearest to zero


@compiled
def turns(slopes, cells):
    """Return ``M_i h^2`` of convex functions [3, *shape of cells] from slopes at corners [nx + 1,
    ny + 1, nz + 1, 3] times h; nan counts as no turn."""
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
    """Lower bounds in cells [nx, ny, nz] from values [nx + 1, ny + 1, nz + 1] and slopes as in
    :func:`turns`, -inf where unknown. Second differences with a nan count as 0."""
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
    1, ny + 1, nz + 1, 3] at the corners; 0 where not known."""
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


RIM = 2  # closed cells around the open ones that have coefficients as well
_ROUNDS, _CLOSE = 8, 1.0005  # local reweighting; ends when nothing exceeds by more than _CLOSE
_IDLE, _WORTH = 2, 1.004  # rounds without gain that end it; the factor that counts as a gain
_EVEN = 7  # cells over which the factors on a known cost change from one to another


class Terrain(NamedTuple):
    """A grid and its cost per metre c [1/m]: at corners [nx + 1, ny + 1, nz + 1], less ``bends``
    [3, *cells] half-way along each axis, at least ``floor``. No cell at the border is open; in
    ``level`` cells only the floor counts."""

    edges: np.ndarray
    open_cells: np.ndarray
    rate: np.ndarray
    bends: np.ndarray
    level: np.ndarray
    floor: float

    @property
    def active(self) -> np.ndarray:
        """Cells that have coefficients: open ones and ``RIM`` layers around them. The layers let a
        cost arrive along an oblique border, at whose steps it would be too steep."""
        return widened(self.open_cells, RIM)


def widened(cells: np.ndarray, times: int = 1) -> np.ndarray:
    """Return ``cells`` and ``times`` layers of cells around them."""
    out = cells.copy()
    for _ in range(times):
        for axis in range(3):
            before = out.copy()
            here, after = out.swapaxes(0, axis), before.swapaxes(0, axis)
            here[1:] |= after[:-1]
            here[:-1] |= after[1:]
    return out


def terrain(rate: np.ndarray, slopes: np.ndarray, positive: np.ndarray, open_cells: np.ndarray,
            edges: np.ndarray, floor: float) -> Terrain:
    """Return the terrain of ``rate`` [1/m] at corners (nan: not evaluated), at least ``floor``.
    ``slopes`` [..., 3] are per cell edge; ``positive`` corners do not have the energy cut off."""
    bends = turns(slopes, open_cells)
    del slopes  # three numbers a corner of the whole box
    bends *= 0.25
    np.maximum(_bends(rate, open_cells), bends, out=bends)
    level = with_corner(positive) & with_corner(~positive)
    return Terrain(edges, open_cells, np.nan_to_num(rate, nan=floor), bends, level, floor)


@compiled
def _bends(values, cells):
    """Return ``M_i h^2 / 4`` of the module's text in ``cells``, shape [3, *shape of cells].
    ``values`` at the corners; a second difference with one that is not known (nan) counts as 0."""
    out = np.zeros((3,) + cells.shape)
    first, last = np.empty(3, np.int64), np.empty(3, np.int64)
    at, step = np.empty(3, np.int64), np.empty(3, np.int64)
    for i in range(cells.shape[0]):
        for j in range(cells.shape[1]):
            for k in range(cells.shape[2]):
                if not cells[i, j, k]:
                    continue
                for axis in range(3):
                    first[0], first[1], first[2] = i, j, k
                    last[:] = first + 1
                    step[:] = 0
                    step[axis] = 1
                    most, least, size = -np.inf, np.inf, 0.0
                    first[axis] = max(first[axis] - 1, 1)
                    last[axis] = min(last[axis] + 1, values.shape[axis] - 2)
                    for p in range(first[0], last[0] + 1):
                        for q in range(first[1], last[1] + 1):
                            for r in range(first[2], last[2] + 1):
                                at[0], at[1], at[2] = p, q, r
                                second = (values[p - step[0], q - step[1], r - step[2]]
                                          - 2.0 * values[p, q, r]
                                          + values[p + step[0], q + step[1], r + step[2]])
                                if np.isnan(second):
                                    second = 0.0
                                most, least = max(most, second), min(least, second)
                                index = i if axis == 0 else (j if axis == 1 else k)
                                if index <= at[axis] <= index + 1:
                                    size = max(size, abs(second))
                    bend = min(2.0 * most - least, CURVATURE_FACTOR * size)
                    out[axis, i, j, k] = 0.25 * max(bend, 0.0)
    return out


def second_differences(values: np.ndarray) -> list[np.ndarray]:
    """Return |second differences| along each axis, of the shape of ``values``; nan counts as 0."""
    found = []
    for axis in range(3):
        second = np.nan_to_num(np.abs(np.diff(values, 2, axis=axis)))
        pad = [(1, 1) if k == axis else (0, 0) for k in range(3)]
        found.append(np.pad(second, pad, mode="edge"))
    return found


def corner_values(values: np.ndarray) -> np.ndarray:
    """Return the values at each cell's corners: [nx + 1, ...] to [8, nx, ny, nz]."""
    nx, ny, nz = (n - 1 for n in values.shape)
    return np.stack([values[i:nx + i, j:ny + j, k:nz + k]
                     for i in (0, 1) for j in (0, 1) for k in (0, 1)])


def corners_of(cells: np.ndarray) -> np.ndarray:
    """Return the nodes [nx + 1, ny + 1, nz + 1] that are corners of any of ``cells``."""
    nodes = np.zeros(tuple(n + 1 for n in cells.shape), bool)
    nx, ny, nz = cells.shape
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                nodes[i:nx + i, j:ny + j, k:nz + k] |= cells
    return nodes


def with_corner(nodes: np.ndarray) -> np.ndarray:
    """Return the cells of which a corner is one of ``nodes`` [nx + 1, ny + 1, nz + 1]."""
    cells = np.zeros(tuple(n - 1 for n in nodes.shape), bool)
    nx, ny, nz = cells.shape
    for i in (0, 1):
        for j in (0, 1):
            for k in (0, 1):
                cells |= nodes[i:nx + i, j:ny + j, k:nz + k]
    return cells


def subsolution(rates: Terrain, known: np.ndarray, shape: np.ndarray, free_cells: np.ndarray,
                rounds: int = _ROUNDS) -> np.ndarray:
    """Return coefficients of a ``u`` with |grad u| <= c in every open cell but ``free_cells``; on
    ``known`` nearly ``shape``, a signed cost, less where that is too steep; infinite where
    unreachable. Fewer local reweightings give a lower ``u``, never an invalid one."""
    active = rates.active
    around = known & active
    u = np.full(active.shape, np.inf)
    if not around.any():
        return u
    numbers, indices, near = neighbours(active)
    bound = _middles(rates.rate, indices, active.shape)
    u[around] = shape[around]
    asked = np.argwhere(rates.open_cells & ~free_cells)
    own = numbers[tuple(asked.T)]
    held, about = around.ravel()[indices], widened(around).ravel()[indices]
    beside = asked[around[tuple(asked.T)]]
    # Where the cost is too steep it counts less there alone: one factor for all would be the least.
    steep = np.ones(active.shape)
    steep[tuple(beside.T)] = np.maximum(_excess(u, *rates, beside), 1.0)
    within = around_box(around)
    u[within] /= scipy.ndimage.uniform_filter(
        scipy.ndimage.maximum_filter(steep[within], _EVEN), _EVEN)
    lengths, most = u.ravel()[indices], float(_excess(u, *rates, beside).max(initial=0.0))
    factor = 1.0 / most if most > 0.0 else float(bound[held].min())
    rate, steepest = bound, held
    least, best, idle = np.inf, bound, 0
    for _ in range(rounds):
        values = march(rate, near, held, factor * lengths, rates.edges)
        u.ravel()[indices] = values
        over = np.ones(len(indices))
        over[own] = np.maximum(_excess(u, *rates, asked), 1.0)
        worst = float(over.max())
        idle = 0 if worst < least / _WORTH else idle + 1
        if worst < least:
            least, best = worst, values
        if worst <= _CLOSE or idle == _IDLE:
            break
        factor /= float(over[steepest].max())
        steepest = about
        # The largest of the neighbours: cell by cell would cause a chequerboard pattern.
        rate = rate / _most_about(over, numbers, indices)
    # The rescaling makes it a proof; the rounds before only keep it small.
    u.ravel()[indices] = best / least
    return u


def around_box(cells: np.ndarray, layers: int = 1) -> tuple[slice, ...]:
    """Return the smallest box with ``cells`` and ``layers`` around them, as far as there are."""
    numbers = np.argwhere(cells)
    return tuple(map(slice, np.maximum(numbers.min(axis=0) - layers, 0),
                     numbers.max(axis=0) + layers + 1))


@compiled
def _middles(values, indices, shape):
    """Return the mean of the values at the corners of the cells ``indices`` [n] of a grid."""
    out = np.empty(len(indices))
    for n in range(len(indices)):
        i, j, k = indices[n] // (shape[1] * shape[2]), indices[n] // shape[2] % shape[1], (
            indices[n] % shape[2])
        out[n] = values[i:i + 2, j:j + 2, k:k + 2].sum() / 8.0
    return out


@compiled
def _most_about(values, numbers, places):
    """Return the largest of each cell's value [n] and those of the cells that touch it."""
    out = np.empty(len(places))
    shape = numbers.shape
    for n in range(len(places)):
        i, j, k = places[n] // (shape[1] * shape[2]), places[n] // shape[2] % shape[1], (
            places[n] % shape[2])
        most = values[n]
        for p in range(max(i - 1, 0), min(i + 2, shape[0])):
            for q in range(max(j - 1, 0), min(j + 2, shape[1])):
                for r in range(max(k - 1, 0), min(k + 2, shape[2])):
                    other = numbers[p, q, r]
                    if other >= 0 and values[other] > most:
                        most = values[other]
        out[n] = most
    return out


def spline_value(u: np.ndarray, cell: np.ndarray) -> float:
    """Return the spline at the centre of ``cell`` [3] from its coefficients ``u``."""
    weights = np.array([0.125, 0.75, 0.125])
    block = u[tuple(slice(k - 1, k + 2) for k in cell)]
    return float(np.einsum("ijk,i,j,k", block, weights, weights, weights))


@compiled
def least_in_cells(u, cells):
    """Return a lower bound of the spline in each of ``cells``: its least Bernstein coefficient."""
    out = np.full(u.shape, np.inf)
    one, two, three = np.empty((3, 3, 3)), np.empty((3, 3, 3)), np.empty((3, 3, 3))
    indices = np.argwhere(cells)
    for n in range(len(indices)):
        i, j, k = indices[n, 0], indices[n, 1], indices[n, 2]
        _along_last(u[i - 1:i + 2, j - 1:j + 2, k - 1:k + 2], one)
        _along_middle(one, two)
        _along_first(two, three)
        out[i, j, k] = three.min()
    return out


# Bernstein coefficients along one axis of a spline from 3 of its own, in all 9 lines along it.


@compiled
def _along_last(source, out):
    for p in range(3):
        for q in range(3):
            a, b, c = source[p, q, 0], source[p, q, 1], source[p, q, 2]
            out[p, q, 0], out[p, q, 1], out[p, q, 2] = 0.5 * (a + b), b, 0.5 * (b + c)


@compiled
def _along_middle(source, out):
    for p in range(3):
        for q in range(3):
            a, b, c = source[p, 0, q], source[p, 1, q], source[p, 2, q]
            out[p, 0, q], out[p, 1, q], out[p, 2, q] = 0.5 * (a + b), b, 0.5 * (b + c)


@compiled
def _along_first(source, out):
    for p in range(3):
        for q in range(3):
            a, b, c = source[0, p, q], source[1, p, q], source[2, p, q]
            out[0, p, q], out[1, p, q], out[2, p, q] = 0.5 * (a + b), b, 0.5 * (b + c)


# Those of its slope along the axis.


@compiled
def _slope_last(source, out):
    for p in range(3):
        for q in range(3):
            a, b, c = source[p, q, 0], source[p, q, 1], source[p, q, 2]
            out[p, q, 0], out[p, q, 1], out[p, q, 2] = b - a, 0.5 * (c - a), c - b


@compiled
def _slope_middle(source, out):
    for p in range(3):
        for q in range(3):
            a, b, c = source[p, 0, q], source[p, 1, q], source[p, 2, q]
            out[p, 0, q], out[p, 1, q], out[p, 2, q] = b - a, 0.5 * (c - a), c - b


@compiled
def _slope_first(source, out):
    for p in range(3):
        for q in range(3):
            a, b, c = source[0, p, q], source[1, p, q], source[2, p, q]
            out[0, p, q], out[1, p, q], out[2, p, q] = b - a, 0.5 * (c - a), c - b


@compiled
def _excess(u, edges, open_cells, rate, bends, level, floor, asked):
    """Return for each of the open cells ``asked`` [n, 3] the largest |grad u| relative to the
    allowed value there, else 0."""
    over = np.zeros(len(asked))
    along, down = np.empty((3, 3, 3)), np.empty((3, 3, 3))
    one, two, three = np.empty((3, 3, 3)), np.empty((3, 3, 3)), np.empty((3, 3, 3))
    allowed = np.empty((3, 3, 3))
    for n in range(len(asked)):
        i, j, k = asked[n, 0], asked[n, 1], asked[n, 2]
        block = u[i - 1:i + 2, j - 1:j + 2, k - 1:k + 2]
        if not (open_cells[i, j, k] and block.max() < np.inf):
            continue
        _along_last(block, along)
        _slope_last(block, down)
        _along_middle(along, one)
        _slope_first(one, two)
        _slope_middle(along, one)
        _along_first(one, three)
        _along_middle(down, one)
        _along_first(one, along)
        for p in range(3):
            for q in range(3):
                for r in range(3):
                    one[p, q, r] = np.sqrt((two[p, q, r] / edges[0])**2
                                           + (three[p, q, r] / edges[1])**2
                                           + (along[p, q, r] / edges[2])**2)
        worst = one.max() / floor
        if level[i, j, k]:
            over[n] = worst
            continue
        _between(rate, i, j, k, allowed)
        x, y, z = bends[0, i, j, k], bends[1, i, j, k], bends[2, i, j, k]
        uneven, even, whole = 0.0, 0.0, 0.5 * (x + y + z)
        for p in range(3):
            for q in range(3):
                for r in range(3):
                    most = allowed[p, q, r]
                    even = max(even, _over(one[p, q, r], most - whole))
                    most -= (x if p == 1 else 0.0) + (y if q == 1 else 0.0) + (
                        z if r == 1 else 0.0)
                    uneven = max(uneven, _over(one[p, q, r], most))
        over[n] = min(worst, even, uneven)
    return over


@compiled
def _over(steep, allowed):
    return steep / allowed if allowed > 0.0 else np.inf


@compiled
def _between(values, i, j, k, out):
    """Write the trilinear interpolation at the 27 points ``(p, q, r) / 2`` in a cell."""
    for p in range(0, 3, 2):
        for q in range(0, 3, 2):
            first, last = values[i + p // 2, j + q // 2, k], values[i + p // 2, j + q // 2, k + 1]
            out[p, q, 0], out[p, q, 1], out[p, q, 2] = first, 0.5 * (first + last), last
        for r in range(3):
            out[p, 1, r] = 0.5 * (out[p, 0, r] + out[p, 2, r])
    for q in range(3):
        for r in range(3):
            out[1, q, r] = 0.5 * (out[0, q, r] + out[2, q, r])
