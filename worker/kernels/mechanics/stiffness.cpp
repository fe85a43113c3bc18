// Tangent stiffness of all elements, added to the lower triangle of a matrix in compressed columns.
//
// Of an element's nodes a and b <= a, `slots` gives the start of the 3 x 3 block in the values; its
// other two columns follow at distances that the column's length gives. An element's nodes are
// sorted by elimination order, so that every block lies in the lower triangle. Blocks of a
// constrained node lie behind the end of the values.
#include "element.hpp"

namespace {

// Columns one after the other: 00 10 20 01 11 21 02 12 22.
typedef Lanes Block[9];

// Adds the blocks of nodes a and b to the values.
INLINE void scatter(const Block& block, const int32_t* slots, const int32_t* lengths, bool is_diagonal, double* values) {
  for (int l = 0; l < kLanes; ++l) {
    double* at = values + slots[l];
    const int length = lengths[l];
    at[0] += block[0][l]; at[1] += block[1][l]; at[2] += block[2][l];
    if (is_diagonal) {
      at += length;
      at[0] += block[4][l]; at[1] += block[5][l];
      at[length - 1] += block[8][l];
    } else {
      at += length - 1;
      at[0] += block[3][l]; at[1] += block[4][l]; at[2] += block[5][l];
      at += length - 2;
      at[0] += block[6][l]; at[1] += block[7][l]; at[2] += block[8][l];
    }
  }
}

// Hooke's law: with u = F g the block is lambda u u'' + mu u'' u' + mu (g g') F F' + (g S g') 1,
// where a second prime is the other node's. The weight's root is in u, the weight in FF' and S.
struct StrainPoint { Symmetric square; };
struct StrainRow { Vector u, stressed; };

INLINE void add_strain_pairs(const StrainRow* one, const StrainRow* two, const StrainPoint* point,
                             const double* g, int a, int b, int nodes, int points, Lanes lambda, Lanes mu, Block& block) {
  Lanes o[9] = {}, xx{}, yy{}, zz{}, xy{}, xz{}, yz{};
  for (int q = 0; q < points; ++q) {
    const double* at = g + 3 * kLanes * nodes * q;
    const Vector u = one[q].u, v = two[q].u, h = gradient_of(at, b);
    o[0] += u.x * v.x; o[1] += u.y * v.x; o[2] += u.z * v.x;
    o[3] += u.x * v.y; o[4] += u.y * v.y; o[5] += u.z * v.y;
    o[6] += u.x * v.z; o[7] += u.y * v.z; o[8] += u.z * v.z;
    const Lanes both = dot(gradient_of(at, a), h), own = dot(one[q].stressed, h);
    const Symmetric& s = point[q].square;
    xx += s.xx * both + own; yy += s.yy * both + own; zz += s.zz * both + own;
    xy += s.xy * both; xz += s.xz * both; yz += s.yz * both;
  }
  const Lanes sum = lambda + mu;
  block[0] += sum * o[0] + xx; block[1] += lambda * o[1] + mu * o[3] + xy; block[2] += lambda * o[2] + mu * o[6] + xz;
  block[3] += lambda * o[3] + mu * o[1] + xy; block[4] += sum * o[4] + yy; block[5] += lambda * o[5] + mu * o[7] + yz;
  block[6] += lambda * o[6] + mu * o[2] + xz; block[7] += lambda * o[7] + mu * o[5] + yz; block[8] += sum * o[8] + zz;
}

// Stable neo-Hooke: with c = cof(F) g it is mu (g g') 1 + (lambda + mu) c c'' + the skew matrix of
// pressure F (g' x g), from the cofactor's change.
struct VolumePoint { Matrix pressed; Lanes mu; };

INLINE void add_volume_pairs(const Vector* one, const Vector* two, const VolumePoint* point,
                             const double* g, int a, int b, int nodes, int points, Lanes both, Block& block) {
  Lanes n[9] = {}, own{};
  Vector t{};
  for (int q = 0; q < points; ++q) {
    const Vector c = one[q], d = two[q];
    n[0] += c.x * d.x; n[1] += c.y * d.x; n[2] += c.z * d.x;
    n[3] += c.x * d.y; n[4] += c.y * d.y; n[5] += c.z * d.y;
    n[6] += c.x * d.z; n[7] += c.y * d.z; n[8] += c.z * d.z;
    const double* at = g + 3 * kLanes * nodes * q;
    const Vector k = gradient_of(at, a), h = gradient_of(at, b);
    const Vector f = times(point[q].pressed, {h.y * k.z - h.z * k.y, h.z * k.x - h.x * k.z, h.x * k.y - h.y * k.x});
    t.x += f.x; t.y += f.y; t.z += f.z;
    own += point[q].mu * dot(k, h);
  }
  block[0] += both * n[0] + own; block[1] += both * n[1] + t.z; block[2] += both * n[2] - t.y;
  block[3] += both * n[3] - t.z; block[4] += both * n[4] + own; block[5] += both * n[5] + t.x;
  block[6] += both * n[6] + t.y; block[7] += both * n[7] - t.x; block[8] += both * n[8] + own;
}

struct Elements {
  const double *displacement, *increment, *gradients, *weights, *lambda, *mu;
  const int32_t* nodes;
  const double* memory;
  const int32_t *slots, *lengths;
  int64_t batches;
  bool is_mixed, has_memory;
};

template <class Count, class Points>
INLINE void add_tangent(const Elements& e, int64_t material, double growth, Count nodes, Points points, double* values) {
  Scratch<Vector> local(nodes), rate(nodes), volume_rows(int64_t{nodes} * points);
  Scratch<StrainRow> strain_rows(int64_t{nodes} * points);
  Scratch<StrainPoint> strain_points(points);
  Scratch<VolumePoint> volume_points(points);
  const double factor = material == kNeoHooke ? growth - 1.0 : growth;
  const bool has_strain = material != kNeoHooke || e.has_memory;
  const int pairs = nodes * (nodes + 1) / 2;
  for (int64_t batch = 0; batch < e.batches; ++batch) {
    const int32_t* own = e.nodes + batch * nodes * kLanes;
    const double* g = e.gradients + batch * points * nodes * 3 * kLanes;
    gather(e.displacement, own, nodes, local.begin());
    if (e.is_mixed) gather(e.increment, own, nodes, rate.begin());
    const Lanes lambda = load(e.lambda + batch * kLanes), mu = load(e.mu + batch * kLanes), both = lambda + mu;
    for (int q = 0; q < points; ++q) {
      const double* at = g + 3 * kLanes * nodes * q;
      const Lanes weight = load(e.weights + (batch * points + q) * kLanes), half = root(weight);
      const Matrix F = material == kSmallStrain ? identity() : deformation(local.begin(), at, nodes);
      if (has_strain) {
        Symmetric E = green_strain(F);
        if (e.is_mixed) {
          const Matrix D = gradient(rate.begin(), at, nodes);
          auto of = [&](int i, int j) { return 0.5 * dot(column(D, i), column(D, j)); };
          E.xx -= of(0, 0); E.yy -= of(1, 1); E.zz -= of(2, 2);
          E.xy -= of(0, 1); E.xz -= of(0, 2); E.yz -= of(1, 2);
        }
        E = scaled(E, factor);
        if (e.has_memory && material != kSmallStrain) {
          const double* m = e.memory + (batch * points + q) * 6 * kLanes;
          E.xx += load(m); E.yy += load(m + kLanes); E.zz += load(m + 2 * kLanes);
          E.xy += load(m + 3 * kLanes); E.xz += load(m + 4 * kLanes); E.yz += load(m + 5 * kLanes);
        }
        const Symmetric S = hooke_stress(E, weight * lambda, weight * mu);
        const Lanes m = weight * (factor * mu);
        auto of = [&](int i, int j) { return m * dot(row(F, i), row(F, j)); };
        strain_points[q].square = {of(0, 0), of(1, 1), of(2, 2), of(0, 1), of(0, 2), of(1, 2)};
        for (int a = 0; a < nodes; ++a) {
          const Vector k = gradient_of(at, a), u = times(F, k);
          strain_rows[a * points + q] = {{half * u.x, half * u.y, half * u.z}, times(S, k)};
        }
      }
      if (material == kNeoHooke) {
        const Matrix C = cofactor(F);
        const Lanes pressure = weight * (both * (determinant(F, C) - 1.0) - mu);
        Matrix pressed;
        for (int i = 0; i < 3; ++i)
          for (int j = 0; j < 3; ++j) pressed.a[i][j] = pressure * F.a[i][j];
        volume_points[q] = {pressed, weight * mu};
        for (int a = 0; a < nodes; ++a) {
          const Vector c = times(C, gradient_of(at, a));
          volume_rows[a * points + q] = {half * c.x, half * c.y, half * c.z};
        }
      }
    }
    const int32_t *slots = e.slots + batch * pairs * kLanes, *lengths = e.lengths + batch * pairs * kLanes;
    const Lanes lambda_now = factor * lambda, mu_now = factor * mu;
    for (int a = 0; a < nodes; ++a)
      for (int b = 0; b <= a; ++b, slots += kLanes, lengths += kLanes) {
        Block block = {};
        if (has_strain)
          add_strain_pairs(&strain_rows[a * points], &strain_rows[b * points], strain_points.begin(), g, a, b, nodes,
                           points, lambda_now, mu_now, block);
        if (material == kNeoHooke)
          add_volume_pairs(&volume_rows[a * points], &volume_rows[b * points], volume_points.begin(), g, a, b, nodes,
                           points, both, block);
        scatter(block, slots, lengths, a == b, values);
      }
  }
}

}  // namespace

// Adds all elements' tangent stiffness [N/m]. With an increment [node_count, 3] (Hooke of the Green
// strain; without rows: Newton) the stress is that at the strain less D'D / 2, D its gradient, as the
// last linearisation predicted (mixed points, Magisano, Leonetti and Garcea 2017). The stress is
// that of growth E + memory; memory [batches, points, 6, 4] or without rows.
KERNEL void tangent_stiffness(
    const double* displacement, const double* increment, const double* gradients, const double* weights,
    const double* lame_lambda, const double* lame_mu, const int32_t* nodes, const double* memory,
    const int32_t* slots, const int32_t* lengths, double* values, int64_t material, double growth,
    int64_t /*node_count*/, int64_t increment_rows, int64_t batches, int64_t points, int64_t corners, int64_t memory_rows,
    int64_t /*pairs*/, int64_t /*value_count*/) {
  const Elements e{displacement, increment, gradients, weights, lame_lambda, lame_mu, nodes, memory, slots, lengths,
                   batches, increment_rows > 0 && material != kSmallStrain, memory_rows > 0};
  with_counts(corners, points, [&](auto n, auto q) {
    if (material == kNeoHooke)
      add_tangent(e, kNeoHooke, growth, n, q, values);
    else
      add_tangent(e, material, growth, n, q, values);
  });
}

// Adds the integral of B'CB [N/m], B the strain's change, for the moduli C [batches, points, 36, 4]
// [Pa] of any law, by rows 00 11 22 and shear angles 01 02 12.
KERNEL void moduli_stiffness(
    const double* displacement, const double* gradients, const double* weights, const double* moduli,
    const int32_t* nodes, const int32_t* slots, const int32_t* lengths, double* values,
    int64_t /*node_count*/, int64_t batches, int64_t points, int64_t corners, int64_t /*pairs*/, int64_t /*value_count*/) {
  const int count = static_cast<int>(corners);
  const int64_t pairs = corners * (corners + 1) / 2;
  // Per node the changes of strain, and of stress, as it moves along each axis.
  Scratch<Vector> local(corners);
  Scratch<Lanes> changes(18 * corners), stresses(18 * corners);
  Scratch<Block> blocks(pairs);
  for (int64_t batch = 0; batch < batches; ++batch) {
    gather(displacement, nodes + batch * corners * kLanes, count, local.begin());
    memset(blocks.begin(), 0, pairs * sizeof(Block));
    for (int64_t q = 0; q < points; ++q) {
      const double* g = gradients + (batch * points + q) * 3 * corners * kLanes;
      const double* c = moduli + (batch * points + q) * 36 * kLanes;
      const Lanes weight = load(weights + (batch * points + q) * kLanes);
      const Matrix F = deformation(local.begin(), g, count);
      for (int a = 0; a < count; ++a) {
        const Vector k = gradient_of(g, a);
        for (int i = 0; i < 3; ++i) {
          Lanes *change = &changes[18 * a + 6 * i], *stress = &stresses[18 * a + 6 * i];
          const Vector f = row(F, i);
          change[0] = f.x * k.x; change[1] = f.y * k.y; change[2] = f.z * k.z;
          change[3] = f.x * k.y + f.y * k.x; change[4] = f.x * k.z + f.z * k.x; change[5] = f.y * k.z + f.z * k.y;
          for (int r = 0; r < 6; ++r) {
            Lanes total{};
            for (int s = 0; s < 6; ++s) total += load(c + (6 * r + s) * kLanes) * change[s];
            stress[r] = weight * total;
          }
        }
      }
      int64_t pair = 0;
      for (int a = 0; a < count; ++a)
        for (int b = 0; b <= a; ++b, ++pair)
          for (int j = 0; j < 3; ++j)
            for (int i = 0; i < 3; ++i) {
              const Lanes *u = &changes[18 * a + 6 * i], *v = &stresses[18 * b + 6 * j];
              blocks[pair][3 * j + i] += u[0] * v[0] + u[1] * v[1] + u[2] * v[2] + u[3] * v[3] + u[4] * v[4] + u[5] * v[5];
            }
    }
    int64_t pair = 0;
    for (int a = 0; a < count; ++a)
      for (int b = 0; b <= a; ++b, ++pair)
        scatter(blocks[pair], slots + (batch * pairs + pair) * kLanes, lengths + (batch * pairs + pair) * kLanes, a == b, values);
  }
}
