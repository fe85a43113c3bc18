// The likeliest Weibull distributions of strains at break.
#include "../lanes.hpp"

namespace {
constexpr int kSteps = 60;  // most steps of Newton's method
}

// Maximum-likelihood shapes and scales [d] for the logarithms [d, n] of Weibull variables x: with weights x^k, the
// shape k has sum(x^k log x) / sum(x^k) - 1 / k = mean(log x), and the scale is mean(x^k)^(1 / k).
KERNEL void weibull_fitted(const double* logs, double* shapes, double* scales, int64_t draws, int64_t count) {
  Scratch<double> off(count);
  for (int64_t d = 0; d < draws; ++d) {
    const double* row = logs + count * d;
    double top = row[0], sum = 0.0, spread = 0.0;
    for (int64_t k = 0; k < count; ++k) {
      top = greater(top, row[k]);
      sum += row[k];
    }
    const double mean = sum / count;
    for (int64_t k = 0; k < count; ++k) {
      spread += (row[k] - mean) * (row[k] - mean);
      off[k] = row[k] - top;
    }
    double shape = 1.2825 / greater(sqrt(spread / count), 1e-12);
    for (int step = 0; step < kSteps; ++step) {
      double total = 0.0, first = 0.0, second = 0.0;
      for (int64_t k = 0; k < count; ++k) {
        const double weight = exp(shape * off[k]);
        total += weight;
        first += weight * row[k];
        second += weight * (row[k] * row[k]);
      }
      first /= total;
      second /= total;
      const double change = (first - 1 / shape - mean) / (second - first * first + 1 / (shape * shape));
      shape = greater(shape - change, 0.5 * shape);
      if (fabs(change) < 1e-12 * shape) break;
    }
    double total = 0.0;
    for (int64_t k = 0; k < count; ++k) total += exp(shape * off[k]);
    shapes[d] = shape;
    scales[d] = exp(top + log(total / count) / shape);
  }
}
