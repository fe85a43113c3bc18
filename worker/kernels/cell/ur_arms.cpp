// The kinematics of an arm of Universal Robots by its Denavit-Hartenberg table [6, 3]: d [m], a [m], twist [rad].
//
// Frames [4, 4] are the controller's: of the base that its pendant shows (not ROS's base_link, which is rotated by 180
// degrees about z) and of the flange. Joint angles [n, 6] are in rad.
#include "../core/rigid.hpp"

namespace {
constexpr double kPi = 3.141592653589793;

// The frame of one joint in the one before it (classic Denavit-Hartenberg).
void link(const double* table, int joint, double angle, double* frame) {
  const double d = table[3 * joint], a = table[3 * joint + 1], twist = table[3 * joint + 2];
  const double c = cos(angle), s = sin(angle), ct = cos(twist), st = sin(twist);
  const double rows[16] = {c, -s * ct, s * st, a * c, s, c * ct, -c * st, a * s, 0, st, ct, d, 0, 0, 0, 1};
  memcpy(frame, rows, sizeof rows);
}

// The frames of all links in the base's, [6, 4, 4].
void chain(const double* table, const double* joints, double* frames) {
  double own[16];
  link(table, 0, joints[0], frames);
  for (int k = 1; k < 6; ++k) {
    link(table, k, joints[k], own);
    rigid::product(frames + 16 * (k - 1), own, frames + 16 * k);
  }
}

// The same angle within half a turn of zero.
double half_turn(double angle) { return angle - 2 * kPi * floor(angle / (2 * kPi) + 0.5); }

// The two elbow solutions [2, 6], with the remaining three parallel joints; nothing where they do not reach.
void solve_plane(const double* table, const double* frame, double q1, double q5, double q6, double* rows) {
  const double a2 = table[4], a3 = table[7];
  double one[16], two[16], end[16], middle[16];
  link(table, 4, q5, one);
  link(table, 5, q6, two);
  rigid::product(one, two, end);
  rigid::inverse_of(end, one);
  rigid::product(frame, one, two);
  link(table, 0, q1, end);
  rigid::inverse_of(end, one);
  rigid::product(one, two, middle);
  // Frame 4 in frame 1: joints 2 to 4 rotate about one direction, its z.
  const double x = middle[3], y = middle[7];
  // Frame 4 follows a twist of a quarter turn: its x axis carries the sum of the angles.
  const double total = atan2(middle[4], middle[0]), far = x * x + y * y;
  double cosine = (far - a2 * a2 - a3 * a3) / (2 * a2 * a3);
  if (fabs(cosine) > 1 + 1e-12) return;
  cosine = lesser(greater(cosine, -1.0), 1.0);
  // (1 - cosine)(1 + cosine) from lengths: no digits are lost near the stretched arm.
  const double both = fabs(a2) + fabs(a3), apart = fabs(a2) - fabs(a3), stretch = both * both - far, fold = far - apart * apart;
  const double sine = sqrt(greater(stretch * fold, 0.0)) / (2 * fabs(a2 * a3));
  for (int elbow = 0; elbow < 2; ++elbow) {
    const double s3 = elbow ? -sine : sine, q3 = atan2(s3, cosine), q2 = atan2(y, x) - atan2(a3 * s3, a2 + a3 * cosine);
    const double solution[6] = {half_turn(q1), half_turn(q2), q3, half_turn(total - q2 - q3), q5, half_turn(q6)};
    memcpy(rows + 6 * elbow, solution, sizeof solution);
  }
}
}  // namespace

// Writes the frames of all six links in the base's [n, 6, 4, 4].
KERNEL void ur_link_frames(const double* table, const double* joints, double* frames, int64_t count) {
  for (int64_t n = 0; n < count; ++n) chain(table, joints + 6 * n, frames + 96 * n);
}

// Writes the flange's Jacobians [n, 6, 6]: speed [m/s] and rotation speed [rad/s] by joint speeds [rad/s].
KERNEL void ur_jacobian(const double* table, const double* joints, double* slopes, int64_t count) {
  double frames[7 * 16] = {1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1};
  for (int64_t n = 0; n < count; ++n) {
    chain(table, joints + 6 * n, frames + 16);
    for (int k = 0; k < 6; ++k) {
      const double* from = frames + 16 * k;
      double axis[3], arm[3], speed[3];
      for (int i = 0; i < 3; ++i) {
        axis[i] = from[4 * i + 2];
        arm[i] = frames[96 + 4 * i + 3] - from[4 * i + 3];
      }
      rigid::crossed(axis, arm, speed);
      for (int i = 0; i < 3; ++i) {
        slopes[36 * n + 6 * i + k] = speed[i];
        slopes[36 * n + 6 * (3 + i) + k] = axis[i];
      }
    }
  }
}

// Writes the distances [n, 3] from the wrist's, the elbow's and the shoulder's singularity, each at most about 1: the
// factors of the Jacobian's determinant. `reach` [m].
KERNEL void ur_singularity_distance(const double* table, const double* joints, double* distances, double reach, int64_t count) {
  for (int64_t n = 0; n < count; ++n) {
    const double* q = joints + 6 * n;
    const double lever = table[4] * cos(q[1]) + table[7] * cos(q[1] + q[2]) + table[12] * sin(q[1] + q[2] + q[3]);
    distances[3 * n] = fabs(sin(q[4]));
    distances[3 * n + 1] = fabs(sin(q[2]));
    distances[3 * n + 2] = fabs(lever) / reach;
  }
}

// Writes all joint angles [n, 8, 6] that bring the flange to frames [n, 4, 4], NaN where there are none; `last` [n]: the
// last joint where the wrist is singular. Analytic solution after Hawkins, "Analytic inverse kinematics for the
// UR-5/UR-10 arms", by arc tangents also for the paper's arc cosines, which lose half of the digits near a singularity.
KERNEL void ur_inverse(const double* table, const double* frames, const double* last, double* solutions, int64_t count) {
  const double d4 = table[9], d6 = table[15];
  for (int64_t n = 0; n < count; ++n) {
    const double* frame = frames + 16 * n;
    double* own = solutions + 48 * n;
    for (int k = 0; k < 48; ++k) own[k] = NAN;
    // The wrist's centre seen from above is at distance d4 from the plane of the arm.
    const double px = frame[3] - d6 * frame[2], py = frame[7] - d6 * frame[6], across = px * px + py * py - d4 * d4;
    if (across < 0.0) continue;
    const double bearing = atan2(py, px), aside = atan2(sqrt(across), d4);
    for (int shoulder = 0; shoulder < 2; ++shoulder) {
      const double q1 = bearing + kPi / 2 + (shoulder ? -aside : aside), s1 = sin(q1), c1 = cos(q1);
      // The flange's axes along the normal of the arm's plane.
      const double along_x = frame[0] * s1 - frame[4] * c1, along_y = frame[1] * s1 - frame[5] * c1;
      const double along_z = frame[2] * s1 - frame[6] * c1, spread = sqrt(along_x * along_x + along_y * along_y);
      for (int wrist = 0; wrist < 2; ++wrist) {
        const double side = wrist ? -1.0 : 1.0, q5 = atan2(side * spread, along_z);
        const double q6 = spread > 1e-9 ? atan2(-side * along_y, side * along_x) : last[n];
        solve_plane(table, frame, q1, q5, q6, own + 6 * (4 * shoulder + 2 * wrist));
      }
    }
  }
}
