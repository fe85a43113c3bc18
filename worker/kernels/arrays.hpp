// numpy's arrays as they lie in memory, for small kernels that Python calls in every step of a control loop:
// they read shapes and strides themselves, which takes a tenth of the time of checks in Python.
#pragma once
#include "lanes.hpp"

// An array behind the head that all objects of Python have, as numpy's C interface keeps it (PyArrayObject).
struct Array {
  double* begin;
  int32_t axes;
  const int64_t* shape;
  const int64_t* strides;
  const void* owner;
  const char* numbers;  // an object too: behind its head and a pointer, the numbers' kind, letter and byte order
  int32_t flags;        // 1: in C order, 1024: writeable
};

// The arguments of one call: `head` is the size of an object's head, whose last word is the object's type. `result`
// is an array of floats in C order that the caller has made: others must be of its type, and of floats, least byte first.
struct Call {
  const char* result;
  int64_t head;

  const Array& array(const char* object) const { return *reinterpret_cast<const Array*>(object + head); }
  double* out() const { return array(result).begin; }
  bool is_array(const char* object) const {
    if (memcmp(object + head - 8, result + head - 8, 8)) return false;
    const char* numbers = array(object).numbers + head + 8;
    return numbers[0] == 'f' && numbers[1] == 'd' && numbers[2] != '>';
  }
  // Whether an array of so many axes lies in C order.
  bool is_whole(const char* object, int32_t axes) const {
    if (!is_array(object) || array(object).axes != axes) return false;
    const Array& from = array(object);
    int64_t step = sizeof(double);
    bool is_whole = true;
    for (int32_t k = axes - 1; k >= 0; step *= from.shape[k--]) is_whole &= from.shape[k] == 1 || from.strides[k] == step;
    return is_whole || step == 0;
  }
  // Copies a vector [count] or matrix [rows, columns] of any strides; false if it is none.
  bool read(const char* object, int64_t count, double* to) const {
    if (!is_array(object)) return false;
    const Array& from = array(object);
    if (from.axes != 1 || from.shape[0] != count) return false;
    for (int64_t k = 0; k < count; ++k) to[k] = at(from, k * from.strides[0]);
    return true;
  }
  bool read(const char* object, int64_t rows, int64_t columns, double* to) const {
    if (!is_array(object)) return false;
    const Array& from = array(object);
    if (from.axes != 2 || from.shape[0] != rows || from.shape[1] != columns) return false;
    for (int64_t i = 0; i < rows; ++i)
      for (int64_t j = 0; j < columns; ++j) to[columns * i + j] = at(from, i * from.strides[0] + j * from.strides[1]);
    return true;
  }

 private:
  static double at(const Array& from, int64_t offset) {
    double value;
    memcpy(&value, reinterpret_cast<const char*>(from.begin) + offset, sizeof value);
    return value;
  }
};
