"""A first tree of a thin scan by paths from its root through its points.

Contraction draws the points of neighbouring twigs together where few show them, and the pieces
that are left are bridged wrongly. A path whose steps cost more than their length goes from point to
point along a twig, and leaves it only at its foot.
"""

import numpy as np
from scipy.spatial import cKDTree

from limber.geometry.skeleton.curve_graph import cover, means
from limber.geometry.skeleton.repair import PointSpacing, prune_spurs
from limber.geometry.skeleton.skeleton import Skeleton

_POWER = 1.5  # of a step's length: 1 leads straight through the air, many is a spanning tree
_PATHS = 0.5  # weight of the path before a step: with 1 paths change between twigs at gaps
_BALL = 1.5  # point spacings around a point whose mean lies nearer to the axis
_SPUR = 4.0  # radii below which a path's end is no twig


def path_tree(points: np.ndarray, root: np.ndarray, apart: PointSpacing) -> Skeleton:
    """Return a tree of paths through points [m], shape [m, 3], from near ``root`` [3] [m], between
    the shortest ones and the spanning tree (Alpert et al. 1995); its radii are half the points'
    spacing."""
    spacing = float(np.median(apart.distance))
    around = apart.tree.query_ball_point(points, _BALL * spacing)
    middle = np.array([points[ball].mean(axis=0) for ball in around])
    nodes = means(cover(middle, np.full(len(points), spacing)), middle)
    cost, key, before, open_ = (np.full(len(nodes), first) for first in (0.0, np.inf, -1, True))
    key[int(cKDTree(nodes).query(root)[1])] = 0.0
    for _ in nodes:
        node = int(np.argmin(np.where(open_, key, np.inf)))
        open_[node] = False
        price = np.linalg.norm(nodes - nodes[node], axis=1)**_POWER
        nearer = open_ & (_PATHS * cost[node] + price < key)
        key[nearer], before[nearer] = _PATHS * cost[node] + price[nearer], node
        cost[nearer] = cost[node] + price[nearer]
    tree = Skeleton.from_edges(nodes, before, np.full(len(nodes), spacing / 2))
    return tree.subset(prune_spurs(tree.nodes, tree.parent, tree.radius, _SPUR)[0])
