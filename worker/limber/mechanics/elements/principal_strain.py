"""The largest principal strain of every element, for colours and limits at interactive rates."""

import numpy as np

from limber.core.numerics.compiled import compiled
from limber.mechanics.elements.stiffness import deformation, gather, green_strain
from limber.mechanics.elements.stiffness_pairs import LANES


@compiled
def largest_principal_strains(displacement, mean_gradients, nodes, carried, out):
    """Write each element's largest principal Green-Lagrange strain of its mean deformation.

    Args:
        displacement: [m], shape [node_count, 3].
        mean_gradients, nodes: From limber.mechanics.elements.forces.ForceLayout.
        carried: Strain of each element in the mesh's shape, [tet_count, 6] (00 11 22 01 02 12), or
            no rows.
        out: Shape [tet_count].
    """
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
