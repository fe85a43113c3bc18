"""Boxes and closed surfaces in the way."""

import numpy as np
import pytest

from limber.cell.obstacles import Box, Solid, closest
from limber.geometry.surface.surface import Surface
from limber.planning.constraints.limits import Obstacles

CORNERS = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)], float)
FACES = np.array([[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1],
                  [2, 3, 7], [2, 7, 6], [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]])


@pytest.fixture
def both():
    """The same box, turned, as a box and as a surface."""
    axes = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0].T
    half, centre = np.array([0.1, 0.05, 0.2]), np.array([0.3, -0.1, 0.4])
    vertices = centre + ((2 * CORNERS - 1) * half) @ axes
    return (Box("box", half, centre, axes), Solid("solid", Surface(vertices, FACES)))


def test_a_box_and_its_surface_are_as_far(both):
    """Signed distances agree inside and outside, and are those to the nearest of many points."""
    box, solid = both
    points = box.centre + np.random.default_rng(0).uniform(-0.3, 0.3, (3000, 3))
    clearance = box.clearance(points)
    assert (clearance < 0).sum() > 10 and (clearance > 0).sum() > 100
    assert np.allclose(clearance, solid.clearance(points), atol=1e-9)


def test_the_deepest_is_told(both):
    """None where all are clear; else which, how deep and where; bodies have a radius."""
    box, _ = both
    clear = box.centre + np.array([[0.5, 0.0, 0.0], [0.0, 0.6, 0.0]])
    assert closest(both, clear) is None
    name, depth, where = closest((box,), np.vstack([clear, box.centre]))
    assert name == "box" and depth == pytest.approx(0.05) and np.allclose(where, box.centre)
    near = (box.centre + (box.half[1] + 0.01) * box.axes[1])[None]
    assert closest((box,), near) is None
    assert closest((box,), near, radius=0.02)[1] == pytest.approx(0.01)


def test_a_clearance_is_kept_from_bodies(both):
    """Broken where the branch comes nearer, with how near; inside a body with how deep; kept beyond
    it. The value that planners limit crosses its limit there."""
    box, _ = both
    constraint, touching = Obstacles.keeping((box,), 0.03), Obstacles((box,))
    places = [box.centre + (box.half[1] + off) * box.axes[1] for off in (0.05, 0.02, -0.01)]
    nodes = np.array(places)[:, None]
    assert constraint.clearance == pytest.approx(0.03) and touching.clearance == 0.0
    assert ((constraint.values(nodes[:, 0], nodes) > constraint.limit) == [False, True, True]).all()
    far, near, inside = (constraint.broken(one[:1, 0], one) for one in nodes[:, None])
    assert far is None and "20.0 mm away from box" in near and "clearance of 30.0 mm" in near
    assert "10.0 mm inside box" in inside and touching.broken(nodes[1], nodes[1:2]) is None
