"""Linear equations of a branch: pattern, factor, solve."""
