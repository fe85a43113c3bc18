"""A function on a grid that no path can beat: the proof of a lower bound.

A path's cost is the integral of c over its length. If |grad u| <= c wherever the path runs, its
cost is at least u(start) - u(end): integrate grad u along it. So any u that keeps the inequality
proves a bound; how u was found does not matter.

Here u is a quadratic B-spline (its gradient is continuous, so that the loss is of second order in
the edge h of a cell; with trilinear u it was of first order, 8 % instead of 2 % on one grid), one
coefficient a cell. In a cell

- each component of grad u is a polynomial in Bernstein form of degree 2 along each axis. At any
  point grad u is a mean of the 27 Bernstein coefficients with the basis as weights, so |grad u| is
  at most the same mean of their magnitudes;
- c is at least the trilinear interpolation of its values at the corners, less
  ``sum_i M_i x_i (h - x_i) / 2`` with ``M_i`` the most that d^2 c / dx_i^2 is there. The Bernstein
  coefficients of the one are its values at the 27 points, those of the other ``M_i h^2 / 4`` where
  the point lies half-way along axis i, else 0.

So |g_m| at most the difference of the two at the 27 points of an open cell is enough; or at most
the first less all that the second ever is, ``sum_i M_i h^2 / 8``; or at most the least that c is
anywhere, the cost of length alone. (With the squares of both the slope of c would count as well:
four times as much about a narrow valley.) The second derivatives are the one thing that is not
proven: they are taken as at most the largest second difference of c at the cell's corners and the
next ones along the axis, and as much more as these differ; or as ``CURVATURE_FACTOR`` times the
largest size of those at its corners, if that is less; never as less than 0. Where c has a kink
inside a cell (the energy is cut off at zero) the cost of length counts.
"""

from typing import NamedTuple

import numpy as np
from scipy.ndimage import binary_dilation, maximum_filter

from limber.compiled import compiled
from limber.planning.bound.marching import march

CURVATURE_FACTOR = 2.0
"""What second differences at a cell's corners are multiplied by to bound derivatives inside."""

RIM = 2
"""Closed cells about the open ones that have coefficients as well."""

_ROUNDS = 8  # of local reweighting; stops before when nothing is over by more than _CLOSE
_CLOSE = 1.0005
_NEAR = np.ones((3, 3, 3))


class Terrain(NamedTuple):
    """A grid of cells, which of them are open, and what a metre costs there.

    Attributes:
        spacing: Edge of a cell [m].
        open_cells: Cells that a path may enter, bool [nx, ny, nz]; none at the grid's border.
        rate: c at the corners [1/m], shape [nx + 1, ny + 1, nz + 1].
        bends: What is subtracted from it half-way along each axis, [3, *shape of open_cells].
        level: Cells where the floor alone counts, shape of ``open_cells``.
        floor: What c never falls below [1/m].
    """

    spacing: float
    open_cells: np.ndarray
    rate: np.ndarray
    bends: np.ndarray
    level: np.ndarray
    floor: float

    @property
    def active(self) -> np.ndarray:
        """Cells that have coefficients: open cells and those about them, ``RIM`` deep.

        Open cells need those of their neighbours. The others let a cost arrive along a slanting
        border as if there were none: about each of its steps it would bend, and be too steep.
        """
        return binary_dilation(self.open_cells, _NEAR, iterations=RIM)


def terrain(rate: np.ndarray, positive: np.ndarray, open_cells: np.ndarray, spacing: float,
            floor: float) -> Terrain:
    """Return the terrain of ``rate`` at the corners, nowhere below ``floor`` [1/m].

    ``positive`` says at which corners the energy is not cut off; corners that were not evaluated
    hold nan in ``rate`` and are no neighbours of an open cell's.
    """
    bends = _bends(rate, open_cells)
    above = corner_values(positive.astype(float))
    level = (above.min(axis=0) < 0.5) & (above.max(axis=0) > 0.5)
    return Terrain(spacing, open_cells, np.nan_to_num(rate, nan=floor), bends, level, floor)


@compiled
def _bends(values, cells):
    """Return ``M_i h^2 / 4`` of the module's text in ``cells``, shape [3, *shape of cells].

    ``values`` at the corners; a second difference with one that is not known (nan) counts as 0.
    """
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
                                place = i if axis == 0 else (j if axis == 1 else k)
                                if place <= at[axis] <= place + 1:
                                    size = max(size, abs(second))
                    bend = min(2.0 * most - least, CURVATURE_FACTOR * size)
                    out[axis, i, j, k] = 0.25 * max(bend, 0.0)
    return out


def curvature_allowance(values: np.ndarray) -> np.ndarray:
    """Return how far a smooth function may leave its trilinear interpolation in each cell.

    ``values`` at the corners, nan where not known; the result has one less along each axis:
    ``CURVATURE_FACTOR / 8`` times the sum over axes of the largest second difference.
    """
    return CURVATURE_FACTOR / 8.0 * sum(
        corner_values(difference).max(axis=0) for difference in second_differences(values))


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


def subsolution(ground: Terrain, known: np.ndarray, shape: np.ndarray, free_cells: np.ndarray,
                rounds: int = _ROUNDS) -> tuple[np.ndarray, float]:
    """Return coefficients of a ``u`` with |grad u| <= c in every open cell, and a factor.

    Args:
        ground: The terrain.
        known: Cells on and about the source, bool [nx, ny, nz].
        shape: A length [m] there that grows by about a metre a metre: a signed distance.
        free_cells: Cells where nothing is asked: those wholly inside the source.
        rounds: Of local reweighting; fewer give a lower ``u``, never a wrong one.

    The coefficients are ``factor * shape`` on ``known``; infinite where nothing leads from there.
    """
    active = ground.active
    bound = np.ascontiguousarray(corner_values(ground.rate).mean(axis=0))
    asked = ground.open_cells & ~free_cells
    held = known & active
    if not held.any():
        return np.full(active.shape, np.inf), 0.0
    steep = float(_excess(np.where(held, shape, np.inf), *ground, ground.open_cells).max())
    factor = 1.0 / steep if steep > 0.0 else float(bound[held].min())
    rate = bound.copy()
    u, used = bound, factor
    about = held
    for _ in range(rounds):
        used = factor
        u = march(rate, active, held, used * shape, ground.spacing)
        over = np.maximum(_excess(u, *ground, asked), 1.0)
        if over.max() <= _CLOSE:
            break
        factor /= float(over[about].max())
        about = binary_dilation(held, _NEAR)
        # The largest of the neighbours: reweighting cell by cell stirs up a chequerboard.
        over[held] = 1.0
        rate /= maximum_filter(over, 3)
    worst = max(float(_excess(u, *ground, asked).max()), 1.0)
    # The rescaling is what makes it a proof; the rounds before only keep it small.
    return u / worst, used / worst


def spline_value(u: np.ndarray, cell: np.ndarray) -> float:
    """Return the spline at the centre of ``cell`` [3] from its coefficients ``u``."""
    weights = np.array([0.125, 0.75, 0.125])
    block = u[tuple(slice(k - 1, k + 2) for k in cell)]
    return float(np.einsum("ijk,i,j,k", block, weights, weights, weights))


@compiled
def least_in_cells(u, cells):
    """Return a lower bound of the spline in each of ``cells``: its least Bernstein coefficient."""
    out = np.full(u.shape, np.inf)
    block, work = np.empty((3, 3, 3)), np.empty((3, 3, 3))
    for i in range(1, u.shape[0] - 1):
        for j in range(1, u.shape[1] - 1):
            for k in range(1, u.shape[2] - 1):
                if cells[i, j, k]:
                    block[:] = u[i - 1:i + 2, j - 1:j + 2, k - 1:k + 2]
                    for axis in range(3):
                        _bernstein(block, work, axis, False)
                        block[:] = work
                    out[i, j, k] = block.min()
    return out


@compiled
def _bernstein(source, out, axis, slope):
    """Write Bernstein coefficients along ``axis`` of the spline, or of its slope, from 3 of it."""
    for p in range(3):
        for q in range(3):
            if axis == 0:
                a, b, c = source[0, p, q], source[1, p, q], source[2, p, q]
            elif axis == 1:
                a, b, c = source[p, 0, q], source[p, 1, q], source[p, 2, q]
            else:
                a, b, c = source[p, q, 0], source[p, q, 1], source[p, q, 2]
            if slope:
                first, second, third = b - a, 0.5 * (c - a), c - b
            else:
                first, second, third = 0.5 * (a + b), b, 0.5 * (b + c)
            if axis == 0:
                out[0, p, q], out[1, p, q], out[2, p, q] = first, second, third
            elif axis == 1:
                out[p, 0, q], out[p, 1, q], out[p, 2, q] = first, second, third
            else:
                out[p, q, 0], out[p, q, 1], out[p, q, 2] = first, second, third


@compiled
def _excess(u, spacing, open_cells, rate, bends, level, floor, asked):
    """Return for each asked cell the largest |grad u| over what is allowed there, else 0."""
    over = np.zeros(u.shape)
    block, one, two = np.empty((3, 3, 3)), np.empty((3, 3, 3)), np.empty((3, 3, 3))
    size = np.empty((3, 3, 3))
    for i in range(1, u.shape[0] - 1):
        for j in range(1, u.shape[1] - 1):
            for k in range(1, u.shape[2] - 1):
                if not (asked[i, j, k] and open_cells[i, j, k]):
                    continue
                block[:] = u[i - 1:i + 2, j - 1:j + 2, k - 1:k + 2]
                if not block.max() < np.inf:
                    continue
                size[:] = 0.0
                for component in range(3):
                    _bernstein(block, one, 0, component == 0)
                    _bernstein(one, two, 1, component == 1)
                    _bernstein(two, one, 2, component == 2)
                    size += one * one
                worst, uneven, even = 0.0, 0.0, 0.0
                whole = 0.5 * bends[:, i, j, k].sum()
                for p in range(3):
                    for q in range(3):
                        for r in range(3):
                            steep = np.sqrt(size[p, q, r]) / spacing
                            worst = max(worst, steep / floor)
                            if level[i, j, k]:
                                continue
                            allowed = _between(rate, i, j, k, p, q, r)
                            even = max(even, _over(steep, allowed - whole))
                            if p == 1:
                                allowed -= bends[0, i, j, k]
                            if q == 1:
                                allowed -= bends[1, i, j, k]
                            if r == 1:
                                allowed -= bends[2, i, j, k]
                            uneven = max(uneven, _over(steep, allowed))
                over[i, j, k] = worst if level[i, j, k] else min(worst, even, uneven)
    return over


@compiled
def _over(steep, allowed):
    return steep / allowed if allowed > 0.0 else np.inf


@compiled
def _between(values, i, j, k, p, q, r):
    """Return the trilinear interpolation at ``(p, q, r) / 2`` in the cell ``(i, j, k)``."""
    total = 0.0
    for a in range(2):
        for b in range(2):
            for c in range(2):
                weight = 0.125 * (2 - p if a == 0 else p) * (2 - q if b == 0 else q) * (
                    2 - r if c == 0 else r)
                if weight > 0.0:
                    total += weight * values[i + a, j + b, k + c]
    return total
