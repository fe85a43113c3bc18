// RRT* over grasp positions: a tree whose nodes keep the cheapest way from its root.
#include "field.hpp"
#include "../containers.hpp"

namespace {
constexpr double kE = 2.718281828459045;
constexpr double kSame = 1e-9;     // [m] between two nodes
constexpr double kSaving = 1e-12;  // of cost
constexpr double kRounding = 1e-9;  // of the reach, at which a node is that was drawn to it

// Parent, first child and next sibling of each node, and its cost, [capacity]; -1: none.
struct Tree {
  double* cost;
  int64_t *parent, *first_child, *next_sibling;

  void attach(int64_t node, int64_t to) {
    parent[node] = to;
    next_sibling[node] = first_child[to];
    first_child[to] = node;
  }
  void detach(int64_t node) {
    int64_t* link = first_child + parent[node];
    while (*link != node) link = next_sibling + *link;
    *link = next_sibling[node];
  }
  // Takes a saving off the cost of a node and of all its descendants.
  void lower(int64_t node, double saving, Growing<int64_t>& waiting) {
    waiting.add(node);
    while (waiting.count() > 0) {
      const int64_t own = waiting[waiting.count() - 1];
      waiting.remove_last();
      cost[own] -= saving;
      for (int64_t child = first_child[own]; child >= 0; child = next_sibling[child]) waiting.add(child);
    }
  }
};

// Squared distances of a point [3] to nodes [3, room]; the nearest one, the first if several are.
int64_t distances(const double* point, const double* nodes, int64_t room, int64_t count, double* distance) {
  for (int64_t i = 0; i < count; i += kLanes) store(distance + i, squared(point, nodes, room, i));
  int64_t nearest = 0;
  for (int64_t i = 1; i < count; ++i)
    if (distance[i] < distance[nearest]) nearest = i;
  return nearest;
}

// Numbers of the `most` smallest of distances, in ascending order, the first first of equal ones; how many.
int64_t smallest(const double* distance, int64_t count, int64_t most, int64_t* kept) {
  int64_t size = 0;
  for (int64_t i = 0; i < count; ++i) {
    if (size == most && distance[i] >= distance[kept[size - 1]]) continue;
    int64_t slot = size < most ? size++ : most - 1;
    for (; slot > 0 && distance[kept[slot - 1]] > distance[i]; --slot) kept[slot] = kept[slot - 1];
    kept[slot] = i;
  }
  return size;
}
}  // namespace

// Adds a node for each of samples [s, 3] [m] that can be reached, by edges of at most `reach` [m]; returns how
// many nodes there are then. Nodes are [capacity, 3] [m], of which `count` are known before.
KERNEL int64_t tree_grown(const double* samples, const double* field, double* nodes, double* cost, int64_t* parent,
                          int64_t* first_child, int64_t* next_sibling, int64_t count, double reach, double energy, double length,
                          double step, int64_t sample_count, int64_t /*field*/, int64_t capacity) {
  const Field own{Numbers(field)};
  const Weights weights{energy, length, step};
  const double longest = reach * (1.0 + kRounding);
  Tree tree{cost, parent, first_child, next_sibling};
  const int64_t room = capacity + kLanes;
  Scratch<double> by(3 * room), distance(room);
  Scratch<int64_t> near(room);
  Growing<int64_t> waiting;
  by.fill(3 * room, 0.0);
  for (int64_t n = 0; n < count; ++n)
    for (int k = 0; k < 3; ++k) by[k * room + n] = nodes[3 * n + k];
  for (const double* sample = samples; sample < samples + 3 * sample_count; sample += 3) {
    const int64_t nearest = distances(sample, by.begin(), room, count, distance.begin());
    const double gap = sqrt(distance[nearest]);
    if (gap < kSame) continue;
    const double part = lesser(1.0, reach / gap);
    double* node = nodes + 3 * count;
    for (int k = 0; k < 3; ++k) node[k] = nodes[3 * nearest + k] + (sample[k] - nodes[3 * nearest + k]) * part;
    distances(node, by.begin(), room, count, distance.begin());
    // k = e (1 + 1/d) log n keeps RRT* asymptotically optimal (Karaman and Frazzoli, 2011).
    const auto asked = static_cast<int64_t>(ceil(kE * (1.0 + 1.0 / 3.0) * log(count + 1.0)));
    const int64_t found = smallest(distance.begin(), count, lesser(asked, count), near.begin());
    int64_t best = -1;
    double least = HUGE_VAL;
    for (int64_t i = 0; i < found; ++i) {
      const int64_t j = near[i];
      const double away = sqrt(distance[j]);
      // Its length alone may cost too much.
      if (away > longest || cost[j] + length * away >= least) continue;
      const double whole = cost[j] + edge_cost(nodes + 3 * j, node, own, weights);
      if (whole < least) {
        best = j;
        least = whole;
      }
    }
    if (best < 0) continue;
    for (int k = 0; k < 3; ++k) by[k * room + count] = node[k];
    cost[count] = least;
    tree.attach(count, best);
    for (int64_t i = 0; i < found; ++i) {
      const int64_t j = near[i];
      const double away = sqrt(distance[j]);
      if (j == best || away > longest || least + length * away >= cost[j]) continue;
      const double saving = cost[j] - least - edge_cost(node, nodes + 3 * j, own, weights);
      if (!(saving > kSaving)) continue;
      tree.detach(j);
      tree.attach(j, count);
      tree.lower(j, saving, waiting);
    }
    ++count;
  }
  return count;
}
