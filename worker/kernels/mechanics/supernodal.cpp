// Supernodal Cholesky factor A = L L' of a branch by fronts, and solutions with it.
//
// The fronts of a slender branch are small, so a general library spends most of its time on
// overhead (CHOLMOD: a third on transposing the matrix, a quarter in BLAS). Here values go directly
// to their positions, and loops over rows take whole vectors.
//
// Shared arguments, with fronts s: `first` [fronts + 1] nodes, `row_start` [fronts + 1] into `rows`,
// `panel` [fronts + 1] starts of columns in `factor`; `inverse` [3 nodes] of the diagonal.
#include "panel.hpp"

namespace {

// Subtracts from three columns of `target`, over `height` rows (a multiple of kPad), the outer
// product of `width` columns' rows from `rows` on with their three rows from `pivot` on.
INLINE void subtract(const double* columns, int64_t width, int64_t stride, int64_t pivot, int64_t rows, int64_t height,
                     double* target, int64_t target_stride) {
  double *one = target, *two = target + target_stride, *three = two + target_stride;
  const double *source = columns + rows, *factors = columns + pivot;
  for (int64_t i = 0; i < height; i += 2 * kLanes) {
    Lanes a{}, b{}, c{}, d{}, e{}, f{};
    for (int64_t k = 0; k < width; ++k) {
      const Lanes x = load(source + k * stride + i), y = load(source + k * stride + i + kLanes);
      const double *at = factors + k * stride;
      const Lanes p = all(at[0]), q = all(at[1]), r = all(at[2]);
      a += p * x; b += p * y;
      c += q * x; d += q * y;
      e += r * x; f += r * y;
    }
    store(one + i, load(one + i) - a); store(one + i + kLanes, load(one + i + kLanes) - b);
    store(two + i, load(two + i) - c); store(two + i + kLanes, load(two + i + kLanes) - d);
    store(three + i, load(three + i) - e); store(three + i + kLanes, load(three + i + kLanes) - f);
  }
}

// Factorises a front's columns, three at a time; false if a pivot is not positive.
bool eliminate(double* columns, int64_t width, int64_t height, double* inverse) {
  for (int64_t j = 0; j < width; j += 3) {
    const int64_t begin = j / kPad * kPad;
    double *one = columns + j * height, *two = one + height, *three = two + height;
    subtract(columns, j, height, j, begin, height - begin, one + begin, height);
    const double d0 = one[j];
    if (!(d0 > 0.0)) return false;
    const double l00 = sqrt(d0), l10 = one[j + 1] / l00, l20 = one[j + 2] / l00;
    const double d1 = two[j + 1] - l10 * l10;
    if (!(d1 > 0.0)) return false;
    const double l11 = sqrt(d1), l21 = (two[j + 2] - l20 * l10) / l11;
    const double d2 = three[j + 2] - l20 * l20 - l21 * l21;
    if (!(d2 > 0.0)) return false;
    const double l22 = sqrt(d2), i0 = 1.0 / l00, i1 = 1.0 / l11, i2 = 1.0 / l22;
    inverse[j] = i0; inverse[j + 1] = i1; inverse[j + 2] = i2;
    for (int64_t i = begin; i < height; i += kLanes) {
      const Lanes x = load(one + i) * i0, y = (load(two + i) - l10 * x) * i1;
      store(one + i, x);
      store(two + i, y);
      store(three + i, (load(three + i) - l20 * x - l21 * y) * i2);
    }
    one[j] = l00; one[j + 1] = l10; one[j + 2] = l20;
    two[j + 1] = l11; two[j + 2] = l21;
    three[j + 2] = l22;
  }
  return true;
}

INLINE void add_rows(const double* source, const int32_t* rows, int64_t begin, int64_t end, double* target) {
  for (int64_t k = begin; k < end; ++k) {
    double* to = target + 3 * int64_t{rows[k]};
    to[0] += source[3 * k]; to[1] += source[3 * k + 1]; to[2] += source[3 * k + 2];
  }
}

// Adds a child's update matrix, of columns with `size` rows, to the front's columns and update matrix.
void extend(const double* source, int64_t size, const int32_t* rows, int64_t count, const Front& front,
            double* columns, double* update) {
  const int64_t nodes = front.width / 3, gap = front.pivots - front.width;
  int64_t inner = 0;
  while (inner < count && rows[inner] < nodes) ++inner;
  for (int64_t k = 0; k < count; ++k)
    for (int64_t j = 0; j < 3; ++j) {
      const double* at = source + (3 * k + j) * size;
      if (k < inner) {
        double* to = columns + (3 * int64_t{rows[k]} + j) * front.height;
        add_rows(at, rows, k, inner, to);
        add_rows(at, rows, inner, count, to + gap);
      } else {
        // Rows of the update matrix are counted from its first row.
        add_rows(at, rows, k, count, update + (3 * (rows[k] - nodes) + j) * front.padded - front.width);
      }
    }
}

// A solution's three unknowns of one node, at a front's columns one, two, three, and row j.
struct Three { double x, y, z; };

INLINE Three solved_down(double* own, const double* one, const double* two, int64_t j, const double* inverse) {
  const double x = own[j] * inverse[j], y = (own[j + 1] - one[j + 1] * x) * inverse[j + 1];
  const double z = (own[j + 2] - one[j + 2] * x - two[j + 2] * y) * inverse[j + 2];
  own[j] = x; own[j + 1] = y; own[j + 2] = z;
  return {x, y, z};
}
INLINE void solve_node_up(double* own, const double* one, const double* two, int64_t j, const double* inverse, Three s) {
  own[j + 2] = s.z * inverse[j + 2];
  own[j + 1] = (s.y - two[j + 2] * own[j + 2]) * inverse[j + 1];
  own[j] = (s.x - one[j + 1] * own[j + 1] - one[j + 2] * own[j + 2]) * inverse[j];
}
INLINE bool any(const double* values, int64_t count) {
  for (int64_t k = 0; k < count; ++k)
    if (values[k] != 0.0) return true;
  return false;
}
INLINE int64_t tallest(const int64_t* row_start, int64_t fronts) {
  int64_t most = 0;
  for (int64_t s = 0; s < fronts; ++s) most = greater(most, row_start[s + 1] - row_start[s]);
  return 3 * most + kPad;
}

// Takes a front's sums from the unknowns below it.
INLINE void subtract_below(const double* sums, const int32_t* rows, int64_t nodes, double* x) {
  for (int64_t n = 0; n < nodes; ++n)
    for (int i = 0; i < 3; ++i) x[3 * int64_t{rows[n]} + i] -= sums[3 * n + i];
}

// Right sides lie one after the other, `size` numbers each; `sides` of them share each reading of
// the factor, which is what takes the time.
template <int sides>
INLINE void down(const int64_t* first, const int64_t* row_start, const int32_t* rows, const int64_t* panel,
                 const double* factor, const double* inverse, double* x, int64_t fronts, int64_t size) {
  const int64_t room = tallest(row_start, fronts);
  Scratch<double> sums(sides * room);
  for (int64_t s = 0; s < fronts; ++s) {
    const Front f(first, row_start, s);
    bool is_empty = true;
    for (int k = 0; k < sides; ++k) is_empty = is_empty && !any(x + k * size + f.start, f.width);
    if (is_empty) continue;  // forces act on a patch: most fronts receive nothing
    for (int k = 0; k < sides; ++k) memset(sums.begin() + k * room, 0, f.padded * sizeof(double));
    for (int64_t j = 0; j < f.width; j += 3) {
      const double *one = factor + panel[s] + j * f.height, *two = one + f.height, *three = two + f.height;
      Three v[sides];
      for (int k = 0; k < sides; ++k) v[k] = solved_down(x + k * size + f.start, one, two, j, inverse + f.start);
      int64_t i = j + 3;
      for (; i + kLanes <= f.width; i += kLanes) {
        const Lanes a = load(one + i), b = load(two + i), c = load(three + i);
        for (int k = 0; k < sides; ++k) {
          double* own = x + k * size + f.start + i;
          store(own, load(own) - (a * v[k].x + b * v[k].y + c * v[k].z));
        }
      }
      for (; i < f.width; ++i)
        for (int k = 0; k < sides; ++k) x[k * size + f.start + i] -= one[i] * v[k].x + two[i] * v[k].y + three[i] * v[k].z;
      for (i = 0; i < f.padded; i += kLanes) {
        const Lanes a = load(one + f.pivots + i), b = load(two + f.pivots + i), c = load(three + f.pivots + i);
        for (int k = 0; k < sides; ++k) {
          double* own = sums.begin() + k * room + i;
          store(own, load(own) + (a * v[k].x + b * v[k].y + c * v[k].z));
        }
      }
    }
    for (int k = 0; k < sides; ++k) subtract_below(sums.begin() + k * room, rows + row_start[s], f.below / 3, x + k * size);
  }
}

template <int sides>
INLINE void up(const int64_t* first, const int64_t* row_start, const int32_t* rows, const int64_t* panel,
               const double* factor, const double* inverse, double* x, int64_t fronts, int64_t size) {
  const int64_t room = tallest(row_start, fronts);
  Scratch<double> known(sides * room);
  for (int64_t s = fronts - 1; s >= 0; --s) {
    const Front f(first, row_start, s);
    for (int k = 0; k < sides; ++k) {
      double* to = known.begin() + k * room;
      for (int64_t n = 0; n < f.below / 3; ++n)
        for (int i = 0; i < 3; ++i) to[3 * n + i] = x[k * size + 3 * int64_t{rows[row_start[s] + n]} + i];
      for (int64_t i = f.below; i < f.padded; ++i) to[i] = 0.0;
    }
    for (int64_t j = f.width - 3; j >= 0; j -= 3) {
      const double *one = factor + panel[s] + j * f.height, *two = one + f.height, *three = two + f.height;
      Lanes sums[sides][3] = {};
      int64_t i = j + 3;
      for (; i + kLanes <= f.width; i += kLanes) {
        const Lanes a = load(one + i), b = load(two + i), c = load(three + i);
        for (int k = 0; k < sides; ++k) {
          const Lanes own = load(x + k * size + f.start + i);
          sums[k][0] += a * own; sums[k][1] += b * own; sums[k][2] += c * own;
        }
      }
      Three rest[sides] = {};
      for (; i < f.width; ++i)
        for (int k = 0; k < sides; ++k) {
          const double own = x[k * size + f.start + i];
          rest[k].x += one[i] * own; rest[k].y += two[i] * own; rest[k].z += three[i] * own;
        }
      for (i = 0; i < f.padded; i += kLanes) {
        const Lanes a = load(one + f.pivots + i), b = load(two + f.pivots + i), c = load(three + f.pivots + i);
        for (int k = 0; k < sides; ++k) {
          const Lanes own = load(known.begin() + k * room + i);
          sums[k][0] += a * own; sums[k][1] += b * own; sums[k][2] += c * own;
        }
      }
      for (int k = 0; k < sides; ++k) {
        double* own = x + k * size + f.start;
        solve_node_up(own, one, two, j, inverse + f.start,
                      {own[j] - (sum(sums[k][0]) + rest[k].x), own[j + 1] - (sum(sums[k][1]) + rest[k].y),
                       own[j + 2] - (sum(sums[k][2]) + rest[k].z)});
      }
    }
  }
}

}  // namespace

// Factorises a matrix of `values`, lower triangle by columns; false if it is not positive definite.
// `even` and `odd` are the work spaces of update matrices of even and odd depth.
KERNEL int64_t factorise(
    const double* values, const int64_t* value_start, const int32_t* targets, const int64_t* first, const int64_t* row_start,
    const int64_t* panel, const int32_t* row_positions, const int64_t* children, const int64_t* child_start,
    const int64_t* work, const int64_t* depth, double* even, double* odd, double* factor, double* inverse,
    int64_t /*value_count*/, int64_t starts_count, int64_t /*row_count*/, int64_t /*fronts*/, int64_t /*even_size*/,
    int64_t /*odd_size*/, int64_t /*entries*/, int64_t /*size*/) {
  for (int64_t s = 0; s + 1 < starts_count; ++s) {
    const Front f(first, row_start, s);
    double* columns = factor + panel[s];
    memset(columns, 0, f.width * f.height * sizeof(double));
    for (int64_t p = value_start[s]; p < value_start[s + 1]; ++p) columns[targets[p]] = values[p];
    double *own = depth[s] == 0 ? even : odd, *theirs = depth[s] == 0 ? odd : even, *update = own + work[s];
    memset(update, 0, f.padded * f.below * sizeof(double));
    for (int64_t k = child_start[s]; k < child_start[s + 1]; ++k) {
      const int64_t child = children[k], begin = row_start[child], count = row_start[child + 1] - begin;
      extend(theirs + work[child], padded_rows(3 * count), row_positions + begin, count, f, columns, update);
    }
    if (!eliminate(columns, f.width, f.height, inverse + f.start)) return false;
    for (int64_t j = 0; j < f.below; j += 3) {
      const int64_t begin = j / kPad * kPad;
      subtract(columns, f.width, f.height, f.pivots + j, f.pivots + begin, f.padded - begin,
               update + j * f.padded + begin, f.padded);
    }
  }
  return true;
}

// Solves in place for right sides x [sides, 3 nodes], three at once: with the factor (down through the fronts).
KERNEL void solve_down(const int64_t* first, const int64_t* row_start, const int32_t* rows, const int64_t* panel,
                       const double* factor, const double* inverse, double* x,
                       int64_t starts_count, int64_t /*row_count*/, int64_t /*entries*/, int64_t size, int64_t sides) {
  int64_t k = 0;
  for (; k + 3 <= sides; k += 3) down<3>(first, row_start, rows, panel, factor, inverse, x + k * size, starts_count - 1, size);
  for (; k < sides; ++k) down<1>(first, row_start, rows, panel, factor, inverse, x + k * size, starts_count - 1, size);
}

// As solve_down, with the factor's transpose (up through the fronts).
KERNEL void solve_up(const int64_t* first, const int64_t* row_start, const int32_t* rows, const int64_t* panel,
                     const double* factor, const double* inverse, double* x,
                     int64_t starts_count, int64_t /*row_count*/, int64_t /*entries*/, int64_t size, int64_t sides) {
  int64_t k = 0;
  for (; k + 3 <= sides; k += 3) up<3>(first, row_start, rows, panel, factor, inverse, x + k * size, starts_count - 1, size);
  for (; k < sides; ++k) up<1>(first, row_start, rows, panel, factor, inverse, x + k * size, starts_count - 1, size);
}
