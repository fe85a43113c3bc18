"""Planners: from the bound's own solution, by random trees, smoothed and refined."""
