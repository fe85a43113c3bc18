"""Warming up compiles what fits and surfaces need."""

from limber.geometry.cloud.leaves import _voted
from limber.geometry.skeleton.bridge_kernels import far_sides, nearest_others, priced
from limber.geometry.skeleton.exact_factor import _analysed, _factorised, _solved
from limber.geometry.skeleton.radii.fit_kernels import (
    mean_on_circle,
    nearest_of,
    normal_blocks,
    reach_on_circle,
)
from limber.geometry.skeleton.radii.stations import station_sums
from limber.geometry.skeleton.radii.visible_sides import flatness
from limber.geometry.surface.surface import _distances, pierced
from limber.geometry.warm_up import warm_up


def test_warm_up_compiles_the_loops():
    """After it they exist as machine code, each in one form."""
    warm_up()
    for kernel in (pierced, _distances, nearest_of, normal_blocks, mean_on_circle,
                   reach_on_circle, priced, nearest_others, far_sides, _voted, _analysed,
                   _factorised, _solved, station_sums, flatness):
        assert len(kernel.signatures) == 1
