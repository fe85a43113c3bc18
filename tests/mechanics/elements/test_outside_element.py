"""An element from outside of the package: all that one file needs to bend a beam with it."""

from dataclasses import replace

import numpy as np
import pytest
from tests.subjects.meshes import box_mesh

from limber.core.errors import InputError
from limber.geometry import TetMesh, register_element
from limber.geometry.tets import element_types
from limber.geometry.tets.element_types import Quadrature, quadrature
from limber.mechanics import BranchModel, Grasp, solve_static
from limber.mechanics.elements.shape_functions import has_curved_sides, node_weights
from limber.results.exports.volumes import inp_text


class Bubble:
    """A linear tetrahedron with a fifth node at its centre, where 256 abcd is 1."""

    name, node_count, cell_type = "bubble", 5, ""
    parents = ((0, 1, 2, 3),)
    mirrored = (0, 2, 1, 3, 4)

    def shape_functions(self, barycentric: np.ndarray) -> np.ndarray:
        bubble = 256 * barycentric.prod(axis=1, keepdims=True)
        return np.hstack([barycentric - bubble / 4, bubble])

    def shape_gradients(self, barycentric: np.ndarray) -> np.ndarray:
        others = np.stack([np.delete(barycentric, k, axis=1).prod(axis=1) for k in range(4)],
                          axis=1)
        bubble = 256 * others[..., None]
        return np.concatenate([np.eye(4) - bubble / 4, bubble], axis=2)

    def stiffness_rule(self, is_curved: bool) -> Quadrature:
        return quadrature(5)

    def mass_rule(self) -> Quadrature:
        return quadrature(5)


@pytest.fixture(autouse=True)
def bubble(monkeypatch):
    monkeypatch.setattr(element_types, "_elements", dict(element_types._elements))
    return register_element(Bubble())


def beam(counts: tuple[int, int, int] = (1, 1, 6)) -> TetMesh:
    """A beam of bubble tetrahedra, held at z = 0 and grasped at the other end."""
    linear = box_mesh((0.01, 0.01, 0.06), counts, quadratic=False)
    centres = linear.node_count + np.arange(linear.tet_count)[:, None]
    nodes = np.vstack([linear.nodes, linear.centroids])
    return TetMesh(nodes, np.hstack([linear.tets, centres])).with_data(point_data={
        "fixed": (nodes[:, 2] < 1e-9).astype(np.int64),
        "grasp": (nodes[:, 2] > 0.06 - 1e-9).astype(np.int64)})


def bent(mesh: TetMesh) -> tuple[BranchModel, np.ndarray, float]:
    """The beam with its end moved aside: model, displacement [m], energy [J]."""
    model = BranchModel(mesh, young=1e8, poisson=0.3, density=900.0, gravity=None)
    grasp = Grasp.from_mesh(mesh, mode="point")
    result = solve_static(model, grasp=grasp,
                          pose=grasp.rest_pose + [0.004, 0, 0, 0, 0, 0]).require()
    return model, result.displacement, result.strain_energy


def test_bends_a_beam_and_its_forces_are_the_gradient_of_its_energy():
    mesh = beam()
    model, displacement, energy = bent(mesh)
    corners = mesh.linear().with_data(point_data={
        name: values[:mesh.linear().node_count] for name, values in mesh.point_data.items()})
    stiffer, softer = bent(corners)[2], bent(corners.quadratic().with_data(point_data={
        "fixed": (corners.quadratic().nodes[:, 2] < 1e-9).astype(np.int64),
        "grasp": (corners.quadratic().nodes[:, 2] > 0.06 - 1e-9).astype(np.int64)}))[2]
    # The gradient of a bubble has no mean: it does not couple with the elements' constant strain.
    assert softer < energy == pytest.approx(stiffer, rel=1e-6)
    displacement = displacement + np.random.default_rng(0).normal(size=displacement.shape) * 1e-5
    change = np.random.default_rng(1).normal(size=displacement.shape) * 1e-7
    energies = [model.internal(displacement + sign * change).energy for sign in (1, -1)]
    assert energies[0] - energies[1] == pytest.approx(
        2 * float(np.sum(model.internal(displacement).force * change)), rel=1e-5)


def test_masses_and_straight_sides_follow_its_description():
    mesh = beam((1, 1, 1))
    consistent, lumped = node_weights(mesh)
    assert consistent.sum() == pytest.approx(0.01 * 0.01 * 0.06)
    assert lumped.sum() == pytest.approx(0.01 * 0.01 * 0.06)
    assert not has_curved_sides(mesh)
    mesh.nodes[-1] += 1e-4
    assert has_curved_sides(mesh)
    swapped = replace(mesh, tets=mesh.tets[:, [0, 2, 1, 3, 4]])
    assert (swapped.volumes < 0).all() and (swapped.oriented().tets == mesh.tets).all()
    assert mesh.quadratic().tets.shape[1] == 10


def test_files_that_cannot_hold_it_refuse_it(tmp_path):
    mesh = beam((1, 1, 1))
    with pytest.raises(InputError, match="no cell for the element 'bubble'"):
        mesh.write(tmp_path / "mesh.vtu")
    model = BranchModel(mesh, young=1e8, poisson=0.3, density=900.0, gravity=None)
    with pytest.raises(InputError, match="cannot hold the element 'bubble'"):
        inp_text(model, "beam", 0)


def test_inconsistent_elements_are_refused(bubble):
    for name, value in (("node_count", 10), ("parents", ()), ("mirrored", (0, 1, 2, 3))):
        wrong = Bubble()
        setattr(wrong, name, value)
        with pytest.raises(InputError, match="The number identifies an element"):
            register_element(wrong)
    bubble.shape_functions = lambda barycentric: np.hstack([barycentric, barycentric[:, :1]])
    with pytest.raises(InputError, match="1 at its own node"):
        register_element(bubble)
    unknown = replace(beam((1, 1, 1)), tets=np.zeros((1, 7), int))
    with pytest.raises(InputError, match=r"have 7 nodes.*bubble \(5\)"):
        _ = unknown.element
