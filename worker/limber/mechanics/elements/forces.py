"""Kernels of internal force, energy, strain and their changes, and the layout that they take.

``worker/kernels/mechanics/forces.cpp`` has the equations and what the arguments mean. An element
may have any number of nodes and quadrature points.
"""

from functools import cached_property

import numpy as np

from limber.kernels import Kernel
from limber.mechanics.elements.stiffness import LANES


class ForceLayout:
    """Elements in batches, the last axis: nodes [batch, n, LANES], gradients [batch, q, n, 3,
    LANES], weights [batch, q, LANES] for :func:`internal_force`. Padding has zero weight."""

    def __init__(self, tets: np.ndarray, gradients: np.ndarray, weights: np.ndarray):
        count = len(tets)
        self._order = np.minimum(np.arange(-(-count // LANES) * LANES), count - 1)
        padded = weights[self._order]
        padded[count:] = 0.0
        self.nodes = lanes_last(tets[self._order].astype(np.int32))
        self.weights = lanes_last(padded)
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


_POINTS = ("gradients float64[batches, points, corners, 3, 4]",)
_NODES = ("nodes int32[batches, corners, 4]",)
_MATERIAL = ("weights float64[batches, points, 4]", "lame_lambda float64[batches, 4]",
             "lame_mu float64[batches, 4]", *_NODES, "memory float64[remembered, points, 6]")
_MEAN = ("mean_gradients float64[batches, corners, 3, 4]", *_NODES)

internal_force = Kernel(
    "internal_force", "displacement float64[nodes, 3]", *_POINTS, *_MATERIAL,
    "out force float64[nodes, 3]", "out energies float64[tets]", "material int", "growth float",
    returns="float")
"""Write the internal force [N] and each element's strain energy [J]; return the least det F."""

tangent_times = Kernel(
    "tangent_times", "displacement float64[nodes, 3]", "direction float64[nodes, 3]", *_POINTS,
    *_MATERIAL, "out product float64[nodes, 3]", "material int", "growth float", "tet_count int")
"""Write the exact directional derivative of the force of ``tet_count`` elements [N]."""

strains = Kernel(
    "strains", "displacement float64[nodes, 3]", *_POINTS, *_NODES,
    "out strains float64[tets, points, 6]", "material int")
"""Write the strain at each quadrature point (00 11 22 01 02 12)."""

strain_changes = Kernel(
    "strain_changes", "displacement float64[nodes, 3]", "direction float64[nodes, 3]", *_POINTS,
    *_NODES, "out changes float64[tets, points, 6]", "material int")
"""Write the directional derivative of the strains."""

largest_principal_strains = Kernel(
    "largest_principal_strains", "displacement float64[nodes, 3]", *_MEAN,
    "carried float64[carried, 6]", "out strains float64[tets]")
"""Write each element's largest principal Green-Lagrange strain of its mean deformation."""

largest_stretch = Kernel(
    "largest_stretch", "displacement float64[nodes, 3]", *_MEAN, "out stretch float64[1]",
    returns="int")
"""Write the largest principal stretch of the mean deformations; return its element."""

sparse_times = Kernel(
    "sparse_times", "starts int32[starts]", "columns int32[entries]", "values float64[entries]",
    "field float64[columns, 3]", "out product float64[rows, 3]")
"""Write the product of a matrix in compressed rows and a nodal field."""
