// The columns of a supernode's front: 3 * nodes of them, each with the supernode's own rows
// (pivots), then those below, each part padded with zeros to whole vectors.
#pragma once
#include "../lanes.hpp"

constexpr int64_t kPad = 8;
INLINE int64_t padded_rows(int64_t rows) { return (rows + kPad - 1) / kPad * kPad; }

struct Front {
  int64_t start, width, pivots, below, padded, height;
  INLINE Front(const int64_t* first, const int64_t* row_start, int64_t s)
      : start(3 * first[s]), width(3 * (first[s + 1] - first[s])), pivots(padded_rows(width)),
        below(3 * (row_start[s + 1] - row_start[s])), padded(padded_rows(below)), height(pivots + padded) {}
};
