"""The kernels element by element: strains, and the tangent stiffness times a direction.

All kernels refer to the rest shape: with H = du/dX and F = I + H, the second Piola-Kirchhoff
stress S follows from the Green-Lagrange strain E = (H + H^T + H^T H) / 2, and the force of node
a is the integral of F S grad N_a.

Shared arguments:
    displacement: Node displacements [m], shape [node_count, 3].
    gradients, weights: From limber.mechanics.elements, [tet_count, q, 3, n] and [tet_count, q].
    lame_lambda, lame_mu: Lamé coefficients [Pa], shape [tet_count].
    tets: Node indices, shape [tet_count, n], int32.
    material: limber.mechanics.materials.Material as int.
    growth, memory: In motion the stress is that of the strain ``growth * E + memory``: viscous
        stress (Kelvin-Voigt) follows the strain's rate, and a difference formula gives that rate
        from the strain now and the strains before, which are the memory, [tet_count, q, 6] (00
        11 22 01 02 12). Growth 1 and a memory of no rows: no viscosity.

Displacements are taken relative to the element's first node: gradients sum to zero, so this
changes nothing but the round-off of a branch that has moved far.
"""

import numpy as np

from limber.mechanics.compiled import compiled

_NEO_HOOKE = 1
_LINEAR = 2


@compiled
def strain_changes(displacement, direction, gradients, tets, material, out):
    """Write the directional derivative of the strain at each quadrature point."""
    F = np.empty((3, 3))
    H = np.empty((3, 3))
    for e in range(tets.shape[0]):
        first = tets[e, 0]
        for q in range(gradients.shape[1]):
            for i in range(3):
                for j in range(3):
                    f, h = 0.0, 0.0
                    for a in range(tets.shape[1]):
                        g = gradients[e, q, j, a]
                        f += (displacement[tets[e, a], i] - displacement[first, i]) * g
                        h += (direction[tets[e, a], i] - direction[first, i]) * g
                    F[i, j], H[i, j] = f, h
                F[i, i] += 1.0
            if material == _LINEAR:
                for i in range(3):
                    for j in range(3):
                        F[i, j] = 1.0 if i == j else 0.0
            out[e, q] = _strain_rate(F, H)


@compiled
def _green_strain(F):
    return (0.5 * (F[0, 0] * F[0, 0] + F[1, 0] * F[1, 0] + F[2, 0] * F[2, 0] - 1.0),
            0.5 * (F[0, 1] * F[0, 1] + F[1, 1] * F[1, 1] + F[2, 1] * F[2, 1] - 1.0),
            0.5 * (F[0, 2] * F[0, 2] + F[1, 2] * F[1, 2] + F[2, 2] * F[2, 2] - 1.0),
            0.5 * (F[0, 0] * F[0, 1] + F[1, 0] * F[1, 1] + F[2, 0] * F[2, 1]),
            0.5 * (F[0, 0] * F[0, 2] + F[1, 0] * F[1, 2] + F[2, 0] * F[2, 2]),
            0.5 * (F[0, 1] * F[0, 2] + F[1, 1] * F[1, 2] + F[2, 1] * F[2, 2]))


@compiled
def _strain_rate(F, D):
    """Symmetric part of F^T D: the change of the Green-Lagrange strain as F changes by D."""
    return (F[0, 0] * D[0, 0] + F[1, 0] * D[1, 0] + F[2, 0] * D[2, 0],
            F[0, 1] * D[0, 1] + F[1, 1] * D[1, 1] + F[2, 1] * D[2, 1],
            F[0, 2] * D[0, 2] + F[1, 2] * D[1, 2] + F[2, 2] * D[2, 2],
            0.5 * (F[0, 0] * D[0, 1] + F[1, 0] * D[1, 1] + F[2, 0] * D[2, 1]
                   + D[0, 0] * F[0, 1] + D[1, 0] * F[1, 1] + D[2, 0] * F[2, 1]),
            0.5 * (F[0, 0] * D[0, 2] + F[1, 0] * D[1, 2] + F[2, 0] * D[2, 2]
                   + D[0, 0] * F[0, 2] + D[1, 0] * F[1, 2] + D[2, 0] * F[2, 2]),
            0.5 * (F[0, 1] * D[0, 2] + F[1, 1] * D[1, 2] + F[2, 1] * D[2, 2]
                   + D[0, 1] * F[0, 2] + D[1, 1] * F[1, 2] + D[2, 1] * F[2, 2]))


@compiled
def _add_turned(F, lam, mu, e00, e11, e22, e01, e02, e12, P):
    """Add F S to P, with S = lambda tr(E) I + 2 mu E."""
    trace = lam * (e00 + e11 + e22)
    s00, s11, s22 = trace + 2 * mu * e00, trace + 2 * mu * e11, trace + 2 * mu * e22
    s01, s02, s12 = 2 * mu * e01, 2 * mu * e02, 2 * mu * e12
    for i in range(3):
        x, y, z = F[i, 0], F[i, 1], F[i, 2]
        P[i, 0] += x * s00 + y * s01 + z * s02
        P[i, 1] += x * s01 + y * s11 + z * s12
        P[i, 2] += x * s02 + y * s12 + z * s22


@compiled
def _cofactor(F, i, j):
    a, b = (i + 1) % 3, (i + 2) % 3
    c, d = (j + 1) % 3, (j + 2) % 3
    return F[a, c] * F[b, d] - F[a, d] * F[b, c]


@compiled
def stress_derivative(F, H, lam, mu, material, growth, M, d_p):
    """Write the change of P as F changes by H (directional, exact)."""
    for i in range(3):
        for j in range(3):
            d_p[i, j] = 0.0
    if material == _LINEAR:
        trace = lam * (H[0, 0] + H[1, 1] + H[2, 2])
        for i in range(3):
            for j in range(3):
                d_p[i, j] = growth * mu * (H[i, j] + H[j, i])
            d_p[i, i] += growth * trace
        return
    factor = growth
    if material == _NEO_HOOKE:
        _neo_hookean_derivative(F, H, lam, mu, d_p)
        factor = growth - 1.0
    e00, e11, e22, e01, e02, e12 = _green_strain(F)
    _add_turned(H, lam, mu, factor * e00 + M[0], factor * e11 + M[1], factor * e22 + M[2],
                factor * e01 + M[3], factor * e02 + M[4], factor * e12 + M[5], d_p)
    h00, h11, h22, h01, h02, h12 = _strain_rate(F, H)
    _add_turned(F, factor * lam, factor * mu, h00, h11, h22, h01, h02, h12, d_p)


@compiled
def _neo_hookean_derivative(F, H, lam, mu, d_p):
    det = 0.0
    d_det = 0.0
    for j in range(3):
        det += F[0, j] * _cofactor(F, 0, j)
    for i in range(3):
        for j in range(3):
            d_det += _cofactor(F, i, j) * H[i, j]
    pressure = (lam + mu) * (det - 1.0) - mu
    for i in range(3):
        a, b = (i + 1) % 3, (i + 2) % 3
        for j in range(3):
            c, d = (j + 1) % 3, (j + 2) % 3
            d_cofactor = (H[a, c] * F[b, d] + F[a, c] * H[b, d]
                          - H[a, d] * F[b, c] - F[a, d] * H[b, c])
            d_p[i, j] = (mu * H[i, j] + pressure * d_cofactor
                         + (lam + mu) * d_det * _cofactor(F, i, j))


@compiled
def tangent_times(displacement, direction, gradients, weights, lame_lambda, lame_mu, tets,
                  material, growth, memory, product):
    """Write the exact directional derivative of the internal force, shape [node_count, 3]."""
    tet_count, point_count = weights.shape
    node_count = tets.shape[1]
    F, H, d_p = np.empty((3, 3)), np.empty((3, 3)), np.empty((3, 3))
    u, d = np.empty((3, node_count)), np.empty((3, node_count))
    out = np.empty((3, node_count))
    M = np.zeros(6)
    product[:] = 0.0
    for e in range(tet_count):
        first = tets[e, 0]
        for a in range(node_count):
            node = tets[e, a]
            for i in range(3):
                u[i, a] = displacement[node, i] - displacement[first, i]
                d[i, a] = direction[node, i] - direction[first, i]
                out[i, a] = 0.0
        for q in range(point_count):
            for i in range(3):
                for j in range(3):
                    f, h = 0.0, 0.0
                    for a in range(node_count):
                        f += u[i, a] * gradients[e, q, j, a]
                        h += d[i, a] * gradients[e, q, j, a]
                    F[i, j], H[i, j] = f, h
                F[i, i] += 1.0
            if memory.shape[0]:
                for k in range(6):
                    M[k] = memory[e, q, k]
            stress_derivative(F, H, lame_lambda[e], lame_mu[e], material, growth, M, d_p)
            weight = weights[e, q]
            for i in range(3):
                x, y, z = weight * d_p[i, 0], weight * d_p[i, 1], weight * d_p[i, 2]
                for a in range(node_count):
                    out[i, a] += (x * gradients[e, q, 0, a] + y * gradients[e, q, 1, a]
                                  + z * gradients[e, q, 2, a])
        for a in range(node_count):
            node = tets[e, a]
            for i in range(3):
                product[node, i] += out[i, a]


@compiled
def sparse_times(starts, columns, values, field, product):
    """Write a matrix in compressed rows times a nodal field, shape [node_count, 3]."""
    for row in range(len(starts) - 1):
        x, y, z = 0.0, 0.0, 0.0
        # Unsigned: numba looks whether a signed index counts from the end.
        for p in range(np.uint64(starts[row]), np.uint64(starts[row + 1])):
            value, node = values[p], np.uint64(columns[p])
            x += value * field[node, 0]
            y += value * field[node, 1]
            z += value * field[node, 2]
        product[row, 0], product[row, 1], product[row, 2] = x, y, z
