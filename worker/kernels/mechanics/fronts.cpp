// The structure of a supernodal Cholesky factor: elimination tree, postorder, columns, supernodes,
// work spaces and positions, on nodes with three rows and columns each (Liu 1986, 1992; Duff and Reid 1983).
#include "../lanes.hpp"
#include "panel.hpp"

// Writes each node's parent [count], -1 at roots, from the strictly lower triangle by rows.
KERNEL void elimination_tree(const int64_t* starts, const int64_t* columns, int64_t* parent,
                             int64_t /*starts_count*/, int64_t /*entries*/, int64_t count) {
  Scratch<int64_t> ancestor(count);
  for (int64_t i = 0; i < count; ++i) {
    parent[i] = ancestor[i] = -1;
    for (int64_t p = starts[i]; p < starts[i + 1]; ++p)
      for (int64_t k = columns[p], next; k != -1 && k < i; k = next) {
        next = ancestor[k];
        ancestor[k] = i;
        if (next == -1) parent[k] = i;
      }
  }
}

// Writes the nodes [count] with each subtree in one run, children first.
KERNEL void postorder(const int64_t* parent, int64_t* order, int64_t count) {
  Scratch<int64_t> head(count), following(count), stack(count);
  head.fill(count, -1);
  for (int64_t node = count - 1; node >= 0; --node)
    if (parent[node] >= 0) {
      following[node] = head[parent[node]];
      head[parent[node]] = node;
    } else {
      following[node] = -1;
    }
  int64_t done = 0;
  for (int64_t root = 0; root < count; ++root) {
    if (parent[root] != -1) continue;
    int64_t top = 0;
    stack[0] = root;
    while (top >= 0) {
      const int64_t node = stack[top], child = head[node];
      if (child == -1) {
        order[done++] = node;
        --top;
      } else {
        head[node] = following[child];
        stack[++top] = child;
      }
    }
  }
}

// Finds the factor's rows strictly below each column: row i has entries in the columns on the ways
// from its own entries up the tree. First call, `below` empty: writes how many, `lengths` [count].
// Second call: writes the rows, ascending in each column, from `begin` [count] on.
KERNEL void column_structure(const int64_t* starts, const int64_t* columns, const int64_t* parent, const int64_t* begin,
                             int64_t* lengths, int64_t* below,
                             int64_t /*starts_count*/, int64_t /*entries*/, int64_t count, int64_t below_count) {
  Scratch<int64_t> mark(count);
  mark.fill(count, -1);
  memset(lengths, 0, count * sizeof(int64_t));
  for (int64_t i = 0; i < count; ++i) {
    mark[i] = i;
    for (int64_t p = starts[i]; p < starts[i + 1]; ++p)
      for (int64_t k = columns[p]; mark[k] != i; k = parent[k]) {
        mark[k] = i;
        if (below_count > 0) below[begin[k] + lengths[k]] = i;
        ++lengths[k];
      }
  }
}

// Writes the first node of each supernode [count], a run of columns eliminated together; returns
// how many. A child is joined where at most the fraction `zeros_allowed` [limits] of the entries of
// `widest` [limits] joint columns would be zeros.
KERNEL int64_t supernodes(const int64_t* parent, const int64_t* lengths, const int64_t* widest, const double* zeros_allowed,
                          int64_t* first, int64_t count, int64_t limits) {
  Scratch<int64_t> last(count);
  Scratch<double> zeros(count);
  int64_t top = -1;
  for (int64_t j = 0; j < count; ++j) {
    if (top >= 0 && parent[j - 1] == j && lengths[j - 1] == lengths[j] + 1) {
      // The rows of the current run and of this column agree.
      last[top] = j;
    } else {
      ++top;
      first[top] = last[top] = j;
      zeros[top] = 0.0;
    }
    if (j + 1 < count && parent[j] == j + 1 && lengths[j] == lengths[j + 1] + 1) continue;
    // The run is complete: join the last child as long as that adds few zeros.
    while (top > 0 && parent[last[top - 1]] >= 0 && parent[last[top - 1]] <= last[top]) {
      const int64_t own = last[top] - first[top] + 1, others = last[top - 1] - first[top - 1] + 1, wide = own + others;
      const double added = static_cast<double>(others * (own + lengths[last[top]] - lengths[last[top - 1]]));
      const double total = zeros[top] + zeros[top - 1] + added;
      const double entries = wide * (wide + 1) / 2.0 + static_cast<double>(wide * lengths[last[top]]);
      bool is_allowed = false;
      for (int64_t k = 0; k < limits; ++k)
        is_allowed = is_allowed || (3 * wide <= widest[k] && total <= zeros_allowed[k] * entries);
      if (!is_allowed) break;
      last[top - 1] = last[top];
      zeros[top - 1] = total;
      --top;
    }
  }
  return top + 1;
}

// Writes depth modulo 2 and the start of each front's update matrix [fronts], and both work spaces'
// sizes [2]. Matrices of one parity form a stack: a parent's is pushed after its grandchildren's are popped.
KERNEL void work_offsets(const int64_t* parents, const int64_t* sizes, const int64_t* children, const int64_t* child_start,
                         int64_t* depth, int64_t* begin, int64_t* most, int64_t fronts, int64_t /*starts_count*/) {
  for (int64_t s = fronts - 1; s >= 0; --s) depth[s] = parents[s] >= 0 ? 1 - depth[parents[s]] : 0;
  int64_t top[2] = {0, 0};
  most[0] = most[1] = 0;
  for (int64_t s = 0; s < fronts; ++s) {
    const int64_t own = depth[s];
    begin[s] = top[own];
    top[own] += sizes[s];
    most[own] = greater(most[own], top[own]);
    for (int64_t k = child_start[s]; k < child_start[s + 1]; ++k) top[1 - own] -= sizes[children[k]];
  }
}

// Writes where each of a front's rows below stands in its parent's front, as node.
KERNEL void row_positions(const int64_t* first, const int64_t* row_start, const int32_t* rows, const int64_t* parents,
                          int32_t* positions, int64_t starts_count, int64_t /*row_count*/, int64_t fronts) {
  Scratch<int64_t> where(first[starts_count - 1]);
  for (int64_t s = 0; s < fronts; ++s) {
    const int64_t above = parents[s];
    if (above < 0) continue;
    const int64_t width = first[above + 1] - first[above];
    for (int64_t p = row_start[above]; p < row_start[above + 1]; ++p) where[rows[p]] = width + p - row_start[above];
    for (int64_t p = row_start[s]; p < row_start[s + 1]; ++p)
      positions[p] = static_cast<int32_t>(rows[p] < first[above + 1] ? rows[p] - first[above] : where[rows[p]]);
  }
}

// Writes the position of each value (lower triangle by columns) in its supernode's columns, [9 entries - 3 count].
KERNEL void targets(const int64_t* starts, const int64_t* rows, const int64_t* first, const int64_t* row_start,
                    const int32_t* front_rows, const int64_t* owner, int32_t* out, int64_t /*starts_count*/,
                    int64_t /*entries*/, int64_t /*fronts_count*/, int64_t /*row_count*/, int64_t count, int64_t /*values*/) {
  Scratch<int64_t> where(count);
  int64_t filled = -1;
  for (int64_t j = 0; j < count; ++j) {
    const int64_t s = owner[j];
    const Front front(first, row_start, s);
    if (filled != s) {
      filled = s;
      for (int64_t p = row_start[s]; p < row_start[s + 1]; ++p) where[front_rows[p]] = front.pivots + 3 * (p - row_start[s]);
    }
    for (int64_t jj = 0; jj < 3; ++jj) {
      const int64_t base = (3 * (j - first[s]) + jj) * front.height;
      for (int64_t p = starts[j]; p < starts[j + 1]; ++p) {
        const int64_t r = rows[p], at = r < first[s + 1] ? 3 * (r - first[s]) : where[r];
        for (int64_t ii = r == j ? jj : 0; ii < 3; ++ii) *out++ = static_cast<int32_t>(base + at + ii);
      }
    }
  }
}
