"""Finite elements: shape functions, kernels of force, strain and stiffness."""
