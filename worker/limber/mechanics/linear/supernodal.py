"""Supernodal Cholesky factor of a branch, by fronts.

The fronts of a slender branch are small, so a general library spends most of its time on overhead
(CHOLMOD through cvxopt: a third on transposing the matrix, a quarter in BLAS). Here the values are
scattered directly to their positions, and all loops run over rows in whole vectors.
"""

import copy
from collections.abc import Callable

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.mechanics.linear.fronts import PAD, Fronts

# Forward and backward substitution with a supernodal factor.


@compiled
def _sizes(first, row_start, s):
    """Return a front's first unknown, pivots, padded pivots, rows below, padded rows, height."""
    width, below = 3 * (first[s + 1] - first[s]), row_start[s + 1] - row_start[s]
    pivots = (width + PAD - 1) // PAD * PAD
    padded = (3 * below + PAD - 1) // PAD * PAD
    return 3 * first[s], width, pivots, below, padded, pivots + padded


@compiled
def _room(row_start):
    """Zeros for the rows below the tallest front."""
    tallest = 0
    for s in range(len(row_start) - 1):
        tallest = max(tallest, row_start[s + 1] - row_start[s])
    return np.zeros(3 * tallest + PAD)


@compiled
def _columns(factor, at, height):
    """Three columns of a front."""
    return (factor[at:at + height], factor[at + height:at + 2 * height],
            factor[at + 2 * height:at + 3 * height])


@compiled
def solve_down_one(first, row_start, rows, panel, factor, inverse, x):
    """Solve in place with the factor: down through the fronts."""
    t = _room(row_start)
    for s in range(len(first) - 1):
        start, width, pivots, below, padded, height = _sizes(first, row_start, s)
        own = x[start:start + width]
        if not own.any():
            continue  # forces act on a patch: most fronts receive nothing
        t[:padded] = 0.0
        for j in range(0, width, 3):
            one, two, three = _columns(factor, panel[s] + j * height, height)
            x0, x1, x2 = _down(x, start + j, one, two, j, inverse)
            for i in range(j + 3, width):
                own[i] -= one[i] * x0 + two[i] * x1 + three[i] * x2
            one, two, three = one[pivots:], two[pivots:], three[pivots:]
            for i in range(padded):
                t[i] += one[i] * x0 + two[i] * x1 + three[i] * x2
        for k in range(below):
            to = 3 * rows[row_start[s] + k]
            for axis in range(3):
                x[to + axis] -= t[3 * k + axis]


@compiled
def solve_up_one(first, row_start, rows, panel, factor, inverse, x):
    """Solve in place with its transpose: up through the fronts."""
    t = _room(row_start)
    for s in range(len(first) - 2, -1, -1):
        start, width, pivots, below, padded, height = _sizes(first, row_start, s)
        t[:padded] = 0.0
        for k in range(below):
            to = 3 * rows[row_start[s] + k]
            for axis in range(3):
                t[3 * k + axis] = x[to + axis]
        own = x[start:start + width]
        for j in range(width - 3, -1, -3):
            one, two, three = _columns(factor, panel[s] + j * height, height)
            s0, s1, s2 = own[j], own[j + 1], own[j + 2]
            for i in range(j + 3, width):
                s0 -= one[i] * own[i]
                s1 -= two[i] * own[i]
                s2 -= three[i] * own[i]
            low, middle, high = one[pivots:], two[pivots:], three[pivots:]
            for i in range(padded):
                s0 -= low[i] * t[i]
                s1 -= middle[i] * t[i]
                s2 -= high[i] * t[i]
            _up(own, j, s0, s1, s2, one, two, inverse, start)


@compiled
def solve_down_three(first, row_start, rows, panel, factor, inverse, x, y, z):
    """As ``solve_down_one``, for three right sides at once."""
    t, u, v = _room(row_start), _room(row_start), _room(row_start)
    for s in range(len(first) - 1):
        start, width, pivots, below, padded, height = _sizes(first, row_start, s)
        own, other, last = (x[start:start + width], y[start:start + width],
                            z[start:start + width])
        if not (own.any() or other.any() or last.any()):
            continue  # forces act on a patch: most fronts receive nothing
        t[:padded] = 0.0
        u[:padded] = 0.0
        v[:padded] = 0.0
        for j in range(0, width, 3):
            one, two, three = _columns(factor, panel[s] + j * height, height)
            x0, x1, x2 = _down(x, start + j, one, two, j, inverse)
            y0, y1, y2 = _down(y, start + j, one, two, j, inverse)
            z0, z1, z2 = _down(z, start + j, one, two, j, inverse)
            for i in range(j + 3, width):
                a, b, c = one[i], two[i], three[i]
                own[i] -= a * x0 + b * x1 + c * x2
                other[i] -= a * y0 + b * y1 + c * y2
                last[i] -= a * z0 + b * z1 + c * z2
            one, two, three = one[pivots:], two[pivots:], three[pivots:]
            for i in range(padded):
                a, b, c = one[i], two[i], three[i]
                t[i] += a * x0 + b * x1 + c * x2
                u[i] += a * y0 + b * y1 + c * y2
                v[i] += a * z0 + b * z1 + c * z2
        for k in range(below):
            to = 3 * rows[row_start[s] + k]
            for axis in range(3):
                x[to + axis] -= t[3 * k + axis]
                y[to + axis] -= u[3 * k + axis]
                z[to + axis] -= v[3 * k + axis]


@compiled
def solve_up_three(first, row_start, rows, panel, factor, inverse, x, y, z):
    """As ``solve_up_one``, for three at once."""
    t, u, v = _room(row_start), _room(row_start), _room(row_start)
    for s in range(len(first) - 2, -1, -1):
        start, width, pivots, below, padded, height = _sizes(first, row_start, s)
        t[:padded] = 0.0
        u[:padded] = 0.0
        v[:padded] = 0.0
        for k in range(below):
            to = 3 * rows[row_start[s] + k]
            for axis in range(3):
                t[3 * k + axis] = x[to + axis]
                u[3 * k + axis] = y[to + axis]
                v[3 * k + axis] = z[to + axis]
        own, other, last = (x[start:start + width], y[start:start + width],
                            z[start:start + width])
        for j in range(width - 3, -1, -3):
            one, two, three = _columns(factor, panel[s] + j * height, height)
            x0, x1, x2 = own[j], own[j + 1], own[j + 2]
            y0, y1, y2 = other[j], other[j + 1], other[j + 2]
            z0, z1, z2 = last[j], last[j + 1], last[j + 2]
            for i in range(j + 3, width):
                a, b, c = one[i], two[i], three[i]
                x0 -= a * own[i]
                x1 -= b * own[i]
                x2 -= c * own[i]
                y0 -= a * other[i]
                y1 -= b * other[i]
                y2 -= c * other[i]
                z0 -= a * last[i]
                z1 -= b * last[i]
                z2 -= c * last[i]
            low, middle, high = one[pivots:], two[pivots:], three[pivots:]
            for i in range(padded):
                a, b, c = low[i], middle[i], high[i]
                x0 -= a * t[i]
                x1 -= b * t[i]
                x2 -= c * t[i]
                y0 -= a * u[i]
                y1 -= b * u[i]
                y2 -= c * u[i]
                z0 -= a * v[i]
                z1 -= b * v[i]
                z2 -= c * v[i]
            _up(own, j, x0, x1, x2, one, two, inverse, start)
            _up(other, j, y0, y1, y2, one, two, inverse, start)
            _up(last, j, z0, z1, z2, one, two, inverse, start)


@compiled
def _down(x, at, one, two, j, inverse):
    """Solve for a node's three unknowns on the way down, in place."""
    x0 = x[at] * inverse[at]
    x1 = (x[at + 1] - one[j + 1] * x0) * inverse[at + 1]
    x2 = (x[at + 2] - one[j + 2] * x0 - two[j + 2] * x1) * inverse[at + 2]
    x[at], x[at + 1], x[at + 2] = x0, x1, x2
    return x0, x1, x2


@compiled
def _up(own, j, s0, s1, s2, one, two, inverse, start):
    """Solve for a node's three unknowns on the way up, in place."""
    x2 = s2 * inverse[start + j + 2]
    x1 = (s1 - two[j + 2] * x2) * inverse[start + j + 1]
    x0 = (s0 - one[j + 1] * x1 - one[j + 2] * x2) * inverse[start + j]
    own[j], own[j + 1], own[j + 2] = x0, x1, x2


_COUNT = np.uint64
"""Type of the indices of inner loops: numba checks whether a signed index counts from the end."""


class SupernodalFactor:
    """Factor of a matrix with a fixed pattern."""

    def __init__(self, fronts: Fronts):
        self._fronts = fronts
        self._factor = np.zeros(fronts.panel[-1])
        self._inverse = np.zeros(3 * int(fronts.first[-1]))
        self._even, self._odd = (np.zeros(int(size)) for size in fronts.work_size)

    def twin(self) -> "SupernodalFactor":
        """Return a factor of the same pattern with memory of its own."""
        other = copy.copy(self)
        other._factor, other._inverse = np.zeros_like(self._factor), np.zeros_like(self._inverse)
        return other

    def factorise(self, values: np.ndarray) -> None:
        """Factorise the matrix with these ``values``, lower triangle by columns.
        NotPositiveDefiniteError if it is not positive definite."""
        f = self._fronts
        if not _factorise(values, f.value_start, f.targets, f.first, f.row_start, f.panel,
                          f.row_positions, f.children, f.child_start, f.work, f.depth, self._even,
                          self._odd, self._factor, self._inverse):
            raise NotPositiveDefiniteError("a pivot is not positive")

    def solve(self, right: np.ndarray) -> np.ndarray:
        """Return the solution for right sides [size] or [size, k]. Three take the time of one,
        which goes into reading the factor; if they are mostly 0, four fifths of that."""
        return self.up(self.down(right))

    def down(self, right: np.ndarray) -> np.ndarray:
        """Return the first half of a solution (forward substitution), of the same shape. If the
        right sides are mostly 0, this takes almost no time."""
        return self._halved(right, solve_down_one, solve_down_three)

    def up(self, half: np.ndarray) -> np.ndarray:
        """Return the other half: the solution with the factor's transpose, of the same shape."""
        return self._halved(half, solve_up_one, solve_up_three)

    def _halved(self, right: np.ndarray, one: Callable, three: Callable) -> np.ndarray:
        if not right.any():
            return np.zeros_like(right)
        f = self._fronts
        solution = np.array(right.reshape(len(right), -1).T, order="C")
        together = len(solution) // 3 * 3
        for column in range(0, together, 3):
            three(f.first, f.row_start, f.rows, f.panel, self._factor, self._inverse,
                  *solution[column:column + 3])
        for column in solution[together:]:
            one(f.first, f.row_start, f.rows, f.panel, self._factor, self._inverse, column)
        return np.ascontiguousarray(solution.T).reshape(right.shape)


@compiled
def _factorise(values, value_start, targets, first, row_start, panel, row_positions, children,
               child_start, work, depth, even, odd, factor, inverse):
    for s in range(len(first) - 1):
        width = 3 * (first[s + 1] - first[s])
        below = 3 * (row_start[s + 1] - row_start[s])
        pivots = (width + PAD - 1) // PAD * PAD
        padded = (below + PAD - 1) // PAD * PAD
        columns = factor[panel[s]:panel[s + 1]]
        columns[:] = 0.0
        for p in range(value_start[s], value_start[s + 1]):
            columns[targets[p]] = values[p]
        own, theirs = (even, odd) if depth[s] == 0 else (odd, even)
        update = own[work[s]:work[s] + padded * below]
        update[:] = 0.0
        for k in range(child_start[s], child_start[s + 1]):
            child = children[k]
            begin, end = row_start[child], row_start[child + 1]
            size = 3 * (end - begin)
            size = (size + PAD - 1) // PAD * PAD
            _extend(theirs[work[child]:work[child] + size * 3 * (end - begin)], size,
                    row_positions[begin:end], width, pivots, padded, columns, update)
        if not _eliminate(columns, width, pivots + padded, inverse[3 * first[s]:]):
            return False
        for j in range(0, below, 3):
            begin = j // PAD * PAD
            _subtract(columns, width, pivots + padded, pivots + j, pivots + begin,
                      (padded - begin) // PAD, update, padded, j * padded + begin)
    return True


@compiled
def _extend(source, size, rows, width, pivots, padded, columns, update):
    """Add a child's update matrix to the front."""
    three, height = _COUNT(3), _COUNT(pivots + padded)
    nodes, count = _COUNT(width) // three, _COUNT(len(rows))
    size, gap, padded = _COUNT(size), _COUNT(pivots) - three * nodes, _COUNT(padded)
    inner = _COUNT(0)
    while inner < count and rows[inner] < nodes:
        inner += _COUNT(1)
    for kj in range(count):
        row = _COUNT(rows[kj])
        for jj in range(three):
            at = (three * kj + jj) * size
            if kj < inner:
                base = (three * row + jj) * height
                _add_rows(source, at, rows, kj, inner, columns, base)
                _add_rows(source, at, rows, inner, count, columns, base + gap)
            else:
                # Rows of the update matrix are counted from its first row.
                base = (three * (row - nodes) + jj) * padded - three * nodes
                _add_rows(source, at, rows, kj, count, update, base)


@compiled
def _add_rows(source, at, rows, begin, end, target, base):
    for k in range(begin, end):
        to, of = base + _COUNT(3) * _COUNT(rows[k]), at + _COUNT(3) * k
        target[to] += source[of]
        target[to + _COUNT(1)] += source[of + _COUNT(1)]
        target[to + _COUNT(2)] += source[of + _COUNT(2)]


@compiled
def _eliminate(columns, width, height, inverse):
    """Factorise a front's columns, three at a time; return False if a pivot is not positive."""
    for j in range(0, width, 3):
        begin = j // PAD * PAD
        runs = (height - begin) // PAD
        _subtract(columns, j, height, j, begin, runs, columns, height, j * height + begin)
        at = j * height + j
        d0 = columns[at]
        if not d0 > 0.0:
            return False
        l00 = np.sqrt(d0)
        l10, l20 = columns[at + 1] / l00, columns[at + 2] / l00
        d1 = columns[at + height + 1] - l10 * l10
        if not d1 > 0.0:
            return False
        l11 = np.sqrt(d1)
        l21 = (columns[at + height + 2] - l20 * l10) / l11
        d2 = columns[at + 2 * height + 2] - l20 * l20 - l21 * l21
        if not d2 > 0.0:
            return False
        l22 = np.sqrt(d2)
        i0, i1, i2 = 1.0 / l00, 1.0 / l11, 1.0 / l22
        inverse[j], inverse[j + 1], inverse[j + 2] = i0, i1, i2
        one = columns[j * height + begin:(j + 1) * height]
        two = columns[(j + 1) * height + begin:(j + 2) * height]
        three = columns[(j + 2) * height + begin:(j + 3) * height]
        for i in range(PAD * runs):
            x = one[i] * i0
            y = (two[i] - l10 * x) * i1
            one[i] = x
            two[i] = y
            three[i] = (three[i] - l20 * x - l21 * y) * i2
        columns[at], columns[at + 1], columns[at + 2] = l00, l10, l20
        columns[at + height + 1], columns[at + height + 2] = l11, l21
        columns[at + 2 * height + 2] = l22
    return True


@compiled
def _subtract(columns, width, height, row, begin, runs, target, stride, at):
    """Subtract the contribution of the first ``width`` columns from three of ``target``. ``row``
    belongs to the first of the three, ``begin`` to the target's start; ``runs`` are rows / PAD."""
    h, r, z, n = _COUNT(height), _COUNT(row), _COUNT(begin), _COUNT(runs)
    t0 = _COUNT(at)
    t1 = t0 + _COUNT(stride)
    t2 = t1 + _COUNT(stride)
    k, end = _COUNT(0), _COUNT(width) * h
    while k + _COUNT(6) * h <= end:
        _subtract_six(columns, k, h, r, z, n, target, t0, t1, t2)
        k += _COUNT(6) * h
    if k < end:
        _subtract_three(columns, k, h, r, z, n, target, t0, t1, t2)


@compiled
def _subtract_three(columns, a, height, row, begin, runs, target, t0, t1, t2):
    one, two = _COUNT(1), _COUNT(2)
    b, c = a + height, a + two * height
    a0, a1, a2 = columns[a + row], columns[a + row + one], columns[a + row + two]
    b0, b1, b2 = columns[b + row], columns[b + row + one], columns[b + row + two]
    c0, c1, c2 = columns[c + row], columns[c + row + one], columns[c + row + two]
    a, b, c = a + begin, b + begin, c + begin
    for i in range(_COUNT(PAD) * runs):
        u, v, w = columns[a + i], columns[b + i], columns[c + i]
        target[t0 + i] -= a0 * u + b0 * v + c0 * w
        target[t1 + i] -= a1 * u + b1 * v + c1 * w
        target[t2 + i] -= a2 * u + b2 * v + c2 * w


@compiled
def _subtract_six(columns, a, height, row, begin, runs, target, t0, t1, t2):
    one, two = _COUNT(1), _COUNT(2)
    b, c = a + height, a + two * height
    d, e, f = c + height, c + two * height, c + _COUNT(3) * height
    a0, a1, a2 = columns[a + row], columns[a + row + one], columns[a + row + two]
    b0, b1, b2 = columns[b + row], columns[b + row + one], columns[b + row + two]
    c0, c1, c2 = columns[c + row], columns[c + row + one], columns[c + row + two]
    d0, d1, d2 = columns[d + row], columns[d + row + one], columns[d + row + two]
    e0, e1, e2 = columns[e + row], columns[e + row + one], columns[e + row + two]
    f0, f1, f2 = columns[f + row], columns[f + row + one], columns[f + row + two]
    a, b, c, d, e, f = a + begin, b + begin, c + begin, d + begin, e + begin, f + begin
    for i in range(_COUNT(PAD) * runs):
        u, v, w = columns[a + i], columns[b + i], columns[c + i]
        x, y, z = columns[d + i], columns[e + i], columns[f + i]
        target[t0 + i] -= a0 * u + b0 * v + c0 * w + d0 * x + e0 * y + f0 * z
        target[t1 + i] -= a1 * u + b1 * v + c1 * w + d1 * x + e1 * y + f1 * z
        target[t2 + i] -= a2 * u + b2 * v + c2 * w + d2 * x + e2 * y + f2 * z
