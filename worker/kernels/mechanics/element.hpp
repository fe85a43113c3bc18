// One quadrature point of four elements: deformation, strain and stress, in the rest shape.
//
// F = 1 + sum u_a g_a', E = (F'F - 1) / 2, Hooke's S = lambda tr(E) 1 + 2 mu E, stable neo-Hookean
// P = mu F + ((lambda + mu) (det F - 1) - mu) cof F (Smith, De Goes and Kim 2018, without its last
// term). Force of node a: f_a = sum_q w F S g_a.
//
// Arrays of elements have the element within its batch of four as the last axis. Displacements
// are relative to the element's first node: the gradients sum to zero, so this only reduces the
// round-off of a branch with large displacements.
#pragma once
#include "../lanes.hpp"

enum Material : int64_t { kGreenStrain = 0, kNeoHooke = 1, kSmallStrain = 2 };

struct Matrix { Lanes a[3][3]; };
struct Symmetric { Lanes xx, yy, zz, xy, xz, yz; };
struct Vector { Lanes x, y, z; };

// Calls with the counts of nodes and points, known to the compiler for Limber's own elements.
template <class Body>
INLINE auto with_counts(int64_t nodes, int64_t points, Body body) {
  if (nodes == 10 && points == 4) return body(Fixed<10>{}, Fixed<4>{});
  if (nodes == 10 && points == 1) return body(Fixed<10>{}, Fixed<1>{});
  if (nodes == 4 && points == 1) return body(Fixed<4>{}, Fixed<1>{});
  return body(static_cast<int>(nodes), static_cast<int>(points));
}

// The gradient of node a at a point, whose gradients [nodes, 3, 4] [1/m] begin at g.
INLINE Vector gradient_of(const double* g, int a) {
  g += 3 * kLanes * a;
  return {load(g), load(g + kLanes), load(g + 2 * kLanes)};
}
INLINE Lanes dot(Vector a, Vector b) { return a.x * b.x + a.y * b.y + a.z * b.z; }
INLINE Vector row(const Matrix& m, int i) { return {m.a[i][0], m.a[i][1], m.a[i][2]}; }
INLINE Vector column(const Matrix& m, int j) { return {m.a[0][j], m.a[1][j], m.a[2][j]}; }
INLINE Vector times(const Matrix& m, Vector v) { return {dot(row(m, 0), v), dot(row(m, 1), v), dot(row(m, 2), v)}; }
INLINE Vector times(const Symmetric& s, Vector v) {
  return {s.xx * v.x + s.xy * v.y + s.xz * v.z, s.xy * v.x + s.yy * v.y + s.yz * v.z,
          s.xz * v.x + s.yz * v.y + s.zz * v.z};
}
INLINE Symmetric scaled(const Symmetric& s, double factor) {
  return {factor * s.xx, factor * s.yy, factor * s.zz, factor * s.xy, factor * s.xz, factor * s.yz};
}

// A nodal field [node_count, 3] at the nodes [nodes, 4], less its value at the first.
INLINE void gather(const double* field, const int32_t* nodes, int count, Vector* out) {
  auto at = [=](int a) -> Vector {
    const double* p[kLanes];
    for (int l = 0; l < kLanes; ++l) p[l] = field + 3 * int64_t{nodes[kLanes * a + l]};
    return {Lanes{p[0][0], p[1][0], p[2][0], p[3][0]}, Lanes{p[0][1], p[1][1], p[2][1], p[3][1]},
            Lanes{p[0][2], p[1][2], p[2][2], p[3][2]}};
  };
  const Vector first = at(0);
  out[0] = Vector{};
  for (int a = 1; a < count; ++a) {
    const Vector own = at(a);
    out[a] = {own.x - first.x, own.y - first.y, own.z - first.z};
  }
}
// Adds the first `count` elements' forces to a nodal field [node_count, 3].
INLINE void spread(const Vector* pull, const int32_t* nodes, int node_count, int64_t count, double* force) {
  for (int64_t l = 0; l < count && l < kLanes; ++l)
    for (int a = 0; a < node_count; ++a) {
      double* own = force + 3 * int64_t{nodes[kLanes * a + l]};
      own[0] += pull[a].x[l];
      own[1] += pull[a].y[l];
      own[2] += pull[a].z[l];
    }
}

INLINE Matrix gradient(const Vector* u, const double* g, int nodes) {
  Matrix h{};
  for (int a = 0; a < nodes; ++a) {
    const Vector k = gradient_of(g, a);
    h.a[0][0] += u[a].x * k.x; h.a[0][1] += u[a].x * k.y; h.a[0][2] += u[a].x * k.z;
    h.a[1][0] += u[a].y * k.x; h.a[1][1] += u[a].y * k.y; h.a[1][2] += u[a].y * k.z;
    h.a[2][0] += u[a].z * k.x; h.a[2][1] += u[a].z * k.y; h.a[2][2] += u[a].z * k.z;
  }
  return h;
}
INLINE Matrix identity() {
  Matrix f{};
  for (int i = 0; i < 3; ++i) f.a[i][i] = all(1.0);
  return f;
}
INLINE Matrix deformation(const Vector* u, const double* g, int nodes) {
  Matrix f = gradient(u, g, nodes);
  for (int i = 0; i < 3; ++i) f.a[i][i] += 1.0;
  return f;
}
INLINE Matrix cofactor(const Matrix& f) {
  Matrix c;
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      const int k = (i + 1) % 3, l = (i + 2) % 3, m = (j + 1) % 3, n = (j + 2) % 3;
      c.a[i][j] = f.a[k][m] * f.a[l][n] - f.a[k][n] * f.a[l][m];
    }
  return c;
}
INLINE Lanes determinant(const Matrix& f, const Matrix& c) { return dot(row(f, 0), row(c, 0)); }

INLINE Symmetric green_strain(const Matrix& f) {
  auto of = [&](int i, int j) { return dot(column(f, i), column(f, j)); };
  return {0.5 * (of(0, 0) - 1.0), 0.5 * (of(1, 1) - 1.0), 0.5 * (of(2, 2) - 1.0),
          0.5 * of(0, 1), 0.5 * of(0, 2), 0.5 * of(1, 2)};
}
INLINE Symmetric small_strain(const Matrix& f) {
  return {f.a[0][0] - 1.0, f.a[1][1] - 1.0, f.a[2][2] - 1.0, 0.5 * (f.a[0][1] + f.a[1][0]),
          0.5 * (f.a[0][2] + f.a[2][0]), 0.5 * (f.a[1][2] + f.a[2][1])};
}
// Symmetric part of F'H: the change of the strain as F changes by H.
INLINE Symmetric strain_change(const Matrix& f, const Matrix& h) {
  auto of = [&](int i, int j) { return dot(column(f, i), column(h, j)); };
  return {of(0, 0), of(1, 1), of(2, 2), 0.5 * (of(0, 1) + of(1, 0)), 0.5 * (of(0, 2) + of(2, 0)),
          0.5 * (of(1, 2) + of(2, 1))};
}
// Adds the six numbers per element [tet_count, points, 6] of a point to a strain. Padding takes the last element's.
INLINE void add_memory(const double* memory, int64_t tet_count, int64_t batch, int points, int q, Symmetric& e) {
  for (int l = 0; l < kLanes; ++l) {
    const double* own = memory + 6 * (points * lesser(kLanes * batch + l, tet_count - 1) + q);
    e.xx[l] += own[0]; e.yy[l] += own[1]; e.zz[l] += own[2];
    e.xy[l] += own[3]; e.xz[l] += own[4]; e.yz[l] += own[5];
  }
}
INLINE Symmetric hooke_stress(const Symmetric& e, Lanes lambda, Lanes mu) {
  const Lanes twice = 2.0 * mu, trace = lambda * (e.xx + e.yy + e.zz);
  return {trace + twice * e.xx, trace + twice * e.yy, trace + twice * e.zz,
          twice * e.xy, twice * e.xz, twice * e.yz};
}
INLINE Lanes hooke_energy(const Symmetric& e, Lanes lambda, Lanes mu) {
  const Lanes trace = e.xx + e.yy + e.zz;
  return 0.5 * lambda * trace * trace + mu * (e.xx * e.xx + e.yy * e.yy + e.zz * e.zz
         + 2.0 * (e.xy * e.xy + e.xz * e.xz + e.yz * e.yz));
}
// Adds F S.
INLINE void add_product(const Matrix& f, const Symmetric& s, Matrix& p) {
  for (int i = 0; i < 3; ++i) {
    const Vector r = times(s, row(f, i));
    p.a[i][0] += r.x; p.a[i][1] += r.y; p.a[i][2] += r.z;
  }
}
INLINE void add_pull(const Matrix& p, const double* g, int nodes, Vector* pull) {
  for (int a = 0; a < nodes; ++a) {
    const Vector f = times(p, gradient_of(g, a));
    pull[a].x += f.x; pull[a].y += f.y; pull[a].z += f.z;
  }
}

// Largest eigenvalue of symmetric matrices, and an upper bound of it that needs no angle.
struct Principal {
  Lanes mean, size, half;
  INLINE explicit Principal(const Symmetric& e) {
    mean = (e.xx + e.yy + e.zz) / 3.0;
    const Lanes x = e.xx - mean, y = e.yy - mean, z = e.zz - mean;
    size = root((x * x + y * y + z * z + 2.0 * (e.xy * e.xy + e.xz * e.xz + e.yz * e.yz)) / 6.0);
    half = 0.5 * (x * (y * z - e.yz * e.yz) - e.xy * (e.xy * z - e.yz * e.xz) + e.xz * (e.xy * e.yz - y * e.xz));
  }
  INLINE Lanes bound() const { return mean + 2.0 * size; }
  INLINE double largest(int l) const {
    const double s = size[l], cosine = s > 0.0 ? lesser(1.0, greater(-1.0, half[l] / (s * s * s))) : 1.0;
    return mean[l] + 2.0 * s * cos(acos(cosine) / 3.0);
  }
};
