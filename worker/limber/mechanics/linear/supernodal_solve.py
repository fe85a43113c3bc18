"""Forward and backward substitution with a supernodal factor."""

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.mechanics.linear.fronts import PAD


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
