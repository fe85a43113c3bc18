"""The innermost kernels of the stiffness: 3 x 3 blocks of two nodes, LANES elements at a time.

Every number is a run of LANES numbers, one per element, and a function's arrays are flat runs at
distances known to the compiler. The compiler therefore sees that nothing overlaps, unrolls the
quadrature points and keeps all sums in vector registers. (Measured: with runs of 8, LLVM unrolls
instead of vectorising; sums that go through memory at each point take four times as long.)

A block's nine runs are its columns one after the other: 00 10 20 01 11 21 02 12 22.
"""

from collections.abc import Callable

from limber.core.numerics.compiled import compiled

LANES = 16
"""Elements per run."""

STRAIN_ROWS = 9
"""Runs per node and point for strain_pairs: F g times the weight's root, g, S g."""
STRAIN_TERMS = 6
"""Runs per point: weight times mu F F^T (00 11 22 01 02 12)."""
VOLUME_ROWS = 6
"""Runs per node and point for volume_pairs: cof(F) g times the weight's root, g."""
VOLUME_TERMS = 10
"""Runs per point: weight times pressure times F by rows, weight times mu."""


def _strain_pairs(points: int) -> Callable:
    @compiled
    def strain_pairs(one, two, terms, lam, mu, block):
        """Add the blocks of St. Venant-Kirchhoff elements, summed over a few points.

        With u = F g it is lambda u u'^T + mu u' u^T + mu (g g') F F^T + (g S g') 1.
        """
        for l in range(LANES):
            o00 = o11 = o22 = o01 = o10 = o02 = o20 = o12 = o21 = 0.0
            b00 = b11 = b22 = b01 = b02 = b12 = 0.0
            for q in range(points):
                k = q * STRAIN_ROWS * LANES + l
                u0, u1, u2 = one[k], one[k + LANES], one[k + 2 * LANES]
                v0, v1, v2 = two[k], two[k + LANES], two[k + 2 * LANES]
                o00 += u0 * v0
                o11 += u1 * v1
                o22 += u2 * v2
                o01 += u0 * v1
                o10 += u1 * v0
                o02 += u0 * v2
                o20 += u2 * v0
                o12 += u1 * v2
                o21 += u2 * v1
                h0, h1, h2 = two[k + 3 * LANES], two[k + 4 * LANES], two[k + 5 * LANES]
                dot = one[k + 3 * LANES] * h0 + one[k + 4 * LANES] * h1 + one[k + 5 * LANES] * h2
                own = one[k + 6 * LANES] * h0 + one[k + 7 * LANES] * h1 + one[k + 8 * LANES] * h2
                m = q * STRAIN_TERMS * LANES + l
                b00 += terms[m] * dot + own
                b11 += terms[m + LANES] * dot + own
                b22 += terms[m + 2 * LANES] * dot + own
                b01 += terms[m + 3 * LANES] * dot
                b02 += terms[m + 4 * LANES] * dot
                b12 += terms[m + 5 * LANES] * dot
            x, y = lam[l], mu[l]
            block[l] += (x + y) * o00 + b00
            block[LANES + l] += x * o10 + y * o01 + b01
            block[2 * LANES + l] += x * o20 + y * o02 + b02
            block[3 * LANES + l] += x * o01 + y * o10 + b01
            block[4 * LANES + l] += (x + y) * o11 + b11
            block[5 * LANES + l] += x * o21 + y * o12 + b12
            block[6 * LANES + l] += x * o02 + y * o20 + b02
            block[7 * LANES + l] += x * o12 + y * o21 + b12
            block[8 * LANES + l] += (x + y) * o22 + b22
    return strain_pairs


def _volume_pairs(points: int) -> Callable:
    @compiled
    def volume_pairs(one, two, terms, both, block):
        """Add the blocks of stable neo-Hookean elements, summed over a few points.

        With c = cof(F) g it is mu (g g') 1 + (lambda + mu) c c'^T + the skew matrix of pressure F
        (g' x g), from the change of the cofactor.
        """
        for l in range(LANES):
            n00 = n11 = n22 = n01 = n10 = n02 = n20 = n12 = n21 = 0.0
            t0 = t1 = t2 = own = 0.0
            for q in range(points):
                k = q * VOLUME_ROWS * LANES + l
                c0, c1, c2 = one[k], one[k + LANES], one[k + 2 * LANES]
                d0, d1, d2 = two[k], two[k + LANES], two[k + 2 * LANES]
                n00 += c0 * d0
                n11 += c1 * d1
                n22 += c2 * d2
                n01 += c0 * d1
                n10 += c1 * d0
                n02 += c0 * d2
                n20 += c2 * d0
                n12 += c1 * d2
                n21 += c2 * d1
                g0, g1, g2 = one[k + 3 * LANES], one[k + 4 * LANES], one[k + 5 * LANES]
                h0, h1, h2 = two[k + 3 * LANES], two[k + 4 * LANES], two[k + 5 * LANES]
                x, y, z = h1 * g2 - h2 * g1, h2 * g0 - h0 * g2, h0 * g1 - h1 * g0
                m = q * VOLUME_TERMS * LANES + l
                t0 += terms[m] * x + terms[m + LANES] * y + terms[m + 2 * LANES] * z
                t1 += terms[m + 3 * LANES] * x + terms[m + 4 * LANES] * y + terms[
                    m + 5 * LANES] * z
                t2 += terms[m + 6 * LANES] * x + terms[m + 7 * LANES] * y + terms[
                    m + 8 * LANES] * z
                own += terms[m + 9 * LANES] * (g0 * h0 + g1 * h1 + g2 * h2)
            x = both[l]
            block[l] += x * n00 + own
            block[LANES + l] += x * n10 + t2
            block[2 * LANES + l] += x * n20 - t1
            block[3 * LANES + l] += x * n01 - t2
            block[4 * LANES + l] += x * n11 + own
            block[5 * LANES + l] += x * n21 + t0
            block[6 * LANES + l] += x * n02 + t1
            block[7 * LANES + l] += x * n12 - t0
            block[8 * LANES + l] += x * n22 + own
    return volume_pairs


def _nodes_gradient(node_count: int) -> Callable:
    @compiled
    def nodes_gradient(values, gradients, out):
        """Write the gradient of a nodal field by rows; runs are node by node, then by axis."""
        for l in range(LANES):
            h00 = h01 = h02 = h10 = h11 = h12 = h20 = h21 = h22 = 0.0
            for a in range(node_count):
                k = 3 * a * LANES + l
                x, y, z = values[k], values[k + LANES], values[k + 2 * LANES]
                g0, g1, g2 = gradients[k], gradients[k + LANES], gradients[k + 2 * LANES]
                h00 += x * g0
                h01 += x * g1
                h02 += x * g2
                h10 += y * g0
                h11 += y * g1
                h12 += y * g2
                h20 += z * g0
                h21 += z * g1
                h22 += z * g2
            out[l] = h00
            out[LANES + l] = h01
            out[2 * LANES + l] = h02
            out[3 * LANES + l] = h10
            out[4 * LANES + l] = h11
            out[5 * LANES + l] = h12
            out[6 * LANES + l] = h20
            out[7 * LANES + l] = h21
            out[8 * LANES + l] = h22
    return nodes_gradient


strain_pairs_1, strain_pairs_2, strain_pairs_4 = (_strain_pairs(n) for n in (1, 2, 4))
volume_pairs_1, volume_pairs_2, volume_pairs_4 = (_volume_pairs(n) for n in (1, 2, 4))
linear_gradient, quadratic_gradient = _nodes_gradient(4), _nodes_gradient(10)


@compiled
def any_gradient(values, gradients, node_count, out):
    """As ``linear_gradient``, for elements with any number of nodes."""
    out[:9 * LANES] = 0.0
    for a in range(node_count):
        for i in range(3):
            for j in range(3):
                for l in range(LANES):
                    out[(3 * i + j) * LANES + l] += (
                        values[(3 * a + i) * LANES + l] * gradients[(3 * a + j) * LANES + l])


@compiled
def scatter_block(block, slots, lengths, is_diagonal, values):
    """Add the blocks of one pair of nodes to the lower triangle in compressed columns."""
    if is_diagonal:
        for l in range(LANES):
            at, length = slots[l], lengths[l]
            values[at] += block[l]
            values[at + 1] += block[LANES + l]
            values[at + 2] += block[2 * LANES + l]
            at += length
            values[at] += block[4 * LANES + l]
            values[at + 1] += block[5 * LANES + l]
            values[at + length - 1] += block[8 * LANES + l]
        return
    for l in range(LANES):
        at, length = slots[l], lengths[l]
        values[at] += block[l]
        values[at + 1] += block[LANES + l]
        values[at + 2] += block[2 * LANES + l]
        at += length - 1
        values[at] += block[3 * LANES + l]
        values[at + 1] += block[4 * LANES + l]
        values[at + 2] += block[5 * LANES + l]
        at += length - 2
        values[at] += block[6 * LANES + l]
        values[at + 1] += block[7 * LANES + l]
        values[at + 2] += block[8 * LANES + l]
