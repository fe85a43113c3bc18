// Kernels of a fitted field over grasp positions: its chart, interpolant, region, slacks, and costs of paths.
#include "field.hpp"

namespace {
// Rows [n, width] by columns, padded to whole lanes by rows of 0 with another last number: points so far
// that they are never nearest and have no weight.
constexpr double kFar = 1e60;
int64_t padded(int64_t count) { return (count + kLanes - 1) / kLanes * kLanes; }
class ByColumn {
 public:
  ByColumn(const double* rows, int64_t count, int width = 3, double beyond = kFar)
      : count_(padded(count)), numbers_(width * count_) {
    for (int k = 0; k < width; ++k)
      for (int64_t i = 0; i < count_; ++i)
        numbers_[k * count_ + i] = i < count ? rows[width * i + k] : k + 1 == width ? beyond : 0.0;
  }
  int64_t count() const { return count_; }
  const double* begin() { return numbers_.begin(); }

 private:
  int64_t count_;
  Scratch<double> numbers_;
};

// The number of the nearest to a point [3], the first if several are; and its squared distance.
int64_t nearest_number(const double* point, ByColumn& others, double& distance) {
  Lanes least = all(HUGE_VAL), number = all(0.0), own{0.0, 1.0, 2.0, 3.0};
  for (int64_t i = 0; i < others.count(); i += kLanes, own += 4.0) {
    const Lanes here = squared(point, others.begin(), others.count(), i);
    number = here < least ? own : number;
    least = lesser(least, here);
  }
  int best = 0;
  for (int l = 1; l < kLanes; ++l)
    if (least[l] < least[best] || (least[l] == least[best] && number[l] < number[best])) best = l;
  distance = least[best];
  return static_cast<int64_t>(number[best]);
}
}  // namespace

// Chart coordinates [n, 3] of points [n, 3] [m].
KERNEL void chart_mapped(const double* points, const double* chart, double* flat, int64_t count) {
  Numbers numbers(chart);
  const Chart own(numbers);
  for (int64_t n = 0; n < count; ++n) own.mapped(points + 3 * n, flat + 3 * n);
}

// Gradients [n, 3] to the point from those to the chart's coordinates, or the inverse (forward is 1).
KERNEL void gradients_turned(const double* points, const double* gradients, const double* chart, double* turned, int64_t forward,
                             int64_t count) {
  Numbers numbers(chart);
  const Chart own(numbers);
  for (int64_t n = 0; n < count; ++n) own.turned(points + 3 * n, gradients + 3 * n, forward != 0, turned + 3 * n);
}

// The symmetric system of an interpolant: phi between centres [m, 3] in the first m rows and columns, and
// if there are 4 m of them, -grad phi to the right and its Hessian below there, [m * 3 ...].
KERNEL void radial_system(const double* centres, double* matrix, double shape, int64_t kernel, int64_t count, int64_t size) {
  ByColumn at(centres, count);
  const double* by = at.begin();
  const int64_t whole = at.count();
  with_kernel(kernel, [&](auto number) {
    for (int64_t i = 0; i < count; ++i) {
      double *row = matrix + i * size, *below[3];
      for (int k = 0; k < 3; ++k) below[k] = matrix + (count + 3 * i + k) * size;
      for (int64_t j = 0; j < count; j += kLanes) {
        Lanes offset[3];
        for (int k = 0; k < 3; ++k) offset[k] = centres[3 * i + k] - load(by + k * whole + j);
        const Terms term =
            radial_terms<number>(shape, offset[0] * offset[0] + offset[1] * offset[1] + offset[2] * offset[2]);
        const int last = static_cast<int>(lesser(count - j, int64_t{kLanes}));
        for (int l = 0; l < last; ++l) row[j + l] = term.phi[l];
        if (size == count) continue;
        for (int k = 0; k < 3; ++k) {
          const Lanes slope = term.a * offset[k];
          for (int l = 0; l < last; ++l) {
            below[k][j + l] = slope[l];
            row[count + 3 * (j + l) + k] = -slope[l];
          }
          for (int m = 0; m < 3; ++m) {
            const Lanes bend = -term.b * offset[k] * offset[m] - (m == k ? term.a : all(0.0));
            for (int l = 0; l < last; ++l) below[k][count + 3 * (j + l) + m] = bend[l];
          }
        }
      }
    }
  });
}

// Channels [c] of a field at points [n, 3] of its chart, [n, c].
KERNEL void radial_values(const double* points, const int64_t* channels, const double* interpolant, double* values, int64_t count,
                          int64_t asked, int64_t /*interpolant*/) {
  Numbers numbers(interpolant);
  const Radial own(numbers);
  for (int64_t n = 0; n < count; ++n) {
    int64_t c = 0;
    for (; c + 3 <= asked; c += 3) own.values<3>(points + 3 * n, channels + c, values + n * asked + c);
    for (; c < asked; ++c) own.values<1>(points + 3 * n, channels + c, values + n * asked + c);
  }
}

// Their gradients, [n, 3, c].
KERNEL void radial_gradients(const double* points, const int64_t* channels, const double* interpolant, double* gradients,
                             int64_t count, int64_t asked, int64_t /*interpolant*/) {
  Numbers numbers(interpolant);
  const Radial own(numbers);
  double slope[3];
  for (int64_t n = 0; n < count; ++n)
    for (int64_t c = 0; c < asked; ++c) {
      own.gradient(points + 3 * n, channels[c], slope);
      for (int k = 0; k < 3; ++k) gradients[(3 * n + k) * asked + c] = slope[k];
    }
}

// Which of points [n, 3] [m] are trusted.
KERNEL void points_trusted(const double* points, const double* region, uint8_t* trusted, int64_t count, int64_t /*region*/) {
  Numbers numbers(region);
  const Region own(numbers);
  double flat[3];
  for (int64_t n = 0; n < count; ++n) {
    own.chart.mapped(points + 3 * n, flat);
    trusted[n] = own.trusts(points + 3 * n, flat);
  }
}

// How far points [n, 3] are above the highest of planes [k, 4] there, and which one that is, [n].
KERNEL void heights_above(const double* points, const double* planes, double* heights, int64_t* top, int64_t count, int64_t known) {
  ByColumn by(planes, known, 4, -HUGE_VAL);
  for (int64_t n = 0; n < count; ++n) {
    const double* point = points + 3 * n;
    Lanes most = all(-HUGE_VAL), number = all(0.0), own{0.0, 1.0, 2.0, 3.0};
    for (int64_t i = 0; i < by.count(); i += kLanes, own += 4.0) {
      Lanes height = load(by.begin() + 3 * by.count() + i);
      for (int k = 0; k < 3; ++k) height += load(by.begin() + k * by.count() + i) * point[k];
      number = height > most ? own : number;
      most = greater(most, height);
    }
    int best = 0;
    for (int l = 1; l < kLanes; ++l)
      if (most[l] > most[best] || (most[l] == most[best] && number[l] < number[best])) best = l;
    heights[n] = most[best];
    top[n] = static_cast<int64_t>(number[best]);
  }
}

// Distance of points [n, 3] from the nearest of others [m, 3] [m], and unit vectors from it, [n, 3].
KERNEL void nearest_others_of(const double* points, const double* others, double* distance, double* away, int64_t count,
                              int64_t known) {
  ByColumn by(others, known);
  for (int64_t n = 0; n < count; ++n) {
    double square;
    const double *point = points + 3 * n, *other = others + 3 * nearest_number(point, by, square);
    distance[n] = sqrt(square);
    for (int k = 0; k < 3; ++k) away[3 * n + k] = (point[k] - other[k]) / greater(distance[n], 1e-12);
  }
}

// Which boxes about centres [n, 3] with half edges as rows [3, 3] [m] are nearer to one refused pose than
// to any accepted one: |x - a|^2 - |x - r|^2 is linear in x, least at a corner.
KERNEL void boxes_refused(const double* centres, const double* halves, const double* accepted, const double* rejected,
                          uint8_t* refused, int64_t count, int64_t accepted_count, int64_t rejected_count) {
  ByColumn good(accepted, accepted_count), bad(rejected, rejected_count);
  const int64_t whole = good.count();
  for (int64_t n = 0; n < count; ++n) {
    double square;
    const double *centre = centres + 3 * n, *from = rejected + 3 * nearest_number(centre, bad, square);
    refused[n] = 1;
    for (int64_t i = 0; refused[n] && i < accepted_count; i += kLanes) {
      Lanes ahead = all(0.0), to[3];
      for (int k = 0; k < 3; ++k) to[k] = load(good.begin() + k * whole + i);
      for (int axis = 0; axis < 3; ++axis) {
        Lanes along = all(0.0);
        for (int k = 0; k < 3; ++k) along += 2.0 * (from[k] - to[k]) * halves[3 * axis + k];
        ahead -= along < 0.0 ? -along : along;
        ahead += 2.0 * (from[axis] - to[axis]) * (centre[axis] - 0.5 * (from[axis] + to[axis]));
      }
      const int64_t last = lesser(accepted_count - i, int64_t{kLanes});
      for (int64_t l = 0; l < last; ++l) refused[n] = refused[n] && ahead[l] > 0.0;
    }
  }
}

// Tightening of the limit of a row at points [n, 3] of the plain chart, [n].
KERNEL void slacks_at(const double* points, const double* slack, double* found, int64_t row, int64_t count, int64_t /*slack*/) {
  Numbers numbers(slack);
  const Slack own(numbers);
  for (int64_t n = 0; n < count; ++n) found[n] = own.at(points + 3 * n, row);
}

// Its gradients [n, 3] to those points.
KERNEL void slack_slopes(const double* points, const double* slack, double* found, int64_t row, int64_t count, int64_t /*slack*/) {
  Numbers numbers(slack);
  const Slack own(numbers);
  for (int64_t n = 0; n < count; ++n) own.slope(points + 3 * n, row, found + 3 * n);
}

// Means [n] of squares [m] of samples [m, 3] at points [n, 3], with weights that fall with the distance
// beyond `near` [m^2]; without the sample of the same number if it is left out.
KERNEL void means_about(const double* points, const double* samples, const double* squares, double* means, double near,
                        int64_t is_left_out, int64_t count, int64_t known) {
  ByColumn by(samples, known), of(squares, known, 1, 0.0);
  for (int64_t n = 0; n < count; ++n)
    means[n] = mean_about(points + 3 * n, by.begin(), of.begin(), near, by.count(), is_left_out ? n : -1);
}

// Which of points [n, 3] [m] are trusted and within the limits.
KERNEL void points_allowed(const double* points, const double* field, uint8_t* allowed, int64_t count, int64_t /*field*/) {
  const Field own{Numbers(field)};
  for (int64_t n = 0; n < count; ++n) allowed[n] = own.allows(points + 3 * n, own.energy(points + 3 * n));
}

// The summed cost of the edges of a path [n, 3] [m]; infinite if any of it but its start is not allowed.
KERNEL double path_cost(const double* path, const double* field, double energy, double length, double step, int64_t count,
                        int64_t /*field*/) {
  const Field own{Numbers(field)};
  const Weights weights{energy, length, step};
  double total = 0.0;
  for (int64_t n = 0; n + 1 < count; ++n) total += edge_cost(path + 3 * n, path + 3 * n + 3, own, weights);
  return total;
}
