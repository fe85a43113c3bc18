"""Compiles the loops that are not native yet once, so that no user waits for a compiler."""

import numpy as np

from limber.geometry.skeleton.radii.stations import station_sums
from limber.geometry.skeleton.radii.visible_sides import flatness


def warm_up() -> None:
    """Compile what fits of merged and of noisy scans need."""
    way, size = np.eye(3), np.ones(3)
    station_sums(way, size, way, way, way, size, size[:2], 0.0, 1.0)
    flatness(way, way, way)
