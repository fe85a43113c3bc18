// Internal force, energy, strain and their changes, four elements at a time; element.hpp has the
// equations. Elements may have any number of nodes and points.
//
// Shared arguments: displacement [node_count, 3] [m]; gradients [batches, points, corners, 3, 4]
// [1/m]; weights [batches, points, 4] [m^3], 0 for padding; Lamé coefficients [batches, 4] [Pa];
// nodes [batches, corners, 4]. In motion the stress is that of the strain growth E + memory: viscous
// stress (Kelvin-Voigt) follows the strain's rate, which a difference formula gives from this strain
// and earlier ones, the memory [tet_count, points, 6] (00 11 22 01 02 12; without rows: none).
#include "element.hpp"

// Writes the internal force [node_count, 3] [N] and each element's strain energy [tet_count] [J];
// returns the least det F.
KERNEL double internal_force(
    const double* displacement, const double* gradients, const double* weights, const double* lame_lambda,
    const double* lame_mu, const int32_t* nodes, const double* memory, double* force, double* energies,
    int64_t material, double growth,
    int64_t node_count, int64_t batches, int64_t points, int64_t corners, int64_t memory_rows, int64_t tet_count) {
  const double factor = material == kNeoHooke ? growth - 1.0 : growth;
  const bool is_viscous = memory_rows > 0;
  memset(force, 0, 3 * node_count * sizeof(double));
  Lanes lowest = all(HUGE_VAL);
  with_counts(corners, points, [&](auto n, auto m) {
    Scratch<Vector> local(n), pull(n);
    for (int64_t batch = 0; batch < batches; ++batch) {
      const int32_t* own = nodes + batch * n * kLanes;
      gather(displacement, own, n, local.begin());
      pull.fill(n, Vector{});
      const Lanes lambda = load(lame_lambda + batch * kLanes), mu = load(lame_mu + batch * kLanes);
      Lanes energy{};
      for (int q = 0; q < m; ++q) {
        const double* g = gradients + (batch * m + q) * n * 3 * kLanes;
        const Lanes weight = load(weights + (batch * m + q) * kLanes);
        Matrix F = deformation(local.begin(), g, n), P{};
        const Matrix C = cofactor(F);
        const Lanes det = determinant(F, C);
        lowest = det < lowest ? det : lowest;
        Symmetric E = material == kSmallStrain ? small_strain(F) : green_strain(F);
        if (material == kNeoHooke) {
          const Lanes shear = weight * mu, both = weight * (lambda + mu), change = det - 1.0, pressure = both * change - shear;
          Lanes squares{};
          for (int i = 0; i < 3; ++i) {
            for (int j = 0; j < 3; ++j) P.a[i][j] = shear * F.a[i][j] + pressure * C.a[i][j];
            squares += dot(row(F, i), row(F, i));
          }
          energy += 0.5 * shear * (squares - 3.0) - shear * change + 0.5 * both * change * change;
        } else {
          energy += weight * hooke_energy(E, lambda, mu);
        }
        if (material != kNeoHooke || is_viscous) {
          E = scaled(E, factor);
          if (is_viscous) add_memory(memory, memory_rows, batch, m, q, E);
          if (material == kSmallStrain) F = identity();
          add_product(F, hooke_stress(E, weight * lambda, weight * mu), P);
        }
        add_pull(P, g, n, pull.begin());
      }
      const int64_t count = tet_count - batch * kLanes;
      for (int64_t l = 0; l < count && l < kLanes; ++l) energies[batch * kLanes + l] = energy[l];
      spread(pull.begin(), own, n, count, force);
    }
  });
  return lesser(lesser(lowest[0], lowest[1]), lesser(lowest[2], lowest[3]));
}

// Writes the exact derivative [node_count, 3] [N] of the first tet_count elements' force along a direction.
KERNEL void tangent_times(
    const double* displacement, const double* direction, const double* gradients, const double* weights,
    const double* lame_lambda, const double* lame_mu, const int32_t* nodes, const double* memory, double* product,
    int64_t material, double growth, int64_t tet_count,
    int64_t node_count, int64_t batches, int64_t points, int64_t corners, int64_t memory_rows) {
  const double factor = material == kNeoHooke ? growth - 1.0 : growth;
  const bool is_viscous = memory_rows > 0;
  memset(product, 0, 3 * node_count * sizeof(double));
  with_counts(corners, points, [&](auto n, auto m) {
    Scratch<Vector> local(n), moved(n), pull(n);
    for (int64_t batch = 0; batch < batches; ++batch) {
      const int32_t* own = nodes + batch * n * kLanes;
      gather(displacement, own, n, local.begin());
      gather(direction, own, n, moved.begin());
      pull.fill(n, Vector{});
      const Lanes lambda = load(lame_lambda + batch * kLanes), mu = load(lame_mu + batch * kLanes);
      for (int q = 0; q < m; ++q) {
        const double* g = gradients + (batch * m + q) * n * 3 * kLanes;
        const Lanes weight = load(weights + (batch * m + q) * kLanes);
        const Matrix F = material == kSmallStrain ? identity() : deformation(local.begin(), g, n);
        const Matrix H = gradient(moved.begin(), g, n);
        Matrix P{};
        if (material == kNeoHooke) {
          // dP = mu H + (lambda + mu) (C : H) C + pressure dC.
          const Matrix C = cofactor(F);
          const Lanes shear = weight * mu, both = weight * (lambda + mu), pressure = both * (determinant(F, C) - 1.0) - shear;
          const Lanes change = both * (dot(row(C, 0), row(H, 0)) + dot(row(C, 1), row(H, 1)) + dot(row(C, 2), row(H, 2)));
          for (int i = 0; i < 3; ++i)
            for (int j = 0; j < 3; ++j) {
              const int a = (i + 1) % 3, b = (i + 2) % 3, c = (j + 1) % 3, d = (j + 2) % 3;
              P.a[i][j] = shear * H.a[i][j] + change * C.a[i][j]
                  + pressure * (H.a[a][c] * F.a[b][d] + F.a[a][c] * H.a[b][d] - H.a[a][d] * F.a[b][c] - F.a[a][d] * H.a[b][c]);
            }
        }
        if (material != kNeoHooke || is_viscous) {
          // F is the identity if the material is linear, and E is then zero.
          Symmetric E = scaled(green_strain(F), factor);
          if (is_viscous && material != kSmallStrain) add_memory(memory, memory_rows, batch, m, q, E);
          add_product(H, hooke_stress(E, weight * lambda, weight * mu), P);
          add_product(F, hooke_stress(scaled(strain_change(F, H), factor), weight * lambda, weight * mu), P);
        }
        add_pull(P, g, n, pull.begin());
      }
      spread(pull.begin(), own, n, tet_count - batch * kLanes, product);
    }
  });
}

namespace {
// Writes the six numbers of a point [tet_count, points, 6].
INLINE void put(const Symmetric& e, int64_t batch, int64_t points, int64_t q, int64_t tet_count, double* out) {
  for (int64_t l = 0; l < kLanes && batch * kLanes + l < tet_count; ++l) {
    double* at = out + 6 * ((batch * kLanes + l) * points + q);
    at[0] = e.xx[l]; at[1] = e.yy[l]; at[2] = e.zz[l]; at[3] = e.xy[l]; at[4] = e.xz[l]; at[5] = e.yz[l];
  }
}
}  // namespace

// Writes the strain at each point, [tet_count, points, 6] (00 11 22 01 02 12).
KERNEL void strains(const double* displacement, const double* gradients, const int32_t* nodes, double* out, int64_t material,
                    int64_t /*node_count*/, int64_t batches, int64_t points, int64_t corners, int64_t tet_count) {
  with_counts(corners, points, [&](auto n, auto m) {
    Scratch<Vector> local(n);
    for (int64_t batch = 0; batch < batches; ++batch) {
      gather(displacement, nodes + batch * n * kLanes, n, local.begin());
      for (int q = 0; q < m; ++q) {
        const Matrix F = deformation(local.begin(), gradients + (batch * m + q) * n * 3 * kLanes, n);
        put(material == kSmallStrain ? small_strain(F) : green_strain(F), batch, m, q, tet_count, out);
      }
    }
  });
}

// Writes the derivative of the strains along a direction.
KERNEL void strain_changes(const double* displacement, const double* direction, const double* gradients, const int32_t* nodes,
                           double* out, int64_t material,
                           int64_t /*node_count*/, int64_t batches, int64_t points, int64_t corners, int64_t tet_count) {
  with_counts(corners, points, [&](auto n, auto m) {
    Scratch<Vector> local(n), moved(n);
    for (int64_t batch = 0; batch < batches; ++batch) {
      gather(displacement, nodes + batch * n * kLanes, n, local.begin());
      gather(direction, nodes + batch * n * kLanes, n, moved.begin());
      for (int q = 0; q < m; ++q) {
        const double* g = gradients + (batch * m + q) * n * 3 * kLanes;
        const Matrix F = material == kSmallStrain ? identity() : deformation(local.begin(), g, n);
        put(strain_change(F, gradient(moved.begin(), g, n)), batch, m, q, tet_count, out);
      }
    }
  });
}

// Writes each element's largest principal Green strain [tet_count] of its mean deformation, from
// mean gradients [batches, corners, 3, 4]. `carried` [tet_count, 6] is the strain in the mesh's shape, or has no rows.
KERNEL void largest_principal_strains(const double* displacement, const double* mean_gradients, const int32_t* nodes,
                                      const double* carried, double* out,
                                      int64_t /*node_count*/, int64_t batches, int64_t corners, int64_t carried_rows, int64_t tet_count) {
  with_counts(corners, 1, [&](auto n, auto) {
    Scratch<Vector> local(n);
    for (int64_t batch = 0; batch < batches; ++batch) {
      gather(displacement, nodes + batch * n * kLanes, n, local.begin());
      Symmetric E = green_strain(deformation(local.begin(), mean_gradients + batch * n * 3 * kLanes, n));
      if (carried_rows > 0) add_memory(carried, carried_rows, batch, 1, 0, E);
      const Principal principal(E);
      for (int l = 0; l < kLanes && batch * kLanes + l < tet_count; ++l) out[batch * kLanes + l] = principal.largest(l);
    }
  });
}

// Returns the element whose mean deformation has the largest principal stretch, and writes that stretch [1].
KERNEL int64_t largest_stretch(const double* displacement, const double* mean_gradients, const int32_t* nodes, double* stretch,
                               int64_t /*node_count*/, int64_t batches, int64_t corners) {
  double largest = -1.0;
  int64_t which = 0;
  with_counts(corners, 1, [&](auto n, auto) {
    Scratch<Vector> local(n);
    for (int64_t batch = 0; batch < batches; ++batch) {
      gather(displacement, nodes + batch * n * kLanes, n, local.begin());
      const Principal own(green_strain(deformation(local.begin(), mean_gradients + batch * n * 3 * kLanes, n)));
      const Lanes bound = own.bound();
      for (int l = 0; l < kLanes; ++l) {
        if (!(bound[l] > largest)) continue;
        const double strain = own.largest(l);
        if (strain > largest) {
          largest = strain;
          which = batch * kLanes + l;
        }
      }
    }
  });
  stretch[0] = sqrt(1.0 + 2.0 * largest);
  return which;
}

// Writes the product [rows, 3] of a matrix in compressed rows and a nodal field [columns, 3].
KERNEL void sparse_times(const int32_t* starts, const int32_t* columns, const double* values, const double* field, double* product,
                         int64_t /*starts_count*/, int64_t /*entries*/, int64_t /*field_rows*/, int64_t rows) {
  for (int64_t row = 0; row < rows; ++row) {
    double x = 0.0, y = 0.0, z = 0.0;
    for (int32_t p = starts[row]; p < starts[row + 1]; ++p) {
      const double value = values[p], *at = field + 3 * int64_t{columns[p]};
      x += value * at[0]; y += value * at[1]; z += value * at[2];
    }
    product[3 * row] = x; product[3 * row + 1] = y; product[3 * row + 2] = z;
  }
}
