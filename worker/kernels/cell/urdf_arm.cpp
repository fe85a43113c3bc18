// The kinematics of a chain of revolute joints.
//
// `origins` [n + 1, 4, 4] are the joints' frames at angle 0, each in that of the previous joint, and the flange's in the
// last one's; `axes` [n, 3] are the joints' unit axes. Angles are in rad, lengths in m.
#include "../core/rigid.hpp"

namespace {
constexpr int kMostSteps = 60;
constexpr double kClose = 1e-11;  // m and rad: a solution
constexpr double kLargestStep = 0.5;  // rad
constexpr double kLeastDamping = 1e-12, kMostDamping = 1e3;

// The frames [n + 1, 4, 4] of the joints and the flange at one pose [n].
void chain(const double* origins, const double* axes, const double* joints, int64_t count, double* frames) {
  for (int64_t k = 0; k <= count; ++k) {
    double own[16];
    memcpy(own, origins + 16 * k, sizeof own);
    if (k < count) {
      const double c = cos(joints[k]), s = sin(joints[k]), v = 1 - c, *axis = axes + 3 * k, x = axis[0], y = axis[1], z = axis[2];
      // Rodrigues.
      const double turn[3][3] = {{c + x * x * v, x * y * v - z * s, x * z * v + y * s},
                                 {y * x * v + z * s, c + y * y * v, y * z * v - x * s},
                                 {z * x * v - y * s, z * y * v + x * s, c + z * z * v}};
      const double* origin = origins + 16 * k;
      for (int i = 0; i < 3; ++i)
        for (int j = 0; j < 3; ++j)
          own[4 * i + j] = origin[4 * i] * turn[0][j] + origin[4 * i + 1] * turn[1][j] + origin[4 * i + 2] * turn[2][j];
    }
    own[12] = own[13] = own[14] = 0.0;
    own[15] = 1.0;
    if (k) rigid::product(frames + 16 * (k - 1), own, frames + 16 * k);
    else memcpy(frames, own, sizeof own);
  }
}

// The flange's Jacobian [6, n] from the frames of one pose.
void slopes_of(const double* axes, const double* frames, int64_t count, double* slopes) {
  const double* flange = frames + 16 * count;
  for (int64_t k = 0; k < count; ++k) {
    const double* from = frames + 16 * k;
    double axis[3], lever[3], speed[3];
    for (int i = 0; i < 3; ++i) {
      axis[i] = rigid::dot(from + 4 * i, axes + 3 * k);
      lever[i] = flange[4 * i + 3] - from[4 * i + 3];
    }
    rigid::crossed(axis, lever, speed);
    for (int i = 0; i < 3; ++i) {
      slopes[count * i + k] = speed[i];
      slopes[count * (3 + i) + k] = axis[i];
    }
  }
}

// Translation [m] and rotation [rad] from the flange to its target, [6].
void off_from(const double* target, const double* flange, double* off) {
  for (int i = 0; i < 3; ++i) off[i] = target[4 * i + 3] - flange[4 * i + 3];
  rigid::turn_of_frames(flange, target, off + 3);
}
}  // namespace

// Writes the frames of the joints and the flange in the base's, [poses, n + 1, 4, 4], at angles [poses, n].
KERNEL void chain_frames(const double* origins, const double* axes, const double* joints, double* frames,
                         int64_t links, int64_t count, int64_t poses) {
  for (int64_t p = 0; p < poses; ++p) chain(origins, axes, joints + count * p, count, frames + 16 * links * p);
}

// Writes the flange's Jacobians [poses, 6, n] from frames [poses, n + 1, 4, 4].
KERNEL void chain_jacobian(const double* axes, const double* frames, double* slopes, int64_t count, int64_t poses, int64_t links) {
  for (int64_t p = 0; p < poses; ++p) slopes_of(axes, frames + 16 * links * p, count, slopes + 6 * count * p);
}

// Writes the angles [k, n] that bring the flange to frames [k, 4, 4] from starts, by Gauss-Newton steps with
// Levenberg-Marquardt damping, J'(J J' + damping)^-1 off; NaN where they do not converge. `is_path`: each is sought from
// the one before, the first from the only start; NaN from the first unreached one on.
KERNEL void chain_solved(const double* origins, const double* axes, const double* frames, const double* starts, double* found,
                         int64_t is_path, int64_t links, int64_t count, int64_t targets, int64_t /*starts*/) {
  Scratch<double> tried(16 * links), slopes(6 * count), guess(count), joints(count), step(count);
  for (int64_t number = 0; number < targets; ++number) {
    const double* target = frames + 16 * number;
    double* own = found + count * number;
    const double* from = is_path && number ? own - count : starts + count * number;
    memcpy(guess.begin(), from, count * sizeof(double));
    for (int64_t k = 0; k < count; ++k) own[k] = NAN;
    if (isnan(guess[0])) continue;
    double damping = 1e-3, least = HUGE_VAL, off[6], off_tried[6];
    for (int round = 0; round < kMostSteps; ++round) {
      chain(origins, axes, guess.begin(), count, tried.begin());
      off_from(target, tried.begin() + 16 * count, off_tried);
      double square = 0.0, most = 0.0;
      for (int i = 0; i < 6; ++i) square += off_tried[i] * off_tried[i];
      if (square < least || !round) {
        memcpy(joints.begin(), guess.begin(), count * sizeof(double));
        memcpy(off, off_tried, sizeof off);
        least = square;
        damping = greater(0.1 * damping, kLeastDamping);
        slopes_of(axes, tried.begin(), count, slopes.begin());
      } else {
        damping *= 10;
      }
      for (int i = 0; i < 6; ++i) most = greater(most, fabs(off[i]));
      if (!(most > kClose)) {
        memcpy(own, joints.begin(), count * sizeof(double));
        break;
      }
      if (!(damping < kMostDamping)) break;
      double matrix[36];
      for (int i = 0; i < 6; ++i)
        for (int j = 0; j < 6; ++j) {
          matrix[6 * i + j] = i == j ? damping : 0.0;
          for (int64_t k = 0; k < count; ++k) matrix[6 * i + j] += slopes[count * i + k] * slopes[count * j + k];
        }
      memcpy(off_tried, off, sizeof off);
      rigid::solve6(matrix, off_tried);
      double largest = 0.0;
      for (int64_t k = 0; k < count; ++k) {
        step[k] = 0.0;
        for (int i = 0; i < 6; ++i) step[k] += slopes[count * i + k] * off_tried[i];
        largest = greater(largest, fabs(step[k]));
      }
      const double part = lesser(1.0, kLargestStep / greater(largest, 1e-12));
      for (int64_t k = 0; k < count; ++k) guess[k] = joints[k] + step[k] * part;
    }
  }
}
