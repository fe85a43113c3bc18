// The tree's score: density of points across axes, and which of their nodes are left.
#include "../lanes.hpp"

namespace {
constexpr double kPi = 3.141592653589793;
constexpr double kNowhere = 12.0;  // standard deviations from a skin beyond which it shows no point

double power_of(double x, int exponent) {
  double result = 1.0;
  for (; exponent; exponent >>= 1, x *= x)
    if (exponent & 1) result *= x;
  return result;
}

// exp(-x) I0(x), to 2e-7 of it (Abramowitz and Stegun 1964, 9.8.1 and 9.8.2).
double bessel(double x) {
  if (x < 3.75) {
    const double t = (x / 3.75) * (x / 3.75);
    return exp(-x) * (1 + t * (3.5156229 + t * (3.0899424 + t * (1.2067492 + t * (
        0.2659732 + t * (0.0360768 + t * 0.0045813))))));
  }
  const double t = 3.75 / x;
  return (0.39894228 + t * (0.01328592 + t * (0.00225319 + t * (-0.00157565 + t * (
      0.00916281 + t * (-0.02057706 + t * (0.02635537 + t * (-0.01647633 + t * 0.00392377)))))))) / sqrt(x);
}

// Density [1/m^2] across an axis times a power of its radius [m]; facing is NaN where points are seen
// from all around. `hidden`: density of the half hidden from a sensor, as a fraction of that all around.
double density(double distance, double radius, double facing, double noise, double power, double hidden) {
  const double off = (distance - radius) / noise;
  if (fabs(off) > kNowhere) return 0.0;
  const double sharpness = distance * radius / (noise * noise);
  const double all_around = pow(radius, power) * bessel(sharpness) * exp(-0.5 * (off * off)) / (2 * kPi * (noise * noise));
  if (isnan(facing)) return all_around;
  // Fourier's series of the half-wave rectified cosine. Around the circle the noise is von Mises';
  // its harmonics are nearly those of a wrapped normal distribution.
  const double first = sharpness / (0.5 + sqrt(sharpness * sharpness + 2.25)), twice = 2 * (facing * facing) - 1;
  const double seen = 1 + kPi / 2 * first * facing + 2.0 / 3 * power_of(first, 4) * twice
      - 2.0 / 15 * power_of(first, 16) * (2 * (twice * twice) - 1)
      + 2.0 / 35 * power_of(first, 36) * (4 * power_of(twice, 3) - 3 * twice);
  return all_around * (hidden + (1 - hidden) * greater(seen, 0.0));
}
}  // namespace

// Density [m, k] times a power of the radius at distances [m] from axes [m] with radii [m] for each noise [k]
// [m]; facing [m] is the cosine of the angle to the sensor, or NaN.
KERNEL void densities(const double* distance, const double* radius, const double* facing, const double* noises, double* found,
                      double power, double hidden, int64_t count, int64_t noise_count) {
  for (int64_t i = 0; i < count; ++i)
    for (int64_t k = 0; k < noise_count; ++k)
      found[noise_count * i + k] = density(distance[i], radius[i], facing[i], noises[k], power, hidden);
}

// The first nodes of each point's [m, k], nearest first, that are not gone [n], into [m, count]; the last one
// again where there are fewer, and -1 where there is none.
KERNEL void nodes_left(const int64_t* near, const uint8_t* gone, int64_t* found,
                       int64_t points, int64_t candidates, int64_t /*nodes*/, int64_t count) {
  for (int64_t i = 0; i < points; ++i) {
    int64_t *own = found + count * i, place = 0;
    for (int64_t k = 0; k < count; ++k) own[k] = -1;
    for (int64_t k = 0; k < candidates; ++k)
      if (place < count && !gone[near[candidates * i + k]]) {
        for (int64_t j = place; j < count; ++j) own[j] = near[candidates * i + k];
        ++place;
      }
  }
}

// By how much each of t cylinders, foot and end [t, 3] and radius [t], raises the logarithm of the
// likelihood of points [m, 3] with densities wood [m] on a skin; sight [m, 3] or no rows. table [tables,
// facings, distances] holds logarithms of that on theirs, at 0 and at distances whose logarithms are evenly
// spaced, the first two of them `first` [2].
KERNEL void likelihood_raised(
    const double* foot, const double* end, const double* radius, const int64_t* table_of, const double* table,
    const double* first, const double* points, const double* sight, const double* wood, const double* residual, double* rise,
    double power, double skin, double elsewhere, int64_t cylinders, int64_t /*tables*/, int64_t facings, int64_t distances,
    int64_t count, int64_t sighted) {
  Scratch<double> before(count);
  for (int64_t i = 0; i < count; ++i) before[i] = 1 / (wood[i] / skin + elsewhere);
  for (int64_t k = 0; k < cylinders; ++k) {
    const double *o = foot + 3 * k, *e = end + 3 * k;
    const double ax = e[0] - o[0], ay = e[1] - o[1], az = e[2] - o[2], square = ax * ax + ay * ay + az * az;
    const double inverse = 1 / square, after = 1 / (skin + pow(radius[k], power) * sqrt(square));
    const double* own = table + facings * distances * table_of[k];
    // A logarithm takes longer than all else: one of the product of many ratios.
    double ratio = 1.0;
    rise[k] = 0.0;
    for (int64_t i = 0; i < count; ++i) {
      const double px = points[3 * i] - o[0], py = points[3 * i + 1] - o[1], pz = points[3 * i + 2] - o[2];
      const double t = lesser(greater((px * ax + py * ay + pz * az) * inverse, 0.0), 1.0);
      const double dx = px - t * ax, dy = py - t * ay, dz = pz - t * az, squared = dx * dx + dy * dy + dz * dz;
      const double reach = residual[i] + radius[k];
      double here = wood[i];
      if (reach > 0.0 && squared < reach * reach) {
        const double distance = sqrt(squared);
        const double place = greater((log(greater(distance, 1e-300)) - first[0]) / (first[1] - first[0]) + 1, 0.0);
        const int64_t low = lesser(static_cast<int64_t>(place), distances - 2);
        const double part = lesser(place - low, 1.0);
        int64_t row = 0;
        double beside = 0.0;
        if (sighted > 0) {
          double x = sight[3 * i], y = sight[3 * i + 1], z = sight[3 * i + 2];
          const double on = (x * ax + y * ay + z * az) / square;
          x -= on * ax; y -= on * ay; z -= on * az;
          const double open = greater(sqrt(x * x + y * y + z * z), 0.2);
          const double cosine = (x * dx + y * dy + z * dz) / (open * greater(distance, 1e-300));
          const double at = (lesser(greater(cosine, -1.0), 1.0) + 1) / 2 * (facings - 1);
          row = lesser(static_cast<int64_t>(at), facings - 2);
          beside = at - row;
        }
        auto across = [&](int64_t r) { return (1 - part) * own[distances * r + low] + part * own[distances * r + low + 1]; };
        double value = across(row);
        if (beside > 0.0) value += beside * (across(row + 1) - value);
        here = exp(value);
      }
      ratio *= (here * after + elsewhere) * before[i];
      if (!(1e-150 < ratio && ratio < 1e150)) {
        rise[k] += log(ratio);
        ratio = 1.0;
      }
    }
    rise[k] += log(ratio);
  }
}

// The sum [n] of what trees say of features [n, m], from `start` on: each tree's nodes from `first` [trees]
// on, `depth` [trees]; of each node feature, threshold, the next ones within its tree, and value. An end of a
// tree leads to itself.
KERNEL void trees_voted(const double* features, const int64_t* first, const int64_t* depth, const int64_t* feature,
                        const double* threshold, const int64_t* low, const int64_t* high, const double* value, double* total,
                        double start, int64_t rows, int64_t columns, int64_t trees, int64_t /*nodes*/) {
  for (int64_t row = 0; row < rows; ++row) {
    total[row] = start;
    for (int64_t tree = 0; tree < trees; ++tree) {
      int64_t node = first[tree];
      for (int64_t step = 0; step < depth[tree]; ++step)
        node = first[tree] + (features[columns * row + feature[node]] <= threshold[node] ? low[node] : high[node]);
      total[row] += value[node];
    }
  }
}
