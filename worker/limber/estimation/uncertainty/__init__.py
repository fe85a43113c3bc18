"""Reliability of an estimate: unknowns in addition to the moduli, intervals, causes."""
