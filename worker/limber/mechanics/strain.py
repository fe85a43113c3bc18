"""Strain, stretch and stress of a displaced branch, for reports and limits."""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from limber.core.errors import Text
from limber.mechanics.materials.laws import MULTIPLICITY, hooke_stress
from limber.mechanics.model import BranchModel

ALL = slice(None)
_NEAR_STRAIN = 0.57
_NEAR_STRESS = 0.3  # lower, because the norm is taken before the stress is rotated and stretched


@dataclass(frozen=True)
class Place:
    """A value and its location: tetrahedron and rest position of its centroid [m]."""

    value: float
    tet: int
    position: tuple[float, float, float]

    @property
    def at(self) -> Text:
        """Text with the location."""
        return Text("at ({:.3f}, {:.3f}, {:.3f}) m".format(*self.position)).at(self.position)


@dataclass(frozen=True)
class StrainState:
    """Means over each tetrahedron, principal values [tet_count, 3] ascending. They include strain
    and stress that carry a hanging branch's weight. Energy [J/m^3] is relative to the mesh;
    ``det_f`` is the smallest of the quadrature points."""

    energy_density: np.ndarray
    principal_strain: np.ndarray
    principal_stress: np.ndarray
    det_f: np.ndarray


def deformation_gradients(model: BranchModel, displacement: np.ndarray,
                          tets: np.ndarray | slice = ALL) -> np.ndarray:
    """Return F at the quadrature points of ``tets``, shape [tet_count, q, 3, 3]."""
    local = displacement[model.mesh.tets[tets]]
    H = np.matmul(model.gradients[tets], local[:, None])
    return np.swapaxes(H, 2, 3) + np.eye(3)


def principal_stretch(model: BranchModel, displacement: np.ndarray) -> Place:
    """Return the largest principal stretch of any tetrahedron (1: unstretched), and where."""
    value, tet = model.largest_stretch(displacement)
    x, y, z = map(float, model.mesh.nodes[model.mesh.tets[tet, :4]].mean(axis=0))
    return Place(value, tet, (x, y, z))


def strain_state(model: BranchModel, displacement: np.ndarray) -> StrainState:
    """Return energy density, principal strain and stress of every tetrahedron."""
    strain, stress, det = _means(model, displacement, ALL)
    energy = model.internal(displacement).tet_energy / model.weights.sum(axis=1)
    return StrainState(energy, np.linalg.eigvalsh(strain), np.linalg.eigvalsh(stress),
                       det.min(axis=1))


def peak_load(model: BranchModel, displacement: np.ndarray) -> tuple[float, int, float]:
    """Largest principal strain by magnitude, its tetrahedron and largest stress [Pa], as
    :func:`strain_state` in a tenth of the time. A symmetric tensor's largest principal value is at
    least its norm over root 3: only tetrahedra near the largest norm are evaluated."""
    part = model.weights / model.weights.sum(axis=1, keepdims=True)
    green = np.einsum("eq,eqk->ek", part, model.strains(displacement))
    carried = carried_strain(model)
    strain = green if carried is None else green + carried
    stress = hooke_stress(strain, model.lame_lambda, model.lame_mu)
    # An external law may differ greatly from Hooke's, so all of its tetrahedra are evaluated.
    near = np.full(len(strain), not model.material.is_compiled)
    for size, enough in ((_norms(strain), _NEAR_STRAIN), (_norms(stress), _NEAR_STRESS)):
        near |= size >= enough * size.max()
    tets = np.flatnonzero(near)
    strain, stress, _ = _means(model, displacement, tets)
    sizes = np.abs(np.linalg.eigvalsh(strain)).max(axis=1)
    worst = int(sizes.argmax())
    return (float(sizes[worst]), int(tets[worst]),
            float(np.abs(np.linalg.eigvalsh(stress)).max()))


def _norms(tensors: np.ndarray) -> np.ndarray:
    return np.sqrt(tensors**2 @ MULTIPLICITY)


def _means(model: BranchModel, displacement: np.ndarray, tets: np.ndarray | slice,
           ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return mean Green-Lagrange strain and Cauchy stress of ``tets``, each [n, 3, 3], and det F
    at their quadrature points, [n, q]."""
    F = deformation_gradients(model, displacement, tets)
    weights = model.weights[tets]
    part = weights / weights.sum(axis=1, keepdims=True)
    F_t = np.swapaxes(F, 2, 3)
    green = 0.5 * (F_t @ F - np.eye(3))
    carried = _carried(model, tets)
    strain = np.einsum("eq,eqij->eij", part, green + strain_of(model, carried, tets))
    det = np.linalg.det(F)
    lam, mu = (values[tets, None] for values in (model.lame_lambda, model.lame_mu))
    cauchy = model.material.cauchy(F, lam, mu) + F @ carried @ F_t / det[..., None, None]
    return strain, np.einsum("eq,eqij->eij", part, cauchy), det


def strain_of(model: BranchModel, stress: np.ndarray, tets: np.ndarray | slice = ALL) -> np.ndarray:
    """Return the small strain that a stress [Pa] causes in ``tets``, both [tet_count, q, 3, 3]."""
    young, poisson = (values[tets, None, None, None] for values in (model.young, model.poisson))
    trace = np.trace(stress, axis1=2, axis2=3)[..., None, None]
    return ((1 + poisson) * stress - poisson * trace * np.eye(3)) / young


def carried_strain(model: BranchModel) -> np.ndarray | None:
    """Return the mean strain that carries the weight on the scan, [tet_count, 6] (00 11 22 01 02
    12); None if no weight is carried there."""
    if model.prestress is None:
        return None
    part = model.weights / model.weights.sum(axis=1, keepdims=True)
    strain = np.einsum("eq,eqij->eij", part, strain_of(model, _carried(model)))
    return strain[:, [0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]


def _carried(model: BranchModel, tets: np.ndarray | slice = ALL) -> np.ndarray:
    """Return the stress that carries the weight on the scan [Pa], shape [tet_count, q, 3, 3]."""
    if model.prestress is None:
        return np.zeros((*model.weights[tets].shape, 3, 3))
    return model.prestress.total.stress[tets][..., [[0, 3, 4], [3, 1, 5], [4, 5, 2]]]


def gradient_metric(model: BranchModel) -> sp.csr_matrix:
    """Return the H1 seminorm: the integral of grad u : grad u [m^3], [node_count, node_count]."""
    tets, n = model.mesh.tets, model.mesh.node_count
    gradients = model.gradients
    blocks = np.einsum("eq,eqia,eqib->eab", model.weights, gradients, gradients, optimize=True)
    width = tets.shape[1]
    rows, columns = np.repeat(tets, width, axis=1).ravel(), np.tile(tets, (1, width)).ravel()
    return sp.csr_matrix((blocks.ravel(), (rows, columns)), (n, n))
