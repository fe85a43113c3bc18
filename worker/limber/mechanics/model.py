"""The branch model: a mesh with its material, loads and constraints, ready for the solvers."""

import copy
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp

from limber.core.constants import GRAVITY
from limber.core.errors import InputError
from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.geometry.tets.tet_mesh import TetMesh, check_mesh, fixed_mask
from limber.kernels import for_kernels
from limber.mechanics.added_masses import PointMass, Tied, mass_entries, nodal_masses, tied
from limber.mechanics.elements import forces
from limber.mechanics.elements import shape_functions as elements
from limber.mechanics.elements.forces import ForceLayout, sparse_times
from limber.mechanics.grasp import Grasp, stiffening
from limber.mechanics.linear.equations import Equations, Viscous
from limber.mechanics.materials.laws import MaterialLaw, hooke_strain, hooke_stress, material_named
from limber.mechanics.materials.materials import (
    RayleighDamping,
    check_density,
    check_poisson,
    check_young,
    lame,
    per_tet,
)

# Quantities that a branch's mesh determines: operators, equations, masses.


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


# A rest shape prestressed by gravity: how the weight acts in later states.
#
# The scanned shape x is an equilibrium: a stress S0 in it carries the weight,
#
#     integral S0 : sym grad v = weight . v      for every displacement v from x.
#
# With x as the reference, no rest shape is needed. With the Green-Lagrange strain E(u) of the
# displacement u that a gripper causes, E = sym grad u + (grad u)^T grad u / 2, the stress is S0 + C
# : E, and the potential energy above the hanging state is
#
#     integral C : E : E / 2  +  integral S0 : E  -  weight . u
#         = strain energy of E  +  u . G u / 2,       G = integral (grad N)^T S0 grad N,
#
# since the part of S0 that is linear in u balances the weight. The only effect of the weight is the
# geometric stiffness G: a constant, symmetric matrix, the same in each of the three axes. It
# stiffens a hanging branch and softens an upright one. It does not contain Young's modulus: for any
# modulus, the branch hangs as scanned, so estimates need neither a rest shape nor its derivative.
#
# S0 is that of linear elasticity in a branch of one material. In a branch (a tree of beams)
# equilibrium alone determines the forces and moments of each section, so Young's modulus along it
# does not change them. The error is of the order of the strain that the weight causes (0.1 to 1 %).
# Tests check this for pulls of a sagging branch against the stress-free shape by inverse statics,
# from :mod:`limber.mechanics.statics.rest_shape`. Wood that grew while it hung has no stress-free
# shape at all, only S0.

_YOUNG, _POISSON = 1e9, 0.35
"""Values for a branch of one material; the modulus cancels, the ratio has almost no effect."""


@dataclass(frozen=True)
class CarriedWeight:
    """The prestress that carries a load in the scanned shape, linear in it: S0 [tet_count, q, 6]
    [Pa] (00 11 22 01 02 12), G of each axis [N/m], and the base's force [node_count, 3] [N]."""

    stress: np.ndarray
    stiffness: sp.csr_matrix
    base: np.ndarray

    def scaled(self, factor: float) -> "CarriedWeight":
        """Return the prestress that carries ``factor`` times the load."""
        return CarriedWeight(factor * self.stress, factor * self.stiffness, factor * self.base)

    def __add__(self, other: "CarriedWeight") -> "CarriedWeight":
        return CarriedWeight(self.stress + other.stress,
                             (self.stiffness + other.stiffness).tocsr(), self.base + other.base)


@dataclass(frozen=True)
class Prestress:
    """The prestress that carries the weight of a hanging branch: its own, and that of the
    ``mass_count`` added masses that hung on it when it was scanned (None: none)."""

    own: CarriedWeight
    added: CarriedWeight | None
    mass_count: int

    @cached_property
    def total(self) -> CarriedWeight:
        return self.own if self.added is None else self.own + self.added

    def with_density(self, factor: float) -> "Prestress":
        """Return the same for a branch ``factor`` times as dense."""
        return replace(self, own=self.own.scaled(factor))


def carried(model: "BranchModel") -> Prestress:
    """Return the prestress of a model that is assumed to hang in its mesh's shape.
    NotPositiveDefiniteError if the mesh cannot carry any load."""
    mesh = model.mesh
    plain = model.linear(_YOUNG, _POISSON)
    equations = plain.equations()
    tangent = equations.tangent(plain, np.zeros_like(mesh.nodes))
    if not tangent.is_positive_definite:
        raise NotPositiveDefiniteError("the stiffness of the scanned shape has no positive pivots")
    own, added = model.nodal_masses

    def carrying(load: np.ndarray) -> CarriedWeight:
        return _carried(plain, load, tangent.solve(equations.free_part(load)))

    own_load, added_load = (mass[:, None] * model.gravity for mass in (own, added))
    return Prestress(carrying(own_load), carrying(added_load) if added_load.any() else None,
                     len(model.point_masses))


def _carried(model: "BranchModel", load: np.ndarray, moved: np.ndarray) -> CarriedWeight:
    strain = model.strains(moved)
    lam, mu = lame(_YOUNG, _POISSON)
    stress = 2 * mu * strain
    stress[..., :3] += lam * strain[..., :3].sum(axis=2, keepdims=True)
    force = model.tangent_times(np.zeros_like(moved), moved)
    base = np.where(model.fixed[:, None], force - load, 0.0)
    return CarriedWeight(stress, geometric_stiffness(model, stress), base)


def geometric_stiffness(model: "BranchModel", stress: np.ndarray) -> sp.csr_matrix:
    """Return the integral of grad N_a . S grad N_b [N/m], shape [node_count, node_count]."""
    tets, count = model.mesh.tets, model.mesh.node_count
    full = stress[..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]] * model.weights[..., None, None]
    gradients = model.gradients
    blocks = np.einsum("eqia,eqij,eqjb->eab", gradients, full, gradients, optimize=True)
    width = tets.shape[1]
    rows, columns = np.repeat(tets, width, axis=1).ravel(), np.tile(tets, (1, width)).ravel()
    matrix = sp.csr_matrix((blocks.ravel(), (rows, columns)), (count, count))
    matrix.sum_duplicates()
    return matrix


# The elastic state of a branch at one displacement.


@dataclass(frozen=True)
class InternalState:
    """Internal forces [node_count, 3] [N] of one state, the gradient of ``energy`` [J], which is
    that of strain from the mesh's shape, and ``weight_energy`` of a hanging branch."""

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


_NO_MEMORY = np.zeros((0, 0, 6))
DEFAULT_DAMPING = RayleighDamping()


class BranchModel:
    """A branch of tetrahedra. It is immutable; variants share the data that the mesh determines.

    Args:
        mesh: Linear or quadratic tetrahedra, positively oriented, in one piece.
        young: Young's modulus [Pa], one number or one per tetrahedron.
        poisson: Poisson's ratio, likewise.
        density: Density [kg/m^3], likewise.
        fixed: Fixed nodes, mask [node_count] or indices; default the mesh's point data ``fixed``.
        gravity: Acceleration [m/s^2], or None.
        material: A law (:mod:`limber.mechanics.materials`), or the name of one.
        damping: Rayleigh damping, used in dynamics.
        point_masses: Added masses, and twigs (:class:`limber.mechanics.added_masses.HungTwig`).

    Attributes:
        young: Young's modulus of the material [Pa], shape [tet_count].
        stiffening: Factor on the stiffness of a tetrahedron that a gripper holds (see
            :meth:`gripped`), shape [tet_count]; 1 without a gripper.
        lame_lambda, lame_mu: Lamé coefficients [Pa] with the stiffening, shape [tet_count].
        prestress: How the mesh's shape carries the weight (:meth:`as_scanned`); None if unloaded.
        gradients, weights: Strain operators at the quadrature points, from
            :mod:`limber.mechanics.elements.shape_functions`.

    Raises:
        InputError: elements are inverted or flat, the mesh has several pieces or nodes without
            tetrahedra, too few nodes are fixed, or material values are out of range.
    """

    def __init__(self, mesh: TetMesh, *, young: float | np.ndarray, poisson: float | np.ndarray,
                 density: float | np.ndarray, fixed: np.ndarray | None = None,
                 gravity: Sequence[float] | None = GRAVITY,
                 material: str | MaterialLaw = "st_venant_kirchhoff",
                 damping: RayleighDamping = DEFAULT_DAMPING,
                 point_masses: Iterable[PointMass] = ()):
        check_mesh(mesh)
        self._data = MeshData(mesh, fixed_mask(mesh, fixed))
        self.gravity = np.zeros(3) if gravity is None else np.asarray(gravity, float)
        self.material = material_named(material)
        self.damping = damping
        self.point_masses = tuple(point_masses)
        self.prestress: Prestress | None = None
        # Not known yet: any value counts as a change.
        self.density = np.zeros(0)
        self.stiffening: np.ndarray | float = 1.0
        self._set(young, poisson, density)

    @property
    def mesh(self) -> TetMesh:
        return self._data.mesh

    @property
    def fixed(self) -> np.ndarray:
        """Whether a node is fixed, shape [node_count]."""
        return self._data.fixed

    @property
    def gradients(self) -> np.ndarray:
        return self._data.gradients

    @property
    def weights(self) -> np.ndarray:
        return self._data.weights

    @property
    def extent(self) -> float:
        """Diagonal of the bounding box [m]."""
        return self._data.extent

    @property
    def mean_edge(self) -> float:
        """Mean length of an edge [m]."""
        return self._data.edge

    def _copy(self, **changes: Any) -> "BranchModel":
        other = copy.copy(self)
        vars(other).update(changes)
        return other

    def with_young(self, young: float | np.ndarray) -> "BranchModel":
        """Return the model with another Young's modulus [Pa], sharing all unchanged data."""
        return self.with_parameters(young=young)

    def with_parameters(self, *, young: float | np.ndarray | None = None,
                        poisson: float | np.ndarray | None = None,
                        density: float | np.ndarray | None = None,
                        damping: RayleighDamping | None = None,
                        gravity: Sequence[float] | None = None) -> "BranchModel":
        """Return the model with other parameters, sharing data that depend on the mesh alone."""
        other = self._copy() if damping is None else self._copy(damping=damping)
        if gravity is not None:
            # The stress that carries the weight now is not the one that carried it during the scan.
            other.gravity, other.prestress = np.asarray(gravity, float), None
        other._set(self.young if young is None else young,
                   self.poisson if poisson is None else poisson,
                   self.density if density is None else density)
        return other

    def gripped(self, *grasps: Grasp) -> "BranchModel":
        """Return the model stiffened by these clamping grippers, and no others.

        See :mod:`limber.mechanics.grasp`. Pinned grasps, and grasps of
        which only the nodes are known, change nothing.
        """
        held = [grasp.held for grasp in grasps
                if grasp.mode == "rigid" and grasp.held is not None]
        if not held and np.ndim(self.stiffening) == 0:
            return self
        other = self._copy(stiffening=stiffening(np.max(held, axis=0)) if held else 1.0)
        other._set(self.young, self.poisson, self.density)
        return other

    def with_rest_nodes(self, nodes: np.ndarray) -> "BranchModel":
        """Return the model with other rest positions [m] of the same tetrahedra."""
        # Added masses stay with their nodes, not at their positions in space.
        masses = tuple(one.moved(nodes - self.mesh.nodes) for one in self._ties)
        return self._copy(prestress=None, _data=self._data.moved(nodes), _mass={},
                          point_masses=masses)

    def as_scanned(self) -> "BranchModel":
        """Return the model that hangs in its mesh's shape: weight acts, and is carried there.

        The weight of masses added later bends it further. See :mod:`limber.mechanics.model`.

        Raises:
            NotPositiveDefiniteError: the mesh cannot carry any load.
        """
        other = self._copy(prestress=None)
        other.prestress = carried(other)
        return other

    def linear(self, young: float, poisson: float) -> "BranchModel":
        """Return the branch of one linear material, without carried weight and grippers."""
        other = self._copy(prestress=None, stiffening=1.0, material=material_named("linear"))
        other._set(young, poisson, self.density)
        return other

    def with_material(self, material: str | MaterialLaw) -> "BranchModel":
        """Return the model with another law of the same Lamé coefficients."""
        return self._copy(material=material_named(material))

    def with_point_masses(self, masses: Iterable[PointMass]) -> "BranchModel":
        """Return the model with more added masses."""
        return self._copy(point_masses=(*self.point_masses, *masses), _mass={})

    def with_hung_mass(self, factor: float) -> "BranchModel":
        """Return the model with all added masses ``factor`` times as heavy.

        In a branch that hangs as scanned, the scanned shape carries that weight too.
        """
        masses = tuple(one.heavier(factor) for one in self.point_masses)
        other = self._copy(point_masses=masses, _mass={})
        if other.prestress is not None and other.prestress.added is not None:
            other.prestress = replace(other.prestress, added=other.prestress.added.scaled(factor))
        return other

    def without_point_masses(self) -> "BranchModel":
        """Return the model without added masses."""
        if not self.point_masses:
            return self
        # Cached as well: each step of a motion requests it when the density is estimated.
        other = self._copy(point_masses=(), _mass=self._mass.setdefault("bare", {}))
        if other.prestress is not None:
            other.prestress = replace(other.prestress, added=None, mass_count=0)
        return other

    def equations(self, grasps: Sequence[Grasp] = ()) -> Equations:
        """Return the equations with these grasps held; cached for each set of patches.

        Raises:
            InputError: a grasp is in the fixed base, or two overlap.
        """
        return self._data.equations_of(grasps)

    def internal(self, displacement: np.ndarray, *, viscous: Viscous | None = None,
                 lame_pair: tuple[np.ndarray, np.ndarray] | None = None) -> InternalState:
        """Return internal force and energy at a displacement [m], shape [node_count, 3].

        ``viscous`` is the viscous part in motion; ``lame_pair`` are Lamé coefficients instead of
        the model's, in which the force is linear, and no weight.
        """
        data = self._data
        lam, mu = lame_pair or (self.lame_lambda, self.lame_mu)
        growth, memory = (1.0, _NO_MEMORY) if viscous is None else (viscous.growth, viscous.memory)
        force, energies = np.empty((self.mesh.node_count, 3)), np.empty(self.mesh.tet_count)
        layout, of_law = data.layout, None
        if not self.material.is_compiled:
            strain = self.strains(displacement)
            of_law = (data.weights * self.material.energy(strain, lam[:, None], mu[:, None])
                      ).sum(axis=1)
            growth, memory = 0.0, self.bearing_strain(strain, viscous, lame_pair)
            lam, mu = self.lame_lambda, self.lame_mu
        det = forces.internal_force(
            for_kernels(displacement), layout.gradients, layout.weights, layout.per_element(lam),
            layout.per_element(mu), layout.nodes, memory, force, energies, self.material.kernel,
            growth)
        energies = energies if of_law is None else of_law
        if lame_pair is not None or self.weight_stiffness is None:
            return InternalState(force, energies, det)
        lifted = product_with(self.weight_stiffness, displacement)
        return InternalState(force + lifted, energies, det,
                             0.5 * float((lifted * displacement).sum()))

    def tangent_times(self, displacement: np.ndarray, direction: np.ndarray,
                      viscous: Viscous | None = None) -> np.ndarray:
        """Return the exact derivative of the internal force [N] along ``direction`` [m]."""
        growth, memory = (1.0, _NO_MEMORY) if viscous is None else (viscous.growth, viscous.memory)
        product = np.empty((self.mesh.node_count, 3))
        layout, of_change = self._data.layout, None
        if not self.material.is_compiled:
            strain = self.strains(displacement)
            growth, memory = 0.0, self.bearing_strain(strain, viscous)
            of_change = self._stress_change_force(displacement, direction, strain, viscous)
        forces.tangent_times(
            for_kernels(displacement), for_kernels(direction), layout.gradients, layout.weights,
            layout.per_element(self.lame_lambda), layout.per_element(self.lame_mu), layout.nodes,
            memory, product, self.material.kernel, growth, self.mesh.tet_count)
        if of_change is not None:
            product += of_change
        weight = self.weight_stiffness
        return product if weight is None else product + product_with(weight, direction)

    def bearing_strain(self, strain: np.ndarray, viscous: Viscous | None = None,
                       lame_pair: tuple[np.ndarray, np.ndarray] | None = None) -> np.ndarray:
        """Return the strain for which Hooke's stress is the law's at ``strain``, [tet_count, q, 6].

        The kernels take the stress of a law that is not compiled in this form. Arguments as for
        :meth:`strains` and :meth:`internal`.
        """
        if self.material.is_hookean:
            return strain if viscous is None else viscous.growth * strain + viscous.memory
        own = (self.lame_lambda[:, None], self.lame_mu[:, None])
        lam, mu = own if lame_pair is None else (lame_pair[0][:, None], lame_pair[1][:, None])
        stress = self.material.stress(strain, lam, mu)
        if viscous is not None:
            stress = stress + hooke_stress((viscous.growth - 1) * strain + viscous.memory, lam, mu)
        return hooke_strain(stress, *own)

    def _stress_change_force(self, displacement: np.ndarray, direction: np.ndarray,
                             strain: np.ndarray, viscous: Viscous | None) -> np.ndarray:
        """Return the forces [N] of the stress' change along ``direction`` [m]."""
        change = self.strain_changes(displacement, direction)
        lam, mu = self.lame_lambda[:, None], self.lame_mu[:, None]
        bearing = hooke_strain(self.material.stress_change(strain, change, lam, mu), lam, mu)
        if viscous is not None:
            bearing = bearing + (viscous.growth - 1) * change
        # With given Lamé coefficients the weight is left out.
        return self.with_material("st_venant_kirchhoff").internal(
            displacement, viscous=Viscous(0.0, bearing),
            lame_pair=(self.lame_lambda, self.lame_mu)).force

    def strains(self, displacement: np.ndarray) -> np.ndarray:
        """Return the strain at the quadrature points, [tet_count, q, 6] (00 11 22 01 02 12)."""
        data = self._data
        out = np.empty((*data.weights.shape, 6))
        forces.strains(for_kernels(displacement), data.layout.gradients, data.layout.nodes,
                       out, self.material.kernel)
        return out

    def largest_stretch(self, displacement: np.ndarray) -> tuple[float, int]:
        """Return the largest principal stretch of an element's mean deformation, and which."""
        layout = self._data.layout
        stretch = np.empty(1)
        tet = forces.largest_stretch(for_kernels(displacement), layout.mean_gradients,
                                     layout.nodes, stretch)
        return float(stretch[0]), min(tet, self.mesh.tet_count - 1)

    def largest_principal_strains(self, displacement: np.ndarray,
                                  carried: np.ndarray | None = None) -> np.ndarray:
        """Return the largest principal Green-Lagrange strain of each element, [tet_count].

        From its mean deformation, as :meth:`largest_stretch`; ``carried`` is added: the strain that
        carries the weight (:func:`limber.mechanics.strain.carried_strain`), [tet_count, 6].
        """
        layout, out = self._data.layout, np.empty(self.mesh.tet_count)
        forces.largest_principal_strains(
            for_kernels(displacement), layout.mean_gradients, layout.nodes,
            for_kernels(np.empty((0, 6)) if carried is None else carried), out)
        return out

    def strain_changes(self, displacement: np.ndarray, direction: np.ndarray) -> np.ndarray:
        """Return the derivative of :meth:`strains` along ``direction`` [m]."""
        data = self._data
        out = np.empty((*data.weights.shape, 6))
        forces.strain_changes(for_kernels(displacement), for_kernels(direction),
                              data.layout.gradients, data.layout.nodes, out, self.material.kernel)
        return out

    @property
    def weight_stiffness(self) -> sp.csr_matrix | None:
        """Geometric stiffness of the carried weight [N/m], each axis; None if none acts."""
        if self.prestress is None or self.material.is_linear:
            return None
        return self.prestress.total.stiffness

    @property
    def weight_force(self) -> np.ndarray:
        """Weight that the mesh's shape does not carry [N], shape [node_count, 3]."""
        later = self.mass_load if self.prestress is None else nodal_masses(
            self._ties[self.prestress.mass_count:], self.mesh.node_count)
        return later[:, None] * self.gravity

    @property
    def nodal_masses(self) -> tuple[np.ndarray, np.ndarray]:
        """Mass of the branch, and of the added masses, at each node [kg]: each [node_count]."""
        own = np.bincount(self.mesh.tets.ravel(),
                          (self._data.volume_weights * self.density[:, None]).ravel(),
                          self.mesh.node_count)
        return own, nodal_masses(self._ties, self.mesh.node_count)

    @property
    def mass_load(self) -> np.ndarray:
        """Mass that gravity acts on at each node [kg], consistent, shape [node_count]."""
        own, added = self.nodal_masses
        return own + added

    @property
    def total_mass(self) -> float:
        """Mass of the branch including all added masses [kg]."""
        return float(self.mass_load.sum())

    @property
    def mass_matrix(self) -> sp.csr_matrix:
        """Mass matrix [kg] for each axis, shape [node_count, node_count]."""
        if "matrix" not in self._mass:
            matrix = self._data.mass_matrix(self.density)
            self._mass["matrix"] = (matrix + mass_entries(self._ties, self.mesh.node_count)
                                    ).tocsr() if self.point_masses else matrix
        return self._mass["matrix"]

    def mass_times(self, field: np.ndarray) -> np.ndarray:
        """Return the mass matrix times a nodal field of shape [node_count, 3]."""
        return product_with(self.mass_matrix, field)

    @property
    def _ties(self) -> list[Tied]:
        if "ties" not in self._mass:
            data = self._data
            self._mass["ties"] = tied(self.mesh, self.point_masses, data.gradients, data.weights,
                                      data.volume_weights)
        return self._mass["ties"]

    def _set(self, young: float | np.ndarray, poisson: float | np.ndarray,
             density: float | np.ndarray) -> None:
        count = self.mesh.tet_count
        self.young = per_tet("Young's modulus", young, count)
        self.poisson = per_tet("Poisson's ratio", poisson, count)
        check_young(self.young)
        check_poisson(self.poisson)
        before = self.density
        changed = density is not before
        self.density = per_tet("Density", density, count)
        check_density(self.density)
        self.lame_lambda, self.lame_mu = lame(self.young * self.stiffening, self.poisson)
        if changed:
            # Shared by the models derived from this one with the same density.
            self._mass: dict[str, Any] = {}
        if changed and self.prestress is not None:
            ratio = self.density / before
            self.prestress = (self.prestress.with_density(float(ratio[0])) if np.ptp(ratio) < 1e-12
                            else carried(self))


@dataclass
class MotionState:
    """One instant, arrays [node_count, 3]. Strains now and a step earlier (or derivatives) are
    [tet_count, q, 6], empty without viscosity; ``step_before`` [s] is infinite without a state."""

    time: float
    displacement: np.ndarray
    velocity: np.ndarray
    acceleration: np.ndarray
    strain: np.ndarray
    strain_before: np.ndarray
    step_before: float = np.inf

    def rate_formula(self, dt: float) -> tuple[float, float, float]:
        """Factors [1/s] of next, current and previous strain in the rate after ``dt``: the
        second-order backward difference for unequal steps, first-order without a previous state."""
        ratio = dt / self.step_before
        return ((1 + 2 * ratio) / ((1 + ratio) * dt), -(1 + ratio) / dt,
                ratio**2 / ((1 + ratio) * dt))
