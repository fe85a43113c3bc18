"""The elastic state of a branch at one displacement."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from limber.core.numerics.compiled import for_kernels
from limber.mechanics.elements.forces import sparse_times


@dataclass(frozen=True)
class InternalState:
    """Internal forces of one state.

    Attributes:
        force: Internal force on the nodes [N], shape [node_count, 3]; the gradient of ``energy``.
        tet_energy: Strain energy of each tetrahedron relative to the mesh's shape [J], [tet_count].
        min_det_f: Smallest determinant of the deformation gradient at a quadrature point.
        weight_energy: Contribution of the weight of a hanging branch to the potential [J].
    """

    force: np.ndarray
    tet_energy: np.ndarray
    min_det_f: float
    weight_energy: float = 0.0

    @property
    def strain_energy(self) -> float:
        return float(self.tet_energy.sum())

    @property
    def energy(self) -> float:
        """Potential above the mesh's shape [J]: strain and the weight of a hanging branch."""
        return self.strain_energy + self.weight_energy


def product_with(matrix: sp.csr_matrix, field: np.ndarray) -> np.ndarray:
    """Return the product of a matrix for each axis and a nodal field of shape [node_count, 3]."""
    product = np.empty((matrix.shape[0], 3))
    sparse_times(matrix.indptr, matrix.indices, matrix.data, for_kernels(field), product)
    return product
