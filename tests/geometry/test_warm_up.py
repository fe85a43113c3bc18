"""Warming up compiles what surfaces need."""

from limber.geometry.face_crossings import pierced
from limber.geometry.rounded_union import fillet_level
from limber.geometry.surface_distance import _distances
from limber.geometry.warm_up import warm_up


def test_warm_up_compiles_the_surfaces_loops():
    """After it they exist as machine code, each in one form."""
    warm_up()
    for kernel in (pierced, fillet_level, _distances):
        assert len(kernel.signatures) == 1
