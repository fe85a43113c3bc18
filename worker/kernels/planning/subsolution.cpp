// Loops of the certificate: cells with numbers, fast marching, what corners prove of a cell, and how
// steep a spline is. `numbers` are those of cells with coefficients, -1 elsewhere. A cell at the
// border of its grid has no second differences and is never open.
#include "../lanes.hpp"

namespace {
constexpr int kNearer = 12;         // steps towards the point of a hull nearest to zero
constexpr double kNear = 1e-3;      // of its distance

INLINE Lanes magnitude(Lanes x, Lanes y, Lanes z) { return root(x * x + y * y + z * z); }

// A heap of nodes by their arrival costs; a node may rise in it.
class Front {
 public:
  Front(const double* costs, int64_t count) : costs_(costs), heap_(count), index_(count) { index_.fill(count, -1); }
  bool is_empty() const { return size_ == 0; }
  bool has_seen(int32_t node) { return index_[node] >= 0; }
  void add(int32_t node) {
    heap_[size_] = node;
    index_[node] = static_cast<int32_t>(size_);
    rise(node);
    ++size_;
  }
  void rise(int32_t node) {
    int64_t at = index_[node];
    while (at > 0) {
      const int64_t parent = (at - 1) / 2;
      if (costs_[heap_[parent]] <= costs_[node]) break;
      put(at, heap_[parent]);
      at = parent;
    }
    put(at, node);
  }
  int32_t take() {
    const int32_t first = heap_[0];
    --size_;
    index_[first] = -2;
    const int32_t node = heap_[size_];
    int64_t at = 0;
    for (;;) {
      int64_t child = 2 * at + 1;
      if (child >= size_) break;
      if (child + 1 < size_ && costs_[heap_[child + 1]] < costs_[heap_[child]]) ++child;
      if (costs_[node] <= costs_[heap_[child]]) break;
      put(at, heap_[child]);
      at = child;
    }
    if (size_ > 0) put(at, node);
    return first;
  }

 private:
  void put(int64_t at, int32_t node) {
    heap_[at] = node;
    index_[node] = static_cast<int32_t>(at);
  }
  const double* costs_;
  Scratch<int32_t> heap_, index_;
  int64_t size_ = 0;
};

// Solves sum_i w_i (u - t_i)^2 = rate^2 over the axes whose upwind neighbour is done.
double arrival(const int32_t* near, const double* u, const uint8_t* done, double rate, const double* edges, int64_t node) {
  double t[3], w[3], neighbour[3], edge[3];
  int count = 0;
  for (int axis = 0; axis < 3; ++axis) {
    int best = -1;
    double value = HUGE_VAL;
    for (int side = 2 * axis; side < 2 * axis + 2; ++side) {
      const int32_t other = near[6 * node + side];
      if (other >= 0 && done[other] && u[other] < value) {
        best = side;
        value = u[other];
      }
    }
    if (best < 0) continue;
    const double weight = 1.0 / (edges[axis] * edges[axis]);
    t[count] = neighbour[count] = value;
    w[count] = weight;
    edge[count] = edges[axis];
    const int32_t far = near[6 * static_cast<int64_t>(near[6 * node + best]) + best];
    if (far >= 0 && done[far] && u[far] <= value) {
      t[count] = (4.0 * value - u[far]) / 3.0;
      w[count] = 2.25 * weight;
    }
    ++count;
  }
  // The axis with the highest neighbour is dropped until the solution exceeds all used neighbours.
  while (count > 0) {
    double a = 0.0, b = 0.0, c = -rate * rate, top = -HUGE_VAL;
    int last = 0;
    for (int i = 0; i < count; ++i) {
      a += w[i];
      b += w[i] * t[i];
      c += w[i] * t[i] * t[i];
      if (neighbour[i] > top) {
        top = neighbour[i];
        last = i;
      }
    }
    const double square = b * b - a * c;
    if (square >= 0.0) {
      const double solution = (b + sqrt(square)) / a;
      if (solution >= top) return solution;
    }
    if (count == 1) return neighbour[0] + rate * edge[0];
    --count;
    t[last] = t[count]; w[last] = w[count]; neighbour[last] = neighbour[count]; edge[last] = edge[count];
  }
  return HUGE_VAL;
}

// A lower bound of the distance of zero from the convex hull of 8 corners, by Gilbert's steps: along
// any direction, the hull is beyond its least corner.
double off_zero(const double* corners) {
  double best[3] = {}, least = HUGE_VAL;
  for (const double* corner = corners; corner < corners + 24; corner += 3) {
    const double size = corner[0] * corner[0] + corner[1] * corner[1] + corner[2] * corner[2];
    if (size < least) {
      least = size;
      memcpy(best, corner, sizeof(best));
    }
  }
  double found = 0.0;
  for (int step = 0; step < kNearer; ++step) {
    const double size = sqrt(best[0] * best[0] + best[1] * best[1] + best[2] * best[2]);
    if (size <= 0.0) return 0.0;
    double nearest = HUGE_VAL;
    const double* at = corners;
    for (const double* corner = corners; corner < corners + 24; corner += 3) {
      const double along = (corner[0] * best[0] + corner[1] * best[1] + corner[2] * best[2]) / size;
      if (along < nearest) {
        nearest = along;
        at = corner;
      }
    }
    found = greater(found, nearest);
    if (size - nearest <= kNear * size) break;
    double part = 0.0, whole = 0.0;
    for (int c = 0; c < 3; ++c) {
      const double component = at[c] - best[c];
      part -= component * best[c];
      whole += component * component;
    }
    const double share = lesser(greater(part / whole, 0.0), 1.0);
    for (int c = 0; c < 3; ++c) best[c] += share * (at[c] - best[c]);
  }
  return found;
}

// M_i h^2 of a convex function in a cell, from the change of its slopes times h between its corners;
// `steps` are those between corners along the axes. nan counts as no turn.
void turned(const double* slopes, const int64_t* steps, double* turn) {
  turn[0] = turn[1] = turn[2] = 0.0;
  for (int axis = 0; axis < 3; ++axis) {
    const int64_t along = steps[axis], one = steps[(axis + 1) % 3], two = steps[(axis + 2) % 3];
    for (int p = 0; p < 2; ++p)
      for (int q = 0; q < 2; ++q) {
        const double* at = slopes + 3 * (p * one + q * two) + axis;
        turn[axis] = greater(turn[axis], 2.0 * (at[3 * along] - at[0]));
      }
  }
}

// Bernstein coefficients along an axis of a spline from 3 of its own, and of its slope along it, for
// all lines along the axis; `step` is that between them.
template <int step, class Along>
INLINE void along(const Lanes* source, Lanes* out, const Along& of) {
  constexpr int one = step == 1 ? 3 : 1, two = step == 9 ? 3 : 9;
  for (int p = 0; p < 3; ++p)
    for (int q = 0; q < 3; ++q) {
      const int at = p * two + q * one;
      of(source[at], source[at + step], source[at + 2 * step], out[at], out[at + step], out[at + 2 * step]);
    }
}
INLINE void value_of(Lanes a, Lanes b, Lanes c, Lanes& x, Lanes& y, Lanes& z) { x = 0.5 * (a + b); y = b; z = 0.5 * (b + c); }
INLINE void slope_of(Lanes a, Lanes b, Lanes c, Lanes& x, Lanes& y, Lanes& z) { x = b - a; y = 0.5 * (c - a); z = c - b; }

// The trilinear interpolation at the 27 points (p, q, r) / 2 in a cell; those at its corners are given.
INLINE void interpolated(Lanes* at) {
  for (int p = 0; p < 27; p += 18)
    for (int q = 0; q < 9; q += 6) at[p + q + 1] = 0.5 * (at[p + q] + at[p + q + 2]);
  for (int p = 0; p < 27; p += 18)
    for (int r = 0; r < 3; ++r) at[p + 3 + r] = 0.5 * (at[p + r] + at[p + 6 + r]);
  for (int r = 0; r < 9; ++r) at[9 + r] = 0.5 * (at[r] + at[18 + r]);
}

INLINE Lanes over(Lanes steep, Lanes allowed) { return allowed > 0.0 ? steep / allowed : all(HUGE_VAL); }
}  // namespace

// Numbers of the cells with places `cells` [n] in the flat grid, -1 elsewhere, and those of their
// neighbours below and above along each axis, [n, 6].
KERNEL void cells_numbered(const int64_t* cells, int32_t* numbers, int32_t* near, int64_t count, int64_t nx, int64_t ny,
                           int64_t nz) {
  const int64_t steps[3] = {ny * nz, nz, 1}, shape[3] = {nx, ny, nz};
  memset(numbers, 0xff, nx * ny * nz * sizeof(int32_t));
  for (int64_t k = 0; k < count; ++k) numbers[cells[k]] = static_cast<int32_t>(k);
  for (int64_t k = 0; k < count; ++k)
    for (int axis = 0; axis < 3; ++axis) {
      const int64_t at = cells[k] / steps[axis] % shape[axis];
      near[6 * k + 2 * axis] = at > 0 ? numbers[cells[k] - steps[axis]] : -1;
      near[6 * k + 2 * axis + 1] = at + 1 < shape[axis] ? numbers[cells[k] + steps[axis]] : -1;
    }
}

// Fast marching: |grad u| = rate [1/m] (Sethian 1999), second order where possible. Arrival costs u [n],
// infinite where unreachable, from neighbours [n, 6], values [n] that `known` nodes have at most, and edges [3] [m].
KERNEL void fast_marching(const double* rate, const int32_t* near, const uint8_t* known, const double* values,
                          const double* edges, double* u, int64_t count) {
  Scratch<uint8_t> done(count);
  done.fill(count, 0);
  Front front(u, count);
  for (int64_t node = 0; node < count; ++node) {
    u[node] = known[node] ? values[node] : HUGE_VAL;
    if (known[node]) front.add(static_cast<int32_t>(node));
  }
  while (!front.is_empty()) {
    const int64_t node = front.take();
    done[node] = 1;
    for (int side = 0; side < 6; ++side) {
      const int32_t other = near[6 * node + side];
      if (other < 0 || done[other]) continue;
      const double cost = arrival(near, u, done.begin(), rate[other], edges, other);
      if (cost >= u[other]) continue;
      u[other] = cost;
      if (front.has_seen(other)) front.rise(other);
      else front.add(other);
    }
  }
}

// M_i h^2 of convex functions in cells [nx, ny, nz], [3, nx, ny, nz], from slopes at corners times h.
KERNEL void turns_between(const double* slopes, const uint8_t* cells, double* found, int64_t /*nx + 1*/, int64_t cy, int64_t cz,
                          int64_t nx, int64_t ny, int64_t nz) {
  const int64_t steps[3] = {cy * cz, cz, 1}, count = nx * ny * nz;
  for (int64_t cell = 0, i = 0; i < nx; ++i)
    for (int64_t j = 0; j < ny; ++j)
      for (int64_t k = 0; k < nz; ++k, ++cell) {
        double turn[3] = {};
        if (cells[cell]) turned(slopes + 3 * (i * steps[0] + j * steps[1] + k), steps, turn);
        for (int axis = 0; axis < 3; ++axis) found[axis * count + cell] = turn[axis];
      }
}

// Lower bounds in cells from values and slopes times h at corners, -inf where unknown: the least corner
// less sum_i M_i h^2 / 8, M_i from the turns or `curvature` times second differences, of which one with
// a nan counts as 0.
KERNEL void least_between(const double* values, const double* slopes, const uint8_t* cells, double* found, double curvature,
                          int64_t /*nx + 1*/, int64_t cy, int64_t cz, int64_t nx, int64_t ny, int64_t nz) {
  const int64_t steps[3] = {cy * cz, cz, 1};
  for (int64_t cell = 0, i = 0; i < nx; ++i)
    for (int64_t j = 0; j < ny; ++j)
      for (int64_t k = 0; k < nz; ++k, ++cell) {
        found[cell] = -HUGE_VAL;
        const bool is_inner = i > 0 && i + 1 < nx && j > 0 && j + 1 < ny && k > 0 && k + 1 < nz;
        if (!cells[cell] || !is_inner) continue;
        const int64_t first = i * steps[0] + j * steps[1] + k;
        double least = HUGE_VAL, curved[3] = {}, turn[3];
        bool is_known = true;
        for (int corner = 0; corner < 8; ++corner) {
          const double* at = values + first + (corner >> 2) * steps[0] + (corner >> 1 & 1) * steps[1] + (corner & 1);
          is_known = is_known && !isnan(*at);
          least = lesser(least, *at);
          for (int axis = 0; axis < 3; ++axis)
            curved[axis] = greater(curved[axis], fabs(at[-steps[axis]] - 2.0 * *at + at[steps[axis]]));
        }
        if (!is_known) continue;
        turned(slopes + 3 * first, steps, turn);
        for (int axis = 0; axis < 3; ++axis) least -= greater(curvature * curved[axis], turn[axis]) / 8.0;
        found[cell] = least;
      }
}

// The least length in cells of a vector with values at corners [nx + 1, ny + 1, nz + 1, 3], which bends by
// `curvature` times its second differences; 0 where not known.
KERNEL void least_size(const double* vectors, const uint8_t* cells, double* found, double curvature, int64_t /*nx + 1*/,
                       int64_t cy, int64_t cz, int64_t nx, int64_t ny, int64_t nz) {
  const int64_t steps[3] = {3 * cy * cz, 3 * cz, 3};
  for (int64_t cell = 0, i = 0; i < nx; ++i)
    for (int64_t j = 0; j < ny; ++j)
      for (int64_t k = 0; k < nz; ++k, ++cell) {
        found[cell] = 0.0;
        const bool is_inner = i > 0 && i + 1 < nx && j > 0 && j + 1 < ny && k > 0 && k + 1 < nz;
        if (!cells[cell] || !is_inner) continue;
        double corners[24], curved[3] = {};
        bool is_known = true;
        for (int corner = 0; corner < 8; ++corner) {
          const double* at = vectors + (i + (corner >> 2)) * steps[0] + (j + (corner >> 1 & 1)) * steps[1] + (k + (corner & 1)) * 3;
          for (int c = 0; c < 3; ++c) {
            corners[3 * corner + c] = at[c];
            is_known = is_known && !isnan(at[c]);
          }
          for (int axis = 0; axis < 3; ++axis) {
            double bend = 0.0;
            for (int c = 0; c < 3; ++c) {
              const double second = at[c - steps[axis]] - 2.0 * at[c] + at[c + steps[axis]];
              bend += second * second;
            }
            curved[axis] = greater(curved[axis], bend);
          }
        }
        const double bends = sqrt(curved[0]) + sqrt(curved[1]) + sqrt(curved[2]);
        if (is_known) found[cell] = greater(off_zero(corners) - curvature / 8.0 * bends, 0.0);
      }
}

// Lower bounds of the distances of zero from the convex hulls of corners [n, 8, 3], [n].
KERNEL void hulls_off_zero(const double* corners, double* found, int64_t count) {
  for (int64_t n = 0; n < count; ++n) found[n] = off_zero(corners + 24 * n);
}

// M_i h^2 / 4 in cells, [3, nx, ny, nz], from values at corners: at most the largest second difference at
// the cell's corners and the next ones along the axis plus the difference between these, or `curvature`
// times the largest size at its corners. A second difference with a nan counts as 0.
KERNEL void bends_between(const double* values, const uint8_t* cells, double* found, double curvature, int64_t cx,
                          int64_t cy, int64_t cz, int64_t nx, int64_t ny, int64_t nz) {
  const int64_t steps[3] = {cy * cz, cz, 1}, shape[3] = {cx, cy, cz}, count = nx * ny * nz;
  for (int64_t cell = 0, i = 0; i < nx; ++i)
    for (int64_t j = 0; j < ny; ++j)
      for (int64_t k = 0; k < nz; ++k, ++cell) {
        const int64_t place[3] = {i, j, k}, first = i * steps[0] + j * steps[1] + k;
        for (int axis = 0; axis < 3; ++axis) {
          double* out = found + axis * count + cell;
          *out = 0.0;
          if (!cells[cell]) continue;
          const int64_t along = steps[axis], one = steps[(axis + 1) % 3], two = steps[(axis + 2) % 3], own = place[axis];
          const int64_t low = own > 1 ? -1 : 1 - own, high = own + 2 < shape[axis] - 2 ? 2 : shape[axis] - 2 - own;
          double most = -HUGE_VAL, least = HUGE_VAL, size = 0.0;
          for (int64_t t = low; t <= high; ++t)
            for (int corner = 0; corner < 4; ++corner) {
              const double* at = values + first + t * along + (corner & 1) * one + (corner >> 1) * two;
              double second = at[-along] - 2.0 * *at + at[along];
              if (isnan(second)) second = 0.0;
              most = greater(most, second);
              least = lesser(least, second);
              if (t == 0 || t == 1) size = greater(size, fabs(second));
            }
          *out = 0.25 * greater(lesser(2.0 * most - least, curvature * size), 0.0);
        }
      }
}

// Means of the values at the corners of the cells with places `cells` [n] in the flat grid, [n].
KERNEL void means_of_corners(const double* values, const int64_t* cells, double* means, int64_t /*nx + 1*/, int64_t cy,
                             int64_t cz, int64_t count) {
  const int64_t ny = cy - 1, nz = cz - 1;
  for (int64_t n = 0; n < count; ++n) {
    const double* at = values + cells[n] / (ny * nz) * cy * cz + cells[n] / nz % ny * cz + cells[n] % nz;
    double total = 0.0;
    for (int corner = 0; corner < 8; ++corner) total += at[(corner >> 2) * cy * cz + (corner >> 1 & 1) * cz + (corner & 1)];
    means[n] = total / 8.0;
  }
}

// The largest of each cell's value [n] and those of the cells that touch it.
KERNEL void most_about(const double* values, const int32_t* numbers, const int64_t* cells, double* most, int64_t count,
                       int64_t nx, int64_t ny, int64_t nz) {
  for (int64_t n = 0; n < count; ++n) {
    const int64_t i = cells[n] / (ny * nz), j = cells[n] / nz % ny, k = cells[n] % nz;
    double largest = values[n];
    for (int64_t p = i > 0 ? i - 1 : 0; p < (i + 2 < nx ? i + 2 : nx); ++p)
      for (int64_t q = j > 0 ? j - 1 : 0; q < (j + 2 < ny ? j + 2 : ny); ++q)
        for (int64_t r = k > 0 ? k - 1 : 0; r < (k + 2 < nz ? k + 2 : nz); ++r) {
          const int32_t other = numbers[(p * ny + q) * nz + r];
          if (other >= 0) largest = greater(largest, values[other]);
        }
    most[n] = largest;
  }
}

// A lower bound of the spline u [nx, ny, nz] in cells: its least Bernstein coefficient, inf in others.
KERNEL void least_in_cells(const double* u, const uint8_t* cells, double* found, int64_t nx, int64_t ny, int64_t nz) {
  Scratch<int64_t> waiting(nx * ny * nz + kLanes);
  int64_t count = 0;
  for (int64_t cell = 0, i = 0; i < nx; ++i)
    for (int64_t j = 0; j < ny; ++j)
      for (int64_t k = 0; k < nz; ++k, ++cell) {
        found[cell] = HUGE_VAL;
        if (cells[cell] && i > 0 && i + 1 < nx && j > 0 && j + 1 < ny && k > 0 && k + 1 < nz) waiting[count++] = cell;
      }
  for (int64_t n = 0; n < count; n += kLanes) {
    Lanes one[27], two[27];
    const int64_t last = lesser(count - n, int64_t{kLanes}) - 1;
    for (int at = 0; at < 27; ++at)
      for (int l = 0; l < kLanes; ++l)
        one[at][l] = u[waiting[n + lesser(int64_t{l}, last)] + (at / 9 - 1) * ny * nz + (at / 3 % 3 - 1) * nz + at % 3 - 1];
    along<1>(one, two, value_of);
    along<3>(two, one, value_of);
    along<9>(one, two, value_of);
    Lanes least = two[0];
    for (int at = 1; at < 27; ++at) least = lesser(least, two[at]);
    for (int l = 0; l <= last; ++l) found[waiting[n + l]] = least[l];
  }
}

// The largest |grad u| relative to the allowed value in each of the cells `asked` [n, 3], at the Bernstein
// coefficients of both: the cost per metre c at corners, less `bends` half-way along each axis, or less the
// most that these may be; or the floor, which alone counts in `level` cells. 0 where a cell is not open
// or u infinite beside it. edges [3] [m].
KERNEL void spline_excess(const double* u, const double* edges, const uint8_t* open_cells, const double* rate,
                          const double* bends, const uint8_t* level, const int64_t* asked, double* over_by, double floor,
                          int64_t nx, int64_t ny, int64_t nz, int64_t /*nx + 1*/, int64_t cy, int64_t cz, int64_t count) {
  const double per_edge[3] = {1.0 / edges[0], 1.0 / edges[1], 1.0 / edges[2]};
  int64_t waiting[kLanes], cell[kLanes], corner[kLanes];
  int held = 0;
  for (int64_t n = 0; n <= count; ++n) {
    if (n < count) {
      const int64_t i = asked[3 * n], j = asked[3 * n + 1], k = asked[3 * n + 2], own = (i * ny + j) * nz + k;
      over_by[n] = 0.0;
      if (!open_cells[own]) continue;
      if (i < 1 || j < 1 || k < 1 || i + 1 >= nx || j + 1 >= ny || k + 1 >= nz) {
        over_by[n] = HUGE_VAL;
        continue;
      }
      bool is_finite = true;
      for (int at = 0; at < 27; ++at)
        is_finite = is_finite && u[own + (at / 9 - 1) * ny * nz + (at / 3 % 3 - 1) * nz + at % 3 - 1] < HUGE_VAL;
      if (!is_finite) continue;
      waiting[held] = n;
      cell[held] = own;
      corner[held++] = (i * cy + j) * cz + k;
    }
    if (held == 0 || (held < kLanes && n < count)) continue;
    for (int l = held; l < kLanes; ++l) {
      cell[l] = cell[0];
      corner[l] = corner[0];
    }
    Lanes block[27], flat[27], down[27], one[27], two[27], steep[27], allowed[27], bend[3], worst = all(0.0);
    for (int l = 0; l < kLanes; ++l) {
      for (int at = 0; at < 27; ++at)
        block[at][l] = u[cell[l] + (at / 9 - 1) * ny * nz + (at / 3 % 3 - 1) * nz + at % 3 - 1];
      for (int at = 0; at < 8; ++at)
        allowed[(at >> 2) * 18 + (at >> 1 & 1) * 6 + (at & 1) * 2][l] =
            rate[corner[l] + (at >> 2) * cy * cz + (at >> 1 & 1) * cz + (at & 1)];
      for (int axis = 0; axis < 3; ++axis) bend[axis][l] = bends[axis * nx * ny * nz + cell[l]];
    }
    along<1>(block, flat, value_of);
    along<1>(block, down, slope_of);
    along<3>(flat, one, value_of);
    along<9>(one, two, slope_of);
    along<3>(flat, one, slope_of);
    along<9>(one, flat, value_of);
    along<3>(down, one, value_of);
    along<9>(one, down, value_of);
    for (int at = 0; at < 27; ++at) {
      steep[at] = magnitude(two[at] * per_edge[0], flat[at] * per_edge[1], down[at] * per_edge[2]);
      worst = greater(worst, steep[at]);
    }
    worst /= floor;
    interpolated(allowed);
    const Lanes whole = 0.5 * (bend[0] + bend[1] + bend[2]), none = all(0.0);
    Lanes even = none, uneven = none;
    for (int at = 0; at < 27; ++at) {
      const Lanes off = (at / 9 == 1 ? bend[0] : none) + (at / 3 % 3 == 1 ? bend[1] : none) + (at % 3 == 1 ? bend[2] : none);
      even = greater(even, over(steep[at], allowed[at] - whole));
      uneven = greater(uneven, over(steep[at], allowed[at] - off));
    }
    const Lanes best = lesser(lesser(worst, even), uneven);
    for (int l = 0; l < held; ++l) over_by[waiting[l]] = level[cell[l]] ? worst[l] : best[l];
    held = 0;
  }
}
