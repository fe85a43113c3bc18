"""Axes and radii of a skeleton from the points around them."""
