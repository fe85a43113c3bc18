// A surface's faces in a grid of cells: where they cross, and how far points are from them.
#include "../containers.hpp"

namespace {
constexpr double kEdge = 1e-7;  // touching is not crossing: faces of a union meet at rounding distance

struct Crossing { double at[3]; };

// Adds the points where edges of face `one` pass through `other` (Moeller and Trumbore 1997).
void compare(const double* vertices, const int64_t* one, const int64_t* other, Growing<Crossing>& found) {
  const int64_t o = other[0], p = other[1], q = other[2];
  int common = 0, number = 0;  // shared corners, a bit each
  for (int i = 0; i < 3; ++i)
    if (one[i] == o || one[i] == p || one[i] == q) {
      common |= 1 << i;
      ++number;
    }
  if (number > 1) return;
  const double *origin = vertices + 3 * o, *vp = vertices + 3 * p, *vq = vertices + 3 * q;
  const double sx = vp[0] - origin[0], sy = vp[1] - origin[1], sz = vp[2] - origin[2];
  const double ex = vq[0] - origin[0], ey = vq[1] - origin[1], ez = vq[2] - origin[2];
  for (int i = 0; i < 3; ++i) {
    const int after = (i + 1) % 3;
    if (common & (1 << i | 1 << after)) continue;
    const double *a = vertices + 3 * one[i], *b = vertices + 3 * one[after];
    const double dx = b[0] - a[0], dy = b[1] - a[1], dz = b[2] - a[2];
    const double cx = dy * ez - dz * ey, cy = dz * ex - dx * ez, cz = dx * ey - dy * ex;
    const double det = sx * cx + sy * cy + sz * cz;
    const double size = sqrt((sx * sx + sy * sy + sz * sz) * (dx * dx + dy * dy + dz * dz) * (ex * ex + ey * ey + ez * ez));
    if (fabs(det) <= 1e-9 * size) continue;
    const double fx = a[0] - origin[0], fy = a[1] - origin[1], fz = a[2] - origin[2];
    const double u = (fx * cx + fy * cy + fz * cz) / det;
    const double tx = fy * sz - fz * sy, ty = fz * sx - fx * sz, tz = fx * sy - fy * sx;
    const double v = (dx * tx + dy * ty + dz * tz) / det, t = (ex * tx + ey * ty + ez * tz) / det;
    if (u > kEdge && v > kEdge && u + v < 1 - kEdge && kEdge < t && t < 1 - kEdge)
      found.add({{a[0] + t * dx, a[1] + t * dy, a[2] + t * dz}});
  }
}

// Square of the distance of a point from a triangle (Ericson, Real-Time Collision Detection, 5.1.5).
double squared_distance(const double* p, const double* corner) {
  const double bx = corner[3] - corner[0], by = corner[4] - corner[1], bz = corner[5] - corner[2];
  const double cx = corner[6] - corner[0], cy = corner[7] - corner[1], cz = corner[8] - corner[2];
  const double px = p[0] - corner[0], py = p[1] - corner[1], pz = p[2] - corner[2];
  const double d1 = bx * px + by * py + bz * pz, d2 = cx * px + cy * py + cz * pz;
  const double bb = bx * bx + by * by + bz * bz, cc = cx * cx + cy * cy + cz * cz, bc = bx * cx + by * cy + bz * cz;
  // The same products with the point seen from the other two corners.
  const double d3 = d1 - bb, d4 = d2 - bc, d5 = d1 - bc, d6 = d2 - cc;
  const double va = d3 * d6 - d5 * d4, vb = d5 * d2 - d1 * d6, vc = d1 * d4 - d3 * d2;
  double v = 0.0, w = 0.0;
  if (d1 <= 0 && d2 <= 0) {
  } else if (d3 >= 0 && d4 <= d3) {
    v = 1.0;
  } else if (d6 >= 0 && d5 <= d6) {
    w = 1.0;
  } else if (vc <= 0 && d1 >= 0 && d3 <= 0) {
    v = d1 > d3 ? d1 / (d1 - d3) : 0.0;
  } else if (vb <= 0 && d2 >= 0 && d6 <= 0) {
    w = d2 > d6 ? d2 / (d2 - d6) : 0.0;
  } else if (va <= 0 && d4 - d3 >= 0 && d5 - d6 >= 0) {
    const double total = (d4 - d3) + (d5 - d6);
    w = total > 0 ? (d4 - d3) / total : 0.0;
    v = 1.0 - w;
  } else {
    const double total = va + vb + vc;
    v = total > 0 ? vb / total : 0.0;
    w = total > 0 ? vc / total : 0.0;
  }
  const double x = px - v * bx - w * cx, y = py - v * by - w * cy, z = pz - v * bz - w * cz;
  return x * x + y * y + z * z;
}
}  // namespace

// Numbers of the grid cells that the faces' boxes, from cell `first` to `last` [n, 3], overlap, and the
// face in each, [k]. counts [3] is the number of cells in each direction. Where k is 0: only counts them.
KERNEL int64_t cells_of_faces(const int64_t* first, const int64_t* last, const int64_t* counts, int64_t* keys, int64_t* owner,
                              int64_t faces, int64_t room) {
  int64_t at = 0;
  for (int64_t f = 0; f < faces; ++f) {
    const int64_t *a = first + 3 * f, *b = last + 3 * f;
    if (room == 0) {
      at += (b[0] - a[0] + 1) * (b[1] - a[1] + 1) * (b[2] - a[2] + 1);
      continue;
    }
    for (int64_t i = a[0]; i <= b[0]; ++i)
      for (int64_t j = a[1]; j <= b[1]; ++j)
        for (int64_t k = a[2]; k <= b[2]; ++k, ++at) {
          keys[at] = (i * counts[1] + j) * counts[2] + k;
          owner[at] = f;
        }
  }
  return at;
}

// Points [room, 3] [m] where an edge of one face passes through another one; returns how many there are,
// which may be more than the room. Faces have boxes low to high [n, 3] [m] from the cell `first`; keys [k]
// ascend, numbered as above, with the face `owner` in each.
KERNEL int64_t faces_pierced(const double* vertices, const int64_t* faces, const double* low, const double* high,
                             const int64_t* first, const int64_t* counts, const int64_t* keys, const int64_t* owner,
                             double* points, int64_t /*vertices*/, int64_t /*faces*/, int64_t entries, int64_t room) {
  Growing<Crossing> found;
  for (int64_t begin = 0, end; begin < entries; begin = end) {
    end = begin + 1;
    while (end < entries && keys[end] == keys[begin]) ++end;
    for (int64_t i = begin; i < end; ++i)
      for (int64_t j = i + 1; j < end; ++j) {
        const int64_t one = owner[i], other = owner[j], *a = first + 3 * one, *b = first + 3 * other;
        bool is_near = true;
        for (int k = 0; k < 3; ++k)
          is_near = is_near && low[3 * one + k] <= high[3 * other + k] && low[3 * other + k] <= high[3 * one + k];
        // Of all cells that contain both, only the lowest compares them.
        if (is_near && keys[begin] == (greater(a[0], b[0]) * counts[1] + greater(a[1], b[1])) * counts[2] + greater(a[2], b[2])) {
          compare(vertices, faces + 3 * one, faces + 3 * other, found);
          compare(vertices, faces + 3 * other, faces + 3 * one, found);
        }
      }
  }
  for (int64_t k = 0; k < found.count() && k < room; ++k) memcpy(points + 3 * k, found[k].at, sizeof(Crossing));
  return found.count();
}

// Distances [n] of points [n, 3] from faces with corners [f, 3, 3], at most bound [n]; cells as above, of size
// `cell` from `origin` [3] on. [m]
KERNEL void surface_distances(const double* points, const double* bound, const double* corner, const double* origin,
                              const int64_t* counts, const int64_t* keys, const int64_t* owner, double* found,
                              double cell, int64_t count, int64_t /*faces*/, int64_t entries) {
  for (int64_t p = 0; p < count; ++p) {
    double best = bound[p] * bound[p];
    int64_t low[3], high[3];
    for (int k = 0; k < 3; ++k) {
      const double from = points[3 * p + k];
      low[k] = greater(static_cast<int64_t>(floor((from - bound[p] - origin[k]) / cell)), int64_t{0});
      high[k] = lesser(static_cast<int64_t>(floor((from + bound[p] - origin[k]) / cell)), counts[k] - 1);
    }
    for (int64_t i = low[0]; i <= high[0]; ++i)
      for (int64_t j = low[1]; j <= high[1]; ++j) {
        const int64_t row = (i * counts[1] + j) * counts[2];
        int64_t at = 0;
        for (int64_t end = entries; at < end;) {
          const int64_t middle = (at + end) / 2;
          if (keys[middle] < row + low[2]) at = middle + 1; else end = middle;
        }
        for (; at < entries && keys[at] <= row + high[2]; ++at)
          best = lesser(best, squared_distance(points + 3 * p, corner + 9 * owner[at]));
      }
    found[p] = sqrt(best);
  }
}
