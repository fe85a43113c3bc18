// Rigid transforms that Python calls one at a time; core/rigid.hpp has their units. Each takes arrays as
// arrays.hpp has them and fills its result; it returns whether the arrays have the shapes that it takes.
#include "../arrays.hpp"
#include "rigid.hpp"

namespace {
constexpr double kGravity = 9.80665;  // [m/s^2], limber.core.constants.STANDARD_GRAVITY
}

// The rotation vector [3] of a frame [4, 4] or a rotation matrix [3, 3].
KERNEL bool rotation_vector(const char* frame, const char* turn, int64_t head) {
  const Call call{turn, head};
  double m[16];
  const int wide = call.read(frame, 4, 4, m) ? 4 : 3;
  if (wide == 3 && !call.read(frame, 3, 3, m)) return false;
  rigid::rotation_vector(m, wide, call.out());
  return true;
}

// The frame [4, 4] of a pose [6].
KERNEL bool frame_of(const char* pose, const char* frame, int64_t head) {
  const Call call{frame, head};
  double p[6];
  if (!call.read(pose, 6, p)) return false;
  rigid::frame_of(p, call.out());
  return true;
}

// The pose [6] of a frame [4, 4].
KERNEL bool pose_of(const char* frame, const char* pose, int64_t head) {
  const Call call{pose, head};
  double f[16];
  if (!call.read(frame, 4, 4, f)) return false;
  rigid::pose_of(f, call.out());
  return true;
}

// The inverse of a frame [4, 4].
KERNEL bool inverse_of(const char* frame, const char* inverse, int64_t head) {
  const Call call{inverse, head};
  double f[16];
  if (!call.read(frame, 4, 4, f)) return false;
  rigid::inverse_of(f, call.out());
  return true;
}

// The rotation vector [3] from one pose's [6] rotation to another's.
KERNEL bool turn_between(const char* first, const char* second, const char* turn, int64_t head) {
  const Call call{turn, head};
  double p[6], q[6];
  if (!call.read(first, 6, p) || !call.read(second, 6, q)) return false;
  rigid::turn_between(p, q, call.out());
  return true;
}

// The pose [6] at fraction `part` of a straight line and the shortest rotation.
KERNEL bool pose_between(const char* first, const char* second, double part, const char* pose, int64_t head) {
  const Call call{pose, head};
  double p[6], q[6], turn[6] = {}, turned[16], before[16], frame[16], *out = call.out();
  if (!call.read(first, 6, p) || !call.read(second, 6, q)) return false;
  rigid::turn_between(p, q, turn + 3);
  for (int k = 3; k < 6; ++k) turn[k] *= part;
  rigid::frame_of(turn, turned);
  rigid::frame_of(p, before);
  rigid::product(turned, before, frame);
  for (int k = 0; k < 3; ++k) out[k] = p[k] + part * (q[k] - p[k]);
  rigid::rotation_vector(frame, 4, out + 3);
  return true;
}

// The cross product of two vectors [3].
KERNEL bool crossed(const char* first, const char* second, const char* product, int64_t head) {
  const Call call{product, head};
  double a[3], b[3];
  if (!call.read(first, 3, a) || !call.read(second, 3, b)) return false;
  rigid::crossed(a, b, call.out());
  return true;
}

// The wrench [6] of gravity on a mass [kg] at the flange, flange frame, by the centre of mass there [3] [m] and the
// flange's rotation [3, 3] in a frame with z up.
KERNEL bool weight_wrench(double mass, const char* centre, const char* rotation, const char* wrench, int64_t head) {
  const Call call{wrench, head};
  double c[3], r[9], *out = call.out();
  if (!call.read(centre, 3, c) || !call.read(rotation, 3, 3, r)) return false;
  for (int k = 0; k < 3; ++k) out[k] = -mass * kGravity * r[6 + k];
  rigid::crossed(c, out, out + 3);
  return true;
}

// A wrench [6] in other axes, by the rotation [3, 3] from its own to them, and about another point, from which its
// old one is at `lever` [3] [m] in the new axes.
KERNEL bool turned_wrench(const char* rotation, const char* wrench, const char* lever, const char* result, int64_t head) {
  const Call call{result, head};
  double r[9], w[6], l[3], moment[3], *out = call.out();
  if (!call.read(rotation, 3, 3, r) || !call.read(wrench, 6, w) || !call.read(lever, 3, l)) return false;
  for (int i = 0; i < 3; ++i) {
    out[i] = rigid::dot(r + 3 * i, w);
    out[3 + i] = rigid::dot(r + 3 * i, w + 3);
  }
  rigid::crossed(l, out, moment);
  for (int i = 0; i < 3; ++i) out[3 + i] += moment[i];
  return true;
}
