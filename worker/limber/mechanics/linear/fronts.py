"""Symbolic part of the supernodal Cholesky factor: elimination tree, supernodes, fronts.

The structure is found on nodes, with three rows and columns each. A supernode is a run of columns
that are eliminated together; its front is a dense matrix of those columns' rows: first the columns'
own, then those below, each part padded to whole vectors. The remainder of a front (its update
matrix) is added into its parent's front (Duff and Reid 1983, Liu 1992).
"""

from dataclasses import dataclass

import numpy as np
import scipy.sparse as sp

from limber.core.numerics.compiled import compiled

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


def postordered(graph: sp.csr_matrix, order: np.ndarray) -> np.ndarray:
    """Return an order of elimination (new to old) with the same fill, in which each subtree is a
    contiguous run."""
    lower = sp.tril(graph[order][:, order], -1).tocsr()
    parent = _elimination_tree(lower.indptr.astype(np.int64), lower.indices.astype(np.int64))
    return order[_postorder(parent)]


def make_fronts(starts: np.ndarray, rows: np.ndarray) -> Fronts:
    """Return the fronts of a matrix in postorder from its lower triangle with diagonal, on nodes,
    by columns, sorted."""
    count = len(starts) - 1
    lower = sp.csc_matrix((np.ones(len(rows), np.int8), rows, starts), (count, count))
    by_rows = sp.tril(lower, -1).tocsr()
    parent = _elimination_tree(by_rows.indptr.astype(np.int64), by_rows.indices.astype(np.int64))
    starts, rows = starts.astype(np.int64), rows.astype(np.int64)
    column_start, below = _column_structure(starts, rows, parent)
    below = _sorted_in_columns(column_start, below)
    first = np.append(_supernodes(parent, np.diff(column_start), np.array([r[0] for r in _RELAX]),
                                  np.array([r[1] for r in _RELAX])), count)
    last = first[1:] - 1
    widths = np.diff(first)
    lengths = np.diff(column_start)[last]
    row_start = np.concatenate([[0], np.cumsum(lengths)])
    kept = _runs(column_start[last], lengths)
    front_rows = below[kept]
    owner = np.repeat(np.arange(len(widths)), widths)
    parents = np.where(lengths > 0, owner[front_rows[np.minimum(row_start[:-1],
                                                                len(front_rows) - 1)]]
                       if len(front_rows) else -1, -1)
    heights = _padded(3 * widths) + _padded(3 * lengths)
    panel = np.concatenate([[0], np.cumsum(3 * widths * heights)])
    children = np.argsort(parents, kind="stable")
    child_start = np.searchsorted(parents[children], np.arange(len(widths) + 1))
    depth, work, work_size = _work_offsets(parents, _padded(3 * lengths) * 3 * lengths,
                                           children, child_start)
    row_positions = _row_positions(first, row_start, front_rows, parents)
    targets = _targets(starts, rows, first, row_start, front_rows, owner)
    value_start = 9 * starts[first] - 3 * first
    tall = (3 * (widths + lengths)).astype(float)
    flops = sum(float((np.maximum(tall - k, 0) ** 2 * (3 * widths > k)).sum())
                for k in range(int(3 * widths.max())))
    return Fronts(first, row_start, front_rows.astype(np.int32), row_positions, panel,
                  children, child_start, work, depth, work_size, value_start, targets, flops)


def _padded(rows: np.ndarray) -> np.ndarray:
    return -(-rows // PAD) * PAD


def _runs(begins: np.ndarray, lengths: np.ndarray) -> np.ndarray:
    """Return the numbers of several runs, concatenated."""
    shift = np.repeat(begins - np.concatenate([[0], np.cumsum(lengths)[:-1]]), lengths)
    return np.arange(lengths.sum()) + shift


def _sorted_in_columns(starts: np.ndarray, rows: np.ndarray) -> np.ndarray:
    """Return the rows of each column, ascending."""
    # Not in the kernel: to compile a sort takes a second.
    count = len(starts) - 1
    pattern = sp.csc_matrix((np.ones(len(rows), np.int8), rows, starts), (count, count))
    pattern.sort_indices()
    return pattern.indices.astype(np.int64)


@compiled
def _elimination_tree(starts, columns):
    """Return each node's parent, -1 at roots (Liu 1986); the strictly lower triangle by rows."""
    count = len(starts) - 1
    parent, ancestor = np.full(count, -1), np.full(count, -1)
    for i in range(count):
        for p in range(starts[i], starts[i + 1]):
            k = columns[p]
            while k != -1 and k < i:
                following = ancestor[k]
                ancestor[k] = i
                if following == -1:
                    parent[k] = i
                k = following
    return parent


@compiled
def _postorder(parent):
    count = len(parent)
    head, following = np.full(count, -1), np.full(count, -1)
    for node in range(count - 1, -1, -1):
        if parent[node] >= 0:
            following[node] = head[parent[node]]
            head[parent[node]] = node
    order, stack, done = np.empty(count, np.int64), np.empty(count, np.int64), 0
    for root in range(count):
        if parent[root] != -1:
            continue
        top = 0
        stack[0] = root
        while top >= 0:
            node = stack[top]
            child = head[node]
            if child == -1:
                order[done] = node
                done += 1
                top -= 1
            else:
                head[node] = following[child]
                top += 1
                stack[top] = child
    return order


@compiled
def _column_structure(starts, rows, parent):
    """Return the factor's rows strictly below each column, in any order."""
    count = len(parent)
    head, following = np.full(count, -1), np.full(count, -1)
    mark = np.full(count, -1)
    begin = np.zeros(count + 1, np.int64)
    below = np.empty(4 * len(rows) + 16, np.int64)
    for j in range(count):
        mark[j] = j
        end = begin[j]
        if end + count > len(below):
            larger = np.empty(2 * len(below) + count, np.int64)
            for p in range(end):
                larger[p] = below[p]
            below = larger
        for p in range(starts[j], starts[j + 1]):
            if mark[rows[p]] != j:
                mark[rows[p]] = j
                below[end] = rows[p]
                end += 1
        child = head[j]
        while child != -1:
            for p in range(begin[child], begin[child + 1]):
                if mark[below[p]] != j:
                    mark[below[p]] = j
                    below[end] = below[p]
                    end += 1
            child = following[child]
        begin[j + 1] = end
        if parent[j] >= 0:
            following[j] = head[parent[j]]
            head[parent[j]] = j
    return begin, below[:begin[count]].copy()


@compiled
def _supernodes(parent, lengths, widest, zeros_allowed):
    """Return the first node of each supernode."""
    count = len(parent)
    # A stack of supernodes: first node, last node, number of zero entries.
    first, last = np.empty(count, np.int64), np.empty(count, np.int64)
    zeros = np.empty(count)
    top = -1
    for j in range(count):
        if top >= 0 and parent[j - 1] == j and lengths[j - 1] == lengths[j] + 1:
            # The rows of the current run and of this column agree.
            last[top] = j
        else:
            top += 1
            first[top], last[top], zeros[top] = j, j, 0.0
        if j + 1 < count and parent[j] == j + 1 and lengths[j] == lengths[j + 1] + 1:
            continue
        # The run is complete: join the last child as long as that adds few zeros.
        while top > 0 and parent[last[top - 1]] >= 0 and parent[last[top - 1]] <= last[top]:
            own = last[top] - first[top] + 1
            others = last[top - 1] - first[top - 1] + 1
            added = others * (own + lengths[last[top]] - lengths[last[top - 1]])
            wide = own + others
            total = zeros[top] + zeros[top - 1] + added
            entries = wide * (wide + 1) / 2 + wide * lengths[last[top]]
            allowed = False
            for k in range(len(widest)):
                allowed = allowed or (3 * wide <= widest[k]
                                      and total <= zeros_allowed[k] * entries)
            if not allowed:
                break
            last[top - 1] = last[top]
            zeros[top - 1] = total
            top -= 1
    return first[:top + 1].copy()


@compiled
def _work_offsets(parents, sizes, children, child_start):
    """Return depth modulo 2, the start of each update matrix, and both work spaces' sizes. Matrices
    of one parity form a stack: a parent's is pushed after its grandchildren's are popped."""
    count = len(parents)
    depth = np.zeros(count, np.int64)
    for s in range(count - 1, -1, -1):
        if parents[s] >= 0:
            depth[s] = 1 - depth[parents[s]]
    begin, top, most = np.zeros(count, np.int64), np.zeros(2, np.int64), np.zeros(2, np.int64)
    for s in range(count):
        own = depth[s]
        begin[s] = top[own]
        top[own] += sizes[s]
        most[own] = max(most[own], top[own])
        for k in range(child_start[s], child_start[s + 1]):
            top[1 - own] -= sizes[children[k]]
    return depth, begin, most


@compiled
def _row_positions(first, row_start, rows, parents):
    positions = np.empty(len(rows), np.int32)
    where = np.empty(first[-1], np.int64)
    for s in range(len(parents)):
        above = parents[s]
        if above < 0:
            continue
        width = first[above + 1] - first[above]
        for p in range(row_start[above], row_start[above + 1]):
            where[rows[p]] = width + p - row_start[above]
        for p in range(row_start[s], row_start[s + 1]):
            inside = rows[p] < first[above + 1]
            positions[p] = rows[p] - first[above] if inside else where[rows[p]]
    return positions


@compiled
def _targets(starts, rows, first, row_start, front_rows, owner):
    """Return the position of each value (lower triangle by columns) in its supernode's columns."""
    count = len(starts) - 1
    targets = np.empty(9 * len(rows) - 3 * count, np.int32)
    where = np.empty(count, np.int64)
    filled, seen = -1, 0
    for j in range(count):
        s = owner[j]
        width = first[s + 1] - first[s]
        pivots = (3 * width + PAD - 1) // PAD * PAD
        below = 3 * (row_start[s + 1] - row_start[s])
        height = pivots + (below + PAD - 1) // PAD * PAD
        if filled != s:
            filled = s
            for p in range(row_start[s], row_start[s + 1]):
                where[front_rows[p]] = pivots + 3 * (p - row_start[s])
        for jj in range(3):
            base = (3 * (j - first[s]) + jj) * height
            for p in range(starts[j], starts[j + 1]):
                r = rows[p]
                at = 3 * (r - first[s]) if r < first[s + 1] else where[r]
                for ii in range(jj if r == j else 0, 3):
                    targets[seen] = base + at + ii
                    seen += 1
    return targets
