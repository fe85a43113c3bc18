"""Branches in the formats of other simulators."""
