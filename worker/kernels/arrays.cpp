// What limber.kernels.Kernel checks before each call.
#include "arrays.hpp"

// Whether the first objects of `items` are arrays as `wanted`: their count, the size of an object's head, numpy's type of
// arrays; then of each two letters of its numbers, either of which will do, whether it is written, how many axes it has,
// and of each axis -1 - its size, or where to find it. Writes to `found` where their numbers begin, then the sizes. A size is
// what the first array of its name has; an array without rows may have any other.
KERNEL bool arrays_fit(const int64_t* wanted, const char* const* items, int64_t* found) {
  const int64_t count = wanted[0], head = wanted[1], type = wanted[2];
  const int64_t* own = wanted + 3;
  int64_t known = count;
  for (int64_t k = 0; k < count; ++k) {
    if (memcmp(items[k] + head - 8, &type, 8)) return false;
    const Array& array = *reinterpret_cast<const Array*>(items[k] + head);
    const char* numbers = array.numbers + head + 8;
    if ((numbers[1] != own[0] && numbers[1] != own[1]) || numbers[2] == '>' || array.axes != own[3]) return false;
    if (!(array.flags & 1) || (own[2] && !(array.flags & 1024))) return false;
    found[k] = reinterpret_cast<int64_t>(array.begin);
    own += 4;
    for (int32_t axis = 0; axis < array.axes; ++axis, ++own) {
      const int64_t size = array.shape[axis];
      if (*own == known) found[known++] = size;
      else if (size != (*own < 0 ? -1 - *own : found[*own]) && array.shape[0]) return false;
    }
  }
  return true;
}
