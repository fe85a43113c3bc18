// A fitted field at a point, its limits, and the cost of a path through it. Each part is read from one
// array of numbers, which `numbers` of the Python class of the same name lays out; samples are padded
// to whole lanes by ones that count nothing.
#pragma once
#include "../lanes.hpp"

// The numbers of an array, in turn.
class Numbers {
 public:
  explicit Numbers(const double* at) : at_(at) {}
  double next() { return *at_++; }
  int64_t count() { return static_cast<int64_t>(*at_++); }
  const double* next(int64_t count) {
    at_ += count;
    return at_ - count;
  }

 private:
  const double* at_;
};

inline double length(const double* x) { return sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2]); }
INLINE double fourth_root(double x) { return sqrt(sqrt(x)); }

// Coordinates y = (R t e_1, R t e_2, k g(r - R)), g(w) = w / (1 + (w / d)^2)^(1/4): r [m] from the pivot,
// t the angle from the outward axis, e across towards the point, stretch k, depth d [m]. Radius 0: y = x.
struct Chart {
  const double* pivot;  // [3] [m]
  double radius;        // [m]
  const double* axes;   // [3, 3], rows: two across, then outward at rest
  double stretch, depth;

  explicit Chart(Numbers& from)
      : pivot(from.next(3)), radius(from.next()), axes(from.next(9)), stretch(from.next()), depth(from.next()) {}

  // Along the axes, from the pivot.
  void local(const double* point, double* out) const {
    for (int k = 0; k < 3; ++k) {
      out[k] = 0.0;
      for (int j = 0; j < 3; ++j) out[k] += axes[3 * k + j] * (point[j] - pivot[j]);
    }
  }
  void mapped(const double* point, double* out) const {
    if (radius == 0.0) {
      memcpy(out, point, 3 * sizeof(double));
      return;
    }
    local(point, out);
    const double rho = sqrt(out[0] * out[0] + out[1] * out[1]);
    const double off = sqrt(rho * rho + out[2] * out[2]) - radius;
    const double part = rho < 1e-12 ? radius / out[2] : radius * atan2(rho, out[2]) / rho;
    out[0] *= part;
    out[1] *= part;
    out[2] = stretch * off / fourth_root(1.0 + (off / depth) * (off / depth));
  }
  // A gradient to the chart's coordinates taken to the point's, or the inverse (`forward`).
  void turned(const double* point, const double* gradient, bool forward, double* out) const {
    double at[3], own[3] = {gradient[0], gradient[1], gradient[2]};
    local(point, at);
    if (forward)
      for (int k = 0; k < 3; ++k) {
        own[k] = 0.0;
        for (int j = 0; j < 3; ++j) own[k] += axes[3 * k + j] * gradient[j];
      }
    const double rho = greater(sqrt(at[0] * at[0] + at[1] * at[1]), 1e-12), r = sqrt(rho * rho + at[2] * at[2]);
    const double x = at[0] / rho, y = at[1] / rho, sine = rho / r, cosine = at[2] / r;
    const double square = ((r - radius) / depth) * ((r - radius) / depth), whole = 1.0 + square;
    const double meridian = radius / r, parallel = radius * atan2(rho, at[2]) / rho;
    const double outward = stretch * (1.0 + 0.5 * square) / (whole * fourth_root(whole));
    // Components along the meridian, along the parallel and outward, at both ends.
    const double across = x * own[0] + y * own[1], aside = x * own[1] - y * own[0];
    if (forward) {
      const double along = (cosine * across - sine * own[2]) / meridian, beside = aside / parallel;
      out[0] = x * along - y * beside;
      out[1] = y * along + x * beside;
      out[2] = (sine * across + cosine * own[2]) / outward;
      return;
    }
    const double along = across * meridian, beside = aside * parallel, off = own[2] * outward;
    const double out_across = cosine * along + sine * off;
    const double turned[3] = {x * out_across - y * beside, y * out_across + x * beside, cosine * off - sine * along};
    for (int k = 0; k < 3; ++k) {
      out[k] = 0.0;
      for (int j = 0; j < 3; ++j) out[k] += axes[3 * j + k] * turned[j];
    }
  }
  // The magnitude of a gradient taken to the point's coordinates.
  double size(const double* point, const double* gradient) const {
    double out[3];
    if (radius == 0.0) return length(gradient);
    turned(point, gradient, false, out);
    return length(out);
  }
};

// phi at squared distance, with grad phi = a d and the Hessian a I + b d d^T at the offset d.
enum { kCubic, kQuintic, kMultiquadric, kGaussian };
struct Terms { Lanes phi, a, b; };
template <int kernel>
INLINE Terms radial_terms(double shape, Lanes squared) {
  if constexpr (kernel == kCubic) {
    const Lanes r = root(squared);
    return {r * squared, 3.0 * r, r > 0.0 ? 3.0 / r : all(0.0)};
  } else if constexpr (kernel == kQuintic) {
    const Lanes r = root(squared);
    return {-r * squared * squared, -5.0 * r * squared, -15.0 * r};
  } else if constexpr (kernel == kMultiquadric) {
    const double square = shape * shape;
    const Lanes s = root(1.0 + square * squared);
    return {-s, -square / s, square * square / (s * s * s)};
  } else {
    const double square = shape * shape;
    Lanes phi = -square * squared;
    for (int l = 0; l < kLanes; ++l) phi[l] = exp(phi[l]);
    return {phi, -2.0 * square * phi, 4.0 * square * square * phi};
  }
}
// Calls `of` with the number of a kernel that the compiler knows.
template <class Function>
INLINE auto with_kernel(int64_t kernel, const Function& of) {
  if (kernel == kCubic) return of(Fixed<kCubic>());
  if (kernel == kQuintic) return of(Fixed<kQuintic>());
  if (kernel == kMultiquadric) return of(Fixed<kMultiquadric>());
  return of(Fixed<kGaussian>());
}

// f(x) = sum_j c_j phi(|x - x_j|) - sum_j g_j . grad phi(|x - x_j|) + p(x), x = (point - shift) / scale.
struct Radial {
  int64_t kernel;
  double shape, scale;
  const double* shift;                                 // [3]
  int64_t samples, channels, terms;
  bool has_slopes;
  const double *centres, *weights, *slopes;            // [3, samples], [channels, samples], [channels, 3, samples]
  const double *polynomial, *powers;                   // [terms, channels], [terms, 3]

  explicit Radial(Numbers& from)
      : kernel(from.count()), shape(from.next()), scale(from.next()), shift(from.next(3)), samples(from.count()),
        channels(from.count()), terms(from.count()), has_slopes(from.next() != 0.0), centres(from.next(3 * samples)),
        weights(from.next(channels * samples)), slopes(from.next(has_slopes ? 3 * channels * samples : 0)),
        polynomial(from.next(terms * channels)), powers(from.next(3 * terms)) {}

  double value(const double* point, int64_t channel) const {
    double found;
    values<1>(point, &channel, &found);
    return found;
  }
  // Some channels at a point [3] of the chart, in one pass over the samples.
  template <int count>
  void values(const double* point, const int64_t* asked, double* found) const {
    const double at[3] = {(point[0] - shift[0]) / scale, (point[1] - shift[1]) / scale, (point[2] - shift[2]) / scale};
    with_kernel(kernel, [&](auto number) {
      Lanes total[count] = {};
      for (int64_t j = 0; j < samples; j += kLanes) {
        const Lanes x = at[0] - load(centres + j), y = at[1] - load(centres + samples + j),
                    z = at[2] - load(centres + 2 * samples + j);
        const Terms term = radial_terms<number>(shape, x * x + y * y + z * z);
        for (int c = 0; c < count; ++c) {
          total[c] += load(weights + asked[c] * samples + j) * term.phi;
          if (!has_slopes) continue;
          const double* slope = slopes + 3 * asked[c] * samples + j;
          total[c] -= term.a * (x * load(slope) + y * load(slope + samples) + z * load(slope + 2 * samples));
        }
      }
      for (int c = 0; c < count; ++c) found[c] = sum(total[c]);
    });
    const Powers x(at[0]), y(at[1]), z(at[2]);
    for (int64_t t = 0; t < terms; ++t) {
      const int p = static_cast<int>(powers[3 * t]), q = static_cast<int>(powers[3 * t + 1]), r = static_cast<int>(powers[3 * t + 2]);
      const double term = x[p] * y[q] * z[r];
      for (int c = 0; c < count; ++c) found[c] += polynomial[t * channels + asked[c]] * term;
    }
  }
  // The gradient [3] of one channel at a point [3] of the chart.
  void gradient(const double* point, int64_t channel, double* out) const {
    const double at[3] = {(point[0] - shift[0]) / scale, (point[1] - shift[1]) / scale, (point[2] - shift[2]) / scale};
    const double *weight = weights + channel * samples, *slope = slopes + (has_slopes ? 3 * channel * samples : 0);
    with_kernel(kernel, [&](auto number) {
      Lanes total[3] = {};
      for (int64_t j = 0; j < samples; j += kLanes) {
        const Lanes x = at[0] - load(centres + j), y = at[1] - load(centres + samples + j),
                    z = at[2] - load(centres + 2 * samples + j);
        const Terms term = radial_terms<number>(shape, x * x + y * y + z * z);
        Lanes radial = load(weight + j) * term.a;
        if (has_slopes) {
          const Lanes along_x = load(slope + j), along_y = load(slope + samples + j), along_z = load(slope + 2 * samples + j);
          radial -= term.b * (x * along_x + y * along_y + z * along_z);
          total[0] += radial * x - term.a * along_x;
          total[1] += radial * y - term.a * along_y;
          total[2] += radial * z - term.a * along_z;
        } else {
          total[0] += radial * x;
          total[1] += radial * y;
          total[2] += radial * z;
        }
      }
      for (int k = 0; k < 3; ++k) out[k] = sum(total[k]);
    });
    const Powers x(at[0]), y(at[1]), z(at[2]);
    for (int64_t t = 0; t < terms; ++t) {
      const int p = static_cast<int>(powers[3 * t]), q = static_cast<int>(powers[3 * t + 1]), r = static_cast<int>(powers[3 * t + 2]);
      const double factor = polynomial[t * channels + channel];
      out[0] += factor * p * x[p - 1] * y[q] * z[r];
      out[1] += factor * q * x[p] * y[q - 1] * z[r];
      out[2] += factor * r * x[p] * y[q] * z[r - 1];
    }
    for (int k = 0; k < 3; ++k) out[k] /= scale;
  }

 private:
  // From -1, which counts as 0, to the polynomials' highest.
  struct Powers {
    double known[4];
    explicit Powers(double x) : known{1.0, 1.0, x, x * x} {}
    double operator[](int exponent) const { return known[exponent + 1]; }
  };
};

// Squared distance of a point [3] from four of `others` [3, count] [m^2], and the least to all.
INLINE Lanes squared(const double* point, const double* others, int64_t count, int64_t at) {
  const Lanes x = point[0] - load(others + at), y = point[1] - load(others + count + at), z = point[2] - load(others + 2 * count + at);
  return x * x + y * y + z * z;
}
inline double nearest(const double* point, const double* others, int64_t count) {
  Lanes least = all(HUGE_VAL);
  for (int64_t i = 0; i < count; i += kLanes) least = lesser(least, squared(point, others, count, i));
  return lesser(lesser(least[0], least[1]), lesser(least[2], least[3]));
}

// Where a field is trusted: below planes in the plain chart, and not nearer to a refused pose than to
// any accepted one.
struct Region {
  Chart chart;
  double edge;                                       // [m] above a plane that still belongs to it
  int64_t plane_count, accepted_count, rejected_count;
  const double *planes, *accepted, *rejected;        // [4, planes], [3, accepted] [m], [3, rejected] [m]

  explicit Region(Numbers& from)
      : chart(from), edge(from.next()), plane_count(from.count()), accepted_count(from.count()), rejected_count(from.count()),
        planes(from.next(4 * plane_count)), accepted(from.next(3 * accepted_count)), rejected(from.next(3 * rejected_count)) {}

  bool trusts(const double* point, const double* flat) const {
    for (int64_t i = 0; i < plane_count; i += kLanes) {
      Lanes height = load(planes + 3 * plane_count + i);
      for (int k = 0; k < 3; ++k) height += load(planes + k * plane_count + i) * flat[k];
      if (height[0] > edge || height[1] > edge || height[2] > edge || height[3] > edge) return false;
    }
    return rejected_count == 0 || nearest(point, accepted, accepted_count) <= nearest(point, rejected, rejected_count);
  }
};

// Mean [n] of squares of samples with weights 1 / (near + distance^2)^3; a sample may be left out.
INLINE Lanes weight_of(Lanes distance) { return 1.0 / (distance * distance * distance); }
inline double mean_about(const double* point, const double* samples, const double* squares, double near, int64_t count,
                         int64_t left_out) {
  Lanes total = all(0.0), weights = all(0.0), number{0.0, 1.0, 2.0, 3.0};
  for (int64_t i = 0; i < count; i += kLanes, number += 4.0) {
    Lanes weight = weight_of(near + squared(point, samples, count, i));
    if (left_out >= 0) weight = number == static_cast<double>(left_out) ? all(0.0) : weight;
    total += weight * load(squares + i);
    weights += weight;
  }
  return sum(total) / sum(weights);
}

// By how much limits are tighter at a point of the plain chart, below 0 an extension: a factor times the
// root of that mean, at most `most`. Factor 0: no tighter; infinite: `most`.
struct Slack {
  int64_t rows, count;
  double near;
  const double *factors, *most, *samples, *squares;  // [rows], [rows], [3, count], [rows, count]

  explicit Slack(Numbers& from)
      : rows(from.count()), count(from.count()), near(from.next()), factors(from.next(rows)), most(from.next(rows)),
        samples(from.next(3 * count)), squares(from.next(rows * count)) {}

  double at(const double* point, int64_t row) const {
    const double factor = factors[row];
    if (factor == 0.0) return 0.0;
    if (factor == HUGE_VAL) return most[row];
    const double tighter = factor * sqrt(mean_about(point, samples, squares + row * count, near, count, -1));
    return factor > 0.0 ? lesser(tighter, most[row]) : greater(tighter, most[row]);
  }
  // Its gradient [3] to the point of the chart.
  void slope(const double* point, int64_t row, double* out) const {
    const double factor = factors[row];
    out[0] = out[1] = out[2] = 0.0;
    if (factor == 0.0 || factor == HUGE_VAL) return;
    Lanes total = all(0.0), weights = all(0.0), along[3] = {}, of_weights[3] = {};
    for (int64_t i = 0; i < count; i += kLanes) {
      const Lanes distance = near + squared(point, samples, count, i), weight = weight_of(distance);
      const Lanes square = load(squares + row * count + i);
      total += weight * square;
      weights += weight;
      for (int k = 0; k < 3; ++k) {
        const Lanes change = -6.0 * weight / distance * (point[k] - load(samples + k * count + i));
        along[k] += change * square;
        of_weights[k] += change;
      }
    }
    const double whole = sum(weights), mean = sum(total) / whole;
    if (fabs(factor * sqrt(mean)) >= fabs(most[row])) return;
    for (int k = 0; k < 3; ++k) out[k] = 0.5 * factor / sqrt(mean) * (sum(along[k]) - mean * sum(of_weights[k])) / whole;
  }
};

// A field with limits on energy [J], force [N], a box [m] and loads.
struct Field {
  double most_energy, most_force;
  int64_t load_count;
  const double *most_loads, *low, *high;
  Chart chart;
  Radial energies;
  Region region;
  Chart load_chart;
  Radial loads;
  Slack slack;

  explicit Field(Numbers from)
      : most_energy(from.next()), most_force(from.next()), load_count(from.count()), most_loads(from.next(load_count)),
        low(from.next(3)), high(from.next(3)), chart(from), energies(from), region(from), load_chart(from), loads(from),
        slack(from) {}

  // The energy [J], cut off at 0.
  double energy(const double* point) const {
    double flat[3];
    chart.mapped(point, flat);
    return greater(energies.value(flat, 0), 0.0);
  }
  // Whether a point, whose energy is known, is trusted and within the limits.
  bool allows(const double* point, double energy) const {
    double plain[3], flat[3], slope[3];
    region.chart.mapped(point, plain);
    if (energy > most_energy - slack.at(plain, 0)) return false;
    for (int k = 0; k < 3; ++k)
      if (!(low[k] <= point[k] && point[k] <= high[k])) return false;
    if (!region.trusts(point, plain)) return false;
    bool is_mapped = false;
    for (int64_t k = 0; k < load_count; ++k) {
      if (most_loads[k] == HUGE_VAL) continue;
      if (!is_mapped) load_chart.mapped(point, flat);
      is_mapped = true;
      if (fabs(loads.value(flat, k)) > most_loads[k] - slack.at(plain, 2 + k)) return false;
    }
    if (most_force == HUGE_VAL) return true;
    chart.mapped(point, flat);
    energies.gradient(flat, 0, slope);
    return chart.size(point, slope) <= most_force - slack.at(plain, 1);
  }
};

// Weights of an edge's energy [1/(J m)] and length [1/m], and the step of quadrature [m].
struct Weights { double energy, length, step; };

// The cost of the straight edge, by the midpoint rule at the step or finer; infinite if any of it is not
// allowed. `stop` is checked, `start` is assumed checked.
inline double edge_cost(const double* start, const double* stop, const Field& field, const Weights& weights) {
  const double way[3] = {stop[0] - start[0], stop[1] - start[1], stop[2] - start[2]}, whole = length(way);
  const int64_t pieces = greater(static_cast<int64_t>(ceil(whole / weights.step)), int64_t{1});
  double total = 0.0;
  for (int64_t i = 0; i < pieces; ++i) {
    const double part = (i + 0.5) / pieces;
    const double point[3] = {start[0] + way[0] * part, start[1] + way[1] * part, start[2] + way[2] * part};
    const double energy = weights.energy > 0.0 || field.most_energy < HUGE_VAL ? field.energy(point) : 0.0;
    if (!field.allows(point, energy)) return HUGE_VAL;
    total += energy;
  }
  if (!field.allows(stop, field.most_energy < HUGE_VAL ? field.energy(stop) : 0.0)) return HUGE_VAL;
  return whole * (weights.energy * total / pieces + weights.length);
}
