"""Convergence rate in element size, on a manufactured large-strain solution on refined cubes."""

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh
from tests.subjects.prescribed import solve_prescribed

from limber.geometry.tets.element_types import quadrature
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics import BranchModel, StaticSettings
from limber.mechanics.elements import shape_functions as fe

_LAMBDA, _MU = 0.3 / (1.3 * 0.4), 1 / 2.6  # Young's modulus 1, Poisson's ratio 0.3
_AMPLITUDE = np.array([0.08, -0.05, 0.06])


@pytest.mark.slow
def test_energy_converges_at_fourth_order():
    """The total potential's error falls by nearly 16 as the elements are halved."""
    exact = exact_potential()
    errors = [manufactured_potential(n) - exact for n in (2, 4, 8)]
    rates = np.log2(np.divide(errors[:-1], errors[1:]))
    assert rates[1] == pytest.approx(4.0, abs=0.3)
    assert rates[1] > rates[0]


def exact_potential() -> float:
    places, weights = np.polynomial.legendre.leggauss(24)
    places, weights = (places + 1) / 2, weights / 2
    points = np.stack(np.meshgrid(places, places, places, indexing="ij"), axis=-1).reshape(-1, 3)
    weight = np.einsum("i,j,k->ijk", weights, weights, weights).ravel()
    F = np.eye(3) + _smooth_gradient(points)
    strain = 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))
    energy = (0.5 * _LAMBDA * np.trace(strain, axis1=1, axis2=2)**2
              + _MU * (strain**2).sum(axis=(1, 2)))
    moved = _AMPLITUDE * np.prod(np.sin(np.pi * points), axis=1)[:, None]
    work = -(_divergence(points) * moved).sum(axis=1)
    return float(weight @ (energy - work))


def manufactured_potential(cells: int) -> float:
    box = box_mesh((1.0, 1.0, 1.0), (cells, cells, cells))
    mesh = TetMesh(box.nodes + [0.5, 0.5, 0.0], box.tets)
    model = BranchModel(mesh, young=1.0, poisson=0.3, density=1.0, gravity=None,
                        fixed=(np.abs(mesh.nodes - 0.5) > 0.5 - 1e-9).any(axis=1))
    rule = quadrature(5)
    shape = fe.shape_functions(rule.points, 10)
    corners = mesh.nodes[mesh.tets[:, :4]]
    places = np.einsum("qc,ecx->eqx", rule.points, corners)
    load = -_divergence(places.reshape(-1, 3)).reshape(places.shape)
    weights = mesh.volumes[:, None] * rule.weights
    forces = np.zeros_like(mesh.nodes)
    np.add.at(forces, mesh.tets, np.einsum("eq,qa,eqx->eax", weights, shape, load))
    result = solve_prescribed(model, np.zeros_like(forces), nodal_forces=forces,
                              settings=StaticSettings(tolerance=1e-11)).require()
    return result.strain_energy - float((forces * result.displacement).sum())


def _smooth_gradient(points: np.ndarray) -> np.ndarray:
    """Gradient of u = amplitude sin(pi x) sin(pi y) sin(pi z), shape [n, 3, 3]."""
    s, c = np.sin(np.pi * points), np.pi * np.cos(np.pi * points)
    slope = np.stack([c[:, 0] * s[:, 1] * s[:, 2], s[:, 0] * c[:, 1] * s[:, 2],
                      s[:, 0] * s[:, 1] * c[:, 2]], axis=1)
    return _AMPLITUDE[None, :, None] * slope[:, None, :]


def _first_stress(points: np.ndarray) -> np.ndarray:
    F = np.eye(3) + _smooth_gradient(points)
    strain = 0.5 * (np.swapaxes(F, 1, 2) @ F - np.eye(3))
    trace = np.trace(strain, axis1=1, axis2=2)[:, None, None]
    return F @ (_LAMBDA * trace * np.eye(3) + 2 * _MU * strain)


def _divergence(points: np.ndarray) -> np.ndarray:
    total, h = np.zeros_like(points), 1e-3
    for axis in range(3):
        shift = h * np.eye(3)[axis]
        near = _first_stress(points + shift) - _first_stress(points - shift)
        far = _first_stress(points + 2 * shift) - _first_stress(points - 2 * shift)
        total += ((8 * near - far) / (12 * h))[:, :, axis]
    return total
