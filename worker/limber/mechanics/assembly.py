"""The kernels: internal force, energy and tangent stiffness of all tetrahedra, compiled by numba.

All refer to the rest shape: with H = du/dX and F = I + H, the second Piola-Kirchhoff stress S
follows from the Green-Lagrange strain E = (H + H^T + H^T H) / 2, and the force of node a is
the integral of F S grad N_a.

Shared arguments:
    displacement, other: Node displacements [m], and a second nodal field, shape [node_count, 3]:
        the last increment or the velocity, as the factors below say.
    gradients, weights: From limber.mechanics.elements, [tet_count, q, 3, n] and [tet_count, q].
    lame_lambda, lame_mu: Lamé coefficients [Pa], shape [tet_count].
    tets: Node indices, shape [tet_count, n], int32.
    material: limber.mechanics.materials.Material as int.
    viscosity: Factor [s] of the strain's rate in the stress (Kelvin-Voigt); ``other`` is then
        the velocity [m/s]. 0 leaves ``other`` out.

Displacements are taken relative to the element's first node: gradients sum to zero, so this
changes nothing but the round-off of a branch that has moved far.
"""

import numpy as np

from limber.mechanics.compiled import compiled

_SVK = 0
_NEO_HOOKE = 1
_LINEAR = 2


@compiled
def internal_force(displacement, other, gradients, weights, lame_lambda, lame_mu, tets,
                   material, viscosity, force, energies):
    """Write the internal force [N] and each element's strain energy [J]; return min det F."""
    tet_count, point_count = weights.shape
    node_count = tets.shape[1]
    local = np.empty((3, node_count))
    rate = np.zeros((3, node_count))
    local_force = np.empty((3, node_count))
    F = np.empty((3, 3))
    D = np.zeros((3, 3))
    P = np.empty((3, 3))
    force[:] = 0.0
    min_det = np.inf
    for e in range(tet_count):
        first = tets[e, 0]
        for a in range(node_count):
            node = tets[e, a]
            for i in range(3):
                local[i, a] = displacement[node, i] - displacement[first, i]
                local_force[i, a] = 0.0
        if viscosity != 0.0:
            for a in range(node_count):
                node = tets[e, a]
                for i in range(3):
                    rate[i, a] = other[node, i] - other[first, i]
        energy = 0.0
        for q in range(point_count):
            for i in range(3):
                for j in range(3):
                    total = 0.0
                    for a in range(node_count):
                        total += local[i, a] * gradients[e, q, j, a]
                    F[i, j] = total
                F[i, i] += 1.0
            if viscosity != 0.0:
                for i in range(3):
                    for j in range(3):
                        total = 0.0
                        for a in range(node_count):
                            total += rate[i, a] * gradients[e, q, j, a]
                        D[i, j] = total
            density, det = first_stress(F, D, lame_lambda[e], lame_mu[e], material,
                                        viscosity, P)
            min_det = min(min_det, det)
            weight = weights[e, q]
            energy += weight * density
            for i in range(3):
                x, y, z = weight * P[i, 0], weight * P[i, 1], weight * P[i, 2]
                for a in range(node_count):
                    local_force[i, a] += (x * gradients[e, q, 0, a] + y * gradients[e, q, 1, a]
                                          + z * gradients[e, q, 2, a])
        energies[e] = energy
        for a in range(node_count):
            node = tets[e, a]
            for i in range(3):
                force[node, i] += local_force[i, a]
    return min_det


@compiled
def first_stress(F, D, lam, mu, material, viscosity, P):
    """Write the first Piola-Kirchhoff stress [Pa]; return energy density [J/m^3] and det F.

    ``D`` is the rate of F [1/s], used where ``viscosity`` is not 0.
    """
    det = (F[0, 0] * (F[1, 1] * F[2, 2] - F[1, 2] * F[2, 1])
           - F[0, 1] * (F[1, 0] * F[2, 2] - F[1, 2] * F[2, 0])
           + F[0, 2] * (F[1, 0] * F[2, 1] - F[1, 1] * F[2, 0]))
    if material == _NEO_HOOKE:
        density = _neo_hookean_stress(F, det, lam, mu, P)
        if viscosity != 0.0:
            e00, e11, e22, e01, e02, e12 = _strain_rate(F, D)
            _add_turned(F, lam * viscosity, mu * viscosity, e00, e11, e22, e01, e02, e12, P)
        return density, det
    if material == _LINEAR:
        e00, e11, e22 = F[0, 0] - 1.0, F[1, 1] - 1.0, F[2, 2] - 1.0
        e01 = 0.5 * (F[0, 1] + F[1, 0])
        e02 = 0.5 * (F[0, 2] + F[2, 0])
        e12 = 0.5 * (F[1, 2] + F[2, 1])
    else:
        e00, e11, e22, e01, e02, e12 = _green_strain(F)
    trace = e00 + e11 + e22
    density = (0.5 * lam * trace * trace + mu * (
        e00 * e00 + e11 * e11 + e22 * e22 + 2.0 * (e01 * e01 + e02 * e02 + e12 * e12)))
    if viscosity != 0.0:
        if material == _LINEAR:
            d00, d11, d22 = D[0, 0], D[1, 1], D[2, 2]
            d01 = 0.5 * (D[0, 1] + D[1, 0])
            d02 = 0.5 * (D[0, 2] + D[2, 0])
            d12 = 0.5 * (D[1, 2] + D[2, 1])
        else:
            d00, d11, d22, d01, d02, d12 = _strain_rate(F, D)
        e00 += viscosity * d00
        e11 += viscosity * d11
        e22 += viscosity * d22
        e01 += viscosity * d01
        e02 += viscosity * d02
        e12 += viscosity * d12
    for i in range(3):
        for j in range(3):
            P[i, j] = 0.0
    if material == _LINEAR:
        trace = lam * (e00 + e11 + e22)
        P[0, 0], P[1, 1], P[2, 2] = (trace + 2 * mu * e00, trace + 2 * mu * e11,
                                     trace + 2 * mu * e22)
        P[0, 1] = P[1, 0] = 2 * mu * e01
        P[0, 2] = P[2, 0] = 2 * mu * e02
        P[1, 2] = P[2, 1] = 2 * mu * e12
    else:
        _add_turned(F, lam, mu, e00, e11, e22, e01, e02, e12, P)
    return density, det


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
def _neo_hookean_stress(F, det, lam, mu, P):
    squares = 0.0
    pressure = (lam + mu) * (det - 1.0) - mu
    for i in range(3):
        for j in range(3):
            squares += F[i, j] * F[i, j]
            P[i, j] = mu * F[i, j] + pressure * _cofactor(F, i, j)
    return (0.5 * mu * (squares - 3.0) - mu * (det - 1.0)
            + 0.5 * (lam + mu) * (det - 1.0) * (det - 1.0))


@compiled
def _stress_derivative(F, D, H, V, lam, mu, material, viscosity, d_p):
    """Write the change of P as F changes by H and its rate D by V (directional, exact)."""
    for i in range(3):
        for j in range(3):
            d_p[i, j] = 0.0
    if material == _LINEAR:
        trace = lam * (H[0, 0] + H[1, 1] + H[2, 2]
                       + viscosity * (V[0, 0] + V[1, 1] + V[2, 2]))
        for i in range(3):
            for j in range(3):
                d_p[i, j] = mu * (H[i, j] + H[j, i] + viscosity * (V[i, j] + V[j, i]))
            d_p[i, i] += trace
        return
    if material == _NEO_HOOKE:
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
        if viscosity != 0.0:
            e00, e11, e22, e01, e02, e12 = _strain_rate(F, D)
            _add_turned(H, lam * viscosity, mu * viscosity, e00, e11, e22, e01, e02, e12, d_p)
            a00, a11, a22, a01, a02, a12 = _strain_rate(H, D)
            b00, b11, b22, b01, b02, b12 = _strain_rate(F, V)
            _add_turned(F, lam * viscosity, mu * viscosity, a00 + b00, a11 + b11, a22 + b22,
                        a01 + b01, a02 + b02, a12 + b12, d_p)
        return
    e00, e11, e22, e01, e02, e12 = _green_strain(F)
    h00, h11, h22, h01, h02, h12 = _strain_rate(F, H)
    if viscosity != 0.0:
        v = viscosity
        c00, c11, c22, c01, c02, c12 = _strain_rate(F, D)
        a00, a11, a22, a01, a02, a12 = _strain_rate(H, D)
        b00, b11, b22, b01, b02, b12 = _strain_rate(F, V)
        e00, e11, e22 = e00 + v * c00, e11 + v * c11, e22 + v * c22
        e01, e02, e12 = e01 + v * c01, e02 + v * c02, e12 + v * c12
        h00, h11, h22 = h00 + v * (a00 + b00), h11 + v * (a11 + b11), h22 + v * (a22 + b22)
        h01, h02, h12 = h01 + v * (a01 + b01), h02 + v * (a02 + b02), h12 + v * (a12 + b12)
    _add_turned(H, lam, mu, e00, e11, e22, e01, e02, e12, d_p)
    _add_turned(F, lam, mu, h00, h11, h22, h01, h02, h12, d_p)


@compiled
def tangent_times(displacement, velocity, direction, rate_direction, gradients, weights,
                  lame_lambda, lame_mu, tets, material, viscosity, product):
    """Write the exact directional derivative of the internal force, shape [node_count, 3]."""
    tet_count, point_count = weights.shape
    node_count = tets.shape[1]
    F, D, H, V, d_p = (np.empty((3, 3)), np.zeros((3, 3)), np.empty((3, 3)), np.zeros((3, 3)),
                       np.empty((3, 3)))
    product[:] = 0.0
    for e in range(tet_count):
        first = tets[e, 0]
        for q in range(point_count):
            for i in range(3):
                for j in range(3):
                    f, d, h, v = 0.0, 0.0, 0.0, 0.0
                    for a in range(node_count):
                        node = tets[e, a]
                        g = gradients[e, q, j, a]
                        f += (displacement[node, i] - displacement[first, i]) * g
                        h += (direction[node, i] - direction[first, i]) * g
                        if viscosity != 0.0:
                            d += (velocity[node, i] - velocity[first, i]) * g
                            v += (rate_direction[node, i] - rate_direction[first, i]) * g
                    F[i, j], D[i, j], H[i, j], V[i, j] = f, d, h, v
                F[i, i] += 1.0
            _stress_derivative(F, D, H, V, lame_lambda[e], lame_mu[e], material, viscosity, d_p)
            weight = weights[e, q]
            for a in range(node_count):
                node = tets[e, a]
                for i in range(3):
                    product[node, i] += weight * (
                        d_p[i, 0] * gradients[e, q, 0, a] + d_p[i, 1] * gradients[e, q, 1, a]
                        + d_p[i, 2] * gradients[e, q, 2, a])
