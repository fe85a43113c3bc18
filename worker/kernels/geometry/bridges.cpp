// The search for bridges: the price of joining each end of a piece to each node of other pieces.
#include "../containers.hpp"

namespace {
constexpr int64_t kLeaf = 8;  // most points of the last boxes
constexpr double kDegree = 3.141592653589793 / 180.0;
constexpr double kTurn = 35.0 * kDegree;  // turn that doubles the price
constexpr double kSide = 0.25;            // price of a fork over that of a continuation
// Usual angle of twigs to their carrier, and the deviation from it that doubles the price.
constexpr double kStand = 45.0 * kDegree, kStandDoubles = 60.0 * kDegree;
constexpr double kRatio = 0.7;    // price of a radius ratio of e
constexpr double kFarther = 2.0;  // an end may reach this many limits if it points at its target
constexpr double kPointsAt = 25.0 * kDegree;
constexpr double kLeast = 1e-12;
constexpr double kRounding = 1e-9;  // relative error of a bound

// A binary tree of boxes around points, where 2 i + 1 and 2 i + 2 are parts of i: the points in order,
// each box's first and last place in it, its corners, and its points' label, -1 if they differ.
struct Boxes {
  const int64_t *order, *span;
  const double *low, *high;
  const int64_t* only;
  int64_t count;
  bool has_parts(int64_t box) const { return 2 * box + 2 < count; }
};

struct Ends {
  const double *direction, *radius;
};

INLINE double length(double x, double y, double z) { return sqrt(x * x + y * y + z * z); }
INLINE bool is_zero(const double* v) { return v[0] == 0 && v[1] == 0 && v[2] == 0; }

// Distance [m] of a point from a box with these corners; infinite if empty.
INLINE double distance_to_box(const double* point, const double* low, const double* high) {
  double square = 0.0;
  for (int k = 0; k < 3; ++k) {
    const double beyond = greater(greater(low[k] - point[k], point[k] - high[k]), 0.0);
    square += beyond * beyond;
  }
  return sqrt(square);
}

// Angle [rad] from a direction to a path; an offset of up to a radius is no turn.
INLINE double turn_to(const double* direction, const double* vector, double radius) {
  const double along = vector[0] * direction[0] + vector[1] * direction[1] + vector[2] * direction[2];
  const double aside = length(vector[0] - along * direction[0], vector[1] - along * direction[1], vector[2] - along * direction[2]);
  return atan2(greater(aside - radius, 0.0), along);
}

// Length [m], price [m] (infinite: too long) and turn of a path from an end, and whether its target is
// an end that comes towards it.
struct Path { double length, price, turn, meets; };

Path path(const double* vector, const double* out, double radius, double limit, double thick, const double* axis, bool is_single,
          int64_t end, Ends ends) {
  const double far = greater(length(vector[0], vector[1], vector[2]), kLeast);
  if (far > kFarther * limit) return {far, HUGE_VAL, 0.0, 0.0};
  const double turned = turn_to(out, vector, radius);
  if (far > (turned < kPointsAt ? kFarther : 1.0) * limit) return {far, HUGE_VAL, turned, 0.0};
  double stand = kStand;
  if (!is_zero(axis)) {
    const double along = fabs(vector[0] * axis[0] + vector[1] * axis[1] + vector[2] * axis[2]);
    stand = acos(lesser(along / far, 1.0));
  }
  // For a single patch of skin, the contraction gives no thickness.
  const double thicker = is_single ? 0.0 : log(radius / greater(thick, kLeast)), off = (stand - kStand) / kStandDoubles;
  const double side = kSide + off * off + kRatio * greater(thicker, 0.0);
  double comes = HUGE_VAL;
  if (end >= 0 && !is_zero(ends.direction + 3 * end)) {
    const double back[3] = {-vector[0], -vector[1], -vector[2]};
    const double angle = turn_to(ends.direction + 3 * end, back, ends.radius[end]) / kTurn;
    comes = angle * angle + kRatio * fabs(log(radius / ends.radius[end]));
  }
  const double turns = turned / kTurn;
  return {far, far * (1 + turns * turns + lesser(side, comes)), turned, comes < side ? 1.0 : 0.0};
}

// A lower bound of the price [m] of paths from an end into a box: shares of the length, and of the turn
// into a ball around the box. Infinite: none is allowed.
double least_price(const double* here, const double* out, double radius, double limit, const double* low, const double* high) {
  const double far = distance_to_box(here, low, high);
  if (far > kFarther * limit) return HUGE_VAL;
  const double x = (low[0] + high[0]) / 2 - here[0], y = (low[1] + high[1]) / 2 - here[1], z = (low[2] + high[2]) / 2 - here[2];
  const double half = length(high[0] - low[0], high[1] - low[1], high[2] - low[2]) / 2;
  const double along = x * out[0] + y * out[1] + z * out[2];
  double aside = sqrt(greater(x * x + y * y + z * z - along * along, 0.0));
  // The angle falls with the path's part along the direction, and ahead it rises with the part aside.
  const double ahead = along + half;
  aside += ahead >= 0 ? -half : half;
  const double turned = atan2(greater(aside - radius, 0.0), ahead);
  if (far > limit && turned >= kPointsAt) return HUGE_VAL;
  return (1 - kRounding) * far * (1 + (turned / kTurn) * (turned / kTurn));
}

// An end's paths so far, and which of them are the cheapest: `most` in all, `most_of_piece` of a piece.
class Paths {
 public:
  Paths(const int64_t* label, int64_t labels, int64_t most, int64_t most_of_piece)
      : label_(label), most_(most), most_of_piece_(most_of_piece), of_piece_(labels) {
    of_piece_.fill(labels, 0);
  }
  Growing<Path> paths;
  Growing<int64_t> nodes;

  // Writes the numbers of the cheapest of those in `order`, ascending in it, and how many; the largest price of them.
  int64_t cheapest(const int64_t* order, int64_t* kept, double* largest) {
    const int64_t count = paths.count();
    Scratch<int64_t> by_price(count), room(count);
    Scratch<bool> is_kept(count);
    for (int64_t k = 0; k < count; ++k) {
      by_price[k] = k;
      is_kept[k] = false;
    }
    sort_stably(by_price.begin(), count, room.begin(), [&](int64_t k) { return paths[order[k]].price; });
    int64_t taken = 0;
    *largest = -HUGE_VAL;
    for (int64_t k = 0; k < count && taken < most_; ++k) {
      const int64_t own = by_price[k], path = order[own];
      int64_t& piece = of_piece_[label_[nodes[path]]];
      if (piece >= most_of_piece_) continue;
      ++piece;
      is_kept[own] = true;
      ++taken;
      *largest = greater(*largest, paths[path].price);
    }
    for (int64_t k = 0; k < count; ++k) of_piece_[label_[nodes[order[k]]]] = 0;
    int64_t to = 0;
    for (int64_t k = 0; k < count; ++k)
      if (is_kept[k]) kept[to++] = order[k];
    return taken;
  }

 private:
  const int64_t* label_;
  int64_t most_, most_of_piece_;
  Scratch<int64_t> of_piece_;
};
}  // namespace

// Halves points [n, 3] along their longest side, again and again: their order [n] and boxes: span [b, 2], corners
// low and high [b, 3] [m], label `only` [b]. Returns how many boxes there are; writes nothing where the room is less.
KERNEL int64_t boxes_around(const double* points, const int64_t* label, int64_t* order, int64_t* span, double* low, double* high,
                            int64_t* only, int64_t total, int64_t room) {
  int64_t depth = 0;
  while (total > kLeaf << depth) ++depth;
  const int64_t count = (int64_t{2} << depth) - 1;
  if (room < count) return count;
  Scratch<int64_t> work(total);
  for (int64_t k = 0; k < total; ++k) order[k] = k;
  span[0] = 0;
  span[1] = total;
  for (int64_t box = 0; box < count; ++box) {
    const int64_t begin = span[2 * box], end = span[2 * box + 1], middle = (begin + end) / 2;
    double *least = low + 3 * box, *most = high + 3 * box;
    for (int k = 0; k < 3; ++k) {
      least[k] = HUGE_VAL;
      most[k] = -HUGE_VAL;
    }
    only[box] = -1;
    for (int64_t place = begin; place < end; ++place) {
      const int64_t point = order[place];
      for (int k = 0; k < 3; ++k) {
        least[k] = lesser(least[k], points[3 * point + k]);
        most[k] = greater(most[k], points[3 * point + k]);
      }
      if (place == begin) only[box] = label[point];
      else if (only[box] != label[point]) only[box] = -1;
    }
    if (2 * box + 2 >= count) continue;
    int64_t* parts = span + 2 * (2 * box + 1);
    parts[0] = begin; parts[1] = middle; parts[2] = middle; parts[3] = end;
    if (end > begin) {
      int axis = 0;
      for (int k = 1; k < 3; ++k)
        if (most[k] - least[k] > most[axis] - least[axis]) axis = k;
      sort_stably(order + begin, end - begin, work.begin(), [&](int64_t k) { return points[3 * k + axis]; });
    }
  }
  return count;
}

// Prices the paths from the k ends to the n nodes of other pieces; keeps the cheapest of each: end's node, other
// node, whether they meet, length, price [m] and turn [rad], [room], where there is room for `most` of each end.
// Returns how many. Directions [k, 3] are zero and end_of [n] is -1 where there is none. Only an end that points
// straight at its target goes beyond `limit` [m].
KERNEL int64_t bridges_priced(
    const double* nodes, const double* thickness, const double* axis, const uint8_t* single, const int64_t* label,
    const int64_t* end_node, const double* end_direction, const double* end_radius, const int64_t* end_of,
    const int64_t* order, const int64_t* span, const double* low, const double* high, const int64_t* only,
    int64_t* one, int64_t* other, int64_t* meets, double* lengths, double* prices, double* turns,
    double limit, int64_t most, int64_t most_of_piece, int64_t node_count, int64_t ends, int64_t box_count, int64_t /*room*/) {
  const Boxes tree{order, span, low, high, only, box_count};
  int64_t labels = 0, count = 0;
  for (int64_t k = 0; k < node_count; ++k) labels = greater(labels, label[k] + 1);
  Paths known(label, labels, most, most_of_piece);
  Scratch<int64_t> kept(node_count), all(node_count), room(node_count);
  Queue waiting;
  for (int64_t k = 0; k < ends; ++k) {
    const int64_t own = end_node[k];
    const double *out = end_direction + 3 * k, *here = nodes + 3 * own, radius = end_radius[k];
    if (is_zero(out)) continue;
    double cheap = HUGE_VAL, least;
    int64_t tried = most;
    known.paths.clear();
    known.nodes.clear();
    waiting.clear();
    waiting.add(0.0, 0);
    while (!waiting.is_empty()) {
      const int64_t box = waiting.take(least);
      if (least > cheap) break;
      if (tree.has_parts(box)) {
        for (int64_t child = 2 * box + 1; child <= 2 * box + 2; ++child) {
          if (only[child] == label[own]) continue;
          least = least_price(here, out, radius, limit, low + 3 * child, high + 3 * child);
          if (least <= cheap) waiting.add(least, child);
        }
        continue;
      }
      for (int64_t place = span[2 * box]; place < span[2 * box + 1]; ++place) {
        const int64_t node = order[place];
        if (label[node] == label[own]) continue;
        const double vector[3] = {nodes[3 * node] - here[0], nodes[3 * node + 1] - here[1], nodes[3 * node + 2] - here[2]};
        const Path found = path(vector, out, radius, limit, thickness[node], axis + 3 * node, single[node], end_of[node],
                                {end_direction, end_radius});
        if (found.price < HUGE_VAL) {
          known.paths.add(found);
          known.nodes.add(node);
        }
      }
      const int64_t so_far = known.paths.count();
      if (so_far >= 2 * tried) {
        double largest;
        for (int64_t j = 0; j < so_far; ++j) all[j] = j;
        const bool is_full = known.cheapest(all.begin(), kept.begin(), &largest) == most;
        cheap = is_full ? (1 + kRounding) * largest : HUGE_VAL;
        tried = so_far;
      }
    }
    // By node, as equal prices are taken in that order.
    double largest;
    for (int64_t j = 0; j < known.paths.count(); ++j) all[j] = j;
    sort_stably(all.begin(), known.paths.count(), room.begin(), [&](int64_t j) { return known.nodes[j]; });
    const int64_t taken = known.cheapest(all.begin(), kept.begin(), &largest);
    for (int64_t j = 0; j < taken; ++j, ++count) {
      const Path& path = known.paths[kept[j]];
      one[count] = own;
      other[count] = known.nodes[kept[j]];
      meets[count] = static_cast<int64_t>(path.meets);
      lengths[count] = path.length;
      prices[count] = path.price;
      turns[count] = path.turn;
    }
  }
  return count;
}

// Finds nodes of other pieces within `limit` [m] of each node in `own`, nearest first: nodes, -1 where there are fewer,
// and distances [m], [own, count] each.
KERNEL void nearest_others(const double* nodes, const int64_t* label, const int64_t* own, const int64_t* order, const int64_t* span,
                           const double* low, const double* high, const int64_t* only, int64_t* near, double* distance,
                           double limit, int64_t /*nodes*/, int64_t own_count, int64_t box_count, int64_t count) {
  Scratch<int64_t> waiting(2 * box_count);
  Scratch<double> far_off(2 * box_count);
  const Boxes tree{order, span, low, high, only, box_count};
  for (int64_t k = 0; k < own_count; ++k) {
    const int64_t node = own[k];
    const double* here = nodes + 3 * node;
    double* far_of = distance + count * k;
    int64_t *near_of = near + count * k, last = 0;
    for (int64_t j = 0; j < count; ++j) {
      near_of[j] = -1;
      far_of[j] = limit;
    }
    auto to_box = [&](int64_t box) { return distance_to_box(here, low + 3 * box, high + 3 * box); };
    waiting[0] = 0;
    far_off[0] = to_box(0);
    while (last >= 0) {
      const int64_t box = waiting[last];
      const double off = far_off[last--];
      if (only[box] == label[node] || off >= far_of[count - 1]) continue;
      if (tree.has_parts(box)) {
        const double one = to_box(2 * box + 1), two = to_box(2 * box + 2);
        const int64_t first = one <= two;
        waiting[++last] = 2 * box + 1 + first;
        far_off[last] = one <= two ? two : one;
        waiting[++last] = 2 * box + 2 - first;
        far_off[last] = one <= two ? one : two;
        continue;
      }
      for (int64_t place = span[2 * box]; place < span[2 * box + 1]; ++place) {
        const int64_t other = order[place];
        if (label[other] == label[node]) continue;
        const double* there = nodes + 3 * other;
        const double far = length(there[0] - here[0], there[1] - here[1], there[2] - here[2]);
        int64_t worse = count - 1;
        if (far >= far_of[worse]) continue;
        for (; worse > 0 && far_of[worse - 1] > far; --worse) {
          far_of[worse] = far_of[worse - 1];
          near_of[worse] = near_of[worse - 1];
        }
        far_of[worse] = far;
        near_of[worse] = other;
      }
    }
  }
}

// Largest distance [m] of the points of a node's piece from it, for each node in `own` [k]. spread [n] [m] is that of each
// node's own points; order [n] has the nodes by label, start [labels + 1] the first of each.
KERNEL void far_sides(const double* nodes, const double* spread, const int64_t* label, const int64_t* own, const int64_t* order,
                      const int64_t* start, double* far, int64_t count, int64_t own_count, int64_t /*labels*/) {
  Scratch<double> known(count);
  known.fill(count, -1.0);
  for (int64_t k = 0; k < own_count; ++k) {
    const int64_t node = own[k];
    const double* here = nodes + 3 * node;
    if (known[node] < 0)
      for (int64_t at = start[label[node]]; at < start[label[node] + 1]; ++at) {
        const double* there = nodes + 3 * order[at];
        known[node] = greater(known[node], length(there[0] - here[0], there[1] - here[1], there[2] - here[2]) + spread[order[at]]);
      }
    far[k] = known[node];
  }
}
