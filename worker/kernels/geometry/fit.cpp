// Loops of the axis fit over points: nearest cylinder of each, its normal equations, and points on circles.
#include "../lanes.hpp"

namespace {
constexpr double kEven = 1e-9;                     // of a radius
constexpr double kWide = 60.0;                     // concentration (7 degrees)
constexpr int64_t kFine = 150;                     // positions on the circle
constexpr double kNormal = 30.0;                   // concentration of the normal approximation
constexpr int kTerms = 30;                         // of the series
constexpr double kTold = 14.0;                     // log weight below the best's at which a position still counts
constexpr double kPi = 3.141592653589793;

// Fraction of a von Mises distribution around 0 below an angle, counting whole turns: its series
// (Hill, ACM Algorithm 518, 1977), or the normal distribution that it approaches.
double below(double angle, double sharpness, double bessel) {
  const double turns = floor((angle + kPi) / (2 * kPi));
  angle -= 2 * kPi * turns;
  if (sharpness > kNormal) {
    const double half = sqrt(2 / kPi) / bessel * sin(angle / 2);
    return turns + 0.5 * (1 + erf(half / sqrt(2.0)));
  }
  const double sine = sin(angle), cosine = cos(angle);
  int order = kTerms;
  double up = sin(order * angle), across = cos(order * angle), ratio = 0.0, total = 0.0;
  for (int term = 1; term < kTerms; ++term) {
    --order;
    const double before = up;
    up = before * cosine - across * sine;
    across = across * cosine + before * sine;
    ratio = 1 / (2 * order / greater(sharpness, 1e-12) + ratio);
    total = (up / order + total) * ratio;
  }
  return turns + 0.5 + (angle / 2 + total) / kPi;
}
}  // namespace

// Finds the cylinder nearest to each point [m, 3] among candidates [m, k]: its upper node [m], the
// fraction of the path to it [m], unit vector from the axis [m, 3], distance from the surface [m]
// (positive outside) and radius [m]. own_radius [n]: the cylinder has its upper node's throughout.
KERNEL void nearest_cylinder(const double* points, const int64_t* near, const int64_t* parent, const uint8_t* own_radius,
                             const double* nodes, const double* radius, int64_t* segment, double* share, double* normal,
                             double* residual, double* thick, int64_t count, int64_t candidates, int64_t /*nodes*/) {
  for (int64_t i = 0; i < count; ++i) {
    const double* point = points + 3 * i;
    double best = HUGE_VAL;
    for (int64_t k = 0; k < candidates; ++k) {
      const int64_t end = near[candidates * i + k], start = parent[end];
      const double *a = nodes + 3 * end, *o = nodes + 3 * start;
      const double ax = a[0] - o[0], ay = a[1] - o[1], az = a[2] - o[2];
      const double px = point[0] - o[0], py = point[1] - o[1], pz = point[2] - o[2];
      const double square = greater(ax * ax + ay * ay + az * az, 1e-300);
      const double t = lesser(greater((px * ax + py * ay + pz * az) / square, 0.0), 1.0);
      const double dx = px - t * ax, dy = py - t * ay, dz = pz - t * az;
      const double distance = sqrt(dx * dx + dy * dy + dz * dz);
      // No branch: it is often mispredicted.
      const double between[2] = {(1 - t) * radius[start] + t * radius[end], radius[end]}, here = between[own_radius[end]];
      // Two cylinders that meet are equally near to a point beyond both: rounding must not decide.
      if (distance - here < best - kEven * here) {
        const double chosen = greater(distance, 1e-300);
        best = distance - here;
        segment[i] = end; share[i] = t; thick[i] = here; residual[i] = best;
        normal[3 * i] = dx / chosen; normal[3 * i + 1] = dy / chosen; normal[3 * i + 2] = dz / chosen;
      }
    }
  }
}

// Normal equations of each cylinder's points in (x, y, z, r) of both ends, blocks [count, 8, 8] and
// right sides [count, 8]. Of each point, [m]: low and high, the radius's derivatives by the ends'
// radii; gradient [m, 8] of the residual; across [m, 3], how firmly it holds the axis across its direction.
KERNEL void normal_blocks(const int64_t* segment, const double* share, const double* low, const double* high,
                          const double* normal, const double* across, const double* gradient, const double* weight,
                          double* block, double* right, int64_t points, int64_t count) {
  memset(block, 0, 64 * count * sizeof(double));
  memset(right, 0, 8 * count * sizeof(double));
  for (int64_t i = 0; i < points; ++i) {
    const double w = weight[i];
    if (w == 0.0) continue;
    double row[8], side[8] = {}, *to = block + 64 * segment[i];
    for (int k = 0; k < 3; ++k) {
      row[k] = -(1 - share[i]) * normal[3 * i + k];
      row[4 + k] = -share[i] * normal[3 * i + k];
      side[k] = -(1 - share[i]) * across[3 * i + k];
      side[4 + k] = -share[i] * across[3 * i + k];
    }
    row[3] = -low[i];
    row[7] = -high[i];
    for (int a = 0; a < 8; ++a) {
      right[8 * segment[i] + a] += w * gradient[8 * i + a];
      for (int b = a; b < 8; ++b) to[8 * a + b] += w * (row[a] * row[b] + side[a] * side[b]);
    }
  }
  for (int64_t s = 0; s < count; ++s)
    for (int a = 0; a < 8; ++a)
      for (int b = 0; b < a; ++b) block[64 * s + 8 * a + b] = block[64 * s + 8 * b + a];
}

// Mean (cos, sin) [m, 2] of positions on a circle with a density [steps] in the middles of even
// intervals, times exp(sharpness (cos(place - angle) - 1)) for each point [m] (von Mises).
KERNEL void mean_on_circle(const double* cosine, const double* sine, const double* sharpness, const double* density,
                           double* mean, int64_t points, int64_t steps) {
  Scratch<double> across(steps), up(steps), log_density(steps), power(steps);
  for (int64_t k = 0; k < steps; ++k) {
    const double angle = 2 * kPi * (k + 0.5) / steps;
    across[k] = cos(angle);
    up[k] = sin(angle);
    log_density[k] = log(density[k]);
  }
  auto place = [steps](int64_t k) { return ((k % steps) + steps) % steps; };
  for (int64_t i = 0; i < points; ++i) {
    const double sharp = sharpness[i];
    // Positions farther away have no weight.
    int64_t reach = steps;
    if (sharp > kTold / 2) reach = static_cast<int64_t>(ceil(acos(1 - kTold / sharp) * steps / (2 * kPi))) + 1;
    double turn = fmod(atan2(sine[i], cosine[i]), 2 * kPi);
    if (turn < 0) turn += 2 * kPi;
    const int64_t own = static_cast<int64_t>(turn * steps / (2 * kPi));
    const bool is_part = 2 * reach < steps;
    int64_t first = is_part ? own - reach : 0;
    const int64_t count = is_part ? 2 * reach + 1 : steps;
    // If it is wide enough, intervals three times as wide, each by its middle, sum it as well.
    const int64_t step = sharp < kWide && steps % 3 == 0 && steps >= kFine ? 3 : 1;
    if (step == 3) first -= ((first - 1) % 3 + 3) % 3;
    double most = -HUGE_VAL;
    for (int64_t j = 0; j < count; j += step) {
      const int64_t k = place(first + j);
      power[k] = sharp * (cosine[i] * across[k] + sine[i] * up[k] - 1) + log_density[k];
      most = greater(most, power[k]);
    }
    double total = 0.0, x = 0.0, y = 0.0;
    for (int64_t j = 0; j < count; j += step) {
      const int64_t k = place(first + j);
      const double weight = exp(power[k] - most);
      total += weight;
      x += weight * across[k];
      y += weight * up[k];
    }
    mean[2 * i] = x / total;
    mean[2 * i + 1] = y / total;
  }
}

// Log-likelihood [m] of points on a side seen up to `limit` [rad], and its derivatives by angle and
// limit [m]. Positions beyond count `least`, each is blurred by a von Mises distribution; the sum over
// all does not divide it. bessel [m] is I0(sharpness) exp(-sharpness).
KERNEL void reach_on_circle(const double* angle, const double* sharpness, const double* bessel, double* log_likelihood,
                            double* by_angle, double* by_limit, double limit, double least, int64_t points) {
  for (int64_t i = 0; i < points; ++i) {
    const double k = sharpness[i], low = -limit - angle[i], high = limit - angle[i];
    const double blurred = least + (1 - least) * (below(high, k, bessel[i]) - below(low, k, bessel[i]));
    const double at_low = exp(k * (cos(low) - 1)) / (2 * kPi * bessel[i]);
    const double at_high = exp(k * (cos(high) - 1)) / (2 * kPi * bessel[i]);
    log_likelihood[i] = log(blurred);
    by_angle[i] = (1 - least) * (at_low - at_high) / blurred;
    by_limit[i] = (1 - least) * (at_low + at_high) / blurred;
  }
}
