"""The kernel that computes the tangent stiffness and scatters it into the factor's pattern.

Elements are processed LANES at a time (:mod:`limber.mechanics.elements.stiffness`). The
layout comes from :mod:`limber.mechanics.linear.equations`; the element is the last axis.

``slots`` gives, for each pair of an element's nodes, the start of the pair's block in the values of
the lower triangle in compressed columns; the block's other two columns follow at distances that the
column's length gives. An element's nodes are sorted by elimination order, so every pair's block is
in the lower triangle without transposing. Pairs with a constrained node point behind the end of the
values.
"""

from collections.abc import Callable

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.mechanics.materials.laws import NEO_HOOKE, SMALL_STRAIN

# The innermost kernels of the stiffness: 3 x 3 blocks of two nodes, LANES elements at a time.
#
# Every number is a run of LANES numbers, one per element, and a function's arrays are flat runs at
# distances known to the compiler. The compiler therefore sees that nothing overlaps, unrolls the
# quadrature points and keeps all sums in vector registers. (Measured: with runs of 8, LLVM unrolls
# instead of vectorising; sums that go through memory at each point take four times as long.)
#
# A block's nine runs are its columns one after the other: 00 10 20 01 11 21 02 12 22.

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
        """Add the blocks of St. Venant-Kirchhoff elements, summed over a few points. With u = F g
        it is lambda u u'^T + mu u' u^T + mu (g g') F F^T + (g S g') 1."""
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
        """Add the blocks of stable neo-Hookean elements. With c = cof(F) g it is mu (g g') 1 +
        (lambda + mu) c c'^T + the skew matrix of pressure F (g' x g), from the cofactor."""
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


@compiled
def tangent_stiffness(displacement, increment, gradients, weights, lame_lambda, lame_mu, nodes,
                      material, growth, memory, slots, lengths, values):
    """Add all elements' tangent stiffness [N/m] to ``values``. With an ``increment`` (St.
    Venant-Kirchhoff; without rows: Newton) the stress is that at the strain less dH^T dH / 2, as
    the last linearisation predicted (mixed points, Magisano, Leonetti and Garcea 2017)."""
    batch_count, point_count = weights.shape[0], weights.shape[1]
    node_count = nodes.shape[1]
    flat = gradients.reshape(batch_count, point_count, 3 * node_count * LANES)
    local = np.empty(3 * node_count * LANES)
    rate = np.empty(3 * node_count * LANES)
    strain_rows = np.empty((node_count, point_count * STRAIN_ROWS * LANES))
    volume_rows = np.empty((node_count, point_count * VOLUME_ROWS * LANES))
    strain_terms = np.empty(point_count * STRAIN_TERMS * LANES)
    volume_terms = np.empty(point_count * VOLUME_TERMS * LANES)
    F, D = np.empty(9 * LANES), np.empty(9 * LANES)
    E, C = np.empty(6 * LANES), np.empty(9 * LANES)
    root, lam, mu, both = np.empty(LANES), np.empty(LANES), np.empty(LANES), np.empty(LANES)
    block = np.empty(9 * LANES)
    mixed = material != SMALL_STRAIN and increment.shape[0] > 0
    has_memory = memory.shape[0] > 0 and material != SMALL_STRAIN
    factor = growth - 1.0 if material == NEO_HOOKE else growth
    has_strain = material != NEO_HOOKE or memory.shape[0] > 0
    for batch in range(batch_count):
        gather(displacement, nodes[batch], local)
        if mixed:
            gather(increment, nodes[batch], rate)
        for l in range(LANES):
            lam[l], mu[l] = factor * lame_lambda[batch, l], factor * lame_mu[batch, l]
            both[l] = lame_lambda[batch, l] + lame_mu[batch, l]
        for q in range(point_count):
            if material == SMALL_STRAIN:
                F[:] = 0.0
                for l in range(LANES):
                    F[l] = F[4 * LANES + l] = F[8 * LANES + l] = 1.0
            else:
                deformation(local, flat[batch, q], node_count, F)
            for l in range(LANES):
                root[l] = np.sqrt(weights[batch, q, l])
            if has_strain:
                green_strain(F, E)
                if mixed:
                    gradient(rate, flat[batch, q], node_count, D)
                    _subtract_half_square(D, E)
                for k in range(6 * LANES):
                    E[k] *= factor
                if has_memory:
                    for k in range(6):
                        for l in range(LANES):
                            E[k * LANES + l] += memory[batch, q, k, l]
                _stress(lame_lambda[batch], lame_mu[batch], weights[batch, q], E)
                _strain_terms(F, mu, weights[batch, q], strain_terms[q * STRAIN_TERMS * LANES:])
                for a in range(node_count):
                    _strain_rows(F, E, root, flat[batch, q, 3 * a * LANES:],
                                 strain_rows[a, q * STRAIN_ROWS * LANES:])
            if material == NEO_HOOKE:
                _volume_terms(F, lame_mu[batch], both, weights[batch, q], C,
                              volume_terms[q * VOLUME_TERMS * LANES:])
                for a in range(node_count):
                    _volume_rows(C, root, flat[batch, q, 3 * a * LANES:],
                                 volume_rows[a, q * VOLUME_ROWS * LANES:])
        pair = 0
        for a in range(node_count):
            for b in range(a + 1):
                block[:] = 0.0
                if has_strain:
                    _add_strain_pairs(strain_rows[a], strain_rows[b], strain_terms, lam, mu,
                                      point_count, block)
                if material == NEO_HOOKE:
                    _add_volume_pairs(volume_rows[a], volume_rows[b], volume_terms, both,
                                      point_count, block)
                scatter_block(block, slots[batch, pair], lengths[batch, pair], a == b, values)
                pair += 1


@compiled
def gather(field, nodes, out):
    """Write a nodal field, less its value at each element's first node."""
    for a in range(nodes.shape[0]):
        for l in range(LANES):
            node, first = nodes[a, l], nodes[0, l]
            for i in range(3):
                out[(3 * a + i) * LANES + l] = field[node, i] - field[first, i]


@compiled
def gradient(values, gradients, node_count, out):
    """Write the gradient of a nodal field, by rows."""
    if node_count == 10:
        quadratic_gradient(values, gradients, out)
    elif node_count == 4:
        linear_gradient(values, gradients, out)
    else:
        any_gradient(values, gradients, node_count, out)


@compiled
def deformation(values, gradients, node_count, F):
    """Write the deformation gradient of a nodal displacement, by rows."""
    gradient(values, gradients, node_count, F)
    for l in range(LANES):
        F[l] += 1.0
        F[4 * LANES + l] += 1.0
        F[8 * LANES + l] += 1.0


@compiled
def green_strain(F, E):
    """Write the Green-Lagrange strain: 00 11 22 01 02 12."""
    for l in range(LANES):
        f00, f01, f02 = F[l], F[LANES + l], F[2 * LANES + l]
        f10, f11, f12 = F[3 * LANES + l], F[4 * LANES + l], F[5 * LANES + l]
        f20, f21, f22 = F[6 * LANES + l], F[7 * LANES + l], F[8 * LANES + l]
        E[l] = 0.5 * (f00 * f00 + f10 * f10 + f20 * f20 - 1.0)
        E[LANES + l] = 0.5 * (f01 * f01 + f11 * f11 + f21 * f21 - 1.0)
        E[2 * LANES + l] = 0.5 * (f02 * f02 + f12 * f12 + f22 * f22 - 1.0)
        E[3 * LANES + l] = 0.5 * (f00 * f01 + f10 * f11 + f20 * f21)
        E[4 * LANES + l] = 0.5 * (f00 * f02 + f10 * f12 + f20 * f22)
        E[5 * LANES + l] = 0.5 * (f01 * f02 + f11 * f12 + f21 * f22)


@compiled
def _subtract_half_square(D, E):
    for l in range(LANES):
        d00, d01, d02 = D[l], D[LANES + l], D[2 * LANES + l]
        d10, d11, d12 = D[3 * LANES + l], D[4 * LANES + l], D[5 * LANES + l]
        d20, d21, d22 = D[6 * LANES + l], D[7 * LANES + l], D[8 * LANES + l]
        E[l] -= 0.5 * (d00 * d00 + d10 * d10 + d20 * d20)
        E[LANES + l] -= 0.5 * (d01 * d01 + d11 * d11 + d21 * d21)
        E[2 * LANES + l] -= 0.5 * (d02 * d02 + d12 * d12 + d22 * d22)
        E[3 * LANES + l] -= 0.5 * (d00 * d01 + d10 * d11 + d20 * d21)
        E[4 * LANES + l] -= 0.5 * (d00 * d02 + d10 * d12 + d20 * d22)
        E[5 * LANES + l] -= 0.5 * (d01 * d02 + d11 * d12 + d21 * d22)


@compiled
def _stress(lam, mu, weight, E):
    """Turn strain into weight times stress, in place."""
    for l in range(LANES):
        twice = 2.0 * weight[l] * mu[l]
        trace = weight[l] * lam[l] * (E[l] + E[LANES + l] + E[2 * LANES + l])
        E[l] = trace + twice * E[l]
        E[LANES + l] = trace + twice * E[LANES + l]
        E[2 * LANES + l] = trace + twice * E[2 * LANES + l]
        E[3 * LANES + l] *= twice
        E[4 * LANES + l] *= twice
        E[5 * LANES + l] *= twice


@compiled
def _strain_terms(F, mu, weight, out):
    for l in range(LANES):
        f00, f01, f02 = F[l], F[LANES + l], F[2 * LANES + l]
        f10, f11, f12 = F[3 * LANES + l], F[4 * LANES + l], F[5 * LANES + l]
        f20, f21, f22 = F[6 * LANES + l], F[7 * LANES + l], F[8 * LANES + l]
        m = weight[l] * mu[l]
        out[l] = m * (f00 * f00 + f01 * f01 + f02 * f02)
        out[LANES + l] = m * (f10 * f10 + f11 * f11 + f12 * f12)
        out[2 * LANES + l] = m * (f20 * f20 + f21 * f21 + f22 * f22)
        out[3 * LANES + l] = m * (f00 * f10 + f01 * f11 + f02 * f12)
        out[4 * LANES + l] = m * (f00 * f20 + f01 * f21 + f02 * f22)
        out[5 * LANES + l] = m * (f10 * f20 + f11 * f21 + f12 * f22)


@compiled
def _strain_rows(F, S, root, gradients, out):
    for l in range(LANES):
        x, y, z = gradients[l], gradients[LANES + l], gradients[2 * LANES + l]
        r = root[l]
        out[l] = r * (F[l] * x + F[LANES + l] * y + F[2 * LANES + l] * z)
        out[LANES + l] = r * (F[3 * LANES + l] * x + F[4 * LANES + l] * y + F[5 * LANES + l] * z)
        out[2 * LANES + l] = r * (
            F[6 * LANES + l] * x + F[7 * LANES + l] * y + F[8 * LANES + l] * z)
        out[3 * LANES + l] = x
        out[4 * LANES + l] = y
        out[5 * LANES + l] = z
        s01, s02, s12 = S[3 * LANES + l], S[4 * LANES + l], S[5 * LANES + l]
        out[6 * LANES + l] = S[l] * x + s01 * y + s02 * z
        out[7 * LANES + l] = s01 * x + S[LANES + l] * y + s12 * z
        out[8 * LANES + l] = s02 * x + s12 * y + S[2 * LANES + l] * z


@compiled
def _volume_terms(F, mu, both, weight, cofactor, out):
    for l in range(LANES):
        f00, f01, f02 = F[l], F[LANES + l], F[2 * LANES + l]
        f10, f11, f12 = F[3 * LANES + l], F[4 * LANES + l], F[5 * LANES + l]
        f20, f21, f22 = F[6 * LANES + l], F[7 * LANES + l], F[8 * LANES + l]
        c00, c01, c02 = f11 * f22 - f12 * f21, f12 * f20 - f10 * f22, f10 * f21 - f11 * f20
        cofactor[l] = c00
        cofactor[LANES + l] = c01
        cofactor[2 * LANES + l] = c02
        cofactor[3 * LANES + l] = f02 * f21 - f01 * f22
        cofactor[4 * LANES + l] = f00 * f22 - f02 * f20
        cofactor[5 * LANES + l] = f01 * f20 - f00 * f21
        cofactor[6 * LANES + l] = f01 * f12 - f02 * f11
        cofactor[7 * LANES + l] = f02 * f10 - f00 * f12
        cofactor[8 * LANES + l] = f00 * f11 - f01 * f10
        det = f00 * c00 + f01 * c01 + f02 * c02
        pressure = weight[l] * (both[l] * (det - 1.0) - mu[l])
        out[l] = pressure * f00
        out[LANES + l] = pressure * f01
        out[2 * LANES + l] = pressure * f02
        out[3 * LANES + l] = pressure * f10
        out[4 * LANES + l] = pressure * f11
        out[5 * LANES + l] = pressure * f12
        out[6 * LANES + l] = pressure * f20
        out[7 * LANES + l] = pressure * f21
        out[8 * LANES + l] = pressure * f22
        out[9 * LANES + l] = weight[l] * mu[l]


@compiled
def _volume_rows(cofactor, root, gradients, out):
    for l in range(LANES):
        x, y, z = gradients[l], gradients[LANES + l], gradients[2 * LANES + l]
        r = root[l]
        out[l] = r * (cofactor[l] * x + cofactor[LANES + l] * y + cofactor[2 * LANES + l] * z)
        out[LANES + l] = r * (cofactor[3 * LANES + l] * x + cofactor[4 * LANES + l] * y
                              + cofactor[5 * LANES + l] * z)
        out[2 * LANES + l] = r * (cofactor[6 * LANES + l] * x + cofactor[7 * LANES + l] * y
                                  + cofactor[8 * LANES + l] * z)
        out[3 * LANES + l] = x
        out[4 * LANES + l] = y
        out[5 * LANES + l] = z


@compiled
def _add_strain_pairs(one, two, terms, lam, mu, point_count, block):
    if point_count == 4:
        strain_pairs_4(one, two, terms, lam, mu, block)
    elif point_count % 2:
        for q in range(point_count):
            row = q * STRAIN_ROWS * LANES
            strain_pairs_1(one[row:], two[row:], terms[q * STRAIN_TERMS * LANES:], lam, mu, block)
    else:
        for q in range(0, point_count, 2):
            row = q * STRAIN_ROWS * LANES
            strain_pairs_2(one[row:], two[row:], terms[q * STRAIN_TERMS * LANES:], lam, mu, block)


@compiled
def _add_volume_pairs(one, two, terms, both, point_count, block):
    if point_count == 4:
        volume_pairs_4(one, two, terms, both, block)
    elif point_count % 2:
        for q in range(point_count):
            row = q * VOLUME_ROWS * LANES
            volume_pairs_1(one[row:], two[row:], terms[q * VOLUME_TERMS * LANES:], both, block)
    else:
        for q in range(0, point_count, 2):
            row = q * VOLUME_ROWS * LANES
            volume_pairs_2(one[row:], two[row:], terms[q * VOLUME_TERMS * LANES:], both, block)


# The stiffness for the moduli of any law, LANES elements at a time.
#
# Stress needs no kernel of its own: Hooke's kernels take the stress of any law as the corresponding
# strain (BranchModel.bearing_strain). Moduli of 21 numbers per point take about five times as long
# as Hooke's two; a law's own formulas in numpy take longer than both.


@compiled
def moduli_stiffness(displacement: np.ndarray, gradients: np.ndarray, weights: np.ndarray,
                     moduli: np.ndarray, nodes: np.ndarray, slots: np.ndarray,
                     lengths: np.ndarray, values: np.ndarray) -> None:
    """Add the integral of B^T C B [N/m] of all elements to ``values``, B the strain's change, C
    [batch, q, 36, LANES] [Pa] by rows 00 11 22 and shear angles 01 02 12."""
    batch_count, point_count = weights.shape[0], weights.shape[1]
    node_count = nodes.shape[1]
    flat = gradients.reshape(batch_count, point_count, 3 * node_count * LANES)
    local, F = np.empty(3 * node_count * LANES), np.empty(9 * LANES)
    changes = np.empty((node_count, 18 * LANES))
    stresses = np.empty((node_count, 18 * LANES))
    blocks = np.empty((node_count * (node_count + 1) // 2, 9 * LANES))
    for batch in range(batch_count):
        gather(displacement, nodes[batch], local)
        blocks[:] = 0.0
        for q in range(point_count):
            deformation(local, flat[batch, q], node_count, F)
            for a in range(node_count):
                _strain_changes(F, flat[batch, q, 3 * a * LANES:], changes[a])
                _stress_changes(moduli[batch, q], weights[batch, q], changes[a], stresses[a])
            pair = 0
            for a in range(node_count):
                for b in range(a + 1):
                    _add_block(changes[a], stresses[b], blocks[pair])
                    pair += 1
        pair = 0
        for a in range(node_count):
            for b in range(a + 1):
                scatter_block(blocks[pair], slots[batch, pair], lengths[batch, pair], a == b,
                              values)
                pair += 1


@compiled
def _strain_changes(F: np.ndarray, gradients: np.ndarray, out: np.ndarray) -> None:
    """Write the changes of strain and shear angles as a node moves along each axis, by axes."""
    for i in range(3):
        for l in range(LANES):
            x, y, z = gradients[l], gradients[LANES + l], gradients[2 * LANES + l]
            f0, f1 = F[3 * i * LANES + l], F[(3 * i + 1) * LANES + l]
            f2 = F[(3 * i + 2) * LANES + l]
            k = 6 * i * LANES + l
            out[k] = f0 * x
            out[k + LANES] = f1 * y
            out[k + 2 * LANES] = f2 * z
            out[k + 3 * LANES] = f0 * y + f1 * x
            out[k + 4 * LANES] = f0 * z + f2 * x
            out[k + 5 * LANES] = f1 * z + f2 * y


@compiled
def _stress_changes(moduli: np.ndarray, weight: np.ndarray, changes: np.ndarray,
                    out: np.ndarray) -> None:
    """Write weight times moduli times the changes along each axis."""
    for l in range(LANES):
        for row in range(6):
            x = y = z = 0.0
            for column in range(6):
                modulus = moduli[6 * row + column, l]
                x += modulus * changes[column * LANES + l]
                y += modulus * changes[(6 + column) * LANES + l]
                z += modulus * changes[(12 + column) * LANES + l]
            out[row * LANES + l] = weight[l] * x
            out[(6 + row) * LANES + l] = weight[l] * y
            out[(12 + row) * LANES + l] = weight[l] * z


@compiled
def _add_block(changes: np.ndarray, stresses: np.ndarray, block: np.ndarray) -> None:
    for l in range(LANES):
        b00 = b10 = b20 = b01 = b11 = b21 = b02 = b12 = b22 = 0.0
        for k in range(6):
            u0, u1 = changes[k * LANES + l], changes[(6 + k) * LANES + l]
            u2 = changes[(12 + k) * LANES + l]
            v0, v1 = stresses[k * LANES + l], stresses[(6 + k) * LANES + l]
            v2 = stresses[(12 + k) * LANES + l]
            b00 += u0 * v0
            b10 += u1 * v0
            b20 += u2 * v0
            b01 += u0 * v1
            b11 += u1 * v1
            b21 += u2 * v1
            b02 += u0 * v2
            b12 += u1 * v2
            b22 += u2 * v2
        block[l] += b00
        block[LANES + l] += b10
        block[2 * LANES + l] += b20
        block[3 * LANES + l] += b01
        block[4 * LANES + l] += b11
        block[5 * LANES + l] += b21
        block[6 * LANES + l] += b02
        block[7 * LANES + l] += b12
        block[8 * LANES + l] += b22
