"""Shape functions, quadrature and the elements' exactness."""

import itertools
import math

import numpy as np
import pytest

from limber.core.errors import InputError
from limber.geometry.tets.element_types import EDGES, quadrature
from limber.geometry.tets.tet_mesh import TetMesh
from limber.mechanics.elements import shape_functions as elements


@pytest.mark.parametrize(("degree", "count"), [(1, 1), (2, 4), (4, 14), (5, 14)])
def test_quadrature_is_exact_up_to_its_degree(degree, count):
    """Every monomial up to the degree gives its exact integral."""
    rule = quadrature(degree)
    assert len(rule.weights) == count
    for powers in itertools.product(range(degree + 1), repeat=3):
        if sum(powers) <= degree:
            exact = 6 * math.prod(map(math.factorial, powers)) / math.factorial(sum(powers) + 3)
            values = np.prod(rule.points[:, 1:] ** np.array(powers), axis=1)
            assert rule.weights @ values == pytest.approx(exact, abs=1e-15)


@pytest.mark.parametrize("node_count", [4, 10])
def test_shape_functions_are_one_at_their_node_and_gradients_match(node_count):
    """Kronecker property, partition of unity, gradients equal finite differences."""
    corners = np.eye(4)
    middles = (corners[EDGES[:, 0]] + corners[EDGES[:, 1]]) / 2
    places = np.vstack([corners, middles])[:node_count]
    assert elements.shape_functions(places, node_count) == pytest.approx(np.eye(node_count))
    at, step = np.array([[0.4, 0.3, 0.2, 0.1]]), 1e-6
    gradients = elements.shape_gradients(at, node_count)[0]
    for axis in range(3):
        shift = np.zeros(4)
        shift[0], shift[axis + 1] = -step, step
        change = (elements.shape_functions(at + shift, node_count)
                  - elements.shape_functions(at - shift, node_count))[0] / (2 * step)
        assert gradients[axis] == pytest.approx(change, abs=1e-8)


def test_curved_sides_use_the_larger_rule_and_keep_the_volume(short_box):
    """A smooth map that keeps volume (a shear that is quadratic) keeps the sum of weights."""
    assert not elements.has_curved_sides(short_box)
    nodes = short_box.nodes.copy()
    nodes[:, 0] += 30 * nodes[:, 2] ** 2
    curved = TetMesh(nodes, short_box.tets)
    assert elements.has_curved_sides(curved)
    rule = elements.stiffness_quadrature(curved)
    _, weights = elements.element_gradients(curved, rule)
    assert weights.sum() == pytest.approx(short_box.volumes.sum(), rel=1e-12)


def test_mass_is_consistent_and_lumped_mass_positive(short_box):
    """Consistent and lumped masses both sum to the volume; lumped ones are positive."""
    consistent, lumped = elements.node_weights(short_box)
    volume = short_box.volumes.sum()
    assert consistent.sum() == pytest.approx(volume)
    assert lumped.sum() == pytest.approx(volume)
    assert lumped.min() > 0
    assert elements.volume_weights(short_box).sum() == pytest.approx(volume)


def test_inverted_element_is_named(short_box):
    """An inverted tetrahedron is refused, with its number."""
    tets = short_box.tets.copy()
    tets[7, [0, 1]] = tets[7, [1, 0]]
    with pytest.raises(InputError, match="number 7"):
        elements.element_gradients(TetMesh(short_box.nodes, tets), quadrature(2))
