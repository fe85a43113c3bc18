"""Choice of a curve graph's root: the lowest of the thick ends, or the user's."""

from typing import NamedTuple

import numpy as np

from limber.geometry.skeleton.contraction.curve_graph import CurveGraph, rooted
from limber.geometry.skeleton.repair.spurs import SPUR_REACH, prune_spurs

_ROOT_SHARE = 0.45  # fraction of the thickest end above which an end may be the root
_ROOT_THICK, _ROOT_HEIGHT = 0.25, 0.1  # logarithm of thickness, and fraction of height
_END_POINTS, _END_REACHES = 30, 4  # points that show an end's thickness; its length
# Radii of its carrier up to which a side arm may be a strand around the rim of a ragged foot.
_STRAND = 5.0
_ROOT_EVEN = 1.0  # difference in these at which two ends are equally likely
# Logistic model of the chosen end against the next: a constant, and a slope of that difference. Of
# 68 generated scans 67 roots were right, among them all 5 with a rival about as likely.
ROOT_ODDS = (2.0, 1.0)


class RootChoice(NamedTuple):
    """The chosen root.

    Attributes:
        node: Its node.
        other: Another end that is about as likely [m], shape [3]; None: there is none.
        probability: That the chosen one is the root, and not the next likely end.
    """

    node: int
    other: np.ndarray | None
    probability: float


def root_node(graph: CurveGraph, points: np.ndarray, root: np.ndarray | None, up: np.ndarray,
              ) -> RootChoice:
    """The end nearest to ``root``, or the lowest of the thick ends; and another about as likely.

    The thickness of an end follows from its smallest extent and the distance that its points moved:
    a leaf is wide, but flat. An end that is shorter than it is thick is a spur, not an end.
    """
    degree = np.bincount(graph.edges.ravel(), minlength=len(graph.nodes))
    tips = np.flatnonzero(degree == 1)
    # Spurs would end the walk from a tip early, so they are pruned here as seen from the lowest
    # tip.
    first = int(tips[np.argmin(graph.nodes[tips] @ up)])
    parent = rooted(graph.nodes, graph.edges, first)
    neighbours = _pruned_neighbours(graph, parent, SPUR_REACH)
    tips = np.array([node for node, near in enumerate(neighbours) if len(near) == 1])
    if root is not None:
        return RootChoice(int(tips[np.argmin(np.linalg.norm(graph.nodes[tips] - root, axis=1))]),
                          None, 1.0)
    thick = _end_thickness(graph, points, neighbours, tips)
    # Where few points show a thick foot, contraction leaves strands around its rim. Each strand
    # gives as little evidence of the foot as a twig.
    neighbours = _pruned_neighbours(graph, parent, _STRAND)
    whole = np.array([len(neighbours[tip]) == 1 for tip in tips])
    thick[whole] = np.maximum(thick[whole], _end_thickness(graph, points, neighbours, tips[whole]))
    able = thick >= _ROOT_SHARE * thick.max()
    height = graph.nodes[tips] @ up / np.linalg.norm(up)
    chosen = int(np.argmin(np.where(able, height, np.inf)))
    # About as likely: about as low and as thick, or thicker by more than it is higher.
    odds = np.log(np.maximum(thick, 1e-12) / max(thick[chosen], 1e-12)) / _ROOT_THICK - (
        height - height[chosen]) / (_ROOT_HEIGHT * max(float(np.ptp(height)), 1e-12))
    odds[chosen] = -np.inf
    rival = int(np.argmax(odds)) if len(tips) > 1 else chosen
    other = graph.nodes[tips[rival]] if odds[rival] > -_ROOT_EVEN else None
    start, slope = ROOT_ODDS
    with np.errstate(over="ignore"):
        probability = float(1 / (1 + np.exp(odds[rival] * slope - start)))
    return RootChoice(int(tips[chosen]), other, probability)


def _pruned_neighbours(graph: CurveGraph, parent: np.ndarray, factor: float) -> list[list[int]]:
    """Neighbours of each node in the graph without spurs."""
    keep, _ = prune_spurs(graph.nodes, parent, graph.thickness, factor)
    neighbours: list[list[int]] = [[] for _ in graph.nodes]
    for node in np.flatnonzero(keep & (parent >= 0)):
        neighbours[node].append(int(parent[node]))
        neighbours[parent[node]].append(int(node))
    return neighbours


def _end_thickness(graph: CurveGraph, points: np.ndarray, neighbours: list[list[int]],
                   tips: np.ndarray) -> np.ndarray:
    """Thickness of each end [m], shape [tips]; 0 for spurs."""
    reach = 0.05 * float(np.linalg.norm(np.ptp(graph.nodes, axis=0)))
    thick = np.zeros(len(tips))
    for k, tip in enumerate(tips):
        # Contraction may draw a few points of an end far beyond it. A few points of a ragged foot
        # give little evidence, so the walk continues until there are enough.
        for distance in reach * np.arange(1, _END_REACHES + 1) + graph.thickness[tip]:
            chain = _end_chain(neighbours, graph.nodes, int(tip), distance)
            mine = points[np.isin(graph.owner, chain)]
            if len(mine) >= _END_POINTS:
                break
        # Measured along the chain: contraction runs what is left of a ragged foot around its rim.
        length = np.linalg.norm(np.diff(graph.nodes[chain], axis=0), axis=1).sum()
        if len(mine) < 4:
            continue
        drawn = float(np.median(np.repeat(graph.thickness[chain], graph.support[chain])))
        if length > 2 * drawn:
            least = np.sqrt(max(np.linalg.eigvalsh(np.cov(mine.T))[0], 0.0))
            thick[k] = np.sqrt(least * drawn)
    return thick


def _end_chain(edges: list[list[int]], nodes: np.ndarray, tip: int, reach: float) -> list[int]:
    """Nodes from a tip to the first fork, or up to a length of ``reach`` [m].

    Args:
        edges: Neighbours of each node.
        nodes: Positions [m], shape [n, 3].
        tip: Where to start.
        reach: How far to go.
    """
    chain, length, before = [tip], 0.0, -1
    while length < reach:
        ahead = [node for node in edges[chain[-1]] if node != before]
        if len(ahead) != 1:
            break
        before = chain[-1]
        length += float(np.linalg.norm(nodes[ahead[0]] - nodes[before]))
        chain.append(ahead[0])
    return chain
