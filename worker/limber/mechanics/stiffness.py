"""The kernels that make the tangent stiffness and scatter it into the factor's own pattern.

Elements are taken LANES at a time: every number of the formulas is a row of LANES numbers, one
an element, so that all inner loops are vector instructions without remainder. The layout (made
by limber.mechanics.pattern) has the element as the last axis.

``slots`` has, for each pair of an element's nodes, where the pair's block starts in the values of
the lower triangle in compressed columns; the block's other two columns follow at distances that
the column's length gives. An element's nodes are sorted so that the earlier eliminated comes first,
so every pair's block is in the lower triangle as it stands. Pairs with a constrained node point
behind the end of the values.
"""

import numpy as np

from limber.mechanics.assembly import stress_derivative
from limber.mechanics.compiled import compiled

LANES = 16
"""Elements a vector row. With 16 LLVM keeps the loops and vectorises them; it unrolls 8."""

_LINEAR = 2


@compiled
def strain_stiffness(displacement, increment, gradients, weights, lame_lambda, lame_mu, nodes,
                     material, growth, memory, slots, lengths, values):
    """Add the tangent stiffness [N/m] of St. Venant-Kirchhoff or linear elements to ``values``.

    Args:
        displacement: See limber.mechanics.assembly.
        increment: The last increment of the displacement; the stress of the geometric part is
            then taken at the strain less dH^T dH / 2, dH the increment's gradient: the stress
            that the last linearisation predicted (mixed integration points, Magisano, Leonetti
            and Garcea 2017). Without rows: Newton's.
        gradients, weights: Shapes [batch, q, 3, n, LANES] and [batch, q, LANES].
        lame_lambda, lame_mu: Shape [batch, LANES].
        nodes: Shape [batch, n, LANES].
        growth, memory: See limber.mechanics.assembly; memory of shape [batch, q, 6, LANES].
        slots, lengths: Shape [batch, pairs, LANES]; pair (a, b <= a) has number a (a+1)/2 + b.
        values: Lower triangle by columns, with a few numbers of scratch behind its end.
    """
    batch_count, point_count = weights.shape[0], weights.shape[1]
    node_count = nodes.shape[1]
    local = np.empty((3, node_count, LANES))
    rate = np.zeros((3, node_count, LANES))
    turned = np.empty((point_count, 3, node_count, LANES))
    F = np.empty((9, LANES))
    D = np.empty((9, LANES))
    E = np.empty((6, LANES))
    # Rows of c: 0-5 stress, 6-11 mu F F^T (00 11 22 01 02 12), 12-14 lambda, mu and their sum.
    c = np.zeros((point_count, 15, LANES))
    block = np.empty((9, LANES))
    mixed = material != _LINEAR and increment.shape[0] > 0
    for batch in range(batch_count):
        for a in range(node_count):
            for l in range(LANES):
                node, first = nodes[batch, a, l], nodes[batch, 0, l]
                for i in range(3):
                    local[i, a, l] = displacement[node, i] - displacement[first, i]
        if mixed:
            for a in range(node_count):
                for l in range(LANES):
                    node, first = nodes[batch, a, l], nodes[batch, 0, l]
                    for i in range(3):
                        rate[i, a, l] = increment[node, i] - increment[first, i]
        for q in range(point_count):
            _deformation(local, gradients[batch, q], material == _LINEAR, F)
            for l in range(LANES):
                E[0, l] = 0.5 * (F[0, l]**2 + F[3, l]**2 + F[6, l]**2 - 1.0)
                E[1, l] = 0.5 * (F[1, l]**2 + F[4, l]**2 + F[7, l]**2 - 1.0)
                E[2, l] = 0.5 * (F[2, l]**2 + F[5, l]**2 + F[8, l]**2 - 1.0)
                E[3, l] = 0.5 * (F[0, l] * F[1, l] + F[3, l] * F[4, l] + F[6, l] * F[7, l])
                E[4, l] = 0.5 * (F[0, l] * F[2, l] + F[3, l] * F[5, l] + F[6, l] * F[8, l])
                E[5, l] = 0.5 * (F[1, l] * F[2, l] + F[4, l] * F[5, l] + F[7, l] * F[8, l])
            if mixed:
                _gradient(rate, gradients[batch, q], D)
                _add_strain_rate(D, D, -0.5, E)
            if memory.shape[0] and material != _LINEAR:
                for k in range(6):
                    for l in range(LANES):
                        E[k, l] = growth * E[k, l] + memory[batch, q, k, l]
            for l in range(LANES):
                weight = weights[batch, q, l]
                lam, mu = weight * lame_lambda[batch, l], weight * lame_mu[batch, l]
                trace = lam * (E[0, l] + E[1, l] + E[2, l])
                c[q, 0, l] = trace + 2 * mu * E[0, l]
                c[q, 1, l] = trace + 2 * mu * E[1, l]
                c[q, 2, l] = trace + 2 * mu * E[2, l]
                c[q, 3, l] = 2 * mu * E[3, l]
                c[q, 4, l] = 2 * mu * E[4, l]
                c[q, 5, l] = 2 * mu * E[5, l]
                lam, mu = growth * lam, growth * mu
                c[q, 6, l] = mu * (F[0, l]**2 + F[1, l]**2 + F[2, l]**2)
                c[q, 7, l] = mu * (F[3, l]**2 + F[4, l]**2 + F[5, l]**2)
                c[q, 8, l] = mu * (F[6, l]**2 + F[7, l]**2 + F[8, l]**2)
                c[q, 9, l] = mu * (F[0, l] * F[3, l] + F[1, l] * F[4, l] + F[2, l] * F[5, l])
                c[q, 10, l] = mu * (F[0, l] * F[6, l] + F[1, l] * F[7, l] + F[2, l] * F[8, l])
                c[q, 11, l] = mu * (F[3, l] * F[6, l] + F[4, l] * F[7, l] + F[5, l] * F[8, l])
                c[q, 12, l], c[q, 13, l], c[q, 14, l] = lam, mu, lam + mu
            for a in range(node_count):
                for l in range(LANES):
                    x = gradients[batch, q, 0, a, l]
                    y = gradients[batch, q, 1, a, l]
                    z = gradients[batch, q, 2, a, l]
                    turned[q, 0, a, l] = F[0, l] * x + F[1, l] * y + F[2, l] * z
                    turned[q, 1, a, l] = F[3, l] * x + F[4, l] * y + F[5, l] * z
                    turned[q, 2, a, l] = F[6, l] * x + F[7, l] * y + F[8, l] * z
        pair = 0
        for a in range(node_count):
            for b in range(a + 1):
                _pair_block(gradients[batch], turned, c, a, b, block)
                _scatter(block, slots[batch, pair], lengths[batch, pair], a == b, values)
                pair += 1


@compiled
def _gradient(local, gradients, H):
    node_count = local.shape[1]
    H[:] = 0.0
    for a in range(node_count):
        for i in range(3):
            for j in range(3):
                for l in range(LANES):
                    H[3 * i + j, l] += local[i, a, l] * gradients[j, a, l]


@compiled
def _deformation(local, gradients, is_linear, F):
    if is_linear:
        F[:] = 0.0
    else:
        _gradient(local, gradients, F)
    for l in range(LANES):
        F[0, l] += 1.0
        F[4, l] += 1.0
        F[8, l] += 1.0


@compiled
def _add_strain_rate(F, D, factor, E):
    for l in range(LANES):
        E[0, l] += factor * (F[0, l] * D[0, l] + F[3, l] * D[3, l] + F[6, l] * D[6, l])
        E[1, l] += factor * (F[1, l] * D[1, l] + F[4, l] * D[4, l] + F[7, l] * D[7, l])
        E[2, l] += factor * (F[2, l] * D[2, l] + F[5, l] * D[5, l] + F[8, l] * D[8, l])
    half = 0.5 * factor
    for l in range(LANES):
        E[3, l] += half * (F[0, l] * D[1, l] + F[3, l] * D[4, l] + F[6, l] * D[7, l]
                           + D[0, l] * F[1, l] + D[3, l] * F[4, l] + D[6, l] * F[7, l])
        E[4, l] += half * (F[0, l] * D[2, l] + F[3, l] * D[5, l] + F[6, l] * D[8, l]
                           + D[0, l] * F[2, l] + D[3, l] * F[5, l] + D[6, l] * F[8, l])
        E[5, l] += half * (F[1, l] * D[2, l] + F[4, l] * D[5, l] + F[7, l] * D[8, l]
                           + D[1, l] * F[2, l] + D[4, l] * F[5, l] + D[7, l] * F[8, l])


@compiled
def _pair_block(gradients, turned, c, a, b, block):
    """Write the 3 x 3 block of nodes a and b: 00 11 22 01 10 02 20 12 21."""
    block[:] = 0.0
    for q in range(gradients.shape[0]):
        for l in range(LANES):
            g0, g1, g2 = gradients[q, 0, a, l], gradients[q, 1, a, l], gradients[q, 2, a, l]
            h0, h1, h2 = gradients[q, 0, b, l], gradients[q, 1, b, l], gradients[q, 2, b, l]
            u0, u1, u2 = turned[q, 0, a, l], turned[q, 1, a, l], turned[q, 2, a, l]
            v0, v1, v2 = turned[q, 0, b, l], turned[q, 1, b, l], turned[q, 2, b, l]
            dot = g0 * h0 + g1 * h1 + g2 * h2
            geometric = ((c[q, 0, l] * g0 + c[q, 3, l] * g1 + c[q, 4, l] * g2) * h0
                         + (c[q, 3, l] * g0 + c[q, 1, l] * g1 + c[q, 5, l] * g2) * h1
                         + (c[q, 4, l] * g0 + c[q, 5, l] * g1 + c[q, 2, l] * g2) * h2)
            lam, mu, both = c[q, 12, l], c[q, 13, l], c[q, 14, l]
            block[0, l] += both * u0 * v0 + c[q, 6, l] * dot + geometric
            block[1, l] += both * u1 * v1 + c[q, 7, l] * dot + geometric
            block[2, l] += both * u2 * v2 + c[q, 8, l] * dot + geometric
            shear, x, y = c[q, 9, l] * dot, u0 * v1, u1 * v0
            block[3, l] += lam * x + mu * y + shear
            block[4, l] += lam * y + mu * x + shear
            shear, x, y = c[q, 10, l] * dot, u0 * v2, u2 * v0
            block[5, l] += lam * x + mu * y + shear
            block[6, l] += lam * y + mu * x + shear
            shear, x, y = c[q, 11, l] * dot, u1 * v2, u2 * v1
            block[7, l] += lam * x + mu * y + shear
            block[8, l] += lam * y + mu * x + shear


@compiled
def _scatter(block, slots, lengths, is_diagonal, values):
    if is_diagonal:
        for l in range(LANES):
            at, length = slots[l], lengths[l]
            values[at] += block[0, l]
            values[at + 1] += block[4, l]
            values[at + 2] += block[6, l]
            at += length
            values[at] += block[1, l]
            values[at + 1] += block[8, l]
            values[at + length - 1] += block[2, l]
        return
    for l in range(LANES):
        at, length = slots[l], lengths[l]
        values[at] += block[0, l]
        values[at + 1] += block[4, l]
        values[at + 2] += block[6, l]
        at += length - 1
        values[at] += block[3, l]
        values[at + 1] += block[1, l]
        values[at + 2] += block[8, l]
        at += length - 2
        values[at] += block[5, l]
        values[at + 1] += block[7, l]
        values[at + 2] += block[2, l]


@compiled
def general_stiffness(displacement, gradients, weights, lame_lambda, lame_mu, nodes,
                      material, growth, memory, slots, lengths, values):
    """Add the tangent stiffness of any material, from the derivative of its stress.

    Arguments as in :func:`strain_stiffness`.
    """
    batch_count, point_count = weights.shape[0], weights.shape[1]
    node_count = nodes.shape[1]
    F, H, d_p, M = np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, 3)), np.zeros(6)
    tensor = np.empty((point_count, 3, 3, 3, 3))
    block = np.empty((9, LANES))
    blocks = np.empty((9, node_count * (node_count + 1) // 2, LANES))
    for batch in range(batch_count):
        blocks[:] = 0.0
        for l in range(LANES):
            first = nodes[batch, 0, l]
            for q in range(point_count):
                for i in range(3):
                    for j in range(3):
                        f = 0.0
                        for a in range(node_count):
                            node = nodes[batch, a, l]
                            f += (displacement[node, i] - displacement[first, i]
                                  ) * gradients[batch, q, j, a, l]
                        F[i, j] = f
                    F[i, i] += 1.0
                if memory.shape[0]:
                    for k in range(6):
                        M[k] = memory[batch, q, k, l]
                for k in range(3):
                    for m in range(3):
                        H[k, m] = 1.0
                        stress_derivative(F, H, lame_lambda[batch, l], lame_mu[batch, l],
                                          material, growth, M, d_p)
                        H[k, m] = 0.0
                        for i in range(3):
                            for j in range(3):
                                tensor[q, k, i, m, j] = weights[batch, q, l] * d_p[i, j]
            _lane_blocks(gradients[batch], tensor, l, blocks)
        pair = 0
        for a in range(node_count):
            for b in range(a + 1):
                block[:] = blocks[:, pair]
                _scatter(block, slots[batch, pair], lengths[batch, pair], a == b, values)
                pair += 1


@compiled
def _lane_blocks(gradients, tensor, l, blocks):
    point_count, node_count = gradients.shape[0], gradients.shape[2]
    half = np.empty((3, 3, 3))
    for q in range(point_count):
        pair = 0
        for a in range(node_count):
            for i in range(3):
                for k in range(3):
                    for m in range(3):
                        total = 0.0
                        for j in range(3):
                            total += tensor[q, k, i, m, j] * gradients[q, j, a, l]
                        half[i, k, m] = total
            for b in range(a + 1):
                x, y, z = gradients[q, 0, b, l], gradients[q, 1, b, l], gradients[q, 2, b, l]
                blocks[0, pair, l] += half[0, 0, 0] * x + half[0, 0, 1] * y + half[0, 0, 2] * z
                blocks[1, pair, l] += half[1, 1, 0] * x + half[1, 1, 1] * y + half[1, 1, 2] * z
                blocks[2, pair, l] += half[2, 2, 0] * x + half[2, 2, 1] * y + half[2, 2, 2] * z
                blocks[3, pair, l] += half[0, 1, 0] * x + half[0, 1, 1] * y + half[0, 1, 2] * z
                blocks[4, pair, l] += half[1, 0, 0] * x + half[1, 0, 1] * y + half[1, 0, 2] * z
                blocks[5, pair, l] += half[0, 2, 0] * x + half[0, 2, 1] * y + half[0, 2, 2] * z
                blocks[6, pair, l] += half[2, 0, 0] * x + half[2, 0, 1] * y + half[2, 0, 2] * z
                blocks[7, pair, l] += half[1, 2, 0] * x + half[1, 2, 1] * y + half[1, 2, 2] * z
                blocks[8, pair, l] += half[2, 1, 0] * x + half[2, 1, 1] * y + half[2, 1, 2] * z
                pair += 1
