"""Conditions on a path: limits, obstacles, and their checks on the full model and in motion."""
