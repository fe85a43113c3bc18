"""The linear equations of the free nodes, assembled repeatedly; each assembly gives a tangent."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from limber.core.numerics.sparse import (
    CholmodFactor,
    NotPositiveDefiniteError,
    SuperLuFactor,
    general_factor,
    little_fill,
)
from limber.kernels import for_kernels
from limber.mechanics.elements.forces import lanes_last
from limber.mechanics.elements.stiffness import LANES, moduli_stiffness, tangent_stiffness
from limber.mechanics.grasp import Grasp
from limber.mechanics.linear.fronts import make_fronts, postordered
from limber.mechanics.linear.supernodal import SupernodalFactor

if TYPE_CHECKING:
    from limber.mechanics.model import BranchModel

# Factorisation of a symmetric matrix with a fixed pattern and changing values.
#
# Limber's own supernodal factor is made for slender branches. For the dense kernels of bulky meshes
# a general library is used (:mod:`limber.core.numerics.sparse`).

_MOST_FLOPS = 1e11
"""Most operations of a factorisation that Limber's own loops do. At 1.5e10 they are still 1.7 times
as fast as CHOLMOD, whose fraction of fast dense kernels grows with the fronts.
"""


Factor = SupernodalFactor | CholmodFactor | SuperLuFactor


def make_factor(pattern: "Pattern") -> Factor:
    """Return the faster factor for a pattern."""
    fronts = make_fronts(pattern.node_starts, pattern.node_rows)
    if fronts.flops <= _MOST_FLOPS:
        return SupernodalFactor(fronts)
    # The elimination order is Limber's own, found once on nodes instead of rows.
    return general_factor(*pattern.entries(), pattern.size)


def elimination_order(graph: sp.csr_matrix) -> np.ndarray:
    """Return an order of nodes (new to old) of little fill for a symmetric pattern [n, n]. Each
    subtree is a contiguous run (postorder)."""
    return postordered(graph, little_fill(graph))


# Elimination order, sparsity pattern and vector layout of the elements' stiffness.

_SCRATCH = 9
"""Length of the scratch space behind the values for entries of constrained nodes."""


class Pattern:
    """Lower triangle by columns of the free nodes' stiffness, three rows a node. ``cliques`` are
    more coupled nodes (pinned patches); ``position`` in ``order`` is -1 if constrained."""

    def __init__(self, tets: np.ndarray, node_count: int, free: np.ndarray,
                 cliques: Sequence[np.ndarray] = ()):
        graph = _node_graph(tets, node_count, cliques)
        kept = np.flatnonzero(free)
        self.order = kept[elimination_order(graph[kept][:, kept])]
        self.position = np.full(node_count, -1)
        self.position[self.order] = np.arange(len(self.order))
        lower = sp.tril(graph[self.order][:, self.order]).tocsc()
        lower.sort_indices()
        count = np.diff(lower.indptr)
        self.node_starts, self.node_rows = lower.indptr, lower.indices
        self._keys = np.repeat(np.arange(len(count)), count) * node_count + lower.indices
        self.length = 3 * count
        self.start = np.concatenate([[0], np.cumsum(9 * count - 3)])
        self.value_count = int(self.start[-1])
        begin = self.start[:-1]
        self.diagonal = np.stack([begin, begin + self.length, begin + 2 * self.length - 1],
                                 axis=1).ravel()

    @property
    def size(self) -> int:
        """Number of equations."""
        return 3 * len(self.order)

    def scratch_values(self) -> np.ndarray:
        """Return zeros for the values, including the scratch space behind them."""
        return np.zeros(self.value_count + _SCRATCH)

    def slots(self, first: np.ndarray, second: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """Return, for pairs of nodes, the start of their block and that column's length."""
        one, two = self.position[first], self.position[second]
        row, column = np.maximum(one, two), np.minimum(one, two)
        inside = column >= 0
        key = np.where(inside, column * len(self.position) + row, self._keys[0])
        found = np.searchsorted(self._keys, key)
        safe = np.where(inside, column, 0)
        slot = self.start[safe] + 3 * (found - self.node_starts[safe])
        return (np.where(inside, slot, self.value_count),
                np.where(inside, self.length[safe], 4))

    def scalar_entries(self, first: np.ndarray, second: np.ndarray) -> np.ndarray:
        """Return the positions of entries xx, yy and zz of pairs of nodes, shape [..., 3]."""
        slot, length = self.slots(first, second)
        return np.stack([slot, slot + length, slot + 2 * length - 1], axis=-1)

    def entries(self) -> tuple[np.ndarray, np.ndarray]:
        """Return row and column of each value."""
        rows = np.empty(self.value_count, np.int64)
        columns = np.empty(self.value_count, np.int64)
        block_column = np.repeat(np.arange(len(self.length)), np.diff(self.node_starts))
        rank = np.arange(len(self.node_rows)) - self.node_starts[block_column]
        for j in range(3):
            base = (self.start[block_column] + j * self.length[block_column]
                    - (1 if j == 2 else 0) + 3 * rank - j)
            for i in range(3):
                keep = (rank > 0) | (i >= j)
                rows[base[keep] + i] = 3 * self.node_rows[keep] + i
                columns[base[keep] + i] = 3 * block_column[keep] + j
        return rows, columns


class LaneLayout:
    """Elements in batches, the last axis, earlier eliminated nodes first: nodes [batch, n, LANES],
    gradients [batch, q, n, 3, LANES], weights [batch, q, LANES], slots and lengths [batch, pairs,
    LANES] for the kernel. Pair (a, b <= a) has number a (a+1)/2 + b."""

    def __init__(self, pattern: Pattern, tets: np.ndarray, gradients: np.ndarray,
                 weights: np.ndarray):
        position = pattern.position[tets]
        turn = np.argsort(position, axis=1, kind="stable")
        # Neighbours in the elimination order are neighbours in memory.
        order = np.argsort(position.max(axis=1), kind="stable")
        padding = -len(order) % LANES
        self._order = np.concatenate([order, np.repeat(order[-1:], padding)])
        self._real = len(order)
        self._turn = turn = turn[self._order]
        nodes = np.take_along_axis(tets[self._order], turn, axis=1)
        self.nodes = lanes_last(nodes.astype(np.int32))
        self._place(gradients, weights)
        later, earlier = np.tril_indices(tets.shape[1])
        slots, lengths = pattern.slots(nodes[:, later], nodes[:, earlier])
        self.slots = lanes_last(slots.astype(np.int32))
        self.lengths = lanes_last(lengths.astype(np.int32))

    def moved(self, gradients: np.ndarray, weights: np.ndarray) -> "LaneLayout":
        """Return the layout of the same tetrahedra at other positions."""
        other = copy.copy(self)
        other._place(gradients, weights)
        return other

    def _place(self, gradients: np.ndarray, weights: np.ndarray) -> None:
        weights = weights[self._order].copy()
        weights[self._real:] = 0.0
        self.weights = lanes_last(weights)
        self.gradients = lanes_last(np.swapaxes(np.take_along_axis(
            gradients[self._order], self._turn[:, None, None, :], axis=3), 2, 3))

    def per_element(self, values: np.ndarray) -> np.ndarray:
        """Return one number per tetrahedron in this layout, shape [batch, LANES]."""
        return values[self._order].reshape(-1, LANES)

    def per_point(self, values: np.ndarray) -> np.ndarray:
        """Return values [tet_count, q, k] in this layout, shape [batch, q, k, LANES]."""
        return lanes_last(values[self._order])


def _node_graph(tets: np.ndarray, node_count: int, cliques: Sequence[np.ndarray]) -> sp.csr_matrix:
    per_tet = tets.shape[1]
    nodes = np.concatenate([tets.ravel(), *(np.asarray(c).ravel() for c in cliques)])
    sizes = np.concatenate([np.full(len(tets), per_tet), [len(c) for c in cliques]]).astype(int)
    groups = np.repeat(np.arange(len(sizes)), sizes)
    incidence = sp.csr_matrix((np.ones(len(nodes), np.float32), (groups, nodes)),
                              shape=(len(sizes), node_count))
    return (incidence.T @ incidence).tocsr()


_NO_INCREMENT = np.zeros((0, 3))
_NO_MEMORY = np.zeros((0, 0, 6, 0))
_FIRST_SHIFT = 1e-7
_LAST_SHIFT = 1.0
"""Terms added to the diagonal, tenfold each time, until the matrix is positive definite, as
fractions of its mean: from just above round-off to a different matrix.
"""


@dataclass(frozen=True)
class Viscous:
    """Viscous stress: that of the strain ``growth * E + memory``. Growth is 1 plus damping times
    the rate's derivative by the strain; memory [tet_count, q, 6] is from earlier strains."""

    growth: float
    memory: np.ndarray


class Tangent:
    """A factorised stiffness, perhaps with inertia; its memory returns when nothing refers to it.
    If not positive definite as assembled, the diagonal was raised: solutions are still descent
    directions, but not Newton's. ``diagonal_norm`` and ``drag``, added on purpose, are in N/m."""

    def __init__(self, equations: "Equations", factor: Factor, values: np.ndarray, drag: float):
        self.equations, self._factor = equations, factor
        diagonal = equations.pattern.diagonal
        self.drag = 0.0
        if drag:
            self.drag = drag * float(np.abs(values[diagonal]).mean())
            values[diagonal] += self.drag
        self.is_positive_definite = self._factorise(values, diagonal)
        self.diagonal_norm = float(np.linalg.norm(values[diagonal]))

    def __del__(self) -> None:
        self.equations.take_back(self._factor)

    def _factorise(self, values: np.ndarray, diagonal: np.ndarray) -> bool:
        scale = np.abs(values[diagonal]).mean()
        shift = 0.0
        while True:
            self.equations.factorisation_count += 1
            try:
                self._factor.factorise(values)
            except NotPositiveDefiniteError:
                raised = max(10 * shift, _FIRST_SHIFT)
                if raised > _LAST_SHIFT or not np.isfinite(scale):
                    raise
                values[diagonal] += (raised - shift) * scale
                shift = raised
                continue
            return shift == 0.0

    @cached_property
    def _pin_halves(self) -> np.ndarray:
        # Computed on demand: many tangents are only checked for stability.
        factor = self._factor
        if not isinstance(factor, SupernodalFactor):
            raise TypeError(f"{type(factor).__name__} cannot solve in two halves.")
        return factor.down(self.equations.pin_rows)

    @cached_property
    def _pin_solutions(self) -> np.ndarray:
        return self._factor.solve(self.equations.pin_rows)

    def solve(self, right: np.ndarray, pin_moves: np.ndarray | None = None) -> np.ndarray:
        """Return the displacement [node_count, 3], 0 at held nodes, for forces ``right`` [N],
        ignored there, and means of the pinned patches [pinned, 3] [m] (None: 0)."""
        return self.solve_all([right], pin_moves)[0]

    def solve_all(self, rights: Sequence[np.ndarray], pin_moves: np.ndarray | None = None,
                  ) -> list[np.ndarray]:
        """Return displacements for several forces, each as in :meth:`solve`; ``pin_moves`` as
        there, or one set a force, [3 pinned, S]."""
        equations = self.equations
        order = equations.pattern.order
        forces = np.stack([right[order].ravel() for right in rights], axis=1)
        if equations.pinned:
            moves = 0.0 if pin_moves is None else np.reshape(
                pin_moves, (3 * len(equations.pinned), -1))
            solutions = self._solve_pinned(forces, moves)
        else:
            solutions = self._factor.solve(forces)
        results = []
        for right, solution in zip(rights, solutions.T, strict=True):
            result = np.zeros_like(right)
            result[order] = solution.reshape(-1, 3)
            results.append(result)
        return results

    def _solve_pinned(self, forces: np.ndarray, moves: np.ndarray | float) -> np.ndarray:
        """Return the solutions [size, S] for ``forces``, with the pinned means ``moves``."""
        factor, rows = self._factor, self.equations.pin_rows
        if not isinstance(factor, SupernodalFactor):
            solutions, pins = factor.solve(forces), self._pin_solutions
            return solutions - pins @ np.linalg.solve(rows.T @ pins, rows.T @ solutions - moves)
        # The multipliers follow from the forward substitution; the backward one is then done once
        # for all.
        half, pins = factor.down(forces), self._pin_halves
        return factor.up(half - pins @ np.linalg.solve(pins.T @ pins, pins.T @ half - moves))


class Equations:
    """Stiffness equations for one set of constraints, shared by a mesh's models. Fixed and clamped
    nodes are eliminated; a pinned mean has three multipliers, on a stiffness plus its weights'
    outer product. This changes no solution, and is positive definite wherever the problem is."""

    def __init__(self, tets: np.ndarray, gradients: np.ndarray, weights: np.ndarray,
                 fixed: np.ndarray, grasps: Sequence[Grasp]):
        self.held = fixed.copy()
        for grasp in grasps:
            if grasp.mode == "rigid":
                self.held[grasp.nodes] = True
        self.pinned = [grasp for grasp in grasps if grasp.mode == "point"]
        self.pattern = Pattern(tets, len(fixed), ~self.held, [g.nodes for g in self.pinned])
        self.layout = LaneLayout(self.pattern, tets, gradients, weights)
        self.factorisation_count = 0
        # Unused factorisations; their memory and symbolic part are reused.
        self._spare: list[Factor] = [make_factor(self.pattern)]
        self._twin = self._spare[0].twin
        self._known: tuple[BranchModel, np.ndarray, Tangent] | None = None
        self._values = self.pattern.scratch_values()
        self._axes: dict[str, tuple[sp.csr_matrix, np.ndarray]] = {}
        self._pin_entries = [self._entries_of(grasp) for grasp in self.pinned]
        self.pin_rows = np.zeros((self.pattern.size, 3 * len(self.pinned)))
        for number, grasp in enumerate(self.pinned):
            rows = 3 * self.pattern.position[grasp.nodes]
            for axis in range(3):
                self.pin_rows[rows + axis, 3 * number + axis] = grasp.weights

    def placed(self, gradients: np.ndarray, weights: np.ndarray) -> "Equations":
        """Return the equations of the same tetrahedra at other positions, with shared pattern."""
        other = copy.copy(self)
        other.layout = self.layout.moved(gradients, weights)
        other._axes, other._known = {}, None
        return other

    def exact_tangent(self, model: "BranchModel", displacement: np.ndarray) -> Tangent:
        """Return the tangent at a state, and keep it: a solve's check of stability, its derivatives
        and the next solve need it. NotPositiveDefiniteError as for :meth:`tangent`."""
        known = self._known
        if known is None or known[0] is not model or not np.array_equal(known[1], displacement):
            tangent = self.tangent(model, displacement)
            known = self._known = (model, displacement.copy(), tangent)
        return known[2]

    def tangent(self, model: "BranchModel", displacement: np.ndarray, *,
                increment: np.ndarray | None = None, strain: np.ndarray | None = None,
                viscous: Viscous | None = None, mass_factor: float = 0.0,
                drag: float = 0.0) -> Tangent:
        """Return the tangent with ``mass_factor`` [1/s^2] times the mass, factorised. Mixed-point
        Newton takes ``increment`` [m], ``strain`` [tet_count, q, 6] sets the geometric stress (St.
        Venant-Kirchhoff). NotPositiveDefiniteError if no raised diagonal helps."""
        # Its memory is reused for the new one.
        self._known = None
        return self.factorised(self.assemble(
            model, displacement, increment=increment, strain=strain, viscous=viscous,
            mass_factor=mass_factor), drag)

    def mass(self, model: "BranchModel") -> Tangent:
        """Return the factorised mass matrix, for accelerations at the start."""
        self._values[:] = self._mass_values(model)
        self._add_pins()
        return self.factorised(self._values[:self.pattern.value_count])

    def factorised(self, values: np.ndarray, drag: float = 0.0) -> Tangent:
        """Return the tangent of ``values`` from :meth:`assemble`; the diagonal is raised in place
        if needed."""
        factor = self._spare.pop() if self._spare else self._twin()
        return Tangent(self, factor, values, drag)

    def take_back(self, factor: Factor) -> None:
        """Keep the memory of an unused tangent for the next one."""
        self._spare.append(factor)

    def assemble(self, model: "BranchModel", displacement: np.ndarray, *,
                 increment: np.ndarray | None = None, strain: np.ndarray | None = None,
                 viscous: Viscous | None = None, mass_factor: float = 0.0) -> np.ndarray:
        """Return the matrix of :meth:`tangent`, lower triangle by columns, shape [value_count]. All
        assembly of these equations writes to the same memory."""
        if mass_factor:
            np.multiply(self._mass_values(model), mass_factor, out=self._values)
        else:
            self._values[:] = 0.0
        if model.weight_stiffness is not None:
            self._values += self._axis_values("weight", model.weight_stiffness)
        layout = self.layout
        lam, mu = layout.per_element(model.lame_lambda), layout.per_element(model.lame_mu)
        growth, memory = 1.0, _NO_MEMORY
        if viscous is not None:
            growth, memory = viscous.growth, layout.per_point(viscous.memory)
        elif strain is not None:
            memory = layout.per_point(strain - model.strains(displacement))
        mixed = _NO_INCREMENT
        law = model.material
        if increment is not None and law.has_cubic_force:
            mixed = for_kernels(increment)
        if not law.is_compiled:
            growth, memory = self._add_moduli(model, displacement, viscous)
        tangent_stiffness(for_kernels(displacement), mixed, layout.gradients, layout.weights,
                          lam, mu, layout.nodes, memory, layout.slots, layout.lengths, self._values,
                          law.kernel, growth)
        self._add_pins()
        return self._values[:self.pattern.value_count]

    def _add_moduli(self, model: "BranchModel", displacement: np.ndarray,
                    viscous: Viscous | None) -> tuple[float, np.ndarray]:
        """Add the stiffness for a law's own moduli. Return growth and memory for which Hooke's
        kernel adds the law's stress and viscosity."""
        layout, strain = self.layout, model.strains(displacement)
        moduli = model.material.moduli(strain, model.lame_lambda[:, None], model.lame_mu[:, None])
        moduli_stiffness(for_kernels(displacement), layout.gradients, layout.weights,
                         layout.per_point(moduli.reshape(*strain.shape[:2], -1)), layout.nodes,
                         layout.slots, layout.lengths, self._values)
        growth = 0.0 if viscous is None else viscous.growth - 1
        return growth, layout.per_point(model.bearing_strain(strain, viscous) - growth * strain)

    def free_part(self, force: np.ndarray) -> np.ndarray:
        """Return forces less what constraints carry: held nodes, means of pinned patches."""
        rest = np.where(self.held[:, None], 0.0, force)
        for grasp, reaction in zip(self.pinned, self.pin_forces(force), strict=True):
            rest[grasp.nodes] -= grasp.weights[:, None] * reaction
        return rest

    def pin_forces(self, force: np.ndarray) -> np.ndarray:
        """Return the nodal forces [N] that each pinned grasp carries, shape [pinned, 3]."""
        return np.array([grasp.weights @ force[grasp.nodes] / (grasp.weights @ grasp.weights)
                         for grasp in self.pinned]).reshape(-1, 3)

    def _mass_values(self, model: "BranchModel") -> np.ndarray:
        return self._axis_values("mass", model.mass_matrix)

    def _axis_values(self, name: str, matrix: sp.csr_matrix) -> np.ndarray:
        """Return a matrix that is equal in each axis, in the pattern; cached until it changes."""
        if name not in self._axes or self._axes[name][0] is not matrix:
            entries = matrix.tocoo()
            lower = self.pattern.position[entries.row] >= self.pattern.position[entries.col]
            row, column, part = entries.row[lower], entries.col[lower], entries.data[lower]
            where = self.pattern.scalar_entries(row, column)
            values = np.bincount(where.ravel(), np.repeat(part, 3), len(self._values))
            self._axes[name] = (matrix, values)
        return self._axes[name][1]

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
