// Internal force, energy and tangent stiffness of St. Venant-Kirchhoff elements in their rest shape,
// sixteen elements at a time. A Lanes is one number of sixteen elements; arithmetic on it reads as
// that of one. F = 1 + du/dX, E = (F^T F - 1) / 2, S = lambda tr(E) 1 + 2 mu E, f_a = sum w F S g_a.
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>
namespace {
constexpr int kLanes = 16;
typedef double Lanes __attribute__((vector_size(8 * kLanes)));
struct Matrix { Lanes a[3][3]; };
struct Symmetric { Lanes xx, yy, zz, xy, xz, yz; };

inline void gather(const double* field, const int64_t* nodes, int count, Lanes (*out)[3]) {
  for (int a = 0; a < count; ++a)
    for (int l = 0; l < kLanes; ++l)
      for (int i = 0; i < 3; ++i)
        out[a][i][l] = field[3 * nodes[a * kLanes + l] + i] - field[3 * nodes[l] + i];
}
template <int N>
inline Matrix deformation(const Lanes (*u)[3], const Lanes (*g)[3]) {
  Matrix F{};
  for (int a = 0; a < N; ++a)
    for (int i = 0; i < 3; ++i)
      for (int j = 0; j < 3; ++j) F.a[i][j] += u[a][i] * g[a][j];
  for (int i = 0; i < 3; ++i) F.a[i][i] += 1.0;
  return F;
}
inline Symmetric green_strain(const Matrix& F) {
  auto dot = [&](int i, int j) { return F.a[0][i] * F.a[0][j] + F.a[1][i] * F.a[1][j] + F.a[2][i] * F.a[2][j]; };
  return {0.5 * (dot(0, 0) - 1.0), 0.5 * (dot(1, 1) - 1.0), 0.5 * (dot(2, 2) - 1.0),
          0.5 * dot(0, 1), 0.5 * dot(0, 2), 0.5 * dot(1, 2)};
}
inline Symmetric stress(const Symmetric& E, Lanes lambda, Lanes mu) {  // both times the weight
  const Lanes t = lambda * (E.xx + E.yy + E.zz), m = 2.0 * mu;
  return {t + m * E.xx, t + m * E.yy, t + m * E.zz, m * E.xy, m * E.xz, m * E.yz};
}
inline void times(const Symmetric& S, const Lanes g[3], Lanes out[3]) {
  out[0] = S.xx * g[0] + S.xy * g[1] + S.xz * g[2];
  out[1] = S.xy * g[0] + S.yy * g[1] + S.yz * g[2];
  out[2] = S.xz * g[0] + S.yz * g[1] + S.zz * g[2];
}
inline Lanes determinant(const Matrix& m) {
  auto& f = m.a;
  return f[0][0] * (f[1][1] * f[2][2] - f[1][2] * f[2][1]) - f[0][1] * (f[1][0] * f[2][2] - f[1][2] * f[2][0])
       + f[0][2] * (f[1][0] * f[2][1] - f[1][1] * f[2][0]);
}
template <int N, int Q>
void tangent(const double* u, int64_t batches, const Lanes (*gradients)[Q][N][3], const Lanes (*weights)[Q],
             const Lanes* lambda, const Lanes* mu, const int64_t (*nodes)[N][kLanes],
             const int32_t* slots, const int32_t* lengths, double* values) {
  constexpr int kPairs = N * (N + 1) / 2;
  Lanes local[N][3], pushed[N][Q][3], stressed[N][Q][3];
  Symmetric terms[Q];
  for (int64_t b = 0; b < batches; ++b) {
    gather(u, &nodes[b][0][0], N, local);
    for (int q = 0; q < Q; ++q) {
      const Lanes w = weights[b][q], l = w * lambda[b], m = w * mu[b];
      const Matrix F = deformation<N>(local, gradients[b][q]);
      const Symmetric S = stress(green_strain(F), l, m);
      auto row = [&](int i, int j) { return m * (F.a[i][0] * F.a[j][0] + F.a[i][1] * F.a[j][1] + F.a[i][2] * F.a[j][2]); };
      terms[q] = {row(0, 0), row(1, 1), row(2, 2), row(0, 1), row(0, 2), row(1, 2)};
      Lanes root;
      for (int k = 0; k < kLanes; ++k) root[k] = std::sqrt(w[k]);
      for (int a = 0; a < N; ++a) {
        const Lanes* g = gradients[b][q][a];
        for (int i = 0; i < 3; ++i) pushed[a][q][i] = root * (F.a[i][0] * g[0] + F.a[i][1] * g[1] + F.a[i][2] * g[2]);
        times(S, g, stressed[a][q]);
      }
    }
    // A block is lambda u u'^T + mu u' u^T + (g g') mu F F^T + (g S g') 1, u = F g.
    int pair = 0;
    for (int a = 0; a < N; ++a)
      for (int c = 0; c <= a; ++c, ++pair) {
        double block[9][kLanes];
        for (int h = 0; h < kLanes; h += 4) {
          typedef double Four __attribute__((vector_size(32)));
          auto at = [h](const Lanes& x) { return *reinterpret_cast<const Four*>(reinterpret_cast<const double*>(&x) + h); };
          Four o[3][3] = {}, xx{}, yy{}, zz{}, xy{}, xz{}, yz{};
          for (int q = 0; q < Q; ++q) {
            for (int i = 0; i < 3; ++i)
              for (int j = 0; j < 3; ++j) o[i][j] += at(pushed[a][q][i]) * at(pushed[c][q][j]);
            const Lanes *g = gradients[b][q][a], *k = gradients[b][q][c];
            const Four dot = at(g[0]) * at(k[0]) + at(g[1]) * at(k[1]) + at(g[2]) * at(k[2]);
            const Lanes* s = stressed[a][q];
            const Four own = at(s[0]) * at(k[0]) + at(s[1]) * at(k[1]) + at(s[2]) * at(k[2]);
            xx += at(terms[q].xx) * dot + own; yy += at(terms[q].yy) * dot + own; zz += at(terms[q].zz) * dot + own;
            xy += at(terms[q].xy) * dot; xz += at(terms[q].xz) * dot; yz += at(terms[q].yz) * dot;
          }
          const Four l = at(lambda[b]), m = at(mu[b]);
          auto put = [&](int k, Four x) { *reinterpret_cast<Four*>(&block[k][h]) = x; };
          put(0, (l + m) * o[0][0] + xx); put(1, l * o[1][0] + m * o[0][1] + xy); put(2, l * o[2][0] + m * o[0][2] + xz);
          put(3, l * o[0][1] + m * o[1][0] + xy); put(4, (l + m) * o[1][1] + yy); put(5, l * o[2][1] + m * o[1][2] + yz);
          put(6, l * o[0][2] + m * o[2][0] + xz); put(7, l * o[1][2] + m * o[2][1] + yz); put(8, (l + m) * o[2][2] + zz);
        }
        const int32_t *slot = slots + (b * kPairs + pair) * kLanes, *length = lengths + (b * kPairs + pair) * kLanes;
        for (int l = 0; l < kLanes; ++l) {
          double* at = values + slot[l];
          at[0] += block[0][l]; at[1] += block[1][l]; at[2] += block[2][l];
          if (a == c) {
            at += length[l]; at[0] += block[4][l]; at[1] += block[5][l]; at[length[l] - 1] += block[8][l];
          } else {
            at += length[l] - 1; at[0] += block[3][l]; at[1] += block[4][l]; at[2] += block[5][l];
            at += length[l] - 2; at[0] += block[6][l]; at[1] += block[7][l]; at[2] += block[8][l];
          }
        }
      }
  }
}
template <int N, int Q>
double force(const double* u, int64_t batches, const Lanes (*gradients)[Q][N][3], const Lanes (*weights)[Q],
             const Lanes* lambda, const Lanes* mu, const int32_t (*nodes)[N][kLanes], int64_t node_count,
             int64_t count, double* out, double* energies) {
  typedef double Four __attribute__((vector_size(32)));
  for (int64_t k = 0; k < 3 * node_count; ++k) out[k] = 0.0;
  Four lowest; for (int l = 0; l < 4; ++l) lowest[l] = std::numeric_limits<double>::infinity();
  for (int64_t b = 0; b < batches; ++b)
    for (int h = 0; h < kLanes; h += 4) {
      auto at = [h](const Lanes& x) { return *reinterpret_cast<const Four*>(reinterpret_cast<const double*>(&x) + h); };
      Four local[N][3];
      for (int a = 0; a < N; ++a)
        for (int l = 0; l < 4; ++l)
          for (int i = 0; i < 3; ++i)
            local[a][i][l] = u[3 * nodes[b][a][h + l] + i] - u[3 * nodes[b][0][h + l] + i];
      Four pull[N][3] = {}, energy{};
      for (int q = 0; q < Q; ++q) {
        Four F[3][3] = {};
        for (int a = 0; a < N; ++a)
          for (int j = 0; j < 3; ++j) {
            const Four g = at(gradients[b][q][a][j]);
            for (int i = 0; i < 3; ++i) F[i][j] += local[a][i] * g;
          }
        for (int i = 0; i < 3; ++i) F[i][i] += 1.0;
        const Four det = F[0][0] * (F[1][1] * F[2][2] - F[1][2] * F[2][1]) - F[0][1] * (F[1][0] * F[2][2] - F[1][2] * F[2][0])
                       + F[0][2] * (F[1][0] * F[2][1] - F[1][1] * F[2][0]);
        lowest = det < lowest ? det : lowest;
        auto dot = [&](int i, int j) { return 0.5 * (F[0][i] * F[0][j] + F[1][i] * F[1][j] + F[2][i] * F[2][j] - (i == j ? 1.0 : 0.0)); };
        const Four xx = dot(0, 0), yy = dot(1, 1), zz = dot(2, 2), xy = dot(0, 1), xz = dot(0, 2), yz = dot(1, 2);
        const Four w = at(weights[b][q]), m = 2.0 * w * at(mu[b]), t = w * at(lambda[b]) * (xx + yy + zz);
        const Four S[3][3] = {{t + m * xx, m * xy, m * xz}, {m * xy, t + m * yy, m * yz}, {m * xz, m * yz, t + m * zz}};
        energy += 0.5 * (S[0][0] * xx + S[1][1] * yy + S[2][2] * zz) + S[0][1] * xy + S[0][2] * xz + S[1][2] * yz;
        Four P[3][3];
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) P[i][j] = F[i][0] * S[0][j] + F[i][1] * S[1][j] + F[i][2] * S[2][j];
        for (int a = 0; a < N; ++a) {
          const Four x = at(gradients[b][q][a][0]), y = at(gradients[b][q][a][1]), z = at(gradients[b][q][a][2]);
          for (int i = 0; i < 3; ++i) pull[a][i] += P[i][0] * x + P[i][1] * y + P[i][2] * z;
        }
      }
      for (int64_t l = 0; l < 4 && b * kLanes + h + l < count; ++l) {
        energies[b * kLanes + h + l] = energy[l];
        for (int a = 0; a < N; ++a)
          for (int i = 0; i < 3; ++i) out[3 * (int64_t)nodes[b][a][h + l] + i] += pull[a][i][l];
      }
    }
  double least = lowest[0];
  for (int l = 1; l < 4; ++l) least = lowest[l] < least ? lowest[l] : least;
  return least;
}
}  // namespace
extern "C" void tangent_10_4(const double* u, int64_t batches, const void* g, const void* w, const void* lam, const void* mu,
                             const void* nodes, const int32_t* slots, const int32_t* lengths, double* values) {
  tangent<10, 4>(u, batches, (const Lanes(*)[4][10][3])g, (const Lanes(*)[4])w, (const Lanes*)lam, (const Lanes*)mu,
                 (const int64_t(*)[10][kLanes])nodes, slots, lengths, values);
}
extern "C" double force_10_4(const double* u, int64_t batches, const void* g, const void* w, const void* lam, const void* mu,
                             const void* nodes, int64_t node_count, int64_t count, double* out, double* energies) {
  return force<10, 4>(u, batches, (const Lanes(*)[4][10][3])g, (const Lanes(*)[4])w, (const Lanes*)lam, (const Lanes*)mu,
                      (const int32_t(*)[10][kLanes])nodes, node_count, count, out, energies);
}
