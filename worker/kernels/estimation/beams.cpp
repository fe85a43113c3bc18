// The run from base to grasp as a rod that recorded forces bend, section by section from the base on: no equations.
#include "../core/rigid.hpp"

namespace {
// A rotation [3, 3] turned by a vector [3] [rad].
void turn_by(const double* vector, const double* before, double* after) {
  const double pose[6] = {0, 0, 0, vector[0], vector[1], vector[2]};
  double frame[16];
  rigid::frame_of(pose, frame);
  for (int i = 0; i < 3; ++i)
    for (int j = 0; j < 3; ++j)
      after[3 * i + j] = frame[4 * i] * before[j] + frame[4 * i + 1] * before[3 + j] + frame[4 * i + 2] * before[6 + j];
}
}  // namespace

// Of b beams in k frames, from the axis at rest [S + 1, 3] [m], bending stiffness and twist stiffness [b, S] [N m^2],
// force [b, k, 3] [N] and torque [k, 3] [N m] at the grasp [b, k, 3] [m]; the weight [S + 1, 3] [N] from each section on,
// its moment about the origin, `hung` [b, k, S + 1, 3], and that as scanned, `held` [S + 1, 3] [N m]: writes places
// [b, k, S + 1, 3] [m] and rotations [b, k, S + 1, 3, 3]. A section turns by the moment M at its middle, by
// length (M - t t.M) / bending + length t t.M / twist, with its tangent t.
KERNEL void rods_bent(const double* axis, const double* bending, const double* twist, const double* force, const double* torque,
                      const double* grasp, const double* weight, const double* hung, const double* held, double* places,
                      double* turns, int64_t sections, int64_t beams, int64_t elements, int64_t frames) {
  for (int64_t b = 0; b < beams; ++b)
    for (int64_t k = 0; k < frames; ++k) {
      double *place = places + 3 * sections * (frames * b + k), *turned = turns + 9 * sections * (frames * b + k);
      const double *pull = force + 3 * (frames * b + k), *end = grasp + 3 * (frames * b + k);
      const double* hanging = hung + 3 * sections * (frames * b + k);
      for (int i = 0; i < 9; ++i) turned[i] = i % 4 ? 0.0 : 1.0;
      for (int i = 0; i < 3; ++i) place[i] = axis[i];
      for (int64_t s = 0; s < elements; ++s, place += 3, turned += 9) {
        const double* begin = axis + 3 * s;
        const double *below = weight + 3 * s + 3, step[3] = {begin[3] - begin[0], begin[4] - begin[1], begin[5] - begin[2]};
        const double length = sqrt(1e-18 + rigid::dot(step, step)), soft = bending[elements * b + s], round = twist[elements * b + s];
        double half[9], at[3], turn[3];
        memcpy(half, turned, sizeof half);
        memcpy(at, place, sizeof at);
        for (int part = 0; part < 2; ++part) {
          // The moment at the begin leads to the middle, and that there to the end.
          double middle[3], arm[3], pulled[3], hangs[3], stood[3], inside[3], tangent[3];
          for (int i = 0; i < 3; ++i) {
            middle[i] = begin[i] + 0.5 * part * step[i];
            arm[i] = end[i] - at[i];
          }
          rigid::crossed(arm, pull, pulled);
          rigid::crossed(at, below, hangs);
          rigid::crossed(middle, below, stood);
          for (int j = 0; j < 3; ++j) stood[j] = held[3 * s + 3 + j] - stood[j];
          for (int i = 0; i < 3; ++i) {
            inside[i] = pulled[i] + torque[3 * k + i] + hanging[3 * s + 3 + i] - hangs[i] - rigid::dot(half + 3 * i, stood);
            tangent[i] = rigid::dot(half + 3 * i, step) / length;
          }
          const double axial = rigid::dot(inside, tangent);
          for (int i = 0; i < 3; ++i) {
            const double along = axial * tangent[i];
            turn[i] = length * ((inside[i] - along) / soft + along / round);
          }
          // A far too soft one curls up, by a radian in each section at most.
          const double shrink = 0.5 / greater(sqrt(rigid::dot(turn, turn)), 1.0);
          for (int i = 0; i < 3; ++i) turn[i] *= shrink;
          turn_by(turn, turned, half);
          for (int i = 0; i < 3; ++i) at[i] = place[i] + 0.5 * rigid::dot(half + 3 * i, step);
        }
        for (int i = 0; i < 3; ++i) {
          turn[i] *= 2.0;
          place[3 + i] = 2 * at[i] - place[i];
        }
        turn_by(turn, turned, turned + 9);
      }
    }
}
