// Rigid transforms of one pose at a time.
//
// Frames [4, 4] are homogeneous matrices by rows, lengths in m; poses [6] a translation [m] and a rotation
// vector [rad] (Rodrigues); wrenches [6] a force [N] and a torque [N m]. Results may not overlap what they are of.
#pragma once
#include "../lanes.hpp"

namespace rigid {
INLINE double dot(const double* a, const double* b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
INLINE void crossed(const double* a, const double* b, double* out) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

// The rotation vector [3] of a matrix whose rows are `wide` numbers apart: through the quaternion with the
// largest component, which loses no digits near half a turn.
inline void rotation_vector(const double* frame, int wide, double* turn) {
  auto m = [&](int i, int j) { return frame[wide * i + j]; };
  const double squares[4] = {1 + m(0, 0) + m(1, 1) + m(2, 2), 1 + m(0, 0) - m(1, 1) - m(2, 2),
                             1 - m(0, 0) + m(1, 1) - m(2, 2), 1 - m(0, 0) - m(1, 1) + m(2, 2)};
  int largest = 0;
  for (int k = 1; k < 4; ++k)
    if (squares[k] > squares[largest]) largest = k;
  const double part = sqrt(greater(squares[largest], 1e-300));
  const double x = m(2, 1) - m(1, 2), y = m(0, 2) - m(2, 0), z = m(1, 0) - m(0, 1);
  const double xy = m(0, 1) + m(1, 0), xz = m(0, 2) + m(2, 0), yz = m(1, 2) + m(2, 1);
  const double all_q[4][4] = {{part, x / part, y / part, z / part}, {x / part, part, xy / part, xz / part},
                              {y / part, xy / part, part, yz / part}, {z / part, xz / part, yz / part, part}};
  const double* q = all_q[largest];
  const double half = q[0] < 0 ? -0.5 : 0.5, v[3] = {half * q[1], half * q[2], half * q[3]};
  const double sine = sqrt(dot(v, v)), angle = 2 * atan2(sine, half * q[0]);
  const double scale = sine > 1e-12 ? angle / sine : 2.0;
  for (int k = 0; k < 3; ++k) turn[k] = scale * v[k];
}

// The frame of a pose.
inline void frame_of(const double* pose, double* frame) {
  const double x = pose[3], y = pose[4], z = pose[5], angle = sqrt(x * x + y * y + z * z);
  double sine = 1.0, bend = 0.5;
  if (angle > 1e-9) {
    sine = sin(angle) / angle;
    bend = (1 - cos(angle)) / (angle * angle);
  }
  const double cosine = 1 - bend * angle * angle;
  const double rows[16] = {
      cosine + bend * x * x, bend * x * y - sine * z, bend * x * z + sine * y, pose[0],
      bend * x * y + sine * z, cosine + bend * y * y, bend * y * z - sine * x, pose[1],
      bend * x * z - sine * y, bend * y * z + sine * x, cosine + bend * z * z, pose[2], 0, 0, 0, 1};
  memcpy(frame, rows, sizeof rows);
}

inline void pose_of(const double* frame, double* pose) {
  for (int k = 0; k < 3; ++k) pose[k] = frame[4 * k + 3];
  rotation_vector(frame, 4, pose + 3);
}

INLINE void inverse_of(const double* frame, double* out) {
  for (int i = 0; i < 3; ++i) {
    double shift = 0.0;
    for (int j = 0; j < 3; ++j) {
      out[4 * i + j] = frame[4 * j + i];
      shift -= frame[4 * j + i] * frame[4 * j + 3];
    }
    out[4 * i + 3] = shift;
  }
  out[12] = out[13] = out[14] = 0.0;
  out[15] = 1.0;
}

INLINE void product(const double* a, const double* b, double* out) {
  for (int i = 0; i < 4; ++i)
    for (int j = 0; j < 4; ++j) {
      double total = 0.0;
      for (int k = 0; k < 4; ++k) total += a[4 * i + k] * b[4 * k + j];
      out[4 * i + j] = total;
    }
}

// The rotation vector from one frame's or pose's rotation to another's.
inline void turn_of_frames(const double* first, const double* second, double* turn) {
  double back[16], both[16];
  inverse_of(first, back);
  product(second, back, both);
  rotation_vector(both, 4, turn);
}
inline void turn_between(const double* first, const double* second, double* turn) {
  double one[16], two[16];
  frame_of(first, one);
  frame_of(second, two);
  turn_of_frames(one, two, turn);
}

// Replaces `right` [6] by the solution of `matrix` [6, 6], by Gauss's elimination with the largest pivots. The matrix
// is lost; if it is singular, the solution is not finite.
inline void solve6(double* matrix, double* right) {
  for (int k = 0; k < 6; ++k) {
    int best = k;
    for (int i = k + 1; i < 6; ++i)
      if (fabs(matrix[6 * i + k]) > fabs(matrix[6 * best + k])) best = i;
    for (int j = k; best != k && j < 6; ++j) {
      const double own = matrix[6 * k + j];
      matrix[6 * k + j] = matrix[6 * best + j];
      matrix[6 * best + j] = own;
    }
    const double own = right[k];
    right[k] = right[best];
    right[best] = own;
    for (int i = k + 1; i < 6; ++i) {
      const double factor = matrix[6 * i + k] / matrix[6 * k + k];
      for (int j = k + 1; j < 6; ++j) matrix[6 * i + j] -= factor * matrix[6 * k + j];
      right[i] -= factor * right[k];
    }
  }
  for (int k = 5; k >= 0; --k) {
    for (int j = k + 1; j < 6; ++j) right[k] -= matrix[6 * k + j] * right[j];
    right[k] /= matrix[6 * k + k];
  }
}
}  // namespace rigid
