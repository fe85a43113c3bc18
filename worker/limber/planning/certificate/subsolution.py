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

from limber.kernels import Kernel

_CELLS, _CORNERS = "cells bool[nx, ny, nz]", "values float64[cx, cy, cz]"
_SLOPES, _FOUND = "slopes float64[cx, cy, cz, 3]", "out found float64[nx, ny, nz]"
_numbered = Kernel("cells_numbered", "cells int64[count]", "out numbers int32[nx, ny, nz]",
                   "out near int32[count, 6]")
_marched = Kernel("fast_marching", "rate float64[count]", "near int32[count, 6]",
                  "known bool[count]", "values float64[count]", "edges float64[3]",
                  "out u float64[count]")
_turned = Kernel("turns_between", _SLOPES, _CELLS, "out found float64[3, nx, ny, nz]")
_least_between = Kernel("least_between", _CORNERS, _SLOPES, _CELLS, _FOUND, "curvature float")
_least_size = Kernel("least_size", "vectors float64[cx, cy, cz, 3]", _CELLS, _FOUND,
                     "curvature float")
_off_zero = Kernel("hulls_off_zero", "corners float64[hulls, 8, 3]", "out found float64[hulls]")
_bent = Kernel("bends_between", _CORNERS, _CELLS, "out found float64[3, nx, ny, nz]",
               "curvature float")
_middle = Kernel("means_of_corners", _CORNERS, "cells int64[count]", "out means float64[count]")
_most = Kernel("most_about", "values float64[count]", "numbers int32[nx, ny, nz]",
               "cells int64[count]", "out most float64[count]")
_least = Kernel("least_in_cells", "u float64[nx, ny, nz]", _CELLS, _FOUND)
_steepness = Kernel(
    "spline_excess", "u float64[nx, ny, nz]", "edges float64[3]", "open_cells bool[nx, ny, nz]",
    "rate float64[cx, cy, cz]", "bends float64[3, nx, ny, nz]", "level bool[nx, ny, nz]",
    "asked int64[asked, 3]", "out over float64[asked]", "floor float")


def neighbours(active: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return numbers of the nodes ``active`` [nx, ny, nz], -1 elsewhere, their indices in the flat
    grid [n], and the numbers of their neighbours below and above along each axis [n, 6]."""
    indices = np.flatnonzero(active)
    numbers, near = np.empty(active.shape, np.int32), np.empty((len(indices), 6), np.int32)
    _numbered(indices, numbers, near)
    return numbers, indices, near


def march(rate: np.ndarray, near: np.ndarray, known: np.ndarray, values: np.ndarray,
          edges: np.ndarray) -> np.ndarray:
    """Fast marching on a masked grid: solve |grad u| = rate on its nodes, second order where
    possible (Sethian 1999, "Fast marching methods", SIAM Review 41, sections 5 and 6).

    Return arrival costs [n], infinite where unreachable, from cost per metre [n], neighbours [n,
    6], values [n] that ``known`` nodes have at most, and the grid's edges [3] [m]. They are only a
    candidate: the subsolution below checks what a proof needs, however the candidate was found.
    """
    out = np.empty(len(rate))
    _marched(rate, near, known, values, edges, out)
    return out


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


def turns(slopes: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return ``M_i h^2`` of convex functions [3, *shape of cells] from slopes at corners [nx + 1,
    ny + 1, nz + 1, 3] times h; nan counts as no turn."""
    out = np.empty((3, *cells.shape))
    _turned(slopes, cells, out)
    return out


def least_between(values: np.ndarray, slopes: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Lower bounds in cells [nx, ny, nz] from values [nx + 1, ny + 1, nz + 1] and slopes as in
    :func:`turns`, -inf where unknown. Second differences with a nan count as 0."""
    out = np.empty(cells.shape)
    _least_between(values, slopes, cells, out, CURVATURE_FACTOR)
    return out


def least_size(vectors: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return the least length in ``cells`` [nx, ny, nz] of a vector with values ``vectors`` [nx +
    1, ny + 1, nz + 1, 3] at the corners; 0 where not known."""
    out = np.empty(cells.shape)
    _least_size(vectors, cells, out, CURVATURE_FACTOR)
    return out


def off_zero(corners: np.ndarray) -> np.ndarray:
    """Return a lower bound of the distances of zero from the convex hulls of ``corners``
    [n, 8, 3], shape [n]."""
    out = np.empty(len(corners))
    _off_zero.of(corners, out)
    return out


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


def _bends(values: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return ``M_i h^2 / 4`` of the module's text in ``cells``, shape [3, *shape of cells].
    ``values`` at the corners; a second difference with one that is not known (nan) counts as 0."""
    out = np.empty((3, *cells.shape))
    _bent(values, cells, out, CURVATURE_FACTOR)
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
    return with_corner(np.pad(cells, 1))


def with_corner(nodes: np.ndarray) -> np.ndarray:
    """Return the cells of which a corner is one of ``nodes`` [nx + 1, ny + 1, nz + 1]."""
    return corner_values(nodes).any(axis=0)


def subsolution(rates: Terrain, known: np.ndarray, shape: np.ndarray, free_cells: np.ndarray,
                rounds: int = _ROUNDS) -> np.ndarray:
    """Return coefficients of a ``u`` with |grad u| <= c in every open cell but ``free_cells``; on
    ``known`` at most ``shape``, a signed cost, less where that is too steep; infinite where
    unreachable. Fewer local reweightings give a lower ``u``, never an invalid one."""
    active = rates.active
    around = known & active
    u = np.full(active.shape, np.inf)
    if not around.any():
        return u
    numbers, indices, near = neighbours(active)
    bound = _middles(rates.rate, indices)
    u[around] = shape[around]
    asked = np.argwhere(rates.open_cells & ~free_cells)
    own = numbers[tuple(asked.T)]
    # Where the cost is too steep it is lowered evenly: cell by cell, it would bend more.
    beside, within = asked[around[tuple(asked.T)]], around_box(around)
    steep = np.ones(active.shape)
    steep[tuple(beside.T)] = np.maximum(_excess(u, rates, beside), 1.0)
    u[within] = np.minimum(u[within], u[within] / scipy.ndimage.uniform_filter(
        scipy.ndimage.maximum_filter(steep[within], _EVEN), _EVEN))
    held, lengths = around.ravel()[indices], u.ravel()[indices]
    rate, least, best, idle = bound, np.inf, bound, 0
    for _ in range(rounds):
        values = march(rate, near, held, lengths, rates.edges)
        u.ravel()[indices] = values
        over = np.ones(len(indices))
        over[own] = np.maximum(_excess(u, rates, asked), 1.0)
        worst = float(over.max())
        idle = 0 if worst < least / _WORTH else idle + 1
        if worst < least:
            least, best = worst, values
        if worst <= _CLOSE or idle == _IDLE:
            break
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


def _middles(values: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the means of the values at the corners of the cells ``indices`` [n] of a grid."""
    out = np.empty(len(indices))
    _middle(values, indices, out)
    return out


def _most_about(values: np.ndarray, numbers: np.ndarray, indices: np.ndarray) -> np.ndarray:
    """Return the largest of each cell's value [n] and those of the cells that touch it."""
    out = np.empty(len(indices))
    _most(values, numbers, indices, out)
    return out


def spline_value(u: np.ndarray, cell: np.ndarray) -> float:
    """Return the spline at the centre of ``cell`` [3] from its coefficients ``u``."""
    weights = np.array([0.125, 0.75, 0.125])
    block = u[tuple(slice(k - 1, k + 2) for k in cell)]
    return float(np.einsum("ijk,i,j,k", block, weights, weights, weights))


def least_in_cells(u: np.ndarray, cells: np.ndarray) -> np.ndarray:
    """Return a lower bound of the spline in each of ``cells``: its least Bernstein coefficient."""
    out = np.empty(u.shape)
    _least(u, cells, out)
    return out


def _excess(u: np.ndarray, rates: Terrain, asked: np.ndarray) -> np.ndarray:
    """Return for each of the open cells ``asked`` [n, 3] the largest |grad u| relative to the
    allowed value there, else 0."""
    out = np.empty(len(asked))
    _steepness.of(u, rates.edges, rates.open_cells, rates.rate, rates.bends, rates.level, asked,
                  out, rates.floor)
    return out
