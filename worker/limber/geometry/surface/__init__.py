"""Closed surfaces: tubes round a skeleton, joined and rounded, checked."""
