"""Strain as a quadratic polynomial of the reduced coordinates, and the force that follows.

The Green-Lagrange strain of u = sum q_i u_i is exactly quadratic in q. It is projected onto a few
strain fields phi_a that true solutions have, e_a = integral phi_a : C : strain(q), a quadratic
form each. With the StVK energy e^T H e / 2 the force J^T H e (J = de/dq) is a cubic polynomial in
q, and H = sum_k E_k (l Lambda_k + m M_k) is linear in Young's modulus E_k of each control point
and in the two numbers l, m that stand for Poisson's ratio.

Why projected: a basis of a few dozen displacements cannot release the axial strain that goes with
a large rotation, and that strain is a thousand times stiffer than bending. Its part outside the
fields of true solutions is noise of the basis; dropped, it no longer stiffens the branch (as
assumed strains do in elements). With as many fields as the polynomial has terms the projection
is the identity, and force and energy are the full model's on the subspace to round-off.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from limber.core.errors import InputError
from limber.core.not_none import present
from limber.kernels import Kernel
from limber.mechanics.materials.materials import lame
from limber.mechanics.model import BranchModel
from limber.reduced.basis import (
    SWING_STRAIN_SHARE,
    TANGENT_SHARE,
    VIBRATION_STEP,
    Basis,
    tangent_steps,
)
from limber.reduced.training import Snapshots

_CHUNK_POINTS = 1000
_PAIRS = np.array([[0, 0], [1, 1], [2, 2], [0, 1], [0, 2], [1, 2]])
_SHEAR = np.array([1.0, 1.0, 1.0, np.sqrt(2), np.sqrt(2), np.sqrt(2)])
_TRACE = np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
_SMALLEST = 1e-11  # eigenvalue of the fields over the largest; below it they are round-off
_ALIKE = 1e-6  # eigenvalue of the normalised fields' products under which they count as alike


@dataclass(frozen=True)
class StrainPolynomial:
    """The quadratic strain map and its moduli.

    Attributes:
        linear: Linear part of e, shape [m, size].
        quadratic: Quadratic part, lower triangles of symmetric matrices by rows, shape
            [m, size (size + 1) / 2].
        by_lambda, by_mu: Moduli per Young's modulus at each control point and per l or m,
            [K, m, m].
        poisson: Poisson's ratio that by_lambda and by_mu were scaled with (mean of the branch).
    """

    linear: np.ndarray
    quadratic: np.ndarray
    by_lambda: np.ndarray
    by_mu: np.ndarray
    poisson: float

    def moduli(self, young: np.ndarray, poisson: float | None = None) -> np.ndarray:
        """Return H for Young's modulus at the control points [Pa], shape [K]; [m, m]."""
        return sum(e * part for e, part in zip(young, self.parts(poisson), strict=True))

    def parts(self, poisson: float | None = None) -> list[np.ndarray]:
        """Return dH/dE_k for each control point."""
        lam, mu = lame(1.0, self.poisson if poisson is None else poisson)
        return [lam * a + mu * b for a, b in zip(self.by_lambda, self.by_mu, strict=True)]

    def whitened(self, moduli: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Return linear and quadratic parts in which H is the identity, and H's root L: with H = L
        L^T the strain coordinates become L^T e."""
        root = np.linalg.cholesky((moduli + moduli.T) / 2)
        return (np.ascontiguousarray(root.T @ self.linear),
                np.ascontiguousarray(root.T @ self.quadratic), root)


_WHITENED = ("linear float64[fields, size]", "quadratic float64[fields, terms]", "q float64[size]")
evaluate_strain = Kernel(
    "strain_evaluated", *_WHITENED, "increment float64[increments]", "velocity float64[velocities]",
    "out strain float64[fields]", "out jacobian float64[fields, size]",
    "out gradient float64[size]", "out tangent float64[size, size]", "damping float",
    "by_rate float", returns="float")
"""Return the energy [J]; write whitened strain, J, force J^T e and tangent (lower triangle).
``increment``: geometric part of mixed integration points. ``velocity``, changing by ``by_rate``
[1/s] with q: stress ``damping`` [s] times the strain's rate. Empty arrays: neither."""

strain_only = Kernel("strain_alone", *_WHITENED, "out strain float64[fields]", returns="float")
"""Write the whitened strain [m]; return the energy [J]."""

_green_change = Kernel(
    "green_changed", "states float64[points, 3, 3, states]",
    "changes float64[points, 3, 3, fields]", "owners int64[fields]", "scales float64[fields]",
    "out strain float64[points, 6, fields]")
"""Write the change of the strain (shear scaled) at states H by D. Field f belongs to state
owners[f] and is scaled by scales[f]."""


def make_polynomial(model: BranchModel, basis: Basis, weights: np.ndarray,
                    control_young: np.ndarray, snapshots: Snapshots | None,
                    field_count: int | None) -> StrainPolynomial:
    """Return the strain polynomial. ``field_count`` None: no projection. ``control_young`` [Pa]
    weighs its product. InputError unless St. Venant-Kirchhoff."""
    if not model.material.has_cubic_force:
        raise InputError(f"A reduced model of the material {model.material.name} is requested.",
                         "Only the force of St. Venant-Kirchhoff is a cubic polynomial.",
                         "Use the full model, or st_venant_kirchhoff.")
    points = _Points(model, weights, control_young)
    if field_count is None:
        transform = _all_fields(points, basis)
        sources = None
    else:
        sources = _strain_sources(model, present(snapshots, "snapshot"))
        transform = _leading_fields(points, sources, field_count)
    return _projected(points, basis, sources, transform)


def reduced_mass(model: BranchModel, basis: Basis) -> np.ndarray:
    """Return the mass matrix of the coordinates, shape [size, size]."""
    heavy = np.array([model.mass_matrix @ column for column in basis.columns])
    return basis.columns.reshape(basis.size, -1) @ heavy.reshape(basis.size, -1).T


class _Points:
    """Quadrature points in chunks: what strain fields are integrated over."""

    def __init__(self, model: BranchModel, weights: np.ndarray, control_young: np.ndarray):
        self.model, self.weights = model, weights
        self.poisson = float(np.average(model.poisson, weights=model.weights.sum(axis=1)))
        lam, mu = lame(weights @ control_young, model.poisson)
        self.lam, self.mu = lam, mu
        # Lamé coefficients per Young's modulus, relative to those of the mean Poisson's ratio:
        # 1 everywhere if it is the same everywhere.
        here, mean = lame(1.0, model.poisson), lame(1.0, self.poisson)
        self.ratio = [a / b if b else np.ones_like(a) for a, b in zip(here, mean, strict=True)]

    def chunks(self) -> Iterator[slice]:
        step = max(1, _CHUNK_POINTS // self.model.weights.shape[1])
        for start in range(0, self.model.mesh.tet_count, step):
            yield slice(start, start + step)

    def gradient(self, fields: np.ndarray, chunk: slice) -> np.ndarray:
        """Return H = du/dX of fields [f, n, 3] at a chunk's points, shape [points, 3, 3, f]."""
        local = fields[:, self.model.mesh.tets[chunk]].astype(float, copy=False)
        H = np.einsum("feai,eqja->eqijf", local, self.model.gradients[chunk], optimize=True)
        return H.reshape(-1, 3, 3, len(fields))

    def volume(self, chunk: slice) -> np.ndarray:
        return self.model.weights[chunk].reshape(-1)

    def per_point(self, values: np.ndarray, chunk: slice) -> np.ndarray:
        return np.repeat(values[chunk], self.model.weights.shape[1])

    def stress(self, strain: np.ndarray, chunk: slice) -> np.ndarray:
        """Return C : strain times the volume; strain [points, 6, f] with scaled shear."""
        lam, mu = self.per_point(self.lam, chunk), self.per_point(self.mu, chunk)
        volume = self.volume(chunk)[:, None, None]
        trace = strain[:, :3].sum(axis=1, keepdims=True)
        return volume * (lam[:, None, None] * trace * _TRACE[:, None]
                         + 2 * mu[:, None, None] * strain)


def _green(H: np.ndarray) -> np.ndarray:
    """Green-Lagrange strain of H [p, 3, 3, f], shear scaled, shape [p, 6, f]."""
    return np.stack([
        scale * 0.5 * (H[:, i, j] + H[:, j, i] + (H[:, :, i] * H[:, :, j]).sum(axis=1))
        for (i, j), scale in zip(_PAIRS, _SHEAR, strict=True)], axis=1)


@dataclass(frozen=True)
class _Sources:
    """States, and changes with the state that each belongs to, whose strains are true ones. The
    first ``rest_count`` states are at rest, the others swung out and weigh less."""

    states: np.ndarray
    rest_count: int
    changes: list[tuple[np.ndarray, np.ndarray, np.ndarray]]

    def strains(self, points: _Points, chunk: slice) -> np.ndarray:
        H = points.gradient(self.states, chunk)
        parts = [_green(H)]
        parts[0][:, :, self.rest_count:] *= SWING_STRAIN_SHARE
        for fields, owners, scales in self.changes:
            if not len(fields):
                continue
            strain = np.empty((len(H), 6, len(fields)))
            _green_change.of(H, points.gradient(fields, chunk), owners, scales, strain)
            parts.append(strain)
        return np.concatenate(parts, axis=2)


def _strain_sources(model: BranchModel, snapshots: Snapshots) -> _Sources:
    def flat(tangents: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        owners = np.repeat(np.arange(len(tangents)), tangents.shape[1])
        return tangents.reshape(len(owners), *tangents.shape[2:]), owners

    steps = 2 * TANGENT_SHARE * tangent_steps(model, snapshots)
    moved, moved_owner = flat(snapshots.pose_tangents)
    stiffer, stiffer_owner = flat(snapshots.young_tangents)
    return _Sources(np.concatenate([snapshots.displacement, snapshots.swings]),
                    len(snapshots), [
        (moved, moved_owner, np.tile(steps, len(snapshots))),
        (stiffer, stiffer_owner, np.full(len(stiffer), 2 * TANGENT_SHARE)),
        (snapshots.vibrations, snapshots.vibration_states,
         np.full(len(snapshots.vibrations), VIBRATION_STEP * model.extent))])


def _leading_fields(points: _Points, sources: _Sources, count: int) -> np.ndarray:
    """Return coefficients of the leading strain fields in the sources, [sources, fields]."""
    gram = np.zeros((1, 1))
    for chunk in points.chunks():
        strain = sources.strains(points, chunk)
        flat = strain.reshape(-1, strain.shape[2])
        gram = gram + points.stress(strain, chunk).reshape(flat.shape).T @ flat
    return _leading(gram, count)


def _leading(gram: np.ndarray, count: int | None) -> np.ndarray:
    values, vectors = np.linalg.eigh((gram + gram.T) / 2)
    keep = np.flatnonzero(values > _SMALLEST * values[-1])[::-1][:count]
    return vectors[:, keep] / np.sqrt(values[keep])


def _terms(points: _Points, basis: Basis, chunk: slice) -> np.ndarray:
    """Return the strain of each term q_i and q_i q_j (j <= i), shape [points, 6, terms]."""
    H = points.gradient(basis.columns, chunk)
    size = basis.size
    later, earlier = np.tril_indices(size)
    terms = np.empty((len(H), 6, size + len(later)))
    for k, ((i, j), scale) in enumerate(zip(_PAIRS, _SHEAR, strict=True)):
        terms[:, k, :size] = 0.5 * scale * (H[:, i, j] + H[:, j, i])
        product = np.matmul(np.swapaxes(H[:, :, i], 1, 2), H[:, :, j])
        product = 0.25 * scale * (product + np.swapaxes(product, 1, 2))
        terms[:, k, size:] = product[:, later, earlier]
    return terms


def _all_fields(points: _Points, basis: Basis) -> np.ndarray:
    gram = np.zeros((1, 1))
    for chunk in points.chunks():
        terms = _terms(points, basis, chunk)
        flat = terms.reshape(-1, terms.shape[2])
        gram = gram + points.stress(terms, chunk).reshape(flat.shape).T @ flat
    # Terms of very different size are scaled first, so that none is lost in another's round-off.
    scale = 1 / np.sqrt(np.maximum(np.diag(gram), np.finfo(float).tiny))
    return scale[:, None] * _leading(gram * scale * scale[:, None], None)


def _projected(points: _Points, basis: Basis, sources: _Sources | None,
               transform: np.ndarray) -> StrainPolynomial:
    count, regions = transform.shape[1], points.weights.shape[1]
    coupling = np.zeros((count, 1))
    own = np.zeros((count, count))
    by_lambda = np.zeros((regions, count, count))
    by_mu = np.zeros((regions, count, count))
    for chunk in points.chunks():
        terms = _terms(points, basis, chunk)
        strain = terms if sources is None else sources.strains(points, chunk)
        fields = strain @ transform
        flat = fields.reshape(-1, count)
        stress = points.stress(fields, chunk).reshape(flat.shape)
        coupling = coupling + stress.T @ terms.reshape(len(flat), -1)
        own += stress.T @ flat
        trace, volume = fields[:, :3].sum(axis=1), points.volume(chunk)
        for k in range(regions):
            part = points.per_point(points.weights[:, k], chunk) * volume
            lam = part * points.per_point(points.ratio[0], chunk)
            mu = part * points.per_point(points.ratio[1], chunk)
            by_lambda[k] += trace.T @ (lam[:, None] * trace)
            by_mu[k] += 2 * flat.T @ (np.repeat(mu, 6)[:, None] * flat)
    inverse = _orthonormal(own)
    coupling = inverse @ coupling
    size = basis.size
    return StrainPolynomial(
        np.ascontiguousarray(coupling[:, :size]), np.ascontiguousarray(coupling[:, size:]),
        inverse @ by_lambda @ inverse.T, inverse @ by_mu @ inverse.T, points.poisson)


def _orthonormal(own: np.ndarray) -> np.ndarray:
    """Return what makes fields of products ``own`` orthonormal, so that coefficients are what the
    functionals measure, shape [m, fields]."""
    scale = 1 / np.sqrt(np.diag(own))
    values, vectors = np.linalg.eigh((own + own.T) / 2 * scale * scale[:, None])
    keep = values > _ALIKE
    return (vectors[:, keep] / np.sqrt(values[keep])).T * scale
