"""Quantities that a branch's mesh determines: operators, equations, masses."""

import copy
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from limber.core.errors import InputError
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.elements import shape_functions as elements
from limber.mechanics.elements.forces import ForceLayout
from limber.mechanics.grasp import Grasp
from limber.mechanics.linear.equations import Equations


class MeshData:
    """Quantities that depend on the mesh only; shared by all its models."""

    def __init__(self, mesh: TetMesh, fixed: np.ndarray):
        self.fixed = fixed
        self.equations: dict[tuple, Equations] = {}
        self._set_mesh(mesh)

    def _set_mesh(self, mesh: TetMesh) -> None:
        self.mesh = mesh
        self.tets = np.ascontiguousarray(mesh.tets, np.int32)
        self.rule = elements.stiffness_quadrature(mesh)
        self.gradients, self.weights = elements.element_gradients(mesh, self.rule)
        self.layout = ForceLayout(self.tets, self.gradients, self.weights)
        self.volume_weights = elements.volume_weights(mesh)
        edge = mesh.nodes[mesh.tets[:, 1]] - mesh.nodes[mesh.tets[:, 0]]
        self.edge = float(np.linalg.norm(edge, axis=1).mean())
        self.extent = float(np.linalg.norm(np.ptp(mesh.nodes, axis=0)))

    def __getstate__(self) -> dict[str, object]:
        # Another process makes its own equations: their factors hold compiled memory.
        return {**vars(self), "equations": {}}

    def moved(self, nodes: np.ndarray) -> "MeshData":
        """Return the data of the mesh with other node positions; patterns are shared."""
        other = copy.copy(self)
        other._set_mesh(replace(self.mesh, nodes=nodes))
        other.equations = {key: equations.placed(other.gradients, other.weights)
                           for key, equations in self.equations.items()}
        return other

    def mass_matrix(self, density: np.ndarray) -> sp.csr_matrix:
        """Return the mass matrix [kg] of each axis for densities [kg/m^3], shape [tet_count]."""
        consistent, _ = elements.node_weights(self.mesh)
        tets, n = self.mesh.tets, self.mesh.node_count
        per_tet = tets.shape[1]
        rows = np.repeat(tets, per_tet, axis=1).ravel()
        columns = np.tile(tets, (1, per_tet)).ravel()
        return sp.csr_matrix(((consistent * density[:, None, None]).ravel(), (rows, columns)),
                             (n, n))

    def equations_of(self, grasps: Sequence[Grasp]) -> Equations:
        """As :meth:`limber.mechanics.model.BranchModel.equations`."""
        key = tuple(grasp.key() for grasp in grasps)
        if key not in self.equations:
            self._check_grasps(grasps)
            self.equations[key] = Equations(self.tets, self.gradients, self.weights, self.fixed,
                                            grasps)
        return self.equations[key]

    def _check_grasps(self, grasps: Sequence[Grasp]) -> None:
        taken = self.fixed.copy()
        for grasp in grasps:
            if taken[grasp.nodes].any():
                where = "the fixed base" if self.fixed[grasp.nodes].any() else "another grasp"
                raise InputError(f"A grasp overlaps {where}.",
                                 "A node cannot follow two masters.",
                                 "Move the grasp, or reduce its radius.")
            taken[grasp.nodes] = True
        if taken.all():
            raise InputError("Every node is fixed or grasped.", "No free node remains to compute.",
                             "Use a smaller grasp or a finer mesh.")
