"""Which end of a curve graph is the root."""

import numpy as np

from limber.geometry.settings import OPEN
from limber.geometry.skeleton.curve_graph import CurveGraph
from limber.geometry.skeleton.plausibility import root_question
from limber.geometry.skeleton.root_end import root_node
from limber.geometry.skeleton.skeletonise import skeletonise

_UP = np.array([0.0, 0.0, 1.0])


def _ring(centre, radius, count):
    angle = 2 * np.pi * np.arange(count) / count
    return centre + radius * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1)


def _graph(parts):
    """Chains of nodes [m]: where each starts (a node's number or -1), thickness, points a node."""
    nodes, edges, thickness, owner, points = [], [], [], [], []
    for chain, start, thick, count in parts:
        before = start
        for place in chain:
            if before >= 0:
                edges.append([before, len(nodes)])
            before = len(nodes)
            nodes.append(place)
            thickness.append(thick)
            owner += count * [before]
            points.append(_ring(np.array(place, float), thick, count))
    return CurveGraph(np.array(nodes, float), np.array(edges), np.array(thickness),
                      np.bincount(owner), owner=np.array(owner)), np.vstack(points)


def _upwards(x, low, high, count):
    return [(x, 0.0, z) for z in np.linspace(low, high, count)]


def test_a_foot_that_contraction_split_into_strands_is_the_root():
    rim = ([(0.0, 0.0, 1.0)], -1, 0.25, 1)
    trunk = (_upwards(0.0, 1.2, 10.0, 45), 0, 0.3, 12)
    strands = [([(x, 0.0, 0.5), (x, 0.0, 0.1 * number)], 0, 0.25, 1)
               for number, x in enumerate((-0.25, 0.25))]
    drooping = ([(0.3 * k, 0.0, 6.0 - 0.15 * k) for k in range(1, 12)], 25, 0.2, 12)
    graph, points = _graph([rim, trunk, *strands, drooping])
    start, *_ = root_node(graph, points, None, _UP)
    assert graph.nodes[start, 2] < 0.2


def test_a_foot_with_few_points_is_judged_by_what_follows_it():
    foot = (_upwards(0.0, 0.0, 0.3, 4), -1, 0.1, 1)
    stem = (_upwards(0.0, 0.4, 8.0, 60), 3, 0.3, 12)
    graph, points = _graph([foot, stem])
    start, *_ = root_node(graph, points, None, _UP)
    assert graph.nodes[start, 2] == 0.0


def _rod(thick, up):
    """The choice on 41 nodes along x from 0 to 1 m, with the thickness ``thick(x)`` [m]."""
    places = [(x, 0.0, 0.0) for x in np.linspace(0.0, 1.0, 41)]
    graph, _ = _graph([(places, -1, 0.0, 12)])
    graph.thickness[:] = [thick(x) for x, *_ in places]
    points = graph.nodes[graph.owner] + graph.thickness[graph.owner, None] * np.tile(
        _ring(np.zeros(3), 1.0, 12)[:, [2, 0, 1]], (41, 1))
    return root_node(graph, points, None, np.array(up, float))


def test_the_thick_end_of_a_hanging_branch_is_the_root():
    """Side branches point down and away from it, and thin ends hang lower."""
    main = ([(0.02 * k, 0.0, -0.05 * k) for k in range(41)], -1, 0.006, 12)
    sides = [([(0.02 * k + side * 0.03 * n, 0.0, -0.05 * k - 0.04 * n) for n in range(1, 15)], k,
              0.003, 12) for k, side in ((8, 1), (16, -1), (24, 1))]
    graph, points = _graph([main, *sides])
    choice = root_node(graph, points, None, _UP)
    assert graph.nodes[choice.node].tolist() == [0.0, 0.0, 0.0]
    assert choice.ends[0]["probability"] > OPEN


def test_a_tapering_rod_stands_on_its_thick_end_and_an_even_one_on_its_lower():
    for up, node in (((1, 0, 0), 0), ((-1, 0, 0), 40)):
        choice = _rod(lambda x: 0.01, up)
        assert choice.node == node and choice.ends[0]["probability"] > OPEN
    for up in ((1, 0, 0), (0, 0, 1)):
        choice = _rod(lambda x: 0.012 - 0.009 * x, up)
        assert choice.node == 0 and choice.ends[0]["probability"] > OPEN
    # Upside down, thickness outweighs height.
    assert _rod(lambda x: 0.012 - 0.009 * x, (-1, 0, 0)).node == 0


def test_the_root_is_asked_for_where_two_ends_are_near_even():
    choice = _rod(lambda x: 0.01, (0, 0, 1))
    assert {tuple(end["at"]) for end in choice.ends} == {(0.0, 0.0, 0.0), (1.0, 0.0, 0.0)}
    assert choice.ends[0]["probability"] < OPEN
    asked = str(root_question(choice.ends))
    for text in ("which of 2 ends", "--root auto", "--root 0 0 0 (", "--root 1 0 0 ("):
        assert text in asked


def test_near_even_radii_hold_for_either_root() -> None:
    """Wood tapers away from the root, and few points determine the end of a rod."""
    rng = np.random.default_rng(3)
    along, angle = rng.uniform(0, 0.5, 2500), rng.uniform(0, 2 * np.pi, 2500)
    points = np.column_stack([along, 0.006 * np.cos(angle), 0.006 * np.sin(angle)])
    points += rng.normal(0, 4e-4, points.shape)
    asked = skeletonise(points)
    stated = skeletonise(points, root=asked.root_ends[0]["at"])
    assert asked.root_probability < OPEN
    share = asked.skeleton.radius_sigma / stated.skeleton.radius_sigma
    assert share.min() >= 1 and share.max() > 1.5
