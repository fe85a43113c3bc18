// What the virtual robot computes in every step: tool state, servo, and the wrench of the branch that it holds.
#include "../arrays.hpp"
#include "../core/rigid.hpp"

namespace {
constexpr double kFarthest = 0.03;  // m over which a change of the tangent is extrapolated
constexpr int64_t kMostJoints = 32;

// An array's last size.
int64_t last_size(const Call& call, const char* object) {
  const Array& array = call.array(object);
  return call.is_array(object) && array.axes > 0 ? array.shape[array.axes - 1] : -1;
}
}  // namespace

// The tool's pose [m, rad] and speed [m/s, rad/s] in the base's frame, [2, 6], by the flange's frame [4, 4], the Jacobian
// [6, n], joint speeds [n] [rad/s], and the tool's frame in the flange's [4, 4].
KERNEL bool tool_state(const char* flange, const char* slopes, const char* speeds, const char* tool, const char* result, int64_t head) {
  const Call call{result, head};
  double f[16], t[16], tip[16], J[6 * kMostJoints], s[kMostJoints], *pose = call.out(), *motion = pose + 6;
  const int64_t count = last_size(call, speeds);
  if (count > kMostJoints || !call.read(flange, 4, 4, f) || !call.read(tool, 4, 4, t) || !call.read(speeds, count, s)
      || !call.read(slopes, 6, count, J))
    return false;
  rigid::product(f, t, tip);
  for (int i = 0; i < 6; ++i) {
    motion[i] = 0.0;
    for (int64_t k = 0; k < count; ++k) motion[i] += J[count * i + k] * s[k];
  }
  const double lever[3] = {tip[3] - f[3], tip[7] - f[7], tip[11] - f[11]};
  double moved[3];
  rigid::crossed(motion + 3, lever, moved);
  for (int i = 0; i < 3; ++i) motion[i] += moved[i];
  rigid::pose_of(tip, pose);
  return true;
}

// One step [s] of servoj: new joints [rad] and speeds [rad/s], [2, n], with accelerations up to `largest` [rad/s^2]: a
// spring of `gain` [1/s^2] to the target, damped by `lookahead` [s].
KERNEL bool servo_step(const char* joints, const char* speeds, const char* target, double gain, double lookahead, double step,
                       double largest, const char* result, int64_t head) {
  const Call call{result, head};
  const int64_t count = last_size(call, result);
  double q[kMostJoints], v[kMostJoints], to[kMostJoints], *out = call.out();
  if (count > kMostJoints || !call.read(joints, count, q) || !call.read(speeds, count, v) || !call.read(target, count, to))
    return false;
  // Implicit in the speed, so that any gain is stable at 125 Hz as well.
  const double damping = 1 + step * gain * lookahead + step * step * gain;
  for (int64_t k = 0; k < count; ++k) {
    const double wanted = (v[k] + step * gain * (to[k] - q[k])) / damping;
    const double speed = v[k] + lesser(greater(wanted - v[k], -largest * step), largest * step);
    out[count + k] = speed;
    out[k] = q[k] + step * speed;
  }
  return true;
}

// The wrench [6] of a held branch near a solution's frame [4, 4], by its wrench [6], stiffness K [6, 6] [N/m, N/rad,
// N m/rad], and changes of that [n, 6, 6] over displacements [n, 3] [m], of which earlier ones take precedence. `patch`
// [4, 4] is the held one's frame without `compliance` [m/N], which lets it lag: felt = wrench + K (change - c felt).
KERNEL bool steered(const char* frame, const char* wrench, const char* stiffness, const char* directions, const char* bends,
                    const char* patch, double compliance, const char* result, int64_t head) {
  const Call call{result, head};
  double here[16], held[16], known[6], K[36], *felt = call.out();
  if (!call.read(frame, 4, 4, here) || !call.read(patch, 4, 4, held) || !call.read(wrench, 6, known) || !call.read(stiffness, 6, 6, K)
      || !call.is_whole(directions, 2) || !call.is_whole(bends, 3))
    return false;
  const Array &ways = call.array(directions), &changes = call.array(bends);
  const int64_t count = ways.shape[0];
  if (changes.shape[0] != count || ways.shape[1] != 3 || changes.shape[1] != 6 || changes.shape[2] != 6) return false;
  double change[6], at[3];
  for (int i = 0; i < 3; ++i) at[i] = change[i] = held[4 * i + 3] - here[4 * i + 3];
  rigid::turn_of_frames(here, held, change + 3);
  // The stiffness is that of the patch's displacement, which depends on the force.
  for (int round = 0; round < (compliance > 0.0 && count > 0 ? 2 : 1); ++round) {
    double secant[36], left[3], yielding[36];
    memcpy(secant, K, sizeof K);
    memcpy(left, at, sizeof at);
    for (int64_t k = 0; k < count; ++k) {
      const double *way = ways.begin + 3 * k, square = rigid::dot(way, way), most = kFarthest / sqrt(square);
      const double part = lesser(greater(rigid::dot(left, way) / square, -most), most);
      for (int i = 0; i < 36; ++i) secant[i] += 0.5 * part * changes.begin[36 * k + i];
      for (int i = 0; i < 3; ++i) left[i] -= part * way[i];
    }
    for (int i = 0; i < 6; ++i) {
      felt[i] = known[i];
      for (int j = 0; j < 6; ++j) {
        felt[i] += secant[6 * i + j] * change[j];
        yielding[6 * i + j] = (i == j ? 1.0 : 0.0) + (j < 3 ? compliance * secant[6 * i + j] : 0.0);
      }
    }
    rigid::solve6(yielding, felt);
    for (int i = 0; i < 3; ++i) at[i] = change[i] - compliance * felt[i];
  }
  return true;
}
