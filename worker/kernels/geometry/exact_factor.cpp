// L D L' of a sparse symmetric matrix, row by row, up along its elimination tree (Davis: Algorithm 849,
// a concise sparse Cholesky factorization package, 2005). The columns are short: no dense blocks.
#include "../lanes.hpp"

// Parents in the elimination tree, -1 at roots, and the entries below each pivot, [n] each, from the
// lower triangle with diagonal by rows.
KERNEL void exact_analysed(const int32_t* starts, const int32_t* columns, int64_t* parent, int64_t* below,
                           int64_t /*starts*/, int64_t /*entries*/, int64_t count) {
  Scratch<int64_t> seen(count);
  for (int64_t row = 0; row < count; ++row) {
    parent[row] = -1;
    below[row] = 0;
    seen[row] = row;
    for (int32_t p = starts[row]; p < starts[row + 1]; ++p)
      for (int64_t k = columns[p]; seen[k] != row; k = parent[k]) {
        if (parent[k] < 0) parent[k] = row;
        ++below[k];
        seen[k] = row;
      }
  }
}

// Row and value of each entry of L, by columns from `begins` [n] on, and the pivots [n]; from the first that
// is not positive on, these are 0.
KERNEL void exact_factorised(const int32_t* starts, const int32_t* columns, const double* values, const int64_t* parent,
                             const int64_t* begins, int64_t* rows, double* factor, double* pivot,
                             int64_t /*starts*/, int64_t /*entries*/, int64_t count, int64_t /*begins*/, int64_t /*below*/) {
  Scratch<int64_t> ends(count), seen(count), path(count), chain(count);
  Scratch<double> work(count);
  for (int64_t k = 0; k < count; ++k) {
    ends[k] = begins[k];
    seen[k] = -1;
    work[k] = pivot[k] = 0.0;
  }
  for (int64_t row = 0; row < count; ++row) {
    seen[row] = row;
    int64_t top = count;
    for (int32_t p = starts[row]; p < starts[row + 1]; ++p) {
      int64_t length = 0;
      work[columns[p]] = values[p];
      for (int64_t k = columns[p]; seen[k] != row; k = parent[k]) {
        chain[length++] = k;
        seen[k] = row;
      }
      while (length > 0) path[--top] = chain[--length];
    }
    double rest = work[row];
    work[row] = 0.0;
    for (int64_t at = top; at < count; ++at) {
      const int64_t k = path[at];
      const double value = work[k];
      work[k] = 0.0;
      for (int64_t p = begins[k]; p < ends[k]; ++p) work[rows[p]] -= factor[p] * value;
      factor[ends[k]] = value / pivot[k];
      rows[ends[k]] = row;
      rest -= factor[ends[k]] * value;
      ++ends[k];
    }
    if (!(rest > 0.0)) return;
    pivot[row] = rest;
  }
}

// Solves in place for right sides [k, n].
KERNEL void exact_solved(const int64_t* begins, const int64_t* rows, const double* factor, const double* pivot, double* sides,
                         int64_t /*begins*/, int64_t /*below*/, int64_t count, int64_t side_count) {
  for (double* x = sides; x < sides + side_count * count; x += count) {
    for (int64_t k = 0; k < count; ++k)
      for (int64_t p = begins[k]; p < begins[k + 1]; ++p) x[rows[p]] -= factor[p] * x[k];
    for (int64_t k = count - 1; k >= 0; --k) {
      x[k] /= pivot[k];
      for (int64_t p = begins[k]; p < begins[k + 1]; ++p) x[k] -= factor[p] * x[rows[p]];
    }
  }
}
