"""Factorisation of a symmetric matrix whose pattern stays and whose values change.

Limber's own supernodal factor, made for slender branches; for the dense kernels of bulky meshes
a general library's (:mod:`limber.core.numerics.sparse`).
"""

from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse as sp

from limber.core.numerics.sparse import CholmodFactor, SuperLuFactor, general_factor
from limber.mechanics.linear.fronts import make_fronts, postordered
from limber.mechanics.linear.supernodal import SupernodalFactor

if TYPE_CHECKING:
    from limber.mechanics.linear.pattern import Pattern

_MOST_FLOPS = 1e11
"""Of a factorisation that Limber's own loops take on; at 1.5e10 they are still 1.7 times as fast
as CHOLMOD, whose share of fast dense kernels grows with the fronts."""


Factor = SupernodalFactor | CholmodFactor | SuperLuFactor


def make_factor(pattern: "Pattern") -> Factor:
    """Return the fastest factor for a pattern that is installed."""
    fronts = make_fronts(pattern.node_starts, pattern.node_rows)
    if fronts.flops <= _MOST_FLOPS:
        return SupernodalFactor(fronts)
    # The order of elimination is ours, found once on nodes instead of rows.
    return general_factor(*pattern.entries(), pattern.size)


def elimination_order(graph: sp.csr_matrix) -> np.ndarray:
    """Return an order of nodes (new to old) with little fill, by approximate minimum degree.

    Each subtree of the elimination is a run (postorder).

    Args:
        graph: Symmetric pattern of the nodes, [n, n].
    """
    try:
        from cvxopt import amd, matrix, spmatrix
    except ImportError:
        from scipy.sparse.csgraph import reverse_cuthill_mckee

        order = reverse_cuthill_mckee(graph, symmetric_mode=True).astype(np.int64)
        return postordered(graph, order)
    lower = sp.tril(graph).tocoo()
    pattern = spmatrix(1.0, matrix(lower.row.astype(np.int64)),
                       matrix(lower.col.astype(np.int64)), graph.shape)
    return postordered(graph, np.array(amd.order(pattern), np.int64).ravel())
