"""Which end of a curve graph is the root."""

import numpy as np

from limber.geometry.skeleton.contraction.curve_graph import CurveGraph
from limber.geometry.skeleton.contraction.root_end import root_node

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
