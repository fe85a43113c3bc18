"""What a viewport shows of a branch, as arrays."""
