"""Kernels of internal force, energy, strain and their changes, LANES elements at a time.

An element may have any number of nodes and quadrature points.

All refer to the rest shape: with H = du/dX and F = I + H, the second Piola-Kirchhoff stress S
follows from the Green-Lagrange strain E = (H + H^T + H^T H) / 2, and the force of node a is the
integral of F S grad N_a. See :mod:`limber.mechanics.elements.stiffness` for the memory layout
of runs of numbers.

Shared arguments:
    displacement: Node displacements [m], shape [node_count, 3].
    gradients, weights, nodes: From :class:`ForceLayout`.
    lame_lambda, lame_mu: Lamé coefficients [Pa], shape [batch, LANES].
    material: ``kernel`` of a limber.mechanics.materials.laws.MaterialLaw.
    growth, memory: In motion the stress is that of the strain ``growth * E + memory``. Viscous
        stress (Kelvin-Voigt) follows the strain rate, which a difference formula gives from the
        current strain and the previous strains; the previous strains are the memory, [tet_count, q,
        6] (00 11 22 01 02 12). Growth 1 and a memory without rows: no viscosity.

Displacements are relative to the element's first node. The gradients sum to zero, so this only
reduces the round-off of a branch with large displacements.
"""

from functools import cached_property

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.mechanics.elements.stiffness import LANES, deformation, gather, gradient, green_strain
from limber.mechanics.elements.stress_kernels import (
    add_pull,
    add_stress,
    determinant,
    energy_density,
    small_strain,
    volume_stress,
)
from limber.mechanics.materials.laws import NEO_HOOKE, SMALL_STRAIN


class ForceLayout:
    """Elements in batches, the last axis: nodes [batch, n, LANES], gradients [batch, q, n, 3,
    LANES], weights [batch, q, LANES] for :func:`internal_force`. Padding has zero weight."""

    def __init__(self, tets: np.ndarray, gradients: np.ndarray, weights: np.ndarray):
        count = len(tets)
        self._order = np.minimum(np.arange(-(-count // LANES) * LANES), count - 1)
        padded = weights[self._order]
        padded[count:] = 0.0
        self.nodes, self.weights = lanes_last(tets[self._order]), lanes_last(padded)
        self.gradients = lanes_last(np.swapaxes(gradients, 2, 3)[self._order])

    @cached_property
    def mean_gradients(self) -> np.ndarray:
        """Mean over the quadrature points, shape [batch, n, 3, LANES]."""
        return self.gradients.mean(axis=1)

    def per_element(self, values: np.ndarray) -> np.ndarray:
        """Return one number per tetrahedron in this layout, shape [batch, LANES]."""
        return values[self._order].reshape(-1, LANES)


def lanes_last(array: np.ndarray) -> np.ndarray:
    """Return an array of elements in batches of LANES; the element is the last axis."""
    batched = array.reshape(-1, LANES, *array.shape[1:])
    return np.ascontiguousarray(np.moveaxis(batched, 1, -1))


@compiled
def internal_force(displacement, gradients, weights, lame_lambda, lame_mu, nodes, material,
                   growth, memory, force, energies):
    """Write the internal force [N] and each element's strain energy [J]; return min det F."""
    batch_count, point_count = weights.shape[0], weights.shape[1]
    node_count = nodes.shape[1]
    flat = gradients.reshape(batch_count, point_count, 3 * node_count * LANES)
    local, pull = np.empty(3 * node_count * LANES), np.empty(3 * node_count * LANES)
    F, P, E = np.empty(9 * LANES), np.empty(9 * LANES), np.empty(6 * LANES)
    energy, det = np.empty(LANES), np.empty(LANES)
    factor = growth - 1.0 if material == NEO_HOOKE else growth
    is_viscous = memory.shape[0] > 0
    force[:] = 0.0
    lowest = np.inf
    for batch in range(batch_count):
        gather(displacement, nodes[batch], local)
        lam, mu = lame_lambda[batch], lame_mu[batch]
        pull[:] = 0.0
        energy[:] = 0.0
        for q in range(point_count):
            weight = weights[batch, q]
            deformation(local, flat[batch, q], node_count, F)
            determinant(F, det)
            for l in range(LANES):
                lowest = min(lowest, det[l])
            if material == SMALL_STRAIN:
                small_strain(F, E)
            else:
                green_strain(F, E)
            P[:] = 0.0
            if material == NEO_HOOKE:
                volume_stress(F, det, lam, mu, weight, energy, P)
            else:
                energy_density(E, lam, mu, weight, energy)
            if material != NEO_HOOKE or is_viscous:
                for k in range(6 * LANES):
                    E[k] *= factor
                if is_viscous:
                    _remember(memory, batch, q, E)
                if material == SMALL_STRAIN:
                    _identity(F)
                add_stress(F, E, lam, mu, weight, P)
            for a in range(node_count):
                add_pull(P, flat[batch, q, 3 * a * LANES:], pull[3 * a * LANES:])
        count = min(LANES, len(energies) - batch * LANES)
        for l in range(count):
            energies[batch * LANES + l] = energy[l]
        _spread(pull, nodes[batch], count, force)
    return lowest


@compiled
def tangent_times(displacement, direction, gradients, weights, lame_lambda, lame_mu, nodes,
                  material, growth, memory, count, product):
    """Write the exact directional derivative of the force of ``count`` elements [N]."""
    batch_count, point_count = weights.shape[0], weights.shape[1]
    node_count = nodes.shape[1]
    flat = gradients.reshape(batch_count, point_count, 3 * node_count * LANES)
    local, change = np.empty(3 * node_count * LANES), np.empty(3 * node_count * LANES)
    pull = np.empty(3 * node_count * LANES)
    F, H, P = np.empty(9 * LANES), np.empty(9 * LANES), np.empty(9 * LANES)
    E, D = np.empty(6 * LANES), np.empty(6 * LANES)
    factor = growth - 1.0 if material == NEO_HOOKE else growth
    is_viscous = memory.shape[0] > 0
    product[:] = 0.0
    for batch in range(batch_count):
        gather(displacement, nodes[batch], local)
        gather(direction, nodes[batch], change)
        lam, mu = lame_lambda[batch], lame_mu[batch]
        pull[:] = 0.0
        for q in range(point_count):
            weight = weights[batch, q]
            if material == SMALL_STRAIN:
                _identity(F)
            else:
                deformation(local, flat[batch, q], node_count, F)
            gradient(change, flat[batch, q], node_count, H)
            P[:] = 0.0
            if material == NEO_HOOKE:
                _add_volume_change(F, H, lam, mu, weight, P)
            if material != NEO_HOOKE or is_viscous:
                # F is the identity if the material is linear, and E is then zero.
                green_strain(F, E)
                _strain_rate(F, H, D)
                for k in range(6 * LANES):
                    E[k] *= factor
                    D[k] *= factor
                if is_viscous and material != SMALL_STRAIN:
                    _remember(memory, batch, q, E)
                add_stress(H, E, lam, mu, weight, P)
                add_stress(F, D, lam, mu, weight, P)
            for a in range(node_count):
                add_pull(P, flat[batch, q, 3 * a * LANES:], pull[3 * a * LANES:])
        _spread(pull, nodes[batch], min(LANES, count - batch * LANES), product)


@compiled
def strains(displacement, gradients, nodes, material, out):
    """Write the strain at each quadrature point, shape [tet_count, q, 6] (00 11 22 01 02 12)."""
    batch_count, point_count = gradients.shape[0], gradients.shape[1]
    node_count = nodes.shape[1]
    flat = gradients.reshape(batch_count, point_count, 3 * node_count * LANES)
    local, F, E = np.empty(3 * node_count * LANES), np.empty(9 * LANES), np.empty(6 * LANES)
    for batch in range(batch_count):
        gather(displacement, nodes[batch], local)
        for q in range(point_count):
            deformation(local, flat[batch, q], node_count, F)
            if material == SMALL_STRAIN:
                small_strain(F, E)
            else:
                green_strain(F, E)
            for l in range(min(LANES, out.shape[0] - batch * LANES)):
                for k in range(6):
                    out[batch * LANES + l, q, k] = E[k * LANES + l]


@compiled
def strain_changes(displacement, direction, gradients, nodes, material, out):
    """Write the directional derivative of the strain at each quadrature point."""
    batch_count, point_count = gradients.shape[0], gradients.shape[1]
    node_count = nodes.shape[1]
    flat = gradients.reshape(batch_count, point_count, 3 * node_count * LANES)
    local, change = np.empty(3 * node_count * LANES), np.empty(3 * node_count * LANES)
    F, H, D = np.empty(9 * LANES), np.empty(9 * LANES), np.empty(6 * LANES)
    for batch in range(batch_count):
        gather(displacement, nodes[batch], local)
        gather(direction, nodes[batch], change)
        for q in range(point_count):
            if material == SMALL_STRAIN:
                _identity(F)
            else:
                deformation(local, flat[batch, q], node_count, F)
            gradient(change, flat[batch, q], node_count, H)
            _strain_rate(F, H, D)
            for l in range(min(LANES, out.shape[0] - batch * LANES)):
                for k in range(6):
                    out[batch * LANES + l, q, k] = D[k * LANES + l]


@compiled
def largest_stretch(displacement, mean_gradients, nodes):
    """Return the largest principal stretch of the mean deformation, and its element."""
    node_count = nodes.shape[1]
    flat = mean_gradients.reshape(len(nodes), 3 * node_count * LANES)
    local, F, E = np.empty(3 * node_count * LANES), np.empty(9 * LANES), np.empty(6 * LANES)
    largest, which = -1.0, 0
    for batch in range(len(nodes)):
        gather(displacement, nodes[batch], local)
        deformation(local, flat[batch], node_count, F)
        green_strain(F, E)
        for l in range(LANES):
            e01, e02, e12 = E[3 * LANES + l], E[4 * LANES + l], E[5 * LANES + l]
            mean = (E[l] + E[LANES + l] + E[2 * LANES + l]) / 3.0
            x, y, z = E[l] - mean, E[LANES + l] - mean, E[2 * LANES + l] - mean
            size = np.sqrt((x * x + y * y + z * z
                            + 2.0 * (e01 * e01 + e02 * e02 + e12 * e12)) / 6.0)
            # Upper bound of the eigenvalues.
            if not mean + 2.0 * size > largest:
                continue
            half = 0.5 * (x * (y * z - e12 * e12) - e01 * (e01 * z - e12 * e02)
                          + e02 * (e01 * e12 - y * e02))
            cosine = min(1.0, max(-1.0, half / size**3)) if size > 0.0 else 1.0
            strain = mean + 2.0 * size * np.cos(np.arccos(cosine) / 3.0)
            if strain > largest:
                largest, which = strain, batch * LANES + l
    return np.sqrt(1.0 + 2.0 * largest), which


@compiled
def sparse_times(starts, columns, values, field, product):
    """Write the product of a matrix in compressed rows and a nodal field, shape [node_count, 3]."""
    for row in range(len(starts) - 1):
        x, y, z = 0.0, 0.0, 0.0
        # Unsigned: numba checks whether a signed index counts from the end.
        for p in range(np.uint64(starts[row]), np.uint64(starts[row + 1])):
            value, node = values[p], np.uint64(columns[p])
            x += value * field[node, 0]
            y += value * field[node, 1]
            z += value * field[node, 2]
        product[row, 0], product[row, 1], product[row, 2] = x, y, z


@compiled
def _identity(F):
    F[:] = 0.0
    for l in range(LANES):
        F[l] = F[4 * LANES + l] = F[8 * LANES + l] = 1.0


@compiled
def _remember(memory, batch, q, E):
    for l in range(LANES):
        e = min(batch * LANES + l, memory.shape[0] - 1)
        for k in range(6):
            E[k * LANES + l] += memory[e, q, k]


@compiled
def _spread(pull, nodes, count, force):
    for l in range(count):
        for a in range(nodes.shape[0]):
            node = nodes[a, l]
            for i in range(3):
                force[node, i] += pull[(3 * a + i) * LANES + l]


@compiled
def _strain_rate(F, H, D):
    """Write the symmetric part of F^T H: the change of the strain as F changes by H."""
    for l in range(LANES):
        f00, f01, f02 = F[l], F[LANES + l], F[2 * LANES + l]
        f10, f11, f12 = F[3 * LANES + l], F[4 * LANES + l], F[5 * LANES + l]
        f20, f21, f22 = F[6 * LANES + l], F[7 * LANES + l], F[8 * LANES + l]
        h00, h01, h02 = H[l], H[LANES + l], H[2 * LANES + l]
        h10, h11, h12 = H[3 * LANES + l], H[4 * LANES + l], H[5 * LANES + l]
        h20, h21, h22 = H[6 * LANES + l], H[7 * LANES + l], H[8 * LANES + l]
        D[l] = f00 * h00 + f10 * h10 + f20 * h20
        D[LANES + l] = f01 * h01 + f11 * h11 + f21 * h21
        D[2 * LANES + l] = f02 * h02 + f12 * h12 + f22 * h22
        D[3 * LANES + l] = 0.5 * (f00 * h01 + f10 * h11 + f20 * h21
                                  + h00 * f01 + h10 * f11 + h20 * f21)
        D[4 * LANES + l] = 0.5 * (f00 * h02 + f10 * h12 + f20 * h22
                                  + h00 * f02 + h10 * f12 + h20 * f22)
        D[5 * LANES + l] = 0.5 * (f01 * h02 + f11 * h12 + f21 * h22
                                  + h01 * f02 + h11 * f12 + h21 * f22)


@compiled
def _add_volume_change(F, H, lam, mu, weight, P):
    """Add the change of the stable neo-Hookean stress as F changes by H."""
    for l in range(LANES):
        f00, f01, f02 = F[l], F[LANES + l], F[2 * LANES + l]
        f10, f11, f12 = F[3 * LANES + l], F[4 * LANES + l], F[5 * LANES + l]
        f20, f21, f22 = F[6 * LANES + l], F[7 * LANES + l], F[8 * LANES + l]
        h00, h01, h02 = H[l], H[LANES + l], H[2 * LANES + l]
        h10, h11, h12 = H[3 * LANES + l], H[4 * LANES + l], H[5 * LANES + l]
        h20, h21, h22 = H[6 * LANES + l], H[7 * LANES + l], H[8 * LANES + l]
        c00, c01, c02 = f11 * f22 - f12 * f21, f12 * f20 - f10 * f22, f10 * f21 - f11 * f20
        c10, c11, c12 = f02 * f21 - f01 * f22, f00 * f22 - f02 * f20, f01 * f20 - f00 * f21
        c20, c21, c22 = f01 * f12 - f02 * f11, f02 * f10 - f00 * f12, f00 * f11 - f01 * f10
        m, both = weight[l] * mu[l], weight[l] * (lam[l] + mu[l])
        p = both * (f00 * c00 + f01 * c01 + f02 * c02 - 1.0) - m
        d = both * (c00 * h00 + c01 * h01 + c02 * h02 + c10 * h10 + c11 * h11 + c12 * h12
                    + c20 * h20 + c21 * h21 + c22 * h22)
        P[l] += m * h00 + d * c00 + p * (h11 * f22 + f11 * h22 - h12 * f21 - f12 * h21)
        P[LANES + l] += m * h01 + d * c01 + p * (
            h12 * f20 + f12 * h20 - h10 * f22 - f10 * h22)
        P[2 * LANES + l] += m * h02 + d * c02 + p * (
            h10 * f21 + f10 * h21 - h11 * f20 - f11 * h20)
        P[3 * LANES + l] += m * h10 + d * c10 + p * (
            h02 * f21 + f02 * h21 - h01 * f22 - f01 * h22)
        P[4 * LANES + l] += m * h11 + d * c11 + p * (
            h00 * f22 + f00 * h22 - h02 * f20 - f02 * h20)
        P[5 * LANES + l] += m * h12 + d * c12 + p * (
            h01 * f20 + f01 * h20 - h00 * f21 - f00 * h21)
        P[6 * LANES + l] += m * h20 + d * c20 + p * (
            h01 * f12 + f01 * h12 - h02 * f11 - f02 * h11)
        P[7 * LANES + l] += m * h21 + d * c21 + p * (
            h02 * f10 + f02 * h10 - h00 * f12 - f00 * h12)
        P[8 * LANES + l] += m * h22 + d * c22 + p * (
            h00 * f11 + f00 * h11 - h01 * f10 - f01 * h10)


