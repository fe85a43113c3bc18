"""Closed surfaces: tubes round a skeleton, united and checked."""
