"""The linear equations of the free nodes: assembled, factorised and solved again and again."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from limber.compiled import for_kernels
from limber.mechanics.elements.stiffness import tangent_stiffness
from limber.mechanics.grasp import Grasp
from limber.mechanics.linear.factor import NotPositiveDefiniteError, make_factor
from limber.mechanics.linear.pattern import LaneLayout, Pattern
from limber.mechanics.materials import Material

if TYPE_CHECKING:
    from limber.mechanics.model import BranchModel

_NO_INCREMENT = np.zeros((0, 3))
_NO_MEMORY = np.zeros((0, 0, 6, 0))
_FIRST_SHIFT = 1e-7
_LAST_SHIFT = 1.0


@dataclass(frozen=True)
class Viscous:
    """Viscous stress in motion: the stress is that of the strain ``growth * E + memory``.

    Attributes:
        growth: 1 plus the damping factor times the rate of the strain per strain.
        memory: What the strains before contribute, shape [tet_count, q, 6].
    """

    growth: float
    memory: np.ndarray


class Equations:
    """Stiffness equations for one set of constraints; shared by models of one mesh.

    Fixed nodes and those of clamped grasps are left out. A pinned grasp prescribes the mean of
    its patch: three Lagrange multipliers, on top of a stiffness that is augmented by the outer
    product of the mean's weights. That changes no solution, and makes the matrix positive
    definite wherever the constrained problem is.

    Attributes:
        held: Whether a node is fixed or clamped, shape [node_count].
        pinned: The pinned grasps.
        factorisation_count: Numeric factorisations so far.
    """

    def __init__(self, tets: np.ndarray, gradients: np.ndarray, weights: np.ndarray,
                 fixed: np.ndarray, grasps: Sequence[Grasp]):
        self.held = fixed.copy()
        for grasp in grasps:
            if grasp.mode == "clamped":
                self.held[grasp.nodes] = True
        self.pinned = [grasp for grasp in grasps if grasp.mode == "pinned"]
        self.pattern = Pattern(tets, len(fixed), ~self.held, [g.nodes for g in self.pinned])
        self.layout = LaneLayout(self.pattern, tets, gradients, weights)
        self.factorisation_count = 0
        self._factor = make_factor(self.pattern)
        self._values = self.pattern.scratch_values()
        self._mass: tuple[object, np.ndarray] | None = None
        self._pin_entries = [self._entries_of(grasp) for grasp in self.pinned]
        self._pin_rows = np.zeros((self.pattern.size, 3 * len(self.pinned)))
        for number, grasp in enumerate(self.pinned):
            rows = 3 * self.pattern.position[grasp.nodes]
            for axis in range(3):
                self._pin_rows[rows + axis, 3 * number + axis] = grasp.weights
        self._pin_solutions = np.zeros_like(self._pin_rows)

    def placed(self, tets: np.ndarray, gradients: np.ndarray, weights: np.ndarray) -> "Equations":
        """Return the equations of the same tetrahedra elsewhere; pattern and factor are shared."""
        other = copy.copy(self)
        other.layout = LaneLayout(self.pattern, tets, gradients, weights)
        other._mass = None
        return other

    def assemble(self, model: "BranchModel", displacement: np.ndarray, *,
                 increment: np.ndarray | None = None, viscous: Viscous | None = None,
                 mass_factor: float = 0.0) -> None:
        """Assemble tangent stiffness plus ``mass_factor`` [1/s^2] times the mass.

        Args:
            increment: The last increment [m], for mixed-point Newton (StVK only).
            viscous: Viscous part in motion.
        """
        if mass_factor:
            np.multiply(self._mass_values(model), mass_factor, out=self._values)
        else:
            self._values[:] = 0.0
        layout = self.layout
        lam, mu = layout.per_element(model.lame_lambda), layout.per_element(model.lame_mu)
        growth, memory = 1.0, _NO_MEMORY
        if viscous is not None:
            growth, memory = viscous.growth, layout.per_point(viscous.memory)
        mixed = increment is not None and model.material == Material.st_venant_kirchhoff
        tangent_stiffness(for_kernels(displacement),
                          for_kernels(increment) if mixed else _NO_INCREMENT,
                          layout.gradients, layout.weights, lam, mu, layout.nodes,
                          int(model.material), growth, memory, layout.slots, layout.lengths,
                          self._values)
        self._add_pins()

    def factorise(self) -> bool:
        """Factorise what was assembled; return whether it was positive definite.

        If it was not, the diagonal is raised until it is: the solution is then still a descent
        direction of the energy, but not Newton's.
        """
        values = self._values[:self.pattern.value_count]
        scale = np.abs(values[self.pattern.diagonal]).mean()
        shift = 0.0
        while True:
            self.factorisation_count += 1
            try:
                self._factor.factorise(values)
            except NotPositiveDefiniteError:
                raised = max(10 * shift, _FIRST_SHIFT)
                if raised > _LAST_SHIFT or not np.isfinite(scale):
                    raise
                values[self.pattern.diagonal] += (raised - shift) * scale
                shift = raised
                continue
            break
        if self.pinned:
            self._pin_solutions = self._factor.solve(self._pin_rows)
        return shift == 0.0

    def raise_diagonal(self, part: float) -> float:
        """Add ``part`` of the mean diagonal to what was assembled; return what was added [N/m]."""
        values = self._values[:self.pattern.value_count]
        added = part * float(np.abs(values[self.pattern.diagonal]).mean())
        values[self.pattern.diagonal] += added
        return added

    def solve(self, right: np.ndarray, pin_moves: np.ndarray | None = None) -> np.ndarray:
        """Return the displacement [node_count, 3], 0 at held nodes, for forces ``right``.

        Args:
            right: Forces [N] on all nodes, shape [node_count, 3]; those on held nodes are left
                out.
            pin_moves: Prescribed means of the pinned patches [m], shape [pinned, 3]; default 0.
        """
        free = right[self.pattern.order].ravel()
        solution = self._factor.solve(free)
        if self.pinned:
            moves = 0.0 if pin_moves is None else np.ravel(pin_moves)
            compliance = self._pin_rows.T @ self._pin_solutions
            excess = self._pin_rows.T @ solution - moves
            solution = solution - self._pin_solutions @ np.linalg.solve(compliance, excess)
        result = np.zeros_like(right)
        result[self.pattern.order] = solution.reshape(-1, 3)
        return result

    def free_part(self, force: np.ndarray) -> np.ndarray:
        """Return forces without what the constraints bear: held nodes, means of pinned patches."""
        rest = np.where(self.held[:, None], 0.0, force)
        for grasp, reaction in zip(self.pinned, self.pin_forces(force), strict=True):
            rest[grasp.nodes] -= grasp.weights[:, None] * reaction
        return rest

    def pin_forces(self, force: np.ndarray) -> np.ndarray:
        """Return the force [N] that each pinned grasp takes of nodal forces, shape [pinned, 3]."""
        return np.array([grasp.weights @ force[grasp.nodes] / (grasp.weights @ grasp.weights)
                         for grasp in self.pinned]).reshape(-1, 3)

    def diagonal_norm(self) -> float:
        """Return the 2-norm of the assembled diagonal [N/m]."""
        return float(np.linalg.norm(self._values[self.pattern.diagonal]))

    def factorise_mass(self, model: "BranchModel") -> None:
        """Factorise the mass matrix, for accelerations at the start."""
        self._values[:] = self._mass_values(model)
        self._add_pins()
        self.factorise()

    def _mass_values(self, model: "BranchModel") -> np.ndarray:
        matrix = model.mass_matrix
        if self._mass is None or self._mass[0] is not matrix:
            entries = matrix.tocoo()
            lower = self.pattern.position[entries.row] >= self.pattern.position[entries.col]
            row, column, mass = entries.row[lower], entries.col[lower], entries.data[lower]
            where = self.pattern.scalar_entries(row, column)
            values = np.bincount(where.ravel(), np.repeat(mass, 3), len(self._values))
            self._mass = (matrix, values)
        return self._mass[1]

    def _entries_of(self, grasp: Grasp) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        later, earlier = np.tril_indices(len(grasp.nodes))
        where = self.pattern.scalar_entries(grasp.nodes[later], grasp.nodes[earlier])
        product = grasp.weights[later] * grasp.weights[earlier]
        own = self.pattern.scalar_entries(grasp.nodes, grasp.nodes)
        return where.ravel(), np.repeat(product, 3), own.ravel()

    def _add_pins(self) -> None:
        for where, product, own in self._pin_entries:
            penalty = 10.0 * np.abs(self._values[own]).sum() / 3
            np.add.at(self._values, where, penalty * product)
