// The strain of a reduced model, a quadratic polynomial of its coordinates, and its force.
//
// With coordinates q [size] the whitened strain [m] is e_a = l_a . q + q . Q_a q: the linear part l [m, size] and the
// lower triangles of symmetric Q_a by rows [m, size (size + 1) / 2]. The energy is e . e / 2 [J] and the force J'e with
// J = de/dq.
#include "../lanes.hpp"

namespace {
// a . b, four at a time.
INLINE double dot(const double* a, const double* b, int64_t count) {
  Lanes total{};
  int64_t j = 0;
  for (; j + kLanes <= count; j += kLanes) total += load(a + j) * load(b + j);
  double rest = 0.0;
  for (; j < count; ++j) rest += a[j] * b[j];
  return sum(total) + rest;
}
}  // namespace

// Returns the energy [J]; writes the strain [m], J [m, size], the force J'e [size] and the tangent [size, size] (lower
// triangle). `increment` [size]: geometric part of mixed integration points. `velocity` [size], changing by `by_rate`
// [1/s] with q: stress `damping` [s] times the strain's rate. Without rows: neither.
KERNEL double strain_evaluated(
    const double* linear, const double* quadratic, const double* q, const double* increment, const double* velocity,
    double* strain, double* jacobian, double* gradient, double* tangent, double damping, double by_rate,
    int64_t count, int64_t size, int64_t terms, int64_t increments, int64_t velocities) {
  memset(gradient, 0, size * sizeof(double));
  memset(tangent, 0, size * size * sizeof(double));
  double energy = 0.0;
  for (int64_t a = 0; a < count; ++a) {
    double* row = jacobian + size * a;
    const double *line = linear + size * a, *form = quadratic + terms * a;
    for (int64_t i = 0; i < size; ++i) {
      const double qi = q[i];
      int64_t j = 0;
      for (; j + kLanes <= i; j += kLanes) store(row + j, load(row + j) + load(form + j) * qi);
      for (; j < i; ++j) row[j] += form[j] * qi;
      row[i] = dot(form, q, i + 1);
      form += i + 1;
    }
    double predicted = 0.0;
    form = quadratic + terms * a;
    for (int64_t i = 0; i < increments; ++i) {
      predicted += increment[i] * (2 * dot(form, increment, i) + form[i] * increment[i]);
      form += i + 1;
    }
    double value = 0.0;
    for (int64_t i = 0; i < size; ++i) {
      value += (line[i] + row[i]) * q[i];
      row[i] = line[i] + 2 * row[i];
    }
    strain[a] = value;
    energy += 0.5 * value * value;
    double viscous = 0.0, growth = 1.0;
    if (velocities > 0) {
      growth += damping * by_rate;
      for (int64_t i = 0; i < size; ++i) viscous += damping * row[i] * velocity[i];
    }
    const double geometric = 2 * (value + viscous - predicted);
    form = quadratic + terms * a;
    for (int64_t i = 0; i < size; ++i) {
      gradient[i] += row[i] * (value + viscous);
      const double ri = row[i] * growth;
      double* own = tangent + size * i;
      int64_t j = 0;
      for (; j + kLanes <= i + 1; j += kLanes) store(own + j, load(own + j) + (ri * load(row + j) + geometric * load(form + j)));
      for (; j <= i; ++j) own[j] += ri * row[j] + geometric * form[j];
      form += i + 1;
    }
  }
  return energy;
}

// Writes the strain [m] alone; returns the energy [J].
KERNEL double strain_alone(const double* linear, const double* quadratic, const double* q, double* strain,
                           int64_t count, int64_t size, int64_t terms) {
  double energy = 0.0;
  for (int64_t a = 0; a < count; ++a) {
    const double *line = linear + size * a, *form = quadratic + terms * a;
    double value = 0.0;
    for (int64_t i = 0; i < size; ++i) {
      value += q[i] * (line[i] + 2 * dot(form, q, i) + form[i] * q[i]);
      form += i + 1;
    }
    strain[a] = value;
    energy += 0.5 * value * value;
  }
  return energy;
}

// Writes the change of the Green-Lagrange strain [p, 6, f], shear scaled by the root of two, at displacement gradients
// H [p, 3, 3, s] by changes D [p, 3, 3, f] of them. Field f belongs to state owners[f] and is scaled by scales[f].
KERNEL void green_changed(const double* H, const double* D, const int64_t* owners, const double* scales, double* strain,
                          int64_t points, int64_t states, int64_t fields) {
  constexpr int kPairs[6][2] = {{0, 0}, {1, 1}, {2, 2}, {0, 1}, {0, 2}, {1, 2}};
  const double shear = sqrt(0.5);
  auto part = [=](auto h, auto d, int k) {
    const int i = kPairs[k][0], j = kPairs[k][1];
    auto total = d(i, j) + d(j, i);
    for (int c = 0; c < 3; ++c) total += h(c, i) * d(c, j) + d(c, i) * h(c, j);
    return total * (k < 3 ? 0.5 : shear);
  };
  for (int64_t p = 0; p < points; ++p) {
    const double *state = H + 9 * p * states, *change = D + 9 * p * fields;
    double* out = strain + 6 * p * fields;
    int64_t f = 0;
    for (; f + kLanes <= fields; f += kLanes) {
      const int64_t* own = owners + f;
      Lanes h[9], d[9];
      for (int k = 0; k < 9; ++k) {
        const double* row = state + k * states;
        h[k] = Lanes{row[own[0]], row[own[1]], row[own[2]], row[own[3]]};
        d[k] = load(change + k * fields + f) * load(scales + f);
      }
      for (int k = 0; k < 6; ++k)
        store(out + k * fields + f, part([&](int c, int i) { return h[3 * c + i]; }, [&](int c, int i) { return d[3 * c + i]; }, k));
    }
    for (; f < fields; ++f)
      for (int k = 0; k < 6; ++k)
        out[k * fields + f] = part([&](int c, int i) { return state[(3 * c + i) * states + owners[f]]; },
                                   [&](int c, int i) { return change[(3 * c + i) * fields + f] * scales[f]; }, k);
  }
}
