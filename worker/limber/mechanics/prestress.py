"""A rest shape prestressed by gravity: how the weight acts in later states.

The scanned shape x is an equilibrium: a stress S0 in it carries the weight,

    integral S0 : sym grad v = weight . v      for every displacement v from x.

With x as the reference, no rest shape is needed. With the Green-Lagrange strain E(u) of the
displacement u that a gripper causes, E = sym grad u + (grad u)^T grad u / 2, the stress is S0 + C :
E, and the potential energy above the hanging state is

    integral C : E : E / 2  +  integral S0 : E  -  weight . u
        = strain energy of E  +  u . G u / 2,       G = integral (grad N)^T S0 grad N,

since the part of S0 that is linear in u balances the weight. The only effect of the weight is the
geometric stiffness G: a constant, symmetric matrix, the same in each of the three axes. It stiffens
a hanging branch and softens an upright one. It does not contain Young's modulus: for any modulus,
the branch hangs as scanned, so estimates need neither a rest shape nor its derivative.

S0 is that of linear elasticity in a branch of one material. In a branch (a tree of beams)
equilibrium alone determines the forces and moments of each section, so Young's modulus along it
does not change them. The error is of the order of the strain that the weight causes (0.1 to 1 %).
Tests check this for pulls of a sagging branch against the stress-free shape by inverse statics,
from :mod:`limber.mechanics.statics.rest_shape`. Wood that grew while it hung has no stress-free
shape at all, only S0.
"""

from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from limber.core.numerics.sparse import NotPositiveDefiniteError
from limber.mechanics.materials.materials import lame

if TYPE_CHECKING:
    from limber.mechanics.model import BranchModel

_YOUNG, _POISSON = 1e9, 0.35
"""Values for a branch of one material; the modulus cancels, the ratio has almost no effect."""


@dataclass(frozen=True)
class CarriedWeight:
    """The prestress that carries a load in the scanned shape; linear in the load.

    Attributes:
        stress: S0 [Pa] at the quadrature points, shape [tet_count, q, 6] (00 11 22 01 02 12).
        stiffness: G [N/m] of each axis, sparse, shape [node_count, node_count].
        base: Force of the base on its nodes while the branch hangs [N], [node_count, 3].
    """

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
    """The prestress that carries the weight of a hanging branch.

    Attributes:
        own: Prestress for the branch's own mass.
        added: Prestress for the masses that hung on it when it was scanned; None: none.
        mass_count: Number of the model's added masses included.
    """

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

    Raises:
        NotPositiveDefiniteError: the mesh cannot carry any load.
    """
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
