"""Loads on a branch: its weight and added masses, wind, gusts, snow, fruit, pruning."""
