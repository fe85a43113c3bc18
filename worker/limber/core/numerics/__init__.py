"""Compiled kernels, sparse solvers and rigid transforms."""
