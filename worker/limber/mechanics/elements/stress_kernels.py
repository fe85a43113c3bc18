"""Stress, energy and volume change at one quadrature point, in compiled loops."""

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.mechanics.elements.stiffness import LANES, deformation, gather, green_strain


@compiled
def determinant(F, det):
    """Set the determinants of LANES deformation gradients."""
    for l in range(LANES):
        f00, f01, f02 = F[l], F[LANES + l], F[2 * LANES + l]
        f10, f11, f12 = F[3 * LANES + l], F[4 * LANES + l], F[5 * LANES + l]
        f20, f21, f22 = F[6 * LANES + l], F[7 * LANES + l], F[8 * LANES + l]
        det[l] = (f00 * (f11 * f22 - f12 * f21) - f01 * (f10 * f22 - f12 * f20)
                  + f02 * (f10 * f21 - f11 * f20))


@compiled
def small_strain(F, E):
    """Set the linear strains: xx, yy, zz, xy, xz, yz."""
    for l in range(LANES):
        E[l] = F[l] - 1.0
        E[LANES + l] = F[4 * LANES + l] - 1.0
        E[2 * LANES + l] = F[8 * LANES + l] - 1.0
        E[3 * LANES + l] = 0.5 * (F[LANES + l] + F[3 * LANES + l])
        E[4 * LANES + l] = 0.5 * (F[2 * LANES + l] + F[6 * LANES + l])
        E[5 * LANES + l] = 0.5 * (F[5 * LANES + l] + F[7 * LANES + l])


@compiled
def energy_density(E, lam, mu, weight, energy):
    """Add weight times the energy density of St. Venant-Kirchhoff."""
    for l in range(LANES):
        e00, e11, e22 = E[l], E[LANES + l], E[2 * LANES + l]
        e01, e02, e12 = E[3 * LANES + l], E[4 * LANES + l], E[5 * LANES + l]
        trace = e00 + e11 + e22
        energy[l] += weight[l] * (0.5 * lam[l] * trace * trace + mu[l] * (
            e00 * e00 + e11 * e11 + e22 * e22 + 2.0 * (e01 * e01 + e02 * e02 + e12 * e12)))


@compiled
def add_stress(F, E, lam, mu, weight, P):
    """Add weight times F S, with S = lambda tr(E) 1 + 2 mu E."""
    for l in range(LANES):
        twice = 2.0 * weight[l] * mu[l]
        trace = weight[l] * lam[l] * (E[l] + E[LANES + l] + E[2 * LANES + l])
        s00, s11 = trace + twice * E[l], trace + twice * E[LANES + l]
        s22 = trace + twice * E[2 * LANES + l]
        s01, s02 = twice * E[3 * LANES + l], twice * E[4 * LANES + l]
        s12 = twice * E[5 * LANES + l]
        x, y, z = F[l], F[LANES + l], F[2 * LANES + l]
        P[l] += x * s00 + y * s01 + z * s02
        P[LANES + l] += x * s01 + y * s11 + z * s12
        P[2 * LANES + l] += x * s02 + y * s12 + z * s22
        x, y, z = F[3 * LANES + l], F[4 * LANES + l], F[5 * LANES + l]
        P[3 * LANES + l] += x * s00 + y * s01 + z * s02
        P[4 * LANES + l] += x * s01 + y * s11 + z * s12
        P[5 * LANES + l] += x * s02 + y * s12 + z * s22
        x, y, z = F[6 * LANES + l], F[7 * LANES + l], F[8 * LANES + l]
        P[6 * LANES + l] += x * s00 + y * s01 + z * s02
        P[7 * LANES + l] += x * s01 + y * s11 + z * s12
        P[8 * LANES + l] += x * s02 + y * s12 + z * s22


@compiled
def volume_stress(F, det, lam, mu, weight, energy, P):
    for l in range(LANES):
        f00, f01, f02 = F[l], F[LANES + l], F[2 * LANES + l]
        f10, f11, f12 = F[3 * LANES + l], F[4 * LANES + l], F[5 * LANES + l]
        f20, f21, f22 = F[6 * LANES + l], F[7 * LANES + l], F[8 * LANES + l]
        m, both, change = weight[l] * mu[l], weight[l] * (lam[l] + mu[l]), det[l] - 1.0
        pressure = both * change - m
        P[l] = m * f00 + pressure * (f11 * f22 - f12 * f21)
        P[LANES + l] = m * f01 + pressure * (f12 * f20 - f10 * f22)
        P[2 * LANES + l] = m * f02 + pressure * (f10 * f21 - f11 * f20)
        P[3 * LANES + l] = m * f10 + pressure * (f02 * f21 - f01 * f22)
        P[4 * LANES + l] = m * f11 + pressure * (f00 * f22 - f02 * f20)
        P[5 * LANES + l] = m * f12 + pressure * (f01 * f20 - f00 * f21)
        P[6 * LANES + l] = m * f20 + pressure * (f01 * f12 - f02 * f11)
        P[7 * LANES + l] = m * f21 + pressure * (f02 * f10 - f00 * f12)
        P[8 * LANES + l] = m * f22 + pressure * (f00 * f11 - f01 * f10)
        squares = (f00 * f00 + f01 * f01 + f02 * f02 + f10 * f10 + f11 * f11 + f12 * f12
                   + f20 * f20 + f21 * f21 + f22 * f22)
        energy[l] += 0.5 * m * (squares - 3.0) - m * change + 0.5 * both * change * change


@compiled
def add_pull(P, gradients, pull):
    for l in range(LANES):
        x, y, z = gradients[l], gradients[LANES + l], gradients[2 * LANES + l]
        pull[l] += P[l] * x + P[LANES + l] * y + P[2 * LANES + l] * z
        pull[LANES + l] += P[3 * LANES + l] * x + P[4 * LANES + l] * y + P[5 * LANES + l] * z
        pull[2 * LANES + l] += P[6 * LANES + l] * x + P[7 * LANES + l] * y + P[8 * LANES + l] * z


# The largest principal strain of every element, for colours and limits at interactive rates.


@compiled
def largest_principal_strains(displacement, mean_gradients, nodes, carried, out):
    """Write each element's largest principal Green-Lagrange strain of its mean deformation.
    ``carried`` [tet_count, 6] (00 11 22 01 02 12) is that in the mesh's shape, or has no rows."""
    node_count = nodes.shape[1]
    flat = mean_gradients.reshape(len(nodes), 3 * node_count * LANES)
    local, F, E = np.empty(3 * node_count * LANES), np.empty(9 * LANES), np.empty(6 * LANES)
    for batch in range(len(nodes)):
        gather(displacement, nodes[batch], local)
        deformation(local, flat[batch], node_count, F)
        green_strain(F, E)
        for l in range(min(LANES, len(out) - batch * LANES)):
            if len(carried):
                for k in range(6):
                    E[k * LANES + l] += carried[batch * LANES + l, k]
            e01, e02, e12 = E[3 * LANES + l], E[4 * LANES + l], E[5 * LANES + l]
            mean = (E[l] + E[LANES + l] + E[2 * LANES + l]) / 3.0
            x, y, z = E[l] - mean, E[LANES + l] - mean, E[2 * LANES + l] - mean
            size = np.sqrt((x * x + y * y + z * z
                            + 2.0 * (e01 * e01 + e02 * e02 + e12 * e12)) / 6.0)
            half = 0.5 * (x * (y * z - e12 * e12) - e01 * (e01 * z - e12 * e02)
                          + e02 * (e01 * e12 - y * e02))
            cosine = min(1.0, max(-1.0, half / size**3)) if size > 0.0 else 1.0
            out[batch * LANES + l] = mean + 2.0 * size * np.cos(np.arccos(cosine) / 3.0)
