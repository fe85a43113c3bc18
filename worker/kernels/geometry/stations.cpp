// What the points of a merged scan tell of its stations, and on which side of the axes they lie.
#include "../lanes.hpp"

namespace {
constexpr double kPi = 3.141592653589793;
constexpr double kSharp = 0.1;   // least radius, of its own
constexpr double kStray = 0.02;  // fraction of points of something else
constexpr double kFar = 4.0;     // noises within which points count
constexpr double kAlike = 2.0;   // points whose errors are correlated, so that they count as one

INLINE double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
INLINE double square_of(double x) { return x * x; }
}  // namespace

// Offsets [m, 3] of points from axes, radii [m] there [m] and unit axes [m, 3]; directions towards k stations and their
// shifts [k, 3] [m], shares [k] of the points; noise [2] beside and along the rays and `fit`, all [m]; the radii's
// shared error `wider` [m]; and places beside the sight and how far they rise towards it [places], over radii. Writes
// the probability that each point is of each station [m, k] and their sums [k]; precision [3 k + 1, 3 k + 1] and pull
// [3 k + 1] of the shifts and the shared error; sums of the sights [k, 3], and of squared misses beside and along them
// [2] [m^2]. Returns the log-likelihood: of a mixture of points drawn evenly over the sides, and stray ones.
KERNEL double station_sums(
    const double* offset, const double* radius, const double* axis, const double* towards, const double* shift,
    const double* share, const double* noise, const double* beside, const double* rise, double* chance, double* number,
    double* precision, double* pull, double* facing, double* square, double wider, double fit,
    int64_t points, int64_t count, int64_t places, int64_t unknowns) {
  Scratch<double> weight(count * places), root(places), ways_of(6 * count), miss(2 * count), level(count);
  memset(number, 0, count * sizeof(double));
  memset(precision, 0, unknowns * unknowns * sizeof(double));
  memset(pull, 0, unknowns * sizeof(double));
  memset(facing, 0, 3 * count * sizeof(double));
  square[0] = square[1] = 0.0;
  double log_likelihood = 0.0;
  const int64_t last = unknowns - 1;
  for (int64_t p = 0; p < places; ++p) root[p] = sqrt(rise[p]);
  for (int64_t k = 0; k < count; ++k) level[k] = (1 - kStray) * share[k] / (2 * kPi * noise[0] * noise[1] * places);
  for (int64_t i = 0; i < points; ++i) {
    const double *own_axis = axis + 3 * i, *own = offset + 3 * i;
    const double thick = greater(radius[i] + wider, kSharp * radius[i]);
    double total = kStray / (kPi * square_of(radius[i] + kFar * fit));
    for (int64_t k = 0; k < count; ++k) {
      double *way = ways_of.begin() + 6 * k, *along = way + 3;
      const double on = dot(own_axis, towards + 3 * k);
      for (int j = 0; j < 3; ++j) along[j] = towards[3 * k + j] - on * own_axis[j];
      const double size = greater(sqrt(dot(along, along)), 1e-9);
      for (int j = 0; j < 3; ++j) along[j] /= size;
      for (int j = 0; j < 3; ++j)
        way[j] = own_axis[(j + 1) % 3] * along[(j + 2) % 3] - own_axis[(j + 2) % 3] * along[(j + 1) % 3];
      const double from[3] = {own[0] - shift[3 * k], own[1] - shift[3 * k + 1], own[2] - shift[3 * k + 2]};
      miss[2 * k] = dot(from, way);
      miss[2 * k + 1] = dot(from, along);
      double* here = weight.begin() + places * k;
      for (int64_t p = 0; p < places; ++p) {
        here[p] = level[k] * root[p] * exp(-0.5 * (square_of((miss[2 * k] - thick * beside[p]) / noise[0])
                                                   + rise[p] * square_of((miss[2 * k + 1] - thick * rise[p]) / noise[1])));
        total += here[p];
      }
    }
    log_likelihood += log(total);
    for (int64_t k = 0; k < count; ++k) {
      const double* here = weight.begin() + places * k;
      double all_here = 0.0;
      for (int64_t p = 0; p < places; ++p) all_here += here[p];
      chance[count * i + k] = all_here / total;
      number[k] += chance[count * i + k];
      for (int d = 0; d < 2; ++d) {
        // A grazing ray's error is larger, and hardly moves it off the surface.
        double whole = 0.0, moved = 0.0, first = 0.0, second = 0.0, crossed = 0.0, seen = 0.0;
        const double *way = ways_of.begin() + 6 * k + 3 * d, *at = d ? rise : beside;
        for (int64_t p = 0; p < places; ++p) {
          const double part = here[p] / total, weighed = d ? part * rise[p] : part, place = at[p];
          const double off = miss[2 * k + d] - thick * place;
          whole += weighed;
          first += weighed * place;
          second += weighed * (place * place);
          moved += weighed * off;
          crossed += weighed * off * place;
          square[d] += weighed * (off * off);
          seen += part * place;
        }
        const double firm = 1 / (kAlike * (noise[d] * noise[d]));
        precision[unknowns * last + last] += firm * second;
        pull[last] += firm * crossed;
        for (int j = 0; j < 3; ++j) {
          facing[3 * k + j] += seen * way[j];
          const double own_way = firm * way[j];
          double* row = precision + unknowns * (3 * k + j);
          pull[3 * k + j] += own_way * moved;
          row[last] += own_way * first;
          for (int l = 0; l < 3; ++l) row[3 * k + l] += own_way * whole * way[l];
        }
      }
    }
  }
  for (int64_t j = 0; j < last; ++j) precision[unknowns * last + j] = precision[unknowns * j + last];
  return log_likelihood;
}

// By how much the squares of offsets [m, 3] [m] across their unit axes [m, 3] are larger across each of k views [k, 3]
// than along it: their mean and its standard deviation [m^2], and its fraction, [k] each.
KERNEL void flatness(const double* axis, const double* offset, const double* views, double* mean, double* sure, double* share,
                     int64_t points, int64_t count) {
  for (int64_t first = 0; first < count; first += kLanes) {
    // Four views at once; beyond the last one, it is taken again.
    Lanes view[3], difference{}, squares{}, total{};
    for (int l = 0; l < kLanes; ++l)
      for (int j = 0; j < 3; ++j) view[j][l] = views[3 * lesser(first + l, count - 1) + j];
    for (int64_t i = 0; i < points; ++i) {
      const double *n = axis + 3 * i, *o = offset + 3 * i;
      const Lanes on = view[0] * n[0] + view[1] * n[1] + view[2] * n[2];
      const Lanes a = view[0] - on * n[0], b = view[1] - on * n[1], c = view[2] - on * n[2];
      const Lanes size = a * a + b * b + c * c, held = size > 1e-12 ? size : all(1e-12), along = a * o[0] + b * o[1] + c * o[2];
      const Lanes across = (n[1] * c - n[2] * b) * o[0] + (n[2] * a - n[0] * c) * o[1] + (n[0] * b - n[1] * a) * o[2];
      const Lanes more = (across * across - along * along) / held;
      difference += more;
      squares += more * more;
      total += (across * across + along * along) / held;
    }
    for (int64_t k = first; k < count && k < first + kLanes; ++k) {
      const int l = static_cast<int>(k - first);
      mean[k] = difference[l] / points;
      sure[k] = sqrt(greater(squares[l] / points - mean[k] * mean[k], 0.0) / points);
      share[k] = difference[l] / greater(total[l], 1e-300);
    }
  }
}
