"""Warming up compiles what surfaces need."""

from limber.geometry.surface.distance import _distances
from limber.geometry.surface.face_crossings import pierced
from limber.geometry.surface.rounded_union import fillet_level
from limber.geometry.warm_up import warm_up


def test_warm_up_compiles_the_surfaces_loops():
    """After it they exist as machine code, each in one form."""
    warm_up()
    for kernel in (pierced, fillet_level, _distances):
        assert len(kernel.signatures) == 1
