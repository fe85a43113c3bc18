"""Experiments that compare planners."""
