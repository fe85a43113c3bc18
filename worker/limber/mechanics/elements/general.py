"""The stiffness for the moduli of any law, LANES elements at a time.

Stress needs no kernel of its own: Hooke's kernels take the stress of any law as the corresponding
strain (BranchModel.bearing_strain). Moduli of 21 numbers per point take about five times as long as
Hooke's two; a law's own formulas in numpy take longer than both.
"""

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.mechanics.elements.stiffness import LANES, deformation, gather, scatter_block


@compiled
def moduli_stiffness(displacement: np.ndarray, gradients: np.ndarray, weights: np.ndarray,
                     moduli: np.ndarray, nodes: np.ndarray, slots: np.ndarray,
                     lengths: np.ndarray, values: np.ndarray) -> None:
    """Add the integral of B^T C B [N/m] of all elements to ``values``; B gives the strain's change.

    An element may have any number of nodes.

    Args:
        moduli: C by rows, 00 11 22 and shear angles 01 02 12 [Pa], shape [batch, q, 36, LANES].
        displacement, gradients, weights, nodes, slots, lengths, values: See
            limber.mechanics.elements.stiffness.
    """
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
