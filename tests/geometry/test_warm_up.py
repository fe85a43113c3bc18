"""Warming up compiles what fits need and is not native."""

from limber.geometry.skeleton.radii.stations import station_sums
from limber.geometry.skeleton.radii.visible_sides import flatness
from limber.geometry.warm_up import warm_up


def test_warm_up_compiles_the_loops():
    """After it they exist as machine code, each in one form."""
    warm_up()
    assert len(station_sums.signatures) == len(flatness.signatures) == 1
