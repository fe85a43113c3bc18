// What the processor can do.
#include "lanes.hpp"
#if defined(__x86_64__)
#include <cpuid.h>
#endif

// Whether the library for x86-64-v3 runs here: AVX2 with its companions, and a system that keeps wide registers.
KERNEL int has_wide_vectors() {
#if defined(__x86_64__)
  unsigned a, b, c, d;
  const unsigned in_1 = bit_FMA | bit_MOVBE | bit_OSXSAVE | bit_AVX | bit_F16C, in_7 = bit_BMI | bit_AVX2 | bit_BMI2;
  if (!__get_cpuid(1, &a, &b, &c, &d) || (c & in_1) != in_1) return 0;
  if (!__get_cpuid_count(7, 0, &a, &b, &c, &d) || (b & in_7) != in_7) return 0;
  if (!__get_cpuid(0x80000001, &a, &b, &c, &d) || !(c & (1u << 5))) return 0;  // LZCNT
  __asm__("xgetbv" : "=a"(a), "=d"(d) : "c"(0));
  return (a & 6) == 6;
#else
  return 0;
#endif
}
