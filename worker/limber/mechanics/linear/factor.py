"""Factorisation of a symmetric matrix with a fixed pattern and changing values.

Limber's own supernodal factor is made for slender branches. For the dense kernels of bulky meshes a
general library is used (:mod:`limber.core.numerics.sparse`).
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
"""Most operations of a factorisation that Limber's own loops do. At 1.5e10 they are still 1.7 times
as fast as CHOLMOD, whose fraction of fast dense kernels grows with the fronts.
"""


Factor = SupernodalFactor | CholmodFactor | SuperLuFactor


def make_factor(pattern: "Pattern") -> Factor:
    """Return the fastest installed factor for a pattern."""
    fronts = make_fronts(pattern.node_starts, pattern.node_rows)
    if fronts.flops <= _MOST_FLOPS:
        return SupernodalFactor(fronts)
    # The elimination order is Limber's own, found once on nodes instead of rows.
    return general_factor(*pattern.entries(), pattern.size)


def elimination_order(graph: sp.csr_matrix) -> np.ndarray:
    """Return an order of nodes (new to old) with little fill, by approximate minimum degree.

    Each subtree of the elimination is a contiguous run (postorder).

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
