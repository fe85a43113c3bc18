// The tree's score: density of points across axes, and which of their nodes are left.
#include "../lanes.hpp"

namespace {
constexpr double kPi = 3.141592653589793;
constexpr double kNowhere = 12.0;  // standard deviations from a skin beyond which it shows no point

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
// from all around. `hidden`: density of the half hidden from a sensor, as a fraction of that all around;
// `open`: sine of the angle between axis and sight; `sharp`: noise across the sight over that along it.
double density(double distance, double radius, double facing, double open, double noise, double power, double hidden,
               double sharp) {
  const double off = (distance - radius) / noise;
  if (fabs(off) > kNowhere) return 0.0;
  const double sharpness = distance * radius / (noise * noise), size = pow(radius, power);
  const double all_around = size * bessel(sharpness) * exp(-0.5 * (off * off)) / (2 * kPi * (noise * noise));
  if (isnan(facing)) return all_around;
  // Rays are even from edge to edge, and meet a circle's front there.
  const double across = sharp * noise, along = noise * sqrt(open * open + (1 - open * open) * (sharp * sharp));
  const double aside = distance * sqrt(greater(1 - facing * facing, 0.0)), unit = sqrt(2.0) * across;
  const double even = (erfc((aside - radius) / unit) - erfc((aside + radius) / unit)) / (4 * radius);
  const double known = radius * radius / (radius * radius + 3 * (across * across)), place = lesser(aside / radius, 1.0);
  const double front = radius * sqrt(1 - (known * (place * place) + (1 - known) / 3));
  const double deep = (distance * facing - front) / along;
  return hidden * all_around + (1 - hidden) * size * even * exp(-0.5 * (deep * deep)) / (sqrt(2 * kPi) * along);
}
}  // namespace

// Density [m, k] times a power of the radius at distances [m] from axes [m] with radii [m] for each noise [k]
// [m]; facing [m] is the cosine of the angle to the sensor, or NaN, and open [m] as above.
KERNEL void densities(const double* distance, const double* radius, const double* facing, const double* open,
                      const double* noises, double* found, double power, double hidden, double sharp, int64_t count,
                      int64_t noise_count) {
  for (int64_t i = 0; i < count; ++i)
    for (int64_t k = 0; k < noise_count; ++k)
      found[noise_count * i + k] = density(distance[i], radius[i], facing[i], open[i], noises[k], power, hidden, sharp);
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

// The nearest values [n] that nowhere rise away from the root, by least squares with weights [n], on a tree by
// its parents [n], each before its children: blocks of one value, of which a node takes the blocks below
// it, the largest first, as long as one is over its own.
KERNEL void falling(const double* value, const double* weight, const int64_t* parent, double* found, int64_t nodes) {
  Scratch<double> total(nodes), mass(nodes);
  Scratch<int64_t> block(nodes), first(nodes), last(nodes), next(nodes);  // lists of the blocks below each
  for (int64_t i = 0; i < nodes; ++i) {
    total[i] = weight[i] * value[i];
    mass[i] = weight[i];
    block[i] = i;
    first[i] = last[i] = next[i] = -1;
  }
  auto append = [&](int64_t to, int64_t from, int64_t end) {
    if (from < 0) return;
    if (first[to] < 0) first[to] = from;
    else next[last[to]] = from;
    last[to] = end;
  };
  for (int64_t i = nodes - 1; i >= 0; --i) {
    for (;;) {
      int64_t most = -1, before_most = -1;
      for (int64_t k = first[i], before = -1; k >= 0; before = k, k = next[k])
        if (most < 0 || total[k] / mass[k] > total[most] / mass[most]) {
          most = k;
          before_most = before;
        }
      if (most < 0 || total[most] / mass[most] <= total[i] / mass[i]) break;
      total[i] += total[most];
      mass[i] += mass[most];
      block[most] = i;
      if (before_most < 0) first[i] = next[most];
      else next[before_most] = next[most];
      if (last[i] == most) last[i] = before_most;
      append(i, first[most], last[most]);
    }
    next[i] = -1;
    if (i) append(parent[i], i, i);
  }
  for (int64_t i = 1; i < nodes; ++i) block[i] = block[block[i]];
  for (int64_t i = 0; i < nodes; ++i) found[i] = total[block[i]] / mass[block[i]];
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
