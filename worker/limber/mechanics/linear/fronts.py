"""Symbolic part of the supernodal Cholesky factor: elimination tree, supernodes, fronts.

The structure is found on nodes, with three rows and columns each. A supernode is a run of columns
that are eliminated together; its front is a dense matrix of those columns' rows: first the columns'
own, then those below, each part padded to whole vectors. The remainder of a front (its update
matrix) is added into its parent's front (Duff and Reid 1983, Liu 1992).
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from limber.kernels import Kernel

PAD = 8
"""Rows are padded to multiples of this, so loops over rows have no remainder."""

_RELAX = ((24, 0.4), (72, 0.1), (200, 0.05))
"""Limits for joining a child to its parent: joint columns and largest fraction of zeros. Chosen
along with the kernels on 2,752 quadratic tetrahedra; not measured one by one.
"""


@dataclass(frozen=True)
class Fronts:
    """Layout of a factor. Per supernode: first node, ``rows`` below with positions in the parent's
    front, start of columns in ``panel`` and of values, whose ``targets`` are in its columns. Update
    matrices lie in two work spaces, of even and odd ``depth``."""

    first: np.ndarray
    row_start: np.ndarray
    rows: np.ndarray
    row_positions: np.ndarray
    panel: np.ndarray
    children: np.ndarray
    child_start: np.ndarray
    work: np.ndarray
    depth: np.ndarray
    work_size: np.ndarray
    value_start: np.ndarray
    targets: np.ndarray
    flops: float


_elimination_tree = Kernel(
    "elimination_tree", "starts int64[starts]", "columns int64[entries]", "out parent int64[nodes]")
_postorder = Kernel("postorder", "parent int64[nodes]", "out order int64[nodes]")
_column_structure = Kernel(
    "column_structure", "starts int64[starts]", "columns int64[entries]", "parent int64[nodes]",
    "begin int64[nodes]", "out lengths int64[nodes]", "out below int64[rows]")
_supernodes = Kernel(
    "supernodes", "parent int64[nodes]", "lengths int64[nodes]", "widest int64[limits]",
    "zeros_allowed float64[limits]", "out first int64[nodes]", returns="int")
_work_offsets = Kernel(
    "work_offsets", "parents int64[fronts]", "sizes int64[fronts]", "children int64[fronts]",
    "child_start int64[starts]", "out depth int64[fronts]", "out begin int64[fronts]",
    "out most int64[2]")
_row_positions = Kernel(
    "row_positions", "first int64[starts]", "row_start int64[starts]", "rows int32[rows]",
    "parents int64[fronts]", "out positions int32[rows]")
_targets = Kernel(
    "targets", "starts int64[starts]", "rows int64[entries]", "first int64[fronts]",
    "row_start int64[fronts]", "front_rows int32[rows]", "owner int64[nodes]",
    "out targets int32[values]")


def _tree(lower: sp.csr_matrix) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return starts, columns and each node's parent (-1: root) of a strictly lower triangle."""
    starts, columns = lower.indptr.astype(np.int64), lower.indices.astype(np.int64)
    parent = np.empty(len(starts) - 1, np.int64)
    _elimination_tree(starts, columns, parent)
    return starts, columns, parent


def postordered(graph: sp.csr_matrix, order: np.ndarray) -> np.ndarray:
    """Return an order of elimination (new to old) with the same fill, in which each subtree is a
    contiguous run."""
    *_, parent = _tree(sp.tril(graph[order][:, order], -1).tocsr())
    turn = np.empty_like(parent)
    _postorder(parent, turn)
    return order[turn]


def make_fronts(starts: np.ndarray, rows: np.ndarray) -> Fronts:
    """Return the fronts of a matrix in postorder from its lower triangle with diagonal, on nodes,
    by columns, sorted."""
    count = len(starts) - 1
    lower = sp.csc_matrix((np.ones(len(rows), np.int8), rows, starts), (count, count))
    tree = _tree(sp.tril(lower, -1).tocsr())
    parent = tree[-1]
    starts, rows = starts.astype(np.int64), rows.astype(np.int64)
    below_count = np.empty(count, np.int64)
    _column_structure(*tree, parent, below_count, np.empty(0, np.int64))
    column_start = np.concatenate([[0], np.cumsum(below_count)])
    below = np.empty(column_start[-1], np.int64)
    _column_structure(*tree, column_start[:-1], below_count, below)
    first = np.empty(count, np.int64)
    joined = _supernodes(parent, below_count, np.array([r[0] for r in _RELAX]),
                         np.array([r[1] for r in _RELAX]), first)
    first = np.append(first[:joined], count)
    last = first[1:] - 1
    widths = np.diff(first)
    lengths = below_count[last]
    row_start = np.concatenate([[0], np.cumsum(lengths)])
    front_rows = below[_runs(column_start[last], lengths)].astype(np.int32)
    owner = np.repeat(np.arange(len(widths)), widths)
    parents = np.where(lengths > 0, owner[front_rows[np.minimum(row_start[:-1],
                                                                len(front_rows) - 1)]]
                       if len(front_rows) else -1, -1)
    heights = _padded(3 * widths) + _padded(3 * lengths)
    panel = np.concatenate([[0], np.cumsum(3 * widths * heights)])
    children = np.argsort(parents, kind="stable")
    child_start = np.searchsorted(parents[children], np.arange(len(widths) + 1))
    depth, work, work_size = np.empty_like(parents), np.empty_like(parents), np.empty(2, np.int64)
    _work_offsets(parents, _padded(3 * lengths) * 3 * lengths, children, child_start, depth, work,
                  work_size)
    row_positions = np.empty_like(front_rows)
    _row_positions(first, row_start, front_rows, parents, row_positions)
    targets = np.empty(9 * len(rows) - 3 * count, np.int32)
    _targets(starts, rows, first, row_start, front_rows, owner, targets)
    value_start = 9 * starts[first] - 3 * first
    tall = (3 * (widths + lengths)).astype(float)
    flops = sum(float((np.maximum(tall - k, 0) ** 2 * (3 * widths > k)).sum())
                for k in range(int(3 * widths.max())))
    return Fronts(first, row_start, front_rows, row_positions, panel, children, child_start, work,
                  depth, work_size, value_start, targets, flops)


def _padded(rows: np.ndarray) -> np.ndarray:
    return -(-rows // PAD) * PAD


def _runs(begins: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the numbers of several runs, concatenated."""
    shift = np.repeat(begins - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
    return np.arange(lengths.sum()) + shift

