"""Choice of a curve graph's root: the end with the best odds, or the user's."""

from typing import Any, NamedTuple

import numpy as np
import scipy.sparse as sparse
from scipy.sparse.csgraph import dijkstra

from limber.geometry.skeleton.curve_graph import CurveGraph, rooted
from limber.geometry.skeleton.repair import SPUR_REACH, prune_spurs

_END_SIZE = 0.05  # length of an end over the graph's size
_END_POINTS, _END_REACHES = 30, 4  # points that show an end's thickness; its most lengths
# Radii of its carrier up to which a side arm may be a strand around the rim of a ragged foot.
_STRAND = 5.0
_FEW = 10  # points that show an arm's direction and thickness half as well as many do
_MOST = 2.5  # logarithm of the share of the greatest thickness from which an end counts as thin
_LOW = 0.1  # height over the graph's size within which an end counts as low
_EVEN_THICKNESS = 0.1  # deviation of the logarithm of thickness that shows no taper
# Weights of what `root_evidence` returns: a conditional logit over the ends of 288 generated scans
# of 400 to 17,000 points, 75 % of them as they grow, 15 % upside down, 10 % turned to any side,
# times 1.3. With each of seven sources left out in turn the weights change by a tenth to a quarter.
# Of 448 further scans, 45 % of them under 1,500 points, 99 % of the roots are right, and of those
# wrong none has 0.8; by 1.3 times the first weights 4 instead of 6 % are asked for.
ROOT_ODDS = (2.0, 2.9, 5.8, 2.0)
_SURE = 0.95  # as of intervals: the likeliest ends that hold it together are named
_NAMED = 5  # of them


class RootChoice(NamedTuple):
    """The chosen root, and the likeliest ends, the chosen one first, with ``at`` [3] [m] and their
    ``probability`` among all: 95 % together, or five; none if the user stated the root."""

    node: int
    ends: list[dict[str, Any]]


def root_node(graph: CurveGraph, points: np.ndarray, root: np.ndarray | None, up: np.ndarray,
              ) -> RootChoice:
    """The end nearest to ``root``, or the end with the best odds."""
    if root is not None:
        tips = _ends(graph, up)[0]
        return RootChoice(int(tips[np.argmin(np.linalg.norm(graph.nodes[tips] - root, axis=1))]),
                          [])
    tips, evidence = root_evidence(graph, points, up)
    odds = evidence @ np.array(ROOT_ODDS)
    share = np.exp(odds - odds.max())
    share /= share.sum()
    nodes, chances = _apart(graph, tips, share)
    count = min(int(np.searchsorted(np.cumsum(chances), _SURE)) + 1, _NAMED)
    return RootChoice(nodes[0], [
        {"at": graph.nodes[node], "probability": chance}
        for node, chance in list(zip(nodes, chances, strict=True))[:count]])


def _apart(graph: CurveGraph, tips: np.ndarray, share: np.ndarray) -> tuple[list[int], list[float]]:
    """Ends at different places, the likeliest first, and their probabilities. The likeliest of the
    strands of one foot stands for all."""
    nodes: list[int] = []
    chances: list[float] = []
    for end in np.argsort(-share, kind="stable"):
        node = int(tips[end])
        same = [k for k, other in enumerate(nodes) if np.linalg.norm(
            graph.nodes[node] - graph.nodes[other]) < _STRAND * graph.thickness[other]]
        if same:
            chances[same[0]] += float(share[end])
        else:
            nodes.append(node)
            chances.append(float(share[end]))
    order = np.argsort(-np.array(chances), kind="stable")
    return [nodes[k] for k in order], [chances[k] for k in order]


def root_evidence(graph: CurveGraph, points: np.ndarray, up: np.ndarray,
                  ) -> tuple[np.ndarray, np.ndarray]:
    """Ends [tips] longer than they are thick, and what speaks for each as the root [tips, 4]: ln of
    its share of the thickest end's, that none is lower (1 to 0), that other arms point away from it
    at forks, that axes become thinner away from it. Few points count less."""
    tips, neighbours, parent = _ends(graph, up)
    thick = _end_thickness(graph, points, neighbours, tips)
    # Where few points show a thick foot, contraction leaves strands around its rim. Each strand
    # gives as little evidence of the foot as a twig.
    freed = _pruned_neighbours(graph, parent, _STRAND)
    whole = np.array([len(freed[tip]) == 1 for tip in tips])
    thick[whole] = np.maximum(thick[whole], _end_thickness(graph, points, freed, tips[whole]))
    thinner = np.log(np.maximum(thick, 1e-12) / max(thick.max(), 1e-12))
    size = _size(graph)
    height = graph.nodes[tips] @ up / np.linalg.norm(up)
    distance, before = _paths(graph, neighbours, tips)
    return tips, np.column_stack([
        np.maximum(thinner, -_MOST),
        np.exp(-(height - height.min()) / (_LOW * size)),
        _pointing_away(graph, neighbours, before), _taper(graph, neighbours, distance)])


def _ends(graph: CurveGraph, up: np.ndarray) -> tuple[np.ndarray, list[list[int]], np.ndarray]:
    """Ends without spurs, shape [tips]; neighbours without spurs; parents from the lowest tip."""
    degree = np.bincount(graph.edges.ravel(), minlength=len(graph.nodes))
    tips = np.flatnonzero(degree == 1)
    # Spurs would end the walk from a tip early, so they are pruned here as seen from the lowest
    # tip.
    first = int(tips[np.argmin(graph.nodes[tips] @ up)])
    parent = rooted(graph.nodes, graph.edges, first)
    neighbours = _pruned_neighbours(graph, parent, SPUR_REACH)
    tips = np.array([node for node, near in enumerate(neighbours) if len(near) == 1])
    return tips, neighbours, parent


def _size(graph: CurveGraph) -> float:
    return max(float(np.linalg.norm(np.ptp(graph.nodes, axis=0))), 1e-12)


def _paths(graph: CurveGraph, neighbours: list[list[int]], tips: np.ndarray,
           ) -> tuple[np.ndarray, np.ndarray]:
    """Distance along the axes [m] from each tip to each node, and the node before it on the way
    there, shape [tips, n]."""
    one, other = np.array([(node, near) for node, all_near in enumerate(neighbours)
                           for near in all_near]).T
    # Steps of length 0 would count as none.
    step = np.maximum(np.linalg.norm(graph.nodes[one] - graph.nodes[other], axis=1), 1e-12)
    steps = sparse.csr_matrix((step, (one, other)), (len(graph.nodes),) * 2)
    return dijkstra(steps, indices=tips, return_predecessors=True)


def _taper(graph: CurveGraph, neighbours: list[list[int]], distance: np.ndarray) -> np.ndarray:
    """How far thickness falls with the distance from each tip, -1 to 1, shape [tips]."""
    on = np.array([len(near) > 0 for near in neighbours])
    weight = graph.support[on] / graph.support[on].sum()
    log = np.log(np.maximum(graph.thickness[on], 1e-12))
    log = log - weight @ log
    away = distance[:, on] - (distance[:, on] @ weight)[:, None]
    spread = np.sqrt(np.maximum(away**2 @ weight, 1e-300) * (log**2 @ weight + _EVEN_THICKNESS**2))
    return -(away * log) @ weight / spread


def _pointing_away(graph: CurveGraph, neighbours: list[list[int]], before: np.ndarray,
                   ) -> np.ndarray:
    """Mean cosine [tips] over all forks between the way from each tip and the other arms there. An
    arm counts less if it is short, in radii of the fork, or if few points show it."""
    total = np.zeros(len(before))
    reach = 2 * _END_SIZE * _size(graph)
    for fork in (node for node, near in enumerate(neighbours) if len(near) > 2):
        arms = np.array(neighbours[fork])
        thick = graph.thickness[fork]
        way = np.empty((len(arms), 3))
        for number, arm in enumerate(arms):
            chain = _end_chain(neighbours, graph.nodes, arm, max(reach, 2.5 * thick), fork)
            step = graph.nodes[chain[-1]] - graph.nodes[fork]
            length = max(float(np.linalg.norm(step)), 1e-12)
            way[number] = step / length / (1 + (thick / length)**2 + _FEW / max(
                int(graph.support[chain].sum()), 1))
        cosine = -np.sum(way * (way.sum(axis=0) - way), axis=1) / (len(arms) - 1)
        total += cosine[np.argmax(before[:, fork, None] == arms, axis=1)]
    return total


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
    reach = _END_SIZE * _size(graph)
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


def _end_chain(edges: list[list[int]], nodes: np.ndarray, start: int, reach: float,
               before: int = -1) -> list[int]:
    """Nodes from ``start`` to the first fork, or up to a length of ``reach`` [m]. It comes there
    from the node ``before``; -1: it starts at a tip."""
    chain, length = [start], 0.0
    while length < reach:
        ahead = [node for node in edges[chain[-1]] if node != before]
        if len(ahead) != 1:
            break
        before = chain[-1]
        length += float(np.linalg.norm(nodes[ahead[0]] - nodes[before]))
        chain.append(ahead[0])
    return chain
