// What all kernels share: numbers of four elements at once, and scratch memory.
//
// Kernels are plain C++20 without its library, so that any compiler builds them in seconds. They
// take pointers to arrays in C order and sizes, and have no state: calls may run at the same time.
// All operations are rounded as they are written (-ffp-contract=off, no fast-math), so that every
// compiler and processor gives the same digits.
#pragma once
#include <math.h>
#include <stdint.h>
#include <stdlib.h>
#include <string.h>

#if defined(_WIN32)
#define KERNEL extern "C" __declspec(dllexport)
#else
#define KERNEL extern "C" __attribute__((visibility("default")))
#endif
#define INLINE inline __attribute__((always_inline))

constexpr int kLanes = 4;

// One number of each of four elements; arithmetic on it reads as that on one.
typedef double Lanes __attribute__((vector_size(8 * kLanes)));
typedef double LanesAnywhere __attribute__((vector_size(8 * kLanes), aligned(8), may_alias));

INLINE Lanes load(const double* from) { return *reinterpret_cast<const LanesAnywhere*>(from); }
INLINE void store(double* to, Lanes x) { *reinterpret_cast<LanesAnywhere*>(to) = x; }
INLINE Lanes all(double x) { return Lanes{x, x, x, x}; }
INLINE double sum(Lanes x) { return (x[0] + x[2]) + (x[1] + x[3]); }
INLINE Lanes root(Lanes x) {
  double each[kLanes];
  store(each, x);
  for (int l = 0; l < kLanes; ++l) each[l] = sqrt(each[l]);
  return load(each);
}

template <class T> INLINE T lesser(T a, T b) { return b < a ? b : a; }
template <class T> INLINE T greater(T a, T b) { return b > a ? b : a; }
// As vectors, of which no compiler makes a branch, which would often be mispredicted.
typedef double Alone __attribute__((vector_size(16)));
template <> INLINE double lesser(double a, double b) {
  const Alone one{a, 0.0}, two{b, 0.0};
  return (two < one ? two : one)[0];
}
template <> INLINE double greater(double a, double b) {
  const Alone one{a, 0.0}, two{b, 0.0};
  return (two > one ? two : one)[0];
}

// Memory of a call, in whole cache lines; without content.
template <class T>
class Scratch {
 public:
  explicit Scratch(int64_t count)
      : memory_(malloc(sizeof(T) * count + 64)),
        begin_(reinterpret_cast<T*>((reinterpret_cast<uintptr_t>(memory_) + 63) & ~uintptr_t{63})) {}
  ~Scratch() { free(memory_); }
  Scratch(const Scratch&) = delete;
  Scratch& operator=(const Scratch&) = delete;
  T& operator[](int64_t k) { return begin_[k]; }
  T* begin() { return begin_; }
  void fill(int64_t count, T value) {
    for (int64_t k = 0; k < count; ++k) begin_[k] = value;
  }

 private:
  void* memory_;
  T* begin_;
};

// A count that the compiler knows.
template <int value>
struct Fixed {
  constexpr operator int() const { return value; }
};
