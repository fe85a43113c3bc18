// Equilibria of a rod: elements, a banded factorisation, Newton's iteration.
//
// Sections have positions r [N + 1, 3] [m] and unit quaternions q [N + 1, 4] (w first); the first is clamped. With
// the middle's rotation R of an element, its rest vector d [m] and its stiffness K [6, 6] [N, N m],
//
//     e = (R'(r2 - r1) - d, log(R1' R2)),      energy = e . K e / 2 + w . e,
//
// w [6] carries the weight in the scanned shape (Crisfield and Jelenic 1999 for e, which no rigid motion changes).
// Unknowns are spatial rotation [rad] and displacement [m], six a section: 6 N. Row i of a lower band [6 N, 12] has
// column j at 11 - (i - j).
#include "../lanes.hpp"

namespace {
constexpr int kBand = 12, kIterations = 14;
constexpr double kSmall = 1e-7;       // last step of Newton's iteration, in rad and lengths; its square is left
constexpr double kLongestTurn = 0.7;  // [rad] in one iteration

// d [N, 3], K [N, 6, 6], w [N, 6]; loads [N + 1, 3] [N] and their arms [N + 1, 3] [m] at the sections.
struct Rod {
  const double *rest, *stiff, *carried, *loads, *arms;
  int64_t count;
};

template <int n> struct Vector {
  double x[n];
  double& operator[](int i) { return x[i]; }
  const double& operator[](int i) const { return x[i]; }
};
template <int rows, int columns> struct Matrix {
  double x[rows][columns];
  double* operator[](int i) { return x[i]; }
  const double* operator[](int i) const { return x[i]; }
};
using Quaternion = Vector<4>;

INLINE double dot3(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
INLINE double dot4(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2] + a[3] * b[3]; }
INLINE Vector<3> crossed(const Vector<3>& a, const Vector<3>& b) {
  return {{a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]}};
}
template <int m, int k, int n> INLINE Matrix<m, n> operator*(const Matrix<m, k>& a, const Matrix<k, n>& b) {
  Matrix<m, n> out;
  for (int i = 0; i < m; ++i)
    for (int j = 0; j < n; ++j) {
      double total = 0.0;
      for (int l = 0; l < k; ++l) total += a[i][l] * b[l][j];
      out[i][j] = total;
    }
  return out;
}
template <int m, int n> INLINE Matrix<n, m> turned_over(const Matrix<m, n>& a) {
  Matrix<n, m> out;
  for (int i = 0; i < m; ++i)
    for (int j = 0; j < n; ++j) out[j][i] = a[i][j];
  return out;
}
// The matrix of a cross product from the left.
INLINE Matrix<3, 3> hat(const Vector<3>& a) { return {{{0, -a[2], a[1]}, {a[2], 0, -a[0]}, {-a[1], a[0], 0}}}; }

// The rotation of a quaternion of any length.
INLINE Matrix<3, 3> rotation(const double* q) {
  const double w = q[0], x = q[1], y = q[2], z = q[3], n = w * w + x * x + y * y + z * z;
  return {{{(w * w + x * x - y * y - z * z) / n, 2 * (x * y - w * z) / n, 2 * (x * z + w * y) / n},
           {2 * (x * y + w * z) / n, (w * w - x * x + y * y - z * z) / n, 2 * (y * z - w * x) / n},
           {2 * (x * z - w * y) / n, 2 * (y * z + w * x) / n, (w * w - x * x - y * y + z * z) / n}}};
}

// The derivative of x . R(q) f by q, and that value.
struct Slope { Quaternion by; double value; };
INLINE Slope slope_of(const Vector<3>& f, const Vector<3>& x, const Quaternion& q) {
  const double n = dot4(q.x, q.x), fx = dot3(f.x, x.x), fv = dot3(f.x, q.x + 1), xv = dot3(x.x, q.x + 1);
  const Vector<3> c = crossed(f, x);
  Slope out;
  out.by[0] = fx * q[0] + c[0] * q[1] + c[1] * q[2] + c[2] * q[3];
  for (int i = 0; i < 3; ++i) out.by[1 + i] = c[i] * q[0] - fx * q[1 + i] + f[i] * xv + x[i] * fv;
  out.value = dot4(out.by.x, q.x) / n;
  for (int i = 0; i < 4; ++i) out.by[i] = 2 * (out.by[i] - out.value * q[i]) / n;
  return out;
}
// Its second derivative.
INLINE Matrix<4, 4> curvature_of(const Vector<3>& f, const Vector<3>& x, const Quaternion& q, const Slope& slope) {
  const double n = dot4(q.x, q.x), fx = dot3(f.x, x.x);
  const Vector<3> c = crossed(f, x);
  Matrix<4, 4> out;
  out[0][0] = fx;
  for (int i = 0; i < 3; ++i) {
    out[0][1 + i] = out[1 + i][0] = c[i];
    for (int j = 0; j < 3; ++j) out[1 + i][1 + j] = f[i] * x[j] + x[i] * f[j];
    out[1 + i][1 + i] -= fx;
  }
  for (int i = 0; i < 4; ++i) {
    for (int j = 0; j < 4; ++j) out[i][j] = 2 * (out[i][j] - slope.by[i] * q[j] - q[i] * slope.by[j]) / n;
    out[i][i] -= 2 * slope.value / n;
  }
  return out;
}

// asin(sqrt u) / sqrt u and its first two derivatives.
struct Arcsine { double value, slope, curvature; };
INLINE Arcsine arcsine(double u) {
  if (u < 1e-2)
    return {1 + u * (1.0 / 6 + u * (3.0 / 40 + u * (5.0 / 112 + u * (35.0 / 1152 + u * 63 / 2816)))),
            1.0 / 6 + u * (3.0 / 20 + u * (15.0 / 112 + u * (35.0 / 288 + u * 315 / 2816))),
            3.0 / 20 + u * (15.0 / 56 + u * (35.0 / 96 + u * 315 / 704))};
  const double value = asin(sqrt(u)) / sqrt(u), steep = 1 / sqrt(1 - u), slope = (steep - value) / (2 * u);
  return {value, slope, (0.5 * (steep * steep * steep) - 3 * slope) / (2 * u)};
}

// The change of a quaternion with a spatial rotation.
INLINE Matrix<4, 3> turning(const double* q) {
  return {{{-0.5 * q[1], -0.5 * q[2], -0.5 * q[3]}, {0.5 * q[0], 0.5 * q[3], -0.5 * q[2]},
           {-0.5 * q[3], 0.5 * q[0], 0.5 * q[1]}, {0.5 * q[2], -0.5 * q[1], 0.5 * q[0]}}};
}

// Energy [J] of an element and its stress less what it carries [6]; gradient [12] and, if curved, second derivative
// [12, 12] to rotation and position of both ends.
double element(const double* r1, const double* q1, const double* r2, const double* q2, const double* rest, const double* stiff,
               const double* carried, bool curved, double* elastic, Vector<12>& grad, Matrix<12, 12>& hess) {
  const Vector<3> along{{r2[0] - r1[0], r2[1] - r1[1], r2[2] - r1[2]}};
  const Quaternion middle{{q1[0] + q2[0], q1[1] + q2[1], q1[2] + q2[2], q1[3] + q2[3]}};
  const Matrix<3, 3> R = rotation(middle.x), R1 = rotation(q1);
  const Vector<3> v{{q1[0] * q2[1] - q2[0] * q1[1] - q1[2] * q2[3] + q1[3] * q2[2],
                     q1[0] * q2[2] - q2[0] * q1[2] - q1[3] * q2[1] + q1[1] * q2[3],
                     q1[0] * q2[3] - q2[0] * q1[3] - q1[1] * q2[2] + q1[2] * q2[1]}};
  const double cosine = dot4(q1, q2);
  const Arcsine g = arcsine(dot3(v.x, v.x));
  const Matrix<4, 3> first = turning(q1), second = turning(q2);
  double strain[6];
  Matrix<6, 12> B{};
  for (int i = 0; i < 3; ++i) {
    Vector<3> unit{};
    unit[i] = 1.0;
    const Slope row = slope_of(unit, along, middle);
    strain[i] = row.value - rest[i];
    strain[3 + i] = 2 * g.value * v[i];
    for (int j = 0; j < 3; ++j) {
      for (int a = 0; a < 4; ++a) {
        B[i][j] += row.by[a] * first[a][j];
        B[i][6 + j] += row.by[a] * second[a][j];
      }
      B[i][3 + j] = -R[j][i];
      B[i][9 + j] = R[j][i];
    }
  }
  Vector<6> stress;
  Matrix<6, 6> K;
  double energy = 0.0;
  for (int i = 0; i < 6; ++i) {
    elastic[i] = 0.0;
    for (int j = 0; j < 6; ++j) {
      K[i][j] = stiff[6 * i + j];
      elastic[i] += K[i][j] * strain[j];
    }
    energy += (0.5 * elastic[i] + carried[i]) * strain[i];
    stress[i] = elastic[i] + carried[i];
  }
  const Vector<3> force{{stress[0], stress[1], stress[2]}}, moment{{stress[3], stress[4], stress[5]}};
  Matrix<3, 3> by_turn = hat(v), by_v;
  for (int i = 0; i < 3; ++i) {
    for (int j = 0; j < 3; ++j) {
      by_turn[i][j] *= -0.5;
      by_v[i][j] = 4 * g.slope * v[i] * v[j];
    }
    by_v[i][i] += 2 * g.value;
    by_turn[i][i] += 0.5 * cosine;
  }
  const Matrix<3, 3> turn = by_v * by_turn * turned_over(R1);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      B[3 + i][j] = -turn[i][j];
      B[3 + i][6 + j] = turn[i][j];
    }
  for (int j = 0; j < 12; ++j) {
    grad[j] = 0.0;
    for (int i = 0; i < 6; ++i) grad[j] += B[i][j] * stress[i];
  }
  if (!curved) return energy;
  hess = turned_over(B) * (K * B);
  // What the stress adds to the second derivative: by the middle's rotation ...
  const Slope slope = slope_of(force, along, middle);
  const Matrix<4, 4> H = curvature_of(force, along, middle, slope);
  const Matrix<4, 3> H1 = H * first, H2 = H * second;
  Matrix<3, 3> one = turned_over(first) * H1, two = turned_over(second) * H2;
  const Matrix<3, 3> both = turned_over(first) * H2;
  // ... and by the relative rotation.
  const double mv = dot3(moment.x, v.x);
  Vector<3> by_moment;
  Matrix<3, 3> V;
  for (int i = 0; i < 3; ++i) {
    by_moment[i] = 2 * g.value * moment[i] + 4 * g.slope * mv * v[i];
    for (int j = 0; j < 3; ++j)
      V[i][j] = 4 * g.slope * (moment[i] * v[j] + v[i] * moment[j]) + 8 * g.curvature * mv * v[i] * v[j];
    V[i][i] += 4 * g.slope * mv;
  }
  V = turned_over(by_turn) * (V * by_turn);
  for (int i = 0; i < 3; ++i) V[i][i] -= 0.25 * dot3(by_moment.x, v.x);
  V = R1 * (V * turned_over(R1));
  Vector<3> twist = crossed(v, by_moment), lever;
  for (int i = 0; i < 3; ++i) twist[i] += cosine * by_moment[i];
  for (int i = 0; i < 3; ++i) lever[i] = 0.25 * dot3(R1[i], twist.x);
  const Matrix<3, 3> spin = hat(lever);
  const double of_first = 0.25 * dot4(slope.by.x, q1), of_second = 0.25 * dot4(slope.by.x, q2);
  for (int i = 0; i < 3; ++i) {
    one[i][i] -= of_first;
    two[i][i] -= of_second;
    Vector<3> unit{};
    unit[i] = 1.0;
    const Slope row = slope_of(force, unit, middle);
    for (int j = 0; j < 3; ++j) {
      hess[i][j] += one[i][j] + V[i][j];
      hess[6 + i][6 + j] += two[i][j] + V[i][j];
      const double cross = both[i][j] - V[i][j] + spin[i][j];
      hess[i][6 + j] += cross;
      hess[6 + j][i] += cross;
      double near = 0.0, far = 0.0;
      for (int a = 0; a < 4; ++a) {
        near += row.by[a] * first[a][j];
        far += row.by[a] * second[a][j];
      }
      hess[j][3 + i] -= near;
      hess[3 + i][j] -= near;
      hess[j][9 + i] += near;
      hess[9 + i][j] += near;
      hess[6 + j][3 + i] -= far;
      hess[3 + i][6 + j] -= far;
      hess[6 + j][9 + i] += far;
      hess[9 + i][6 + j] += far;
    }
  }
  return energy;
}

double assembled(const double* r, const double* q, const Rod& rod, bool curved, double* grad, double* band, double* stress) {
  const int64_t whole = 6 * rod.count;
  double energy = 0.0;
  memset(grad, 0, whole * sizeof(double));
  memset(band, 0, whole * kBand * sizeof(double));
  Vector<12> g;
  Matrix<12, 12> h;
  for (int64_t k = 0; k < rod.count; ++k) {
    energy += element(r + 3 * k, q + 4 * k, r + 3 * k + 3, q + 4 * k + 4, rod.rest + 3 * k, rod.stiff + 36 * k, rod.carried + 6 * k,
                      curved, stress + 6 * k, g, h);
    const int64_t begin = 6 * (k - 1);
    for (int a = k ? 0 : 6; a < 12; ++a) {
      grad[begin + a] += g[a];
      if (curved)
        for (int b = k ? 0 : 6; b <= a; ++b) band[kBand * (begin + a) + 11 - (a - b)] += h[a][b];
    }
  }
  for (int64_t k = 0; k < rod.count; ++k) {
    const double *load = rod.loads + 3 * k + 3, *arm_at_rest = rod.arms + 3 * k + 3;
    const Matrix<3, 3> R = rotation(q + 4 * k + 4);
    const Vector<3> force{{load[0], load[1], load[2]}}, arm{{dot3(R[0], arm_at_rest), dot3(R[1], arm_at_rest), dot3(R[2], arm_at_rest)}};
    const Vector<3> moment = crossed(arm, force);
    const double work = dot3(force.x, arm.x);
    energy -= dot3(load, r + 3 * k + 3) + work;
    for (int i = 0; i < 3; ++i) {
      grad[6 * k + i] -= moment[i];
      grad[6 * k + 3 + i] -= force[i];
      double* row = band + kBand * (6 * k + i);
      for (int j = 0; j <= i; ++j) row[11 - (i - j)] -= 0.5 * (force[i] * arm[j] + arm[i] * force[j]);
      row[11] += work;
    }
  }
  return energy;
}

// Factorises the leading `size` rows in place, L D L'; returns how many pivots are negative: as many as the matrix
// has negative eigenvalues.
int64_t factorised(double* band, int64_t size) {
  int64_t negative = 0;
  double row[kBand];
  for (int64_t i = 0; i < size; ++i) {
    const int64_t low = greater(int64_t{0}, i - 11);
    double *own = band + kBand * i + 11 - i, pivot = own[i];
    for (int64_t j = low; j < i; ++j) {
      const double* other = band + kBand * j + 11 - j;
      double value = own[j];
      for (int64_t k = greater(low, j - 11); k < j; ++k) value -= row[k - low] * other[k];
      row[j - low] = value;
    }
    for (int64_t j = low; j < i; ++j) {
      own[j] = row[j - low] / band[kBand * j + 11];
      pivot -= row[j - low] * own[j];
    }
    own[i] = pivot;
    negative += pivot < 0.0;
  }
  return negative;
}

// Replaces `right` by the solution for the leading `size` rows.
void solve(const double* band, int64_t size, double* right) {
  for (int64_t i = 0; i < size; ++i) {
    const double* own = band + kBand * i + 11 - i;
    for (int64_t j = greater(int64_t{0}, i - 11); j < i; ++j) right[i] -= own[j] * right[j];
  }
  for (int64_t i = 0; i < size; ++i) right[i] /= band[kBand * i + 11];
  for (int64_t i = size - 1; i >= 0; --i) {
    const double* own = band + kBand * i + 11 - i;
    for (int64_t j = greater(int64_t{0}, i - 11); j < i; ++j) right[j] -= own[j] * right[i];
  }
}

void move(double* r, double* q, const double* step, double part, int64_t count) {
  for (int64_t k = 1; k <= count; ++k) {
    const double* own = step + 6 * (k - 1);
    const double turn[3] = {part * own[0], part * own[1], part * own[2]};
    const double angle = sqrt(dot3(turn, turn)), half = angle < 1e-3 ? 0.5 - angle * angle / 48 : sin(0.5 * angle) / angle;
    double* p = q + 4 * k;
    const double w = p[0], x = p[1], y = p[2], z = p[3];
    const double c = cos(0.5 * angle), a = half * turn[0], b = half * turn[1], d = half * turn[2];
    p[0] = c * w - a * x - b * y - d * z;
    p[1] = c * x + a * w + b * z - d * y;
    p[2] = c * y + b * w + d * x - a * z;
    p[3] = c * z + d * w + a * y - b * x;
    const double size = sqrt(dot4(p, p));
    for (int i = 0; i < 4; ++i) p[i] /= size;
    for (int i = 0; i < 3; ++i) r[3 * k + i] += part * own[3 + i];
  }
}
}  // namespace

// Returns the energy [J]; writes its gradient [6 N], lower band [6 N, 12] and the stresses less what is carried [N, 6].
KERNEL double rod_assembled(const double* r, const double* q, const double* rest, const double* stiff, const double* carried,
                            const double* loads, const double* arms, double* grad, double* band, double* stress,
                            int64_t curved, int64_t /*sections*/, int64_t count, int64_t /*unknowns*/) {
  return assembled(r, q, {rest, stiff, carried, loads, arms, count}, curved != 0, grad, band, stress);
}

// Iterates from r and q, in place, with the end at the position `asked` [3] [m] if held, else under that force [N].
// Returns 0 if it does not converge, 1 if to an unstable state, 2 if to a stable one.
KERNEL int64_t rod_newton(double* r, double* q, const double* rest, const double* stiff, const double* carried, const double* loads,
                          const double* arms, const double* asked, int64_t held, int64_t /*sections*/, int64_t count) {
  const Rod rod{rest, stiff, carried, loads, arms, count};
  const int64_t whole = 6 * count, size = held ? whole - 3 : whole;
  Scratch<double> grad(whole), band(whole * kBand), stress(whole), step(whole);
  const double across[3] = {r[3 * count] - r[0], r[3 * count + 1] - r[1], r[3 * count + 2] - r[2]};
  const double length = sqrt(dot3(across, across));
  for (int round = 0; round < kIterations; ++round) {
    assembled(r, q, rod, true, grad.begin(), band.begin(), stress.begin());
    for (int64_t i = 0; i < whole; ++i) step[i] = -grad[i];
    for (int i = 0; i < 3; ++i) step[whole - 3 + i] = asked[i] - (held ? r[3 * count + i] : grad[whole - 3 + i]);
    for (int64_t i = size; i < whole; ++i)
      for (int64_t j = greater(int64_t{0}, i - 11); j < size; ++j) step[j] -= band[kBand * i + 11 - (i - j)] * step[i];
    const int64_t negative = factorised(band.begin(), size);
    solve(band.begin(), size, step.begin());
    double most = 0.0;
    for (int64_t i = 0; i < whole; ++i) {
      const double off = fabs(step[i]) / (i % 6 < 3 ? 1.0 : length);
      most = off > most || isnan(off) ? off : most;
    }
    if (!(most < 1e3)) return 0;
    move(r, q, step.begin(), lesser(1.0, kLongestTurn / greater(most, 1e-12)), count);
    if (most < kSmall) return negative ? 1 : 2;
  }
  return 0;
}

// Returns the energy [J] of a state; writes the force on its end [3] [N], stresses less what is carried [N, 6], changes
// of the unknowns with the end's position [6 N, 3] and the end's stiffness [3, 3] [N/m].
KERNEL double rod_known_at(const double* r, const double* q, const double* rest, const double* stiff, const double* carried,
                           const double* loads, const double* arms, double* force, double* stress, double* changes,
                           double* end_stiffness, int64_t /*sections*/, int64_t count, int64_t /*unknowns*/) {
  const int64_t whole = 6 * count, size = whole - 3;
  Scratch<double> grad(whole), band(whole * kBand), right(whole);
  const double energy = assembled(r, q, {rest, stiff, carried, loads, arms, count}, true, grad.begin(), band.begin(), stress);
  auto last = [&](int64_t i, int64_t j) { return band[kBand * (size + i) + 11 - (size + i - j)]; };
  factorised(band.begin(), size);
  for (int i = 0; i < 3; ++i) {
    force[i] = grad[size + i];
    right.fill(whole, 0.0);
    for (int64_t j = greater(int64_t{0}, size + i - 11); j < size; ++j) right[j] = -last(i, j);
    solve(band.begin(), size, right.begin());
    right[size + i] = 1.0;
    for (int64_t k = 0; k < whole; ++k) changes[3 * k + i] = right[k];
  }
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j) {
      double total = 0.0;
      for (int64_t k = greater(int64_t{0}, size + i - 11); k < size; ++k) total += last(i, k) * changes[3 * k + j];
      end_stiffness[3 * i + j] = total + last(greater(i, j), size + lesser(i, j));
    }
  return energy;
}
